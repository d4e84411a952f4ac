"""The texts of the page as HTML."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from html import escape

import numpy as np
from numpy.typing import NDArray

from ..core import scene
from ..core.modes import COMPONENTS
from ..core.scene import Newest
from ..core.status import STATUS
from ..elastic.surface import Contact

GREEN, AMBER, RED, YELLOW = "#51cf66", "#ffa94d", "#ff6b6b", "#ffd43b"
MOST_ROWS = 20
"""Of cubes that are not fine; beside them the page tells how many there are."""
LEGEND_STEPS = 9

BOX_STYLE = "padding:0 0.8em 0.4em;font-size:0.85em"
BAR_STYLE = "height:0.9em;border-radius:3px;background:linear-gradient(to right,{})"
TICKS_STYLE = "display:flex;justify-content:space-between"
VALUE_STYLE = "text-align:right;font-family:monospace"


@dataclass
class PageStatus:
    """What the page says about other things than the rows.

    links: a line for each link. action: what became of the last thing that was asked for.
    recording: whether a bag is being written.
    """

    links: list[str] = field(default_factory=list)
    action: str = ""
    recording: bool = False


def waiting(domain: str) -> str:
    """What page and terminal say while nothing publishes a skin. domain: of DDS."""
    return (
        f"Waiting for a skin: none is published in DDS domain {domain}. "
        "Start one, for example with ./cube demo; it appears here."
    )


def box(content: str) -> str:
    """Content with the margins that all texts of the page have."""
    return _div(BOX_STYLE, content)


def label(name: str) -> str:
    """A component as people write it: ∂zz/∂x for zz_x."""
    return f"∂{name[:2]}/∂{name[3]}" if "_" in name else name


def newtons(contact: Contact) -> str:
    """The forces of a contact; without shear if the cubes observe none."""
    shear = "" if np.isnan(contact.shear_force) else f", shear {contact.shear_force:.2f} N"
    return f"{contact.normal_force:.2f} N{shear}"


def headline(
    health: NDArray[np.integer],
    hertz: float,
    contact: Contact | None,
    paused: bool,
    recording: bool,
) -> str:
    """The first line: does it run, how many cubes, how fast, how hard it is pressed."""
    live = int(np.count_nonzero(health < scene.FAULTY))
    if paused:
        dot, word = YELLOW, "paused"
    elif live == len(health):
        dot, word = GREEN, "live"
    elif live:
        dot, word = AMBER, "not all cubes"
    else:
        dot, word = RED, "no data"
    parts = [
        f"<span style='color:{dot}'>⬤</span> <b>{word}</b>",
        f"{live} of {len(health)} cubes",
        f"{hertz:.0f} Hz",
        "no load" if contact is None else newtons(contact),
    ]
    if recording:
        parts.append(f"<b style='color:{RED}'>● recording</b>")
    return box(" · ".join(parts))


def action_line(action: str) -> str:
    """What became of the last thing that was asked for; empty if nothing was."""
    return box(escape(action)) if action else ""


def legend(quantity: scene.Quantity, top: float) -> str:
    """The bar of colours with its range; top: SI."""
    values = np.linspace(-top if quantity.signed else 0, top, LEGEND_STEPS)
    colours = (255 * scene.colours(quantity, values, top)).astype(int).tolist()
    stops = ",".join(f"rgb({red},{green},{blue})" for red, green, blue in colours)
    middle = (LEGEND_STEPS - 1) // 2
    ticks = "".join(f"<span>{value / quantity.size:.3g}</span>" for value in values[::middle])
    meaning = f"{quantity.label} in {quantity.unit}; grey: not observed"
    bar = _div(BAR_STYLE.format(stops), "")
    return box(bar + _div(TICKS_STYLE, ticks) + _div("text-align:center", meaning))


def numbers(newest: Newest, cube: int, health: int, hertz: float) -> str:
    """The observed components of a cube, its residual, rate and state."""
    rows = []
    for name, value in zip(COMPONENTS, newest.values[cube], strict=True):
        size, unit = (1e6, "kPa/mm") if "_" in name else (1e3, "kPa")
        if np.isfinite(value):
            rows.append((label(name), f"{value / size:+.3f}", unit))
    rows.append(("residual", f"{newest.residual[cube]:.2f}", "σ"))
    rows.append(("rate", f"{hertz:.0f}", "Hz"))
    rows.append(("state", _state(newest.status[cube], health), ""))
    return box(_table(rows))


def _state(status: int, health: int) -> str:
    words = [name.lower().replace("_", " ") for name, bit in STATUS.items() if status & bit]
    return ", ".join(words) or scene.HEALTH[health]


def conditions(names: list[str], health: NDArray[np.integer], links: list[str]) -> str:
    """The state of the links, how many cubes are in which state, and which are not fine."""
    counts = ", ".join(
        f"{np.count_nonzero(health == state)} {word}" for state, word in enumerate(scene.HEALTH)
    )
    not_fine = np.flatnonzero(health)[:MOST_ROWS].tolist()
    rows = [(names[cube], scene.HEALTH[health[cube]], "") for cube in not_fine]
    lines = "".join(f"<div>{escape(line)}</div>" for line in [*links, counts])
    return box(lines + _table(rows))


def _div(style: str, content: str) -> str:
    return f"<div style='{style}'>{content}</div>"


def _table(rows: Iterable[tuple[str, str, str]]) -> str:
    """Rows of name, value and unit."""
    cells = "".join(
        f"<tr><td>{name}</td><td style='{VALUE_STYLE}'>{value}</td><td>&nbsp;{unit}</td></tr>"
        for name, value, unit in rows
    )
    return f"<table style='width:100%;line-height:1.35'>{cells}</table>"
