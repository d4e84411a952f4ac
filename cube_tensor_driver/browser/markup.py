"""The texts of the page as HTML."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from html import escape
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import Array
from ..core.latest_stress import FAULTY, HEALTH_WORDS
from ..core.modes import COMPONENTS
from ..core.status import STATUS
from ..touch.surface import Contact
from ..views import scene
from .moment import Moment

GREEN, AMBER, RED, BLUE = "#2b8a3e", "#e67700", "#c92a2a", "#1864ab"
NoteColour = Literal["blue", "green", "red"]
MOST_ROWS = 20
"""Of cubes that are not fine; beside them the page tells how many there are."""
LEGEND_STEPS = 9

BOX_STYLE = "padding:0 0.8em 0.4em;font-size:0.85em"
BAR_STYLE = "height:0.9em;border-radius:3px;background:linear-gradient(to right,{})"
TICKS_STYLE = "display:flex;justify-content:space-between"
VALUE_STYLE = "text-align:right;font-family:monospace"
PHONE_STYLE = (
    "<style>@media (max-width: 36em) {"
    "[style*='width: 20em'] {width: 100vw !important}"
    "[style*='max-height: 60%'] {max-height: 45% !important}}</style>"
)
"""viser's sheet for narrow screens is 20em wide and covers the skin: all of the width, but low."""


@dataclass
class PageStatus:
    """What the page says about other things than the rows.

    links: a line for each link. action: what became of the last thing that was asked for, with a
    title and colour for a note. recording: whether a bag is being written.
    """

    links: list[str] = field(default_factory=list)
    action: str = ""
    title: str = ""
    colour: NoteColour = "blue"
    recording: bool = False

    def say(self, title: str, action: str, colour: NoteColour = "blue") -> None:
        self.title, self.action, self.colour = title, action, colour


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
    """A component as people write it: ∂σzz/∂x for zz_x."""
    if name == "residual":
        return name
    return f"∂σ{name[:2]}/∂{name[3]}" if "_" in name else f"σ{name}"


def unit(name: str) -> tuple[float, str]:
    """Size in SI, and name, of the unit in which a component or the residual is shown."""
    if name == "residual":
        return 1.0, "× noise"
    return (1e6, "kPa/mm") if "_" in name else (1e3, "kPa")


def value(quantity: scene.Quantity, shown: float) -> str:
    """A quantity of one cube, SI, with its unit."""
    if np.isnan(shown):
        return "unknown"
    return f"{quantity.label} {_hundredths(shown / quantity.size)} {quantity.unit}"


def surface_pressure(pressure: float, sigma: float) -> str:
    """The pressure on the surface, Pa, with its standard deviation; NaN: unknown."""
    if np.isnan(pressure):
        return "on the surface unknown"
    deviation = "unknown" if np.isnan(sigma) else f"{sigma / 1e3:.2f}"
    return f"on the surface {_hundredths(pressure / 1e3)} ± {deviation} kPa"


def clock(seconds: float) -> str:
    """12.3 s; or 3 min 12.3 s."""
    minutes, rest = divmod(round(seconds, 1), 60)
    return f"{minutes:.0f} min {rest:.1f} s" if minutes else f"{rest:.1f} s"


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
    live = int(np.count_nonzero(health < FAULTY))
    if paused:
        dot, word = BLUE, "paused"
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
        "no load" if contact is None else newtons(contact).replace(" ", "&nbsp;"),
    ]
    if recording:
        parts.append(f"<b style='color:{RED}'>● recording</b>")
    return box(" · ".join(parts))


def action_line(action: str) -> str:
    """What became of the last thing that was asked for; empty if nothing was."""
    return box(escape(action)) if action else ""


def no_deviation() -> str:
    """Instead of the legend of the standard deviation, where there is none."""
    return box(
        "Everything is grey: the standard deviation is known only while the node <i>contacts</i> "
        "runs with <i>method:=inverse</i>."
    )


