"""The texts of the page as HTML."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from html import escape
from typing import Literal

import numpy as np

from ..core.arrays import AnyArray, Array
from ..core.latest_stress import FAULTY, HEALTH_WORDS
from ..core.modes import COMPONENTS
from ..core.status import STATUS
from ..touch.surface import Contact
from ..views import scene
from .moment import Moment

GREEN = "#2b8a3e"
AMBER = "#e67700"
RED = "#c92a2a"
BLUE = "#1864ab"

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

BOX_STYLE = "padding:0 0.8em 0.4em;font-size:0.85em"
"""CSS style of every text on the page: its margins and the size of its letters."""
BAR_STYLE = "height:0.9em;border-radius:3px;background:linear-gradient(to right,{})"
"""CSS style of the bar of colours in the legend; {} stands for a list of colours."""
TICKS_STYLE = "display:flex;justify-content:space-between"
"""CSS style of the numbers below the bar of colours in the legend."""
VALUE_STYLE = "text-align:right;font-family:monospace"
"""CSS style of the cells with numbers in a table."""

PHONE_STYLE = (
    "<style>@media (max-width: 36em) {"
    "[style*='width: 20em'] {width: 100vw !important}"
    "[style*='max-height: 60%'] {max-height: 45% !important}}</style>"
)
"""Style sheet for screens of at most 36em.

viser's panel is 20em wide there and covers the skin. The style makes it as wide as the screen and
limits its height to 45 % of the screen, so that the skin stays visible above it.
"""


@dataclass
class PageStatus:
    """What the page shows besides measured values: links, recording, result of the last action.

    Attributes:
        links: For each link (connection to a hub), one line of text with its name and state, and
            the level of its diagnostics (0 OK, 1 WARN, 2 ERROR, 3 STALE).
        action: Text about the result of the user's last action, such as a tare.
        title: Title of the note with this text.
        colour: Colour of this note.
        recording: Whether a bag is being recorded.
    """

    links: list[tuple[str, int]] = field(default_factory=list)
    action: str = ""
    title: str = ""
    colour: NoteColour = "blue"
    recording: bool = False

    def say(
        self,
        title: str,
        action: str,
        colour: NoteColour = "blue",
    ) -> None:
        """Store the result of an action, which the page shows as a line and as a note.

        Args:
            title: Title of the note.
            action: Text of the line and of the note.
            colour: Colour of the note.
        """
        self.title, self.action, self.colour = title, action, colour


def waiting(domain: str) -> str:
    """Return the text that page and terminal show while no skin is published in a DDS domain."""
    return (
        f"Waiting for a skin: none is published in DDS domain {domain}. "
        "Start one, for example with ./cube demo; it appears here."
    )


def box(content: str) -> str:
    """Return HTML content inside a box with the margins that all texts of the page have."""
    return _div(BOX_STYLE, content)


def label(name: str) -> str:
    """Return the symbol of a component: σzz for the stress zz, ∂σzz/∂x for the gradient zz_x.

    Args:
        name: Name of a component; the name "residual" is returned unchanged.
    """
    if name == "residual":
        return name
    return f"∂σ{name[:2]}/∂{name[3]}" if "_" in name else f"σ{name}"


def unit(name: str) -> tuple[float, str]:
    """Return the unit in which the page shows a component or the residual.

    Returns:
        Size of the unit in SI units, and its name: (1000, "kPa") for a stress.
    """
    if name == "residual":
        return 1.0, "× noise"
    return (1e6, "kPa/mm") if "_" in name else (1e3, "kPa")


def value(quantity: scene.Quantity, si_value: float) -> str:
    """Return text with the label of a quantity, its value and its unit; "unknown" for NaN.

    Args:
        quantity: The quantity, which has a label and a unit for users.
        si_value: Its value in SI units, which is converted to the unit for users.
    """
    if np.isnan(si_value):
        return "unknown"
    return f"{quantity.label} {_hundredths(si_value / quantity.size)} {quantity.unit}"


def surface_pressure(pressure: float, sigma: float) -> str:
    """Return text in kPa for a pressure on the surface of the skin.

    Args:
        pressure: The pressure, in Pa; NaN if it is unknown.
        sigma: Its standard deviation, in Pa.
    """
    if np.isnan(pressure):
        return "on the surface unknown"
    deviation = "unknown" if np.isnan(sigma) else f"{sigma / 1e3:.2f}"
    return f"on the surface {_hundredths(pressure / 1e3)} ± {deviation} kPa"


def clock(seconds: float) -> str:
    """Return a duration in seconds as text, such as "12.3 s" or "3 min 12.3 s"."""
    minutes, rest = divmod(round(seconds, 1), 60)
    return f"{minutes:.0f} min {rest:.1f} s" if minutes else f"{rest:.1f} s"


def newtons(contact: Contact) -> str:
    """Return normal and shear force of a contact as text in N.

    The shear force is left out if it is unknown (NaN), because no cube observes shear.
    """
    shear = "" if np.isnan(contact.shear_force) else f", shear {contact.shear_force:.2f} N"
    return f"{contact.normal_force:.2f} N{shear}"


def headline(
    health: AnyArray,
    hertz: float,
    contact: Contact | None,
    paused: bool,
    recording: bool,
) -> str:
    """Return the first line of the page as HTML: state, live cubes, rate, force.

    Args:
        health: (N,) health of the cubes (fine, doubtful, faulty or stale), coded as in
            core/latest_stress.py.
        hertz: Number of rows (measurements) per second of the fastest cube.
        contact: The contact with the largest force; None without a load.
        paused: Whether the page or the replay is stopped.
        recording: Whether a bag is being recorded.
    """
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
        f"{hertz:.0f} Hz",
        "no load" if contact is None else newtons(contact).replace(" ", "&nbsp;"),
    ]
    if recording:
        parts.append(f"<b style='color:{RED}'>● recording</b>")
    return box(" · ".join(parts))


def action_line(action: str) -> str:
    """Return a text about the user's last action as HTML, or an empty text if there was none."""
    return box(escape(action)) if action else ""


