"""What the page of the browser view says, as HTML."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from html import escape

import numpy as np

from ..core import scene
from ..core.modes import COMPONENTS
from ..core.scene import Newest
from ..core.status import STATUS
from ..elastic.surface import Contact

GREEN, AMBER, RED, YELLOW = "#51cf66", "#ffa94d", "#ff6b6b", "#ffd43b"
MOST_ROWS = 20
"""Of cubes that are not fine; the counts hold all."""


@dataclass
class Facts:
    """What the page says beside the skin: lines about the links, about the last action, whether a
    bag is written."""

    links: list[str] = field(default_factory=list)
    action: str = ""
    recording: bool = False


def box(content: str) -> str:
    return f"<div style='padding:0 0.8em 0.4em;font-size:0.85em'>{content}</div>"


def label(name: str) -> str:
    """A component as people write it: zz_x is ∂zz/∂x."""
    return f"∂{name[:2]}/∂{name[3]}" if "_" in name else name


def newtons(contact: Contact) -> str:
    shear = "" if np.isnan(contact.shear_force) else f", shear {contact.shear_force:.2f} N"
    return f"{contact.normal_force:.2f} N{shear}"


def head(
    health: np.ndarray, hertz: float, contact: Contact | None, paused: bool, recording: bool
) -> str:
    live = int(np.count_nonzero(health < scene.FAULTY))
    dot, word = (
        (GREEN, "live")
        if live == len(health)
        else (AMBER, "not all cubes")
        if live
        else (RED, "no data")
    )
    if paused:
        dot, word = YELLOW, "paused"
    parts = [
        f"<span style='color:{dot}'>⬤</span> <b>{word}</b>",
        f"{live} of {len(health)} cubes",
        f"{hertz:.0f} Hz",
    ]
    parts.append("no load" if contact is None else newtons(contact))
    if recording:
        parts.append(f"<b style='color:{RED}'>● recording</b>")
    return box(" · ".join(parts))


def legend(quantity: scene.Quantity, top: float) -> str:
    values = np.linspace(-top if quantity.signed else 0, top, 9)
    colours = (255 * scene.colours(quantity, values, top)).astype(int).tolist()
    stops = ",".join(f"rgb({red},{green},{blue})" for red, green, blue in colours)
    ticks = "".join(f"<span>{value / quantity.size:.3g}</span>" for value in values[::4])
    return box(
        f"<div style='height:0.9em;border-radius:3px;background:linear-gradient(to right,{stops})'></div>"
        f"<div style='display:flex;justify-content:space-between'>{ticks}</div>"
        f"<div style='text-align:center'>{quantity.label} in {quantity.unit}; grey: not observed</div>"
    )


def numbers(newest: Newest, cube: int, health: int, hertz: float) -> str:
    """One cube's components with units, residual, rate and state."""
    rows = []
    for name, value in zip(COMPONENTS, newest.values[cube], strict=True):
        size, unit = (1e6, "kPa/mm") if "_" in name else (1e3, "kPa")
        if np.isfinite(value):
            rows.append((label(name), f"{value / size:+.3f}", unit))
    words = [
        name.lower().replace("_", " ") for name, bit in STATUS.items() if newest.status[cube] & bit
    ]
    rows += [("residual", f"{newest.residual[cube]:.2f}", "σ"), ("rate", f"{hertz:.0f}", "Hz")]
    rows.append(("state", ", ".join(words) or scene.HEALTH[health], ""))
    return box(_table(rows))


def conditions(names: list[str], health: np.ndarray, links: list[str]) -> str:
    """The links, how many cubes are how, and which are not fine."""
    counts = ", ".join(
        f"{np.count_nonzero(health == k)} {word}" for k, word in enumerate(scene.HEALTH)
    )
    bad = [
        (names[i], scene.HEALTH[health[i]], "") for i in np.flatnonzero(health)[:MOST_ROWS].tolist()
    ]
    lines = "".join(f"<div>{escape(line)}</div>" for line in [*links, counts])
    return box(lines + _table(bad))


def _table(rows: Iterable[tuple[str, str, str]]) -> str:
    cells = "".join(
        f"<tr><td>{name}</td><td style='text-align:right;font-family:monospace'>{value}</td><td>&nbsp;{unit}</td></tr>"
        for name, value, unit in rows
    )
    return f"<table style='width:100%;line-height:1.35'>{cells}</table>"
