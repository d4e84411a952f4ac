# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The live table of a skin in a terminal: latest tensor, rate and state of each cube."""

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
from .output import counted

DRAW_PERIOD_S = 0.1
"""Minimum time, in seconds, from one drawing of the table to the next."""

RATE_PERIOD_S = 1.0
"""Minimum time, in seconds, over which the rows of each cube are counted to compute its rate."""

SHOWN = ("xx", "zz", "zx", "yz", "zz_x", "zz_y", "zz_z")
"""Names of the components that have a column if at least one cube observes them.

They are normal stresses, the shear stresses at the surface of the skin, and the gradient of σzz.
"""

UNOBSERVED = "·"
"""Character that the table shows instead of a value that is not observed (NaN)."""

BAR_WIDTH = 12
"""Width, in characters, of the longest bar in the column for the pressure."""

PEAK_DECAY = 0.99
"""Ratio of the pressure of a full bar to that in the drawing before, while the pressures on the
skin are smaller: the scale of the bars shrinks by 1 % per drawing."""

MIN_PEAK = 1.0
"""Minimum pressure, in Pa, of a full bar; it avoids a division by zero without load."""

OTHER_LINES = 8
"""Number of lines of the terminal that are needed for title, headings, frame and prompt, and are
not available for rows of cubes."""

MIN_ROWS = 4
"""Minimum number of rows (cubes) in the table, even if the terminal has fewer lines."""

UNLIMITED_WIDTH = 1000
"""Width, in characters, that rich is given while it computes how wide the table would like to be.

It is larger than any table, so that it does not limit the result.
"""


@dataclass(frozen=True)
class _Form:
    """A layout of the table: its optional columns, and whether it has lines.

    The columns for names, rates and states are in every layout.
    """

    components: tuple[str, ...]
    has_bar: bool = True
    has_residual: bool = True
    has_lines: bool = True