def no_deviation() -> str:
    """Return the text that replaces the legend of the standard deviation while it is unknown."""
    return box(
        "Everything is grey: the standard deviation is known only while the node <i>contacts</i> "
        "runs with <i>method:=inverse</i>."
    )


def legend(quantity: scene.Quantity, top: float) -> str:
    """Return the legend of a quantity as HTML: a bar of its colours with numbers and unit.

    Args:
        quantity: The quantity that the colours show.
        top: Value at the upper end of the bar, in SI units.
    """
    values = np.linspace(-top if quantity.signed else 0, top, LEGEND_STEPS)
    colours = (255 * scene.colours(quantity, values, top)).astype(int).tolist()
    stops = ",".join(f"rgb({red},{green},{blue})" for red, green, blue in colours)
    middle = (LEGEND_STEPS - 1) // 2
    ticks = "".join(f"<span>{value / quantity.size:.3g}</span>" for value in values[::middle])
    meaning = f"{quantity.label} in {quantity.unit}; grey: unknown"
    bar = _div(BAR_STYLE.format(stops), "")
    return box(bar + _div(TICKS_STYLE, ticks) + _div("text-align:center", meaning))


def explanation(
    bar: float,
    stress: float,
    gradient: float,
    sigma: Array | None,
) -> str:
    """Return HTML that explains the symbols of the 3-D view and the lengths of its arrows.

    Args:
        bar: Length of the scale bar beside the skin, in metres.
        stress: Traction, in Pa, whose arrow is as long as the bar.
        gradient: Gradient, in Pa/m, whose arrow is as long as the bar.
        sigma: Standard deviation of the pressure (M,) on the surface, in Pa; None if the field is
            only interpolated between the cubes.
    """
    long = f"as long as the bar ({1e3 * bar:g} mm):"
    arrows = [
        ("#282c34", f"traction on the upper face, {long} <b>{stress / 1e3:.3g} kPa</b>"),
        ("#1969d2", f"pressure grows this way, {long} <b>{gradient / 1e6:.3g} kPa/mm</b>"),
    ]
    lines = [f"<div><b style='color:{colour}'>➜</b> {text}</div>" for colour, text in arrows]
    lines += [
        f"<div><b>▦</b> {_field_source(sigma)}</div>",
        "<div><b>◯</b> the chosen cube; click another one to choose it</div>",
        "<div>principal stresses: <b style='color:#d22828'>red</b> pulls, "
        "<b style='color:#2850dc'>blue</b> pushes</div>",
        "<div><b>✕</b> over a cube: see <i>health</i>. Axes: x red, y green, z blue</div>",
    ]
    return box("".join(lines))


