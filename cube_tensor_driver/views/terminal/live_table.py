# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The live table of a skin in a terminal: latest tensor, rate and state of each cube."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.live import Live
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from ...config.skin import Skin
from ...core.arrays import Array
from ...core.latest_stress import LatestStress
from ...core.modes import COMPONENTS
from ...core.rows import StressRows
from ...core.status import describe_status
from ..scene import find_component_unit
from .output import format_count

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

PRESSURE = "pressure"
"""Heading of the column with bars, whose lengths show the pressure at each cube."""

BAR_WIDTH = 12
"""Width, in characters, of the longest bar in the column for the pressure."""

PEAK_DECAY = 0.99
"""Factor by which the pressure of a full bar is multiplied from one drawing of the table to the
next, while all pressures on the skin are smaller."""

MIN_PEAK = 1.0
"""Minimum pressure, in Pa, of a full bar; it avoids a division by zero without load."""

OTHER_LINES = 8
"""Number of lines of the terminal that are needed for title, headings, frame and prompt, and are
not available for rows of cubes."""

MIN_ROWS = 4
"""Minimum number of rows (cubes) in the table, even if the terminal has fewer lines."""

UNLIMITED_WIDTH = 1000
"""Width of the terminal, in characters, that is assumed while the library rich computes the width
that a table needs. It is larger than any table, so that it does not limit the result."""


