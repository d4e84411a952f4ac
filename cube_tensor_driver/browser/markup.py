# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The texts of the page as HTML."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from html import escape
from typing import Literal

import numpy as np

from ..core.arrays import Array
from ..core.latest_stress import FAULTY, HEALTH_WORDS
from ..core.modes import COMPONENTS
from ..core.status import describe_status
from ..touch.surface import Contact
from ..views import scene
from .scan import Scan
from .surface_field import DEVIATION, SurfaceField

GREEN = "#2b8a3e"
"""Colour of the dot at the beginning of the page's headline while all cubes send usable samples."""
AMBER = "#e67700"
"""Colour of the dot at the beginning of the page's headline while only some cubes send usable
samples, and of warnings about a link."""
RED = "#c92a2a"
"""Colour of the dot at the beginning of the page's headline while no cube sends usable samples, of
errors of a link, and of the sign of a running recording."""
BLUE = "#1864ab"
"""Colour of the dot at the beginning of the page's headline while page or replay is paused."""

LEVEL_COLOURS = ("inherit", AMBER, RED, RED)
"""Colour of the text about a link for each level of its diagnostics: OK, WARN, ERROR and STALE."""

NoteColour = Literal["blue", "green", "red"]
"""Names of the colours that a note to the user can have, as viser calls them."""

MAX_LISTED_CUBES = 20
"""Maximum number of cubes with a fault that the page lists by name.

The number of all cubes in each state of health stands above the list.
"""

LEGEND_STEPS = 9
"""Number of colours of the legend's bar, between which the browser interpolates.

It is odd, so that one colour is that of the middle of the range.
"""

NO_DEVIATION = (
    "Everything is grey: the standard deviation is known only while the node <i>contacts</i> "
    "runs with <i>method:=inverse</i>."
)
"""Text that replaces the legend of the standard deviation of the pressure while it is unknown."""

BOX_STYLE = "padding:0 0.8em 0.4em;font-size:0.85em"
"""CSS style of every text on the page: its margins and the size of its letters."""
BAR_STYLE = "height:0.9em;border-radius:3px;background:linear-gradient(to right,{})"
"""CSS style of the bar of colours in the legend; {} stands for a list of colours."""
TICKS_STYLE = "display:flex;justify-content:space-between"
"""CSS style of the numbers below the bar of colours in the legend."""
VALUE_STYLE = "text-align:right;font-family:monospace"
"""CSS style of the cells with numbers in a table."""

STYLE = (
    "<style>"
    ".tabler-icon-cloud-check {display: none}"
    ".mantine-Notification-root {font-size: 0.8em; padding: 0.3em 0.6em 0.3em 1.6em}"
    "@media (max-width: 36em) {"
    ".mantine-Notification-description {display: none}"
    "[style*='width: 20em'] {width: 100vw !important}"
    "[style*='max-height: 60%'] {max-height: 45% !important}}</style>"
)
"""Style sheet of the page.

It hides the green tick of viser's connection, which users would take for the state of the skin. It
makes notes small, so that they cover little of the skin. On a screen of at most 36em a note
shows only its title. viser's panel is 20em wide there and covers the skin; the style makes it as
wide as the screen and limits its height to 45 % of the screen, so that the skin stays visible.
"""


@dataclass
class PageStatus:
    """What the page shows besides measured values: recording, and the result of the last action.

    Attributes:
        title: Result of the user's last action in a few words, such as "tare done"; empty before.
        detail: Further text about this result.
        colour: Colour of the note that shows both.
        recording: Whether a bag is being recorded.
    """

    title: str = ""
    detail: str = ""
    colour: NoteColour = "blue"
    recording: bool = False

    @property
    def action(self) -> str:
        """Title and detail as one line."""
        return f"{self.title}: {self.detail}" if self.title else ""

    def say(
        self,
        title: str,
        detail: str,
        colour: NoteColour,
    ) -> None:
        """Store the result of an action, which the page shows as a line and as a note.

        Args:
            title: The result in a few words.
            detail: Further text about it.
            colour: Colour of the note.
        """
        self.title, self.detail, self.colour = title, detail, colour


def describe_waiting(domain: str) -> str:
    """Return the text that page and terminal show while no skin is published in a DDS domain."""
    return (
        f"Waiting for a skin: none is published in {domain}. "
        "Start one, for example with ./cube demo; it appears here."
    )


