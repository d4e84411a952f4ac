"""The live table of a skin in a terminal: newest tensor, rate and state of each cube."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.live import Live
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from ...config.skin import Skin
from ...core.arrays import Array, Index
from ...core.modes import COMPONENTS, STRESS
from ...core.rows import StressRows
from ...core.status import STATUS

DRAW_PERIOD_S = 0.1
"""Time, in seconds, from one drawing of the table to the next."""

RATE_PERIOD_S = 1.0
"""Time, in seconds, over which the rates are counted."""

SHOWN = ("xx", "zz", "zx", "yz", "zz_x", "zz_y", "zz_z")
"""Components with a column, where a cube observes them: normal stress, shear on the surface of the
skin, and the gradient of the pressure."""

UNOBSERVED = "·"
"""What stands in place of a value that is not observed."""

BAR_WIDTH = 12
"""Width, in columns, of the bar of the largest pressure."""

PEAK_DECAY = 0.99
"""Share of the pressure of a full bar that is kept from one drawing to the next."""

MIN_PEAK = 1.0
"""Smallest pressure of a full bar, in Pa; it avoids a division by zero."""

OTHER_LINES = 8
"""Number of lines of the terminal that are no rows of cubes: title, headings, frame, prompt."""

MIN_ROWS = 4
"""Number of rows that are drawn even in a very low terminal."""

UNLIMITED_WIDTH = 1000
"""Width, in columns, with which the own width of the table is measured."""


@dataclass(frozen=True)
class _Form:
    """The columns and lines of a table, apart from names, rates and states, which it always has."""

    components: tuple[str, ...]
    has_bar: bool = True
    has_residual: bool = True
    has_lines: bool = True


def _forms(components: Sequence[str]) -> Iterator[_Form]:
    """Yield the possible forms, from the widest to the narrowest."""
    names = tuple(components)
    yield _Form(names)
    # Without lines, a planar skin fits into 80 columns.
    yield _Form(names, has_lines=False)
    for n in range(len(names), 0, -1):
        yield _Form(names[:n], has_bar=False, has_lines=False)
    yield _Form((), has_bar=False, has_lines=False)
    yield _Form(
        (),
        has_bar=False,
        has_residual=False,
        has_lines=False,
    )


class LiveTable:
    """Draws the table on stderr ten times a second; a context manager that gives the terminal back.

    Attributes:
        note: Text behind the title.
    """

    def __init__(self, skin: Skin, show: bool) -> None:
        """show: whether to draw; without it the table only counts."""
        n = len(skin.cubes)
        self.note = ""
        self._skin = skin
        self._values = np.full((n, len(COMPONENTS)), np.nan)
        self._residual = np.full(n, np.nan)
        self._status = np.zeros(n, np.uint16)
        self._count = np.zeros(n, int)
        self._rate = np.full(n, np.nan)
        self._rate_count = self._count.copy()
        self._rate_s = time.monotonic()
        self._peak = 0.0
        self._drawn_s = 0.0
        self._console = Console(stderr=True)
        self._live = Live(console=self._console, auto_refresh=False) if show else None

    def __enter__(self) -> LiveTable:
        if self._live:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live:
            self._live.stop()
            # Where it is no terminal, rich does not end the last line.
            if not self._console.is_terminal:
                self._console.line()

    @property
    def seen(self) -> int:
        """Number of cubes of which a tensor has arrived."""
        return int(np.count_nonzero(self._count))

    @property
    def seen_all(self) -> bool:
        """Whether a tensor of each cube has arrived."""
        return self.seen == len(self._count)

    def update(self, rows: StressRows) -> None:
        """Add the rows of a message of stress; of several rows of a cube the last one is shown."""
        if not self._count.any():
            # The first tensors are drawn at once.
            self._drawn_s = 0.0
        cube = rows.cube
        self._values[cube, : len(STRESS)] = rows.stress
        self._values[cube, len(STRESS) :] = rows.gradient
        self._residual[cube], self._status[cube] = rows.residual, rows.status
        # `add.at` counts each row where a cube occurs several times in a message.
        np.add.at(self._count, cube, 1)

    def refresh(self) -> None:
        """Count rates and draw the table, if it is time to."""
        now_s = time.monotonic()
        if now_s - self._rate_s >= RATE_PERIOD_S:
            self._rate = (self._count - self._rate_count) / (now_s - self._rate_s)
            self._rate_count, self._rate_s = self._count.copy(), now_s
        if self._live and now_s - self._drawn_s >= DRAW_PERIOD_S:
            self._drawn_s = now_s
            max_rows = max(MIN_ROWS, self._console.height - OTHER_LINES)
            self._live.update(self.draw(max_rows, self._console.width), refresh=True)

    def draw(self, max_rows: int, width: int) -> Table:
        """Make the table for a terminal of `width` columns.

        Of more than `max_rows` cubes those under the largest normal stress are shown. In a narrow
        terminal the lines, the bar, and components from the last one on are left out.
        """
        # Pressure is compression, which is negative stress.
        pressure = np.nan_to_num(-self._values[:, COMPONENTS.index("zz")])
        self._peak = max(self._peak * PEAK_DECAY, float(pressure.max()), MIN_PEAK)
        shown = np.arange(len(pressure))
        caption = None
        if len(shown) > max_rows:
            by_size = np.argsort(-np.abs(pressure), kind="stable")
            # The rows stay in the order of the skin file.
            shown = np.sort(by_size[:max_rows])
            caption = f"the {max_rows} cubes under the greatest normal stress of {len(pressure)}"

        components = [name for name in SHOWN if np.isfinite(self._component(name)).any()]
        options = self._console.options.update(max_width=UNLIMITED_WIDTH)
        table = Table()
        for form in _forms(components):
            # The width depends on the content, so each form is made and measured.
            table = self._table(form, shown, pressure)
            table.caption = caption
            if Measurement.get(self._console, options, table).maximum <= width:
                break
        return table

    def _table(
        self,
        form: _Form,
        shown: Index,
        pressure: Array,
    ) -> Table:
        """Make the table of some cubes.

        Args:
            form: Its columns.
            shown: (K,) indices of the cubes.
            pressure: (N,) pressure on all cubes, in Pa.
        """
        table = self._empty_table(form)
        for number in shown.tolist():
            cells: list[str | Text] = [self._skin.cubes[number].name]
            if form.has_bar:
                share = min(1.0, max(0.0, pressure[number] / self._peak))
                cells.append(Text("█" * int(BAR_WIDTH * share), "blue"))
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
            table.add_column("pressure", width=BAR_WIDTH)
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

    def _component(self, name: str) -> Array:
        """Return a component of all cubes (N,), in Pa or Pa/m."""
        return self._values[:, COMPONENTS.index(name)]

    def _state(self, number: int) -> Text:
        """Return the status bits of a cube that are set, in words."""
        bits = self._status[number]
        words = [word.lower().replace("_", " ") for word, bit in STATUS.items() if bits & bit]
        if words:
            return Text(", ".join(words), "red")
        return Text("ok" if self._count[number] else "waiting", "green")


def is_gradient(component: str) -> bool:
    """Return whether a component is a gradient, such as zz_x, the derivative of zz along x."""
    return "_" in component


def _in_kpa(component: str, value: float) -> str:
    """Return Pa as kPa, and Pa/m as kPa/mm."""
    scale = 1e-6 if is_gradient(component) else 1e-3
    return _number(value * scale, "+.2f")


def _number(value: float, form: str) -> str:
    return UNOBSERVED if np.isnan(value) else f"{value:{form}}"