def _field_source(sigma: Array | None) -> str:
    if sigma is None:
        return "field: interpolated between the cubes, at their depth"
    known = sigma[np.isfinite(sigma)]
    # The standard deviation differs from point to point; the text gives the median.
    typical = f", ±&nbsp;{np.median(known) / 1e3:.2g}&nbsp;kPa" if len(known) else ""
    return f"field: on the surface, from the node <i>contacts</i>{typical}"


def numbers(moment: Moment, cube: int, hertz: float) -> str:
    """Return an HTML table of a cube's observed components, residual, rate and state.

    Args:
        moment: Values of all cubes.
        cube: Index of the cube.
        hertz: Number of rows (measurements) per second of the cube.
    """
    rows = []
    for name, si_value in zip(COMPONENTS, moment.values[cube], strict=True):
        size, unit_name = unit(name)
        if np.isfinite(si_value):
            rows.append((label(name), f"{si_value / size:+.3f}", unit_name))
    rows.append(("residual", f"{moment.residual[cube]:.2f}", "× noise"))
    rows.append(("rate", f"{hertz:.0f}", "Hz"))
    rows.append(("state", _state(moment.status[cube], moment.health[cube]), ""))
    return box(_table(rows))


def _hundredths(number: float) -> str:
    # Adding 0.0 turns -0.0 into 0.0, so that no "-0.00" is printed.
    return f"{round(number, 2) + 0.0:.2f}"


def _state(status: int, health: int) -> str:
    words = [name.lower().replace("_", " ") for name, bit in STATUS.items() if status & bit]
    return ", ".join(words) or HEALTH_WORDS[health]


def conditions(names: list[str], health: AnyArray, links: list[tuple[str, int]]) -> str:
    """Return HTML about the health of a skin: links, number of cubes per state, cubes with a fault.

    Args:
        names: Names of the N cubes.
        health: (N,) health of the cubes (fine, doubtful, faulty or stale), coded as in
            core/latest_stress.py.
        links: Line of text and level of the diagnostics of each link (connection to a hub).
    """
    counts = ", ".join(
        f"{np.count_nonzero(health == state)} {word}" for state, word in enumerate(HEALTH_WORDS)
    )
    with_fault = np.flatnonzero(health)[:MAX_LISTED_CUBES].tolist()
    rows = [(names[cube], HEALTH_WORDS[health[cube]], "") for cube in with_fault]
    lines = "".join(
        _div(f"color:{LEVEL_COLOURS[level]}", escape(line)) for line, level in [*links, (counts, 0)]
    )
    return box(lines + _table(rows))


def _div(style: str, content: str) -> str:
    return f"<div style='{style}'>{content}</div>"


def _table(rows: Iterable[tuple[str, str, str]]) -> str:
    """Return an HTML table of rows with three cells each: name, value and unit."""
    cells = "".join(
        f"<tr><td>{name}</td><td style='{VALUE_STYLE}'>{value}</td><td>&nbsp;{unit}</td></tr>"
        for name, value, unit in rows
    )
    return f"<table style='width:100%;line-height:1.35'>{cells}</table>"