Cells = list[str | Text]
"""Content of one column of the table, one entry for each row."""


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
        self.note = ""
        self._skin = skin
        self._latest = LatestStress(len(skin.cubes))
        self._rate = np.full(len(skin.cubes), np.nan)
        self._rate_count = self._latest.count.copy()
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
        return int(np.count_nonzero(self._latest.count))

    @property
    def seen_all(self) -> bool:
        """Whether at least one tensor has arrived from every cube."""
        return bool(self._latest.count.all())

    def update(self, rows: StressRows) -> None:
        """Store the rows of a stress message, which the next `refresh` shows.

        If a cube has several rows, the last one is shown.
        """
        if not self._latest.count.any():
            # The next `refresh` draws the first tensors without waiting for `DRAW_PERIOD_S`.
            self._drawn_s = 0.0
        self._latest.update(rows, time.monotonic())

    def refresh(self) -> None:
        """Compute the rates and draw the table, each if its period is over."""
        now_s = time.monotonic()
        if now_s - self._rate_s >= RATE_PERIOD_S:
            count = self._latest.count.copy()
            self._rate = (count - self._rate_count) / (now_s - self._rate_s)
            self._rate_count, self._rate_s = count, now_s
        if self._live and now_s - self._drawn_s >= DRAW_PERIOD_S:
            self._drawn_s = now_s
            max_rows = max(MIN_ROWS, self._console.height - OTHER_LINES)
            self._live.update(self.draw(max_rows, self._console.width), refresh=True)

    def draw(self, max_rows: int, width: int) -> Table:
        """Make the table for a terminal.

        In a skin of more than `max_rows` cubes, those with the largest absolute σzz are shown. If
        the table is too wide, parts of it are left out one after the other until it fits: the lines
        between columns, the bars, the components (the last one first), and the residual.

        Args:
            max_rows: Maximum number of cubes in the table.
            width: Width of the terminal, in characters.
        """
        # Tension is positive in the stress tensor, so the pressure is −σzz.
        pressure = np.nan_to_num(-self._select_component("zz"))
        decayed_peak = self._peak * PEAK_DECAY
        highest = float(pressure.max())
        self._peak = max(decayed_peak, highest, MIN_PEAK)
        shown = np.arange(len(pressure))
        notes = []
        if len(shown) > max_rows:
            size = np.abs(pressure)
            by_size = np.argsort(-size, kind="stable")
            # Sorting the indices keeps the rows in the order of the skin file.
            shown = np.sort(by_size[:max_rows])
            notes.append(f"the {max_rows} cubes under the largest normal stress of {len(pressure)}")

        columns = self._make_columns(shown.tolist(), pressure)
        # The first and the last two columns (name, rate and state) are always shown.
        bar, *components, residual = list(columns)[1:-2]
        omissible = ["lines", bar, *reversed(components), residual]
        options = self._console.options.update(max_width=UNLIMITED_WIDTH)
        table = Table()
        # The width of the table depends on its content, so it is made and measured until it fits.
        for n_omitted in range(len(omissible) + 1):
            omitted = omissible[:n_omitted]
            shown_columns = {}
            left_out = []
            for heading, column in columns.items():
                if heading in omitted:
                    # The first line of a heading is a name, the second one a unit.
                    name, *_ = heading.split("\n")
                    left_out.append(name)
                else:
                    shown_columns[heading] = column
            table = self._make_table(shown_columns, has_lines=not omitted)
            too_narrow = [f"too narrow for {', '.join(left_out)}"] if left_out else []
            table.caption = "; ".join([*notes, *too_narrow])
            if Measurement.get(self._console, options, table).maximum <= width:
                break
        return table

    def _make_columns(
        self,
        shown: Sequence[int],
        pressure: Array,
    ) -> dict[str, Cells]:
        """Return all columns by their headings.

        Args:
            shown: Indices of the cubes that have a row.
            pressure: (N,) pressure −σzz at all cubes, in Pa.
        """
        bar_lengths = BAR_WIDTH * np.clip(pressure / self._peak, 0.0, 1.0)
        columns: dict[str, Cells] = {
            "cube": [self._skin.cubes[cube].name for cube in shown],
            PRESSURE: [Text("█" * int(bar_lengths[cube]), "blue") for cube in shown],
        }
        for name in SHOWN:
            values = self._select_component(name)
            if np.isfinite(values).any():
                size, unit = find_component_unit(name)
                stress, _, axis = name.partition("_")
                label = f"∂{stress}/∂{axis}" if axis else stress
                columns[f"{label}\n{unit}"] = _format_numbers(
                    values / size,
                    shown,
                    "+7.2f",
                )
        columns["residual"] = _format_numbers(
            self._latest.residual,
            shown,
            ".2f",
        )
        columns["Hz"] = _format_numbers(self._rate, shown, "4.0f")
        columns["state"] = [self._format_state(cube) for cube in shown]
        return columns

    def _make_table(self, columns: Mapping[str, Cells], has_lines: bool) -> Table:
        """Make the table.

        Args:
            columns: Cells of each column by its heading.
            has_lines: Whether lines separate the columns.
        """
        count = format_count(len(self._skin.cubes), "cube")
        title = f"skin {self._skin.name!r}: {count}. Tension is positive; "
        table = Table(title=f"{title}{UNOBSERVED} is not observed{self.note}")
        # Without lines, the table of a skin of planar cubes is not wider than 80 characters.
        if not has_lines:
            table.box, table.padding, table.show_edge = SIMPLE_HEAD, (0, 0), False
        for heading in columns:
            table.add_column(
                heading,
                justify="left" if heading in ("cube", PRESSURE, "state") else "right",
                # The width is fixed, because otherwise it would follow the longest bar.
                width=BAR_WIDTH if heading == PRESSURE else None,
            )
        for cells in zip(*columns.values(), strict=True):
            table.add_row(*cells)
        return table

    def _select_component(self, name: str) -> Array:
        """Return the values (N,) of one component of all cubes, in Pa or Pa/m."""
        return self._latest.values[:, COMPONENTS.index(name)]

    def _format_state(self, number: int) -> Text:
        """Return the names of the status bits that are set in the latest row of a cube.

        The text is "ok" if no bit is set, and "waiting" if no row has arrived yet.

        Args:
            number: Index of the cube in the skin.
        """
        words = describe_status(self._latest.status[number])
        if words:
            return Text(words, "red")
        return Text("ok" if self._latest.count[number] else "waiting", "green")


def _format_numbers(values: Array, shown: Sequence[int], form: str) -> Cells:
    """Return the cells of some cubes in a column of numbers; NaN becomes `UNOBSERVED`.

    Args:
        values: (N,) numbers of all cubes.
        shown: Indices of the cubes that have a row.
        form: Format of the numbers in Python's notation, such as ".1f".
    """
    cells: Cells = []
    for value in values[list(shown)].tolist():
        cell = UNOBSERVED if np.isnan(value) else f"{value:{form}}"
        cells.append(cell)
    return cells