def put_in_box(content: str) -> str:
    """Return HTML content inside a box with the margins that all texts of the page have."""
    return _make_div(BOX_STYLE, content)


def format_label(name: str) -> str:
    """Return the symbol of a component: σzz for the stress zz, ∂σzz/∂x for the gradient zz_x.

    Args:
        name: Name of a component; the name "residual" is returned unchanged.
    """
    if name == "residual":
        return name
    return f"∂σ{name[:2]}/∂{name[3]}" if "_" in name else f"σ{name}"


def format_clock(seconds: float) -> str:
    """Return a duration in seconds as text, such as "12.3 s" or "3 min 12.3 s"."""
    minutes, rest = divmod(round(seconds, 1), 60)
    return f"{minutes:.0f} min {rest:.1f} s" if minutes else f"{rest:.1f} s"


def format_newtons(contact: Contact) -> str:
    """Return normal and shear force of a contact as text in N, and whether it slips.

    A shear force that is unknown (NaN), because no cube measures shear, is left out. "~" marks
    forces that are integrals of the pressure field, until a fit of the contact gives better ones.
    """
    about = "~" if contact.is_coarse else ""
    shear = "" if np.isnan(contact.shear_force) else f", shear {contact.shear_force:.2f} N"
    slips = ", slips" if contact.slips else ""
    return f"{about}{contact.normal_force:.2f} N{shear}{slips}"


def make_headline(
    scan: Scan,
    paused: bool,
    recording: bool,
) -> str:
    """Return the headline of the page as HTML.

    It states whether samples arrive, the number of cubes that send usable ones, the sampling rate
    of the fastest cube, and the forces of the strongest contact.

    Args:
        scan: Values of all cubes at the instant that is shown.
        paused: Whether the page or the replay is stopped.
        recording: Whether a bag is being recorded.
    """
    health = scan.health
    live = int(np.count_nonzero(health < FAULTY))
    if paused:
        colour, word = BLUE, "paused"
    elif live == len(health):
        colour, word = GREEN, "live"
    elif live:
        colour, word = AMBER, "not all cubes"
    else:
        colour, word = RED, "no data"
    parts = [
        f"<span style='color:{colour}'>⬤</span> <b>{word}</b>",
        f"{live} of {len(health)} cubes",
        f"{scan.rate.max():.0f} Hz",
        format_newtons(scan.contacts[0]).replace(" ", "&nbsp;") if scan.contacts else "no load",
    ]
    if recording:
        parts.append(f"<b style='color:{RED}'>● recording</b>")
    return put_in_box(" · ".join(parts))


def make_legend(
    quantity: scene.Quantity,
    top: float,
    field: SurfaceField,
) -> str:
    """Return the legend of a quantity as HTML: a bar of its colours with numbers and unit.

    Args:
        quantity: The quantity that the colours show.
        top: Value at the upper end of the bar, in SI units.
        field: Pressure and shear on the surface. If the quantity is the standard deviation of the
            pressure and it is unknown (`field.sigma` is None), the text `NO_DEVIATION` is returned.
    """
    if quantity is DEVIATION and field.sigma is None:
        return put_in_box(NO_DEVIATION)
    values = np.linspace(-top if quantity.signed else 0, top, LEGEND_STEPS)
    fractions = scene.choose_colours(quantity, values, top)
    colours = (255 * fractions).astype(int).tolist()
    stops = ",".join(f"rgb({red},{green},{blue})" for red, green, blue in colours)
    middle = (LEGEND_STEPS - 1) // 2
    ticks = "".join(f"<span>{value / quantity.size:.3g}</span>" for value in values[::middle])
    meaning = f"{quantity.label} in {quantity.unit}; grey: unknown"
    bar = _make_div(BAR_STYLE.format(stops), "")
    return put_in_box(bar + _make_div(TICKS_STYLE, ticks) + _make_div("text-align:center", meaning))


