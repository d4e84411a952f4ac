"""The live table of a skin in a terminal."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.live import Live
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from ...config.skin import Skin
from ...core.modes import COMPONENTS
from ...core.rows import StressRows
from ...core.status import STATUS

REFRESH_S = 0.1
"""How often the table is drawn."""
RATE_S = 1.0
"""Over how long rates are counted."""
SHOWN = ("xx", "zz", "zx", "yz", "zz_x", "zz_y", "zz_z")
"""Components with a column where a cube observes them: normal stress, shear on the skin's surface,
the gradient of the pressure."""
UNOBSERVED = "·"
BAR = 12
"""Length of the bar of the largest pressure."""
PEAK_DECAY = 0.99
"""Per drawing, of the pressure that a full bar shows."""
OTHER_LINES = 8
"""Of the terminal, which are not rows of cubes."""
WIDEST = 1000
"""Columns to measure the table's own width with."""


@dataclass(frozen=True)
class _Form:
    """What the table has beside names, rates and states, which it always has."""

    components: tuple[str, ...]
    has_bar: bool = True
    has_residual: bool = True
    has_lines: bool = True


def _forms(components: Sequence[str]) -> Iterator[_Form]:
    """From the widest to the narrowest."""
    names = tuple(components)
    yield _Form(names)
    # Without lines a planar skin fits into 80 columns.
    yield _Form(names, has_lines=False)
    for n in range(len(names), 0, -1):
        yield _Form(names[:n], has_bar=False, has_lines=False)
    yield _Form((), has_bar=False, has_lines=False)
    yield _Form((), has_bar=False, has_residual=False, has_lines=False)


class LiveTable:
    """Last tensor and rate of each cube, drawn ten times a second; a context that gives the
    terminal back."""

    def __init__(self, skin: Skin, show: bool) -> None:
        n = len(skin.cubes)
        self.note = ""
        self._skin = skin
        self._values = np.full((n, len(COMPONENTS)), np.nan)
        self._residual = np.full(n, np.nan)
        self._status = np.zeros(n, np.uint16)
        self._count = np.zeros(n, int)
        self._rate = np.full(n, np.nan)
        self._rate_count = self._count.copy()
        self._rate_at = time.monotonic()
        self._peak = 0.0
        self._drawn_at = 0.0
        self._console = Console(stderr=True)
        self._live = Live(console=self._console, auto_refresh=False) if show else None

    def __enter__(self) -> LiveTable:
        if self._live:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live:
            self._live.stop()
            if not self._console.is_terminal:
                # There rich leaves the last line open, and what follows would stand in it.
                self._console.line()

    @property
    def seen(self) -> int:
        """Number of cubes that have had a tensor."""
        return int(np.count_nonzero(self._count))

    @property
    def seen_all(self) -> bool:
        return self.seen == len(self._count)

    def update(self, rows: StressRows) -> None:
        """Take the rows of a stress message; of several rows of a cube the last stays."""
        cube = rows.cube
        self._values[cube, :6], self._values[cube, 6:] = rows.stress, rows.gradient
        self._residual[cube], self._status[cube] = rows.residual, rows.status
        np.add.at(self._count, cube, 1)

    def refresh(self) -> None:
        """Count rates and draw, when it is time to."""
        now = time.monotonic()
        if now - self._rate_at >= RATE_S:
            self._rate = (self._count - self._rate_count) / (now - self._rate_at)
            self._rate_count, self._rate_at = self._count.copy(), now
        if self._live and now - self._drawn_at >= REFRESH_S:
            self._drawn_at = now
            rows = max(4, self._console.height - OTHER_LINES)
            self._live.update(self.draw(rows, self._console.width), refresh=True)

    def draw(self, most: int, width: int) -> Table:
        """The table for a terminal of `width` columns.

        Of more than `most` cubes it shows those under the greatest normal stress. In a narrow
        terminal it leaves out lines, the bar, and components from the last on.
        """
        pressure = np.nan_to_num(-self._values[:, 2])
        self._peak = max(self._peak * PEAK_DECAY, float(pressure.max()), 1.0)
        shown = np.arange(len(pressure))
        caption = None
        if len(shown) > most:
            shown = np.sort(np.argsort(-np.abs(pressure), kind="stable")[:most])
            caption = f"the {most} cubes under the greatest normal stress of {len(pressure)}"
        components = [name for name in SHOWN if np.isfinite(self._component(name)).any()]
        table = Table()
        for form in _forms(components):
            table = self._table(form, shown, pressure)
            table.caption = caption
            options = self._console.options.update(max_width=WIDEST)
            if Measurement.get(self._console, options, table).maximum <= width:
                break
        return table

    def _table(self, form: _Form, shown: NDArray[np.intp], pressure: NDArray[np.float64]) -> Table:
        """The table of the cubes `shown`."""
        table = self._empty_table(form)
        for number in shown.tolist():
            cells: list[str | Text] = [self._skin.cubes[number].name]
            if form.has_bar:
                part = min(1.0, max(0.0, pressure[number] / self._peak))
                cells.append(Text("█" * int(BAR * part), "blue"))
            for name in form.components:
                cells.append(_in_kpa(name, self._component(name)[number]))
            if form.has_residual:
                cells.append(_number(self._residual[number], ".2f"))
            cells += [_number(self._rate[number], ".0f"), self._state(number)]
            table.add_row(*cells)
        return table

    def _empty_table(self, form: _Form) -> Table:
        cubes = len(self._count)
        count = f"{cubes} {'cube' if cubes == 1 else 'cubes'}"
        title = f"skin {self._skin.name!r}: {count}. Tension is positive; "
        table = Table(title=f"{title}{UNOBSERVED} is not observed{self.note}")
        if not form.has_lines:
            table.box, table.padding, table.show_edge = SIMPLE_HEAD, (0, 0), False
        table.add_column("cube")
        if form.has_bar:
            table.add_column("pressure", width=BAR)
        for name in form.components:
            label, unit = name, "kPa"
            if is_gradient(name):
                label, unit = f"∂{name[:2]}/∂{name[3]}", "kPa/mm"
            table.add_column(f"{label}\n{unit}", justify="right", min_width=7)
        if form.has_residual:
            table.add_column("residual", justify="right")
        table.add_column("Hz", justify="right", min_width=4)
        table.add_column("state")
        return table

    def _component(self, name: str) -> NDArray[np.float64]:
        """Of all cubes, Pa or Pa/m."""
        return self._values[:, COMPONENTS.index(name)]

    def _state(self, number: int) -> Text:
        """Words of the status bits that are set."""
        bits = self._status[number]
        words = [word.lower().replace("_", " ") for word, bit in STATUS.items() if bits & bit]
        if words:
            return Text(", ".join(words), "red")
        return Text("ok" if self._count[number] else "waiting", "green")


def is_gradient(component: str) -> bool:
    """zz_x is the slope of zz along x."""
    return "_" in component


def _in_kpa(component: str, value: float) -> str:
    """Pa in kPa, Pa/m in kPa/mm."""
    scale = 1e-6 if is_gradient(component) else 1e-3
    return _number(value * scale, "+.2f")


def _number(value: float, form: str) -> str:
    return UNOBSERVED if np.isnan(value) else f"{value:{form}}"
