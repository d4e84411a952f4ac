"""The live table of a skin in a terminal."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.live import Live
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from ..config.skin import Skin
from ..core.modes import COMPONENTS
from ..core.rows import StressRows
from ..core.status import STATUS

REFRESH_S = 0.1
RATE_S = 1.0
SHOWN = ("xx", "zz", "zx", "yz", "zz_x", "zz_y", "zz_z")
"""Components with a column of their own where a cube observes them: normal stress, shear on the
skin's surface, how the pressure varies."""
BAR = 12
WIDEST = 1000
"""Of a terminal, in columns."""


class LiveTable:
    """Last tensor and rate per cube, drawn ten times a second; a context that gives the terminal
    back."""

    def __init__(self, skin: Skin, show: bool) -> None:
        self._skin = skin
        n = len(skin.cubes)
        self._values = np.full((n, len(COMPONENTS)), np.nan)
        self._residual = np.full(n, np.nan)
        self._status = np.zeros(n, np.uint16)
        self._count = np.zeros(n, int)
        self._rate_count, self._rate_at, self._rate = (
            self._count.copy(),
            time.monotonic(),
            np.full(n, np.nan),
        )
        self._peak = 0.0
        self._drawn_at = 0.0
        self.note = ""
        self._console = Console(stderr=True)
        self._live = (
            Live(console=self._console, auto_refresh=False, transient=False) if show else None
        )

    def __enter__(self) -> LiveTable:
        if self._live:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live:
            self._live.stop()

    @property
    def seen(self) -> int:
        """Cubes that have had a tensor."""
        return int(np.count_nonzero(self._count))

    @property
    def seen_all(self) -> bool:
        return self.seen == len(self._count)

    def update(self, cube: NDArray[Any], rows: StressRows) -> None:
        """Take the rows of a stress message; of several rows of a cube the last stays."""
        self._values[cube, :6], self._values[cube, 6:] = rows.stress, rows.gradient
        self._residual[cube], self._status[cube] = rows.residual, rows.status
        np.add.at(self._count, cube, 1)

    def refresh(self) -> None:
        """Draw if it is time to."""
        now = time.monotonic()
        if now - self._rate_at >= RATE_S:
            self._rate = (self._count - self._rate_count) / (now - self._rate_at)
            self._rate_count, self._rate_at = self._count.copy(), now
        if self._live and now - self._drawn_at >= REFRESH_S:
            self._drawn_at = now
            self._live.update(
                self.draw(max(4, self._console.height - 8), self._console.width), refresh=True
            )

    def draw(self, most: int, width: int) -> Table:
        """The table for a terminal of `width`, of the `most` cubes under the greatest normal
        stress."""
        title = f"skin {self._skin.name}: {len(self._count)} cubes. Tension is positive; · is not observed"
        table = Table(title=title + self.note)
        table.add_column("cube")
        table.add_column("pressure", width=BAR)
        names = [
            name for name in SHOWN if np.isfinite(self._values[:, COMPONENTS.index(name)]).any()
        ]
        for name in names:
            unit = "kPa/mm" if "_" in name else "kPa"
            label = f"∂{name[:2]}/∂{name[3]}" if "_" in name else name
            table.add_column(f"{label}\n{unit}", justify="right", min_width=7)
        table.add_column("residual", justify="right")
        table.add_column("Hz", justify="right", min_width=4)
        table.add_column("state")
        pressure = np.nan_to_num(-self._values[:, 2])
        self._peak = max(self._peak * 0.99, float(pressure.max()), 1.0)
        shown = np.arange(len(pressure))
        if len(shown) > most:
            shown = np.sort(np.argsort(-np.abs(pressure), kind="stable")[:most])
            table.caption = f"the {most} cubes under the greatest normal stress of {len(pressure)}"
        columns = [COMPONENTS.index(name) for name in names]
        for number in shown.tolist():
            bar = "█" * int(BAR * min(1.0, max(0.0, pressure[number] / self._peak)))
            values = [
                _kilo(self._values[number, column], 1e-6 if column > 5 else 1e-3)
                for column in columns
            ]
            words = [
                word.lower().replace("_", " ")
                for word, bit in STATUS.items()
                if self._status[number] & bit
            ]
            state = (
                Text(", ".join(words), "red")
                if words
                else Text("ok" if self._count[number] else "waiting", "green")
            )
            rate = "·" if np.isnan(self._rate[number]) else f"{self._rate[number]:.0f}"
            residual = "·" if np.isnan(self._residual[number]) else f"{self._residual[number]:.2f}"
            table.add_row(
                self._skin.cubes[number].name, Text(bar, "blue"), *values, residual, rate, state
            )
        if (
            Measurement.get(
                self._console, self._console.options.update(max_width=WIDEST), table
            ).maximum
            > width
        ):
            # Without lines a planar skin fits into 80 columns.
            table.box, table.padding, table.show_edge = SIMPLE_HEAD, 0, False
        return table


def _kilo(value: float, scale: float) -> str:
    return "·" if np.isnan(value) else f"{value * scale:+.2f}"