def _forms(components: Sequence[str]) -> Iterator[_Form]:
    """Yield the possible layouts of the table, from the widest to the narrowest.

    Args:
        components: Names of the components that have a column in the widest layout.
    """
    names = tuple(components)
    yield _Form(names)
    # Without lines, the table of a skin of planar cubes is not wider than 80 characters.
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
    """Draws the table on stderr up to ten times a second.

    It is a context manager, which restores the terminal at its exit.

    Attributes:
        note: Text that is appended to the title of the table.
    """

    def __init__(self, skin: Skin, show: bool) -> None:
        """Prepare an empty table.

        Args:
            skin: The skin whose cubes are shown.
            show: Whether to draw the table; otherwise it only counts rows.
        """
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
            # If stderr is not a terminal, rich does not end the last line.
            if not self._console.is_terminal:
                self._console.line()

    @property
    def is_on_terminal(self) -> bool:
        """Whether the table is drawn on a terminal, where it is updated."""
        return self._live is not None and self._console.is_terminal

    @property
    def seen(self) -> int:
        """Number of cubes from which at least one tensor has arrived."""
        return int(np.count_nonzero(self._count))

    @property
    def seen_all(self) -> bool:
        """Whether at least one tensor has arrived from every cube."""
        return self.seen == len(self._count)

    def update(self, rows: StressRows) -> None:
        """Store the rows of a stress message, which the next `refresh` shows.

        Of several rows of one cube, the last one is shown.
        """
        if not self._count.any():
            # The next `refresh` draws the first tensors without waiting for `DRAW_PERIOD_S`.
            self._drawn_s = 0.0
        cube = rows.cube
        self._values[cube, : len(STRESS)] = rows.stress
        self._values[cube, len(STRESS) :] = rows.gradient
        self._residual[cube], self._status[cube] = rows.residual, rows.status
        # If a cube occurs several times in a message, `+=` would count it only once.
        np.add.at(self._count, cube, 1)

    def refresh(self) -> None:
        """Compute the rates and draw the table, each if its period is over."""
        now_s = time.monotonic()
        if now_s - self._rate_s >= RATE_PERIOD_S:
            self._rate = (self._count - self._rate_count) / (now_s - self._rate_s)
            self._rate_count, self._rate_s = self._count.copy(), now_s
        if self._live and now_s - self._drawn_s >= DRAW_PERIOD_S:
            self._drawn_s = now_s
            max_rows = max(MIN_ROWS, self._console.height - OTHER_LINES)
            self._live.update(self.draw(max_rows, self._console.width), refresh=True)

    def draw(self, max_rows: int, width: int) -> Table:
        """Make the table for a terminal.

        In a skin of more than `max_rows` cubes, those with the largest absolute σzz are shown. If
        the table is too wide, the lines, then the bars, then components from the last one on are
        left out.

        Args:
            max_rows: Maximum number of cubes in the table.
            width: Width of the terminal, in characters.
        """
        # Tension is positive in the stress tensor, so the pressure is −σzz.
        pressure = np.nan_to_num(-self._values[:, COMPONENTS.index("zz")])
        self._peak = max(
            self._peak * PEAK_DECAY,
            float(pressure.max()),
            MIN_PEAK,
        )
        shown = np.arange(len(pressure))
        notes = []
        if len(shown) > max_rows:
            by_size = np.argsort(-np.abs(pressure), kind="stable")
            # Sorting the indices keeps the rows in the order of the skin file.
            shown = np.sort(by_size[:max_rows])
            notes.append(
                f"the {max_rows} cubes under the greatest normal stress of {len(pressure)}"
            )

        components = [name for name in SHOWN if np.isfinite(self._component(name)).any()]
        options = self._console.options.update(max_width=UNLIMITED_WIDTH)
        table = Table()
        for form in _forms(components):
            # The width of the table depends on its content, so it is made in each layout and
            # measured until it fits.
            table = self._table(form, shown, pressure)
            left_out = [] if form.has_bar else ["pressure"]
            left_out += map(_label, components[len(form.components) :])
            left_out += [] if form.has_residual else ["residual"]
            too_narrow = [f"too narrow for {', '.join(left_out)}"] if left_out else []
            table.caption = "; ".join([*notes, *too_narrow])
            if (
                Measurement.get(
                    self._console,
                    options,
                    table,
                ).maximum
                <= width
            ):
                break
        return table

    def _table(
        self,
        form: _Form,
        shown: Index,
        pressure: Array,
    ) -> Table:
        """Make the table in one layout.

        Args:
            form: The layout.
            shown: (K,) indices of the cubes that have a row.
            pressure: (N,) pressure −σzz at all cubes, in Pa.
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
        count = counted(len(self._count), "cube")
        title = f"skin {self._skin.name!r}: {count}. Tension is positive; "
        table = Table(title=f"{title}{UNOBSERVED} is not observed{self.note}")
        if not form.has_lines:
            table.box, table.padding, table.show_edge = SIMPLE_HEAD, (0, 0), False

        table.add_column("cube")
        if form.has_bar:
            table.add_column("pressure", width=BAR_WIDTH)
        for name in form.components:
            unit = "kPa/mm" if is_gradient(name) else "kPa"
            table.add_column(
                f"{_label(name)}\n{unit}",
                justify="right",
                min_width=7,
            )
        if form.has_residual:
            table.add_column("residual", justify="right")
        table.add_column("Hz", justify="right", min_width=4)
        table.add_column("state")
        return table

    def _component(self, name: str) -> Array:
        """Return the values (N,) of one component of all cubes, in Pa or Pa/m."""
        return self._values[:, COMPONENTS.index(name)]

    def _state(self, number: int) -> Text:
        """Return the names of the status bits that are set in the latest row of a cube.

        The text is "ok" if no bit is set, and "waiting" if no row has arrived yet.

        Args:
            number: Index of the cube in the skin.
        """
        bits = self._status[number]
        words = [word.lower().replace("_", " ") for word, bit in STATUS.items() if bits & bit]
        if words:
            return Text(", ".join(words), "red")
        return Text("ok" if self._count[number] else "waiting", "green")


def is_gradient(component: str) -> bool:
    """Return whether a component is a gradient, such as zz_x, the derivative of zz along x."""
    return "_" in component


def _label(component: str) -> str:
    """Return the heading of the column of a component, such as zz or ∂zz/∂x."""
    return f"∂{component[:2]}/∂{component[3]}" if is_gradient(component) else component


def _in_kpa(component: str, value: float) -> str:
    """Return a stress as text in kPa, or a gradient as text in kPa/mm.

    Args:
        component: Name of the component, such as zz (stress) or zz_x (gradient).
        value: Its value, in Pa or Pa/m.
    """
    scale = 1e-6 if is_gradient(component) else 1e-3
    return _number(value * scale, "+.2f")


def _number(value: float, form: str) -> str:
    return UNOBSERVED if np.isnan(value) else f"{value:{form}}"