def legend(quantity: scene.Quantity, top: float) -> str:
    """The bar of colours with its range; top: SI."""
    values = np.linspace(-top if quantity.signed else 0, top, LEGEND_STEPS)
    colours = (255 * scene.colours(quantity, values, top)).astype(int).tolist()
    stops = ",".join(f"rgb({red},{green},{blue})" for red, green, blue in colours)
    middle = (LEGEND_STEPS - 1) // 2
    ticks = "".join(f"<span>{value / quantity.size:.3g}</span>" for value in values[::middle])
    meaning = f"{quantity.label} in {quantity.unit}; grey: unknown"
    bar = _div(BAR_STYLE.format(stops), "")
    return box(bar + _div(TICKS_STYLE, ticks) + _div("text-align:center", meaning))


def explanation(bar: float, stress: float, gradient: float, sigma: Array | None) -> str:
    """What is drawn, and how long arrows are. bar: length of the scale bar, m. stress, Pa, and
    gradient, Pa/m: of arrows as long as the bar. sigma: of the field, as in SurfaceField."""
    long = f"as long as the bar ({1e3 * bar:g} mm):"
    lines = [
        ("#282c34", f"traction on the upper face, {long} <b>{stress / 1e3:.3g} kPa</b>"),
        ("#1969d2", f"pressure grows this way, {long} <b>{gradient / 1e6:.3g} kPa/mm</b>"),
    ]
    rows = "".join(f"<div><b style='color:{colour}'>➜</b> {text}</div>" for colour, text in lines)
    rows += f"<div><b>▦</b> {_field(sigma)}</div>"
    rows += "<div><b>◯</b> the chosen cube; click another one to choose it</div>"
    rows += "<div>principal stresses: <b style='color:#d22828'>red</b> pulls, "
    rows += "<b style='color:#2850dc'>blue</b> pushes</div>"
    rows += "<div><b>✕</b> over a cube: see <i>health</i>. Axes: x red, y green, z blue</div>"
    return box(rows)


def _field(sigma: Array | None) -> str:
    if sigma is None:
        return "field: interpolated between the cubes, at their depth"
    known = sigma[np.isfinite(sigma)]
    typical = f", ±&nbsp;{np.median(known) / 1e3:.2g}&nbsp;kPa" if len(known) else ""
    return f"field: on the surface, from the node <i>contacts</i>{typical}"


def numbers(moment: Moment, cube: int, hertz: float) -> str:
    """The observed components of a cube, its residual, rate and state."""
    rows = []
    for name, shown in zip(COMPONENTS, moment.values[cube], strict=True):
        size, unit_name = unit(name)
        if np.isfinite(shown):
            rows.append((label(name), f"{shown / size:+.3f}", unit_name))
    rows.append(("residual", f"{moment.residual[cube]:.2f}", "× noise"))
    rows.append(("rate", f"{hertz:.0f}", "Hz"))
    rows.append(("state", _state(moment.status[cube], moment.health[cube]), ""))
    return box(_table(rows))


def _hundredths(number: float) -> str:
    """0.00 for -0.001, too."""
    return f"{round(number, 2) + 0.0:.2f}"


def _state(status: int, health: int) -> str:
    words = [name.lower().replace("_", " ") for name, bit in STATUS.items() if status & bit]
    return ", ".join(words) or HEALTH_WORDS[health]


def conditions(names: list[str], health: NDArray[np.integer], links: list[str]) -> str:
    """The state of the links, how many cubes are in which state, and which are not fine."""
    counts = ", ".join(
        f"{np.count_nonzero(health == state)} {word}" for state, word in enumerate(HEALTH_WORDS)
    )
    not_fine = np.flatnonzero(health)[:MOST_ROWS].tolist()
    rows = [(names[cube], HEALTH_WORDS[health[cube]], "") for cube in not_fine]
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
