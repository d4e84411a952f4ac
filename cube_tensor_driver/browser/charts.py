"""The plots of one cube over the last seconds."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import viser
from numpy.typing import NDArray
from viser import uplot

from . import markup
from .history import History

HISTORY_S = 10.0
TIME_SCALE = uplot.Scale(time=False, auto=False, range=(-HISTORY_S, 0.0))
RENEW = 20
"""After so many pictures the charts are laid out again, see `Chart.draw`."""
STROKES = ("#4dabf7", "#ffa94d", "#69db7c")
DASHES = ((), (6, 3), (2, 3))
AXIS_SIZES = (34, 46)
"""Room for the numbers at the time axis and at the axis of values, pixels."""


class ChartContent(NamedTuple):
    """Which columns of the history a chart shows; factor: from SI to the unit in the title."""

    title: str
    factor: float
    columns: tuple[str, ...]


CONTENTS = (
    ChartContent("normal stress / kPa", 1e-3, ("xx", "yy", "zz")),
    ChartContent("shear / kPa", 1e-3, ("zx", "yz", "xy")),
    ChartContent("gradient / kPa/mm", 1e-6, ("zz_x", "zz_y", "zz_z")),
    ChartContent("residual / σ", 1.0, ("residual",)),
)


class Charts:
    """All charts of the page."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._charts = [Chart(gui, content) for content in CONTENTS]
        self._drawn = 0

    def draw(self, times: NDArray[np.float64], values: NDArray[np.float64]) -> None:
        """times (M,) s, values (M, 16) as `History.of` gives them."""
        self._drawn += 1
        for chart in self._charts:
            chart.draw(times, values, nudge=bool(self._drawn // RENEW % 2))


class Chart:
    """One chart with up to three lines."""

    def __init__(self, gui: viser.GuiApi, content: ChartContent) -> None:
        self._factor = content.factor
        self._columns = [History.COLUMNS.index(name) for name in content.columns]
        self._range = (0.0, 1.0)
        lines = [
            uplot.Series(label=markup.label(name), stroke=stroke, width=1.5, dash=dash)
            for name, stroke, dash in zip(content.columns, STROKES, DASHES, strict=False)
        ]
        grid: uplot.Axis_Grid = {"stroke": "#495057", "width": 0.5}
        self._plot = gui.add_uplot(
            (np.array([0.0]),) * (1 + len(lines)),
            (uplot.Series(label="s"), *lines),
            title=content.title,
            height=160,
            axes=tuple(uplot.Axis(stroke="#ced4da", grid=grid, size=size) for size in AXIS_SIZES),
            scales=self._scales(),
            padding=(4, 8, 0, 0),
        )

    def draw(self, times: NDArray[np.float64], values: NDArray[np.float64], nudge: bool) -> None:
        """nudge: change the scale by an invisible amount.

        A chart that the browser made before it knew its width has no time axis until its scales
        change.
        """
        shown = values[:, self._columns].T * self._factor
        self._plot.data = (times, *shown)
        # uPlot cannot find the range of values with NaN.
        finite = shown[np.isfinite(shown)]
        low, high = round_range(finite.min(initial=0.0), finite.max(initial=0.0))
        if nudge:
            high += 1e-9 * (high - low)
        if self._range != (low, high):
            self._range = (low, high)
            self._plot.scales = self._scales()

    def _scales(self) -> dict[str, uplot.Scale]:
        return {"x": TIME_SCALE, "y": uplot.Scale(auto=False, range=self._range)}


def round_range(low: float, high: float) -> tuple[float, float]:
    """A range for an axis that contains low .. high and zero.

    Its ends are multiples of half of 1, 2, 5 or 10 times a power of ten: they change seldom.
    """
    size = max(-low, high, 1e-9)
    power = 10.0 ** np.floor(np.log10(size))
    enough = size * (1 - 1e-9)
    step = power * next(k for k in (1, 2, 5, 10) if k * power >= enough) / 2
    return float(np.floor(min(low, 0) / step) * step), float(np.ceil(max(high, 0) / step) * step)