def make_explanation(
    bar: float,
    stress: float,
    gradient: float,
    field: SurfaceField,
) -> str:
    """Return HTML that explains the symbols of the 3-D view and the lengths of its arrows.

    Args:
        bar: Length of the scale bar beside the skin, in metres.
        stress: Traction, in Pa, whose arrow is as long as the bar.
        gradient: Gradient, in Pa/m, whose arrow is as long as the bar.
        field: Pressure and shear on the surface.
    """
    long = f"as long as the bar ({1e3 * bar:g} mm):"
    arrows = [
        ("#282c34", f"traction on the upper face, {long} <b>{stress / 1e3:.3g} kPa</b>"),
        ("#1969d2", f"pressure grows this way, {long} <b>{gradient / 1e6:.3g} kPa/mm</b>"),
    ]
    lines = [f"<div><b style='color:{colour}'>➜</b> {text}</div>" for colour, text in arrows]
    lines += [
        f"<div><b>▦</b> field: {field.source}{_find_typical(field.sigma)}</div>",
        "<div><b>⌜⌟</b> the chosen cube; click another one to choose it</div>",
        "<div><b style='color:#c828a0'>◯</b> contacts; the first line has the strongest</div>",
        "<div><b>┼</b> principal stresses: <b style='color:#d22828'>red</b> pulls, "
        "<b style='color:#2850dc'>blue</b> pushes</div>",
        "<div><b>✕</b> over a cube: see <i>health</i>. Axes: x red, y green, z blue</div>",
    ]
    return put_in_box("".join(lines))


def _find_typical(sigma: Array | None) -> str:
    """Return the median of the standard deviation of the pressure as text, such as ", ± 0.1 kPa".

    Args:
        sigma: (M,) standard deviation at the points of the surface, in Pa; None if it is unknown.
    """
    if sigma is None:
        return ""
    known = sigma[np.isfinite(sigma)]
    return f", ±&nbsp;{np.median(known) / 1e3:.2g}&nbsp;kPa" if len(known) else ""


def make_numbers_table(scan: Scan, cube: int, above: Array | None) -> str:
    """Return an HTML table of a cube's observed components, residual, sampling rate and state.

    Args:
        scan: Values of all cubes.
        cube: Index of the cube.
        above: (2,) pressure on the surface above the cube and its standard deviation, in Pa; None
            or NaN if they are unknown.
    """
    rows = []
    for name, si_value in zip(COMPONENTS, scan.values[cube], strict=True):
        size, unit = scene.find_component_unit(name)
        if np.isfinite(si_value):
            rows.append((format_label(name), f"{si_value / size:+.3f}", unit))
    if above is not None and np.isfinite(above).all():
        pressure, deviation = 1e-3 * above
        rows.append(("on the surface", f"{pressure:.2f} ± {deviation:.2f}", "kPa"))
    rows.append(("residual", f"{scan.residual[cube]:.2f}", "× noise"))
    rows.append(("rate", f"{scan.rate[cube]:.0f}", "Hz"))
    status = describe_status(scan.status[cube])
    state = status or HEALTH_WORDS[scan.health[cube]]
    rows.append(("state", state, ""))
    return put_in_box(_make_table(rows))


def make_contacts_table(scan: Scan) -> str:
    """Return an HTML table of the position and the forces of each contact, strongest first."""
    rows = []
    for contact in scan.contacts:
        x, y, z = 1e3 * contact.position
        rows.append((f"{x:.1f}, {y:.1f}, {z:.1f} mm", format_newtons(contact), ""))
    return put_in_box(_make_table(rows) if rows else "none")


def describe_conditions(names: list[str], scan: Scan) -> str:
    """Return HTML about the health of a skin: links, number of cubes per state, cubes with a fault.

    Args:
        names: Names of the N cubes.
        scan: The health of the cubes and the state of the links.
    """
    health = scan.health
    counts = ", ".join(
        f"{np.count_nonzero(health == state)} {word}" for state, word in enumerate(HEALTH_WORDS)
    )
    with_fault = np.flatnonzero(health)[:MAX_LISTED_CUBES].tolist()
    rows = [(names[cube], HEALTH_WORDS[health[cube]], "") for cube in with_fault]
    lines = "".join(
        _make_div(f"color:{LEVEL_COLOURS[level]}", escape(line))
        for line, level in (*scan.links, (counts, 0))
    )
    return put_in_box(lines + _make_table(rows))


def _make_div(style: str, content: str) -> str:
    return f"<div style='{style}'>{content}</div>"


def _make_table(rows: Iterable[tuple[str, str, str]]) -> str:
    """Return an HTML table of rows with three cells each: name, value and unit."""
    cells = "".join(
        f"<tr><td>{name}</td><td style='{VALUE_STYLE}'>{value}</td><td>&nbsp;{unit}</td></tr>"
        for name, value, unit in rows
    )
    return f"<table style='width:100%;line-height:1.35'>{cells}</table>"
