"""Plots over the last seconds, of any cubes and any component, on the page and as files."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import viser
from matplotlib.figure import Figure
from viser import uplot

from ..core.arrays import Array
from ..core.modes import COMPONENTS, STRESS
from ..views.figures.style import curve_style, png, print_style, symbol
from . import markup
from .history import History

HISTORY_S = 10.0
"""Time, in seconds, that the plots cover."""

TIME_SCALE = uplot.Scale(
    time=False,
    auto=False,
    range=(-HISTORY_S, 0.0),
)

NUDGE_PERIOD = 3
"""Number of pictures after which the charts are laid out again, see `Chart.draw`."""

MAX_LINES = 12
"""Number of lines in one chart; more cannot be told apart."""

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#000000", "#e69f00", "#56b4e9", "#888888")
"""Colours of the lines, in order (Okabe and Ito: they differ for the colour-blind, too)."""

DASHES = ((), (7, 4))
"""Dashes of the lines: the first colours are solid, then the colours come again, dashed."""

AXIS_SIZES = (44, 56)
"""Room for numbers and label of the time axis and of the value axis, in pixels."""

CHART_HEIGHT = 250
"""Height of a chart, in pixels."""

NOISE_SHARE = 0.02
"""Share of the largest value below which values of the other sign count as noise, which gets no
room on the axis."""

GROUPS = {
    "normal stress": ("xx", "yy", "zz"),
    "shear": ("yz", "zx", "xy"),
    "gradient of σzz": ("zz_x", "zz_y", "zz_z"),
    "all stresses": tuple(STRESS),
    "all gradients": tuple(COMPONENTS[len(STRESS) :]),
    "residual": ("residual",),
    **{markup.label(name): (name,) for name in COMPONENTS},
}
"""Name of what a chart can show -> its columns of the history, which have one unit."""

FIRST_GROUPS = ("normal stress", "gradient of σzz")
"""What the two charts show at first."""


class ChartLine(NamedTuple):
    """One line of a chart: one value of one cube.

    Attributes:
        cube: Index of the cube.
        column: Index in `History.COLUMNS`.
        label: Name on the page.
        printed: Name in a picture, with mathematical type.
    """

    cube: int
    column: int
    label: str
    printed: str


class Charts:
    """The tab with the plots of the chosen cube, and of others that are named in a text field."""

    def __init__(
        self,
        gui: viser.GuiApi,
        tab: viser.GuiTabHandle,
        names: Sequence[str],
    ) -> None:
        """Add the contents of the tab; names: names of the cubes."""
        self._names = list(names)
        self._pictures = 0
        self._history: History | None = None
        self._cubes = [0]
        with tab:
            self._text = gui.add_text(
                "more cubes",
                "",
                hint="names, for example: c05 c06. The chosen cube comes first.",
                order=0,
            )
            # Each chart takes two places: its choice and its plot.
            self._charts = [
                Chart(gui, tab, group, 1 + 2 * number) for number, group in enumerate(FIRST_GROUPS)
            ]
            files = gui.add_button_group("save as", ("CSV", "PNG"), order=10)
            zoom = "To zoom, pause the page and drag. A double click shows all again."
            gui.add_html(markup.box(zoom), order=11)

        @files.on_click
        def _(event: viser.GuiEvent[Any]) -> None:
            self._save(event.client, str(files.value))

    def draw(self, history: History, chosen: int) -> None:
        """Draw all charts; chosen: index of the chosen cube."""
        self._pictures += 1
        self._history = history
        indices = {name: number for number, name in enumerate(self._names)}
        words = str(self._text.value).replace(",", " ").split()
        named = [indices[word] for word in words if word in indices]
        # A cube that is named twice is drawn once, and the chosen one first.
        self._cubes = list(dict.fromkeys([chosen, *named]))
        for chart in self._charts:
            chart.choose(self._lines(chart, history))
            chart.draw(history, nudge=bool(self._pictures // NUDGE_PERIOD % 2))

    def offer_observed(self, history: History) -> None:
        """Offer only what some cube observes."""
        observed = dict(zip(History.COLUMNS, history.observed, strict=True))
        # Before the first tensors nothing is known of what the cubes observe.
        if not any(observed[name] for name in COMPONENTS):
            return
        groups = [
            group for group, columns in GROUPS.items() if any(observed[name] for name in columns)
        ]
        for chart in self._charts:
            chart.offer(groups)

    def _lines(self, chart: Chart, history: History) -> list[ChartLine]:
        observed = dict(zip(History.COLUMNS, history.observed, strict=True))
        columns = [name for name in GROUPS[chart.group] if observed[name]]
        lines = [
            ChartLine(
                cube,
                History.COLUMNS.index(name),
                f"{self._names[cube]} {markup.label(name)}",
                f"{self._names[cube]} {name if name == 'residual' else symbol(name)}",
            )
            for cube in self._cubes
            for name in columns
        ]
        return lines[:MAX_LINES]

    def _save(self, client: viser.ClientHandle | None, kind: str) -> None:
        if client is None or self._history is None:
            return
        if kind == "CSV":
            content = csv_of(self._history, self._cubes, self._names)
            client.send_file_download("skin.csv", content, save_immediately=True)
        elif kind == "PNG":
            panels = [chart.panel(self._history) for chart in self._charts]
            client.send_file_download("skin.png", png(draw_lines(panels)), save_immediately=True)


class Chart:
    """One chart and the choice of what it shows."""

    def __init__(
        self, gui: viser.GuiApi, tab: viser.GuiTabHandle, group: str, order: float
    ) -> None:
        """Add the choice to the tab; the plot follows when there are lines.

        Args:
            gui: The panel.
            tab: The tab.
            group: What it shows at first, of `GROUPS`.
            order: Place of the choice in the tab; the plot has the next one.
        """
        self._gui, self._tab, self._order = gui, tab, order
        self._range = (0.0, 1.0)
        self._lines: list[ChartLine] = []
        self._choice = gui.add_dropdown("plot", tuple(GROUPS), initial_value=group, order=order)
        self._plot: viser.GuiUplotHandle | None = None

    @property
    def group(self) -> str:
        """What it shows, of `GROUPS`."""
        # A browser may send any text.
        return self._choice.value if self._choice.value in GROUPS else "normal stress"

    def offer(self, groups: list[str]) -> None:
        """Offer these groups. Setting the options again would close a list that is open."""
        if tuple(groups) != tuple(self._choice.options):
            self._choice.options = groups

    def choose(self, lines: list[ChartLine]) -> None:
        """Show these lines from now on. Other lines need another chart: uPlot cannot add any."""
        if lines == self._lines or not lines:
            return
        self._lines = lines
        if self._plot is not None:
            self._plot.remove()
        self._range = (0.0, 1.0)

        grid: uplot.Axis_Grid = {"stroke": "#dee2e6", "width": 1}
        labels = ("time before now / s", self._label)
        axes = tuple(
            uplot.Axis(
                stroke="#343a40",
                grid=grid,
                size=size,
                label=label,
                labelSize=18,
            )
            for size, label in zip(AXIS_SIZES, labels, strict=True)
        )
        series = [
            uplot.Series(
                label=line.label,
                stroke=COLOURS[number % len(COLOURS)],
                width=1.8,
                dash=DASHES[number // len(COLOURS) % len(DASHES)],
            )
            for number, line in enumerate(lines)
        ]
        with self._tab:
            self._plot = self._gui.add_uplot(
                (np.array([0.0]),) * (1 + len(lines)),
                (uplot.Series(label="s"), *series),
                height=CHART_HEIGHT,
                axes=axes,
                scales=self._scales(),
                padding=(10, 12, 0, 0),
                # With one key, both plots show the values of one instant.
                cursor={"sync": {"key": "skin"}},
                order=self._order + 1,
            )

    def draw(self, history: History, nudge: bool) -> None:
        """Draw the newest values.

        Args:
            history: The values.
            nudge: Change the scale by an invisible amount. A chart that the browser has made
                before it knew its width shows no time axis until its scales change.
        """
        if self._plot is None:
            return
        values = self._values(history)
        self._plot.data = (history.times, *values)
        # uPlot cannot find the range of values with NaN.
        finite = np.concatenate(values)
        finite = finite[np.isfinite(finite)]
        low, high = round_range(finite.min(initial=0.0), finite.max(initial=0.0))
        if nudge:
            high += 1e-9 * (high - low)
        if self._range != (low, high):
            self._range = (low, high)
            self._plot.scales = self._scales()

    def panel(self, history: History) -> tuple[str, Array, dict[str, Array]]:
        """Return label of the values, times, and values by name of the line, for a picture."""
        lines = zip(self._lines, self._values(history), strict=True)
        # In a picture the component is set in mathematical type.
        label = self._label.replace("σzz", symbol("zz"))
        return label, history.times, {line.printed: values for line, values in lines}

    @property
    def _label(self) -> str:
        return f"{self.group} / {markup.unit(GROUPS[self.group][0])[1]}"

    def _values(self, history: History) -> list[Array]:
        """Return the values of each line (M,), in the unit of the chart."""
        size = markup.unit(GROUPS[self.group][0])[0]
        return [history.of(line.cube, line.column) / size for line in self._lines]

    def _scales(self) -> dict[str, uplot.Scale]:
        return {"x": TIME_SCALE, "y": uplot.Scale(auto=False, range=self._range)}


def csv_of(history: History, cubes: Sequence[int], names: Sequence[str]) -> bytes:
    """Return all observed columns of some cubes as a table in SI units; a row per instant."""
    observed = np.flatnonzero(history.observed).tolist()
    header = ["time / s"]
    columns = [history.times]
    for cube in cubes:
        for column in observed:
            name = History.COLUMNS[column]
            unit = "1" if name == "residual" else "Pa/m" if "_" in name else "Pa"
            header.append(f"{names[cube]} {name} / {unit}")
            columns.append(history.of(cube, column))
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(header)
    table.writerows([f"{value:.6g}" for value in row] for row in zip(*columns, strict=True))
    return text.getvalue().encode()


@print_style()
def draw_lines(panels: Sequence[tuple[str, Array, dict[str, Array]]]) -> Figure:
    """Draw panels over one time axis, each from what `Chart.panel` returns."""
    figure = Figure(figsize=(8, 3 * len(panels)))
    axes = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    for axis, (label, times, lines) in zip(axes, panels, strict=True):
        for number, (name, values) in enumerate(lines.items()):
            axis.plot(times, values, label=name, **curve_style(number) | {"marker": ""})
        axis.set_ylabel(label)
        axis.legend(
            loc="center left",
            bbox_to_anchor=(1.0, 0.5),
            fontsize=8,
            handlelength=3,
        )
    axes[-1].set_xlabel("time before now / s")
    return figure


def round_range(low: float, high: float) -> tuple[float, float]:
    """Return the range of an axis that contains low, high and zero.

    Its ends are multiples of half of 1, 2, 5 or 10 times a power of ten, so that they change
    seldom while values move.
    """
    size = max(-low, high, 1e-9)
    # One noisy value on the other side of zero would take half of the room.
    low, high = (end if abs(end) > NOISE_SHARE * size else 0.0 for end in (low, high))
    power = 10.0 ** np.floor(np.log10(size))
    # The tolerance keeps a size of exactly 1, 2 or 5 from taking the next step.
    min_step = size * (1 - 1e-9)
    step = power * next(factor for factor in (1, 2, 5, 10) if factor * power >= min_step) / 2
    n_below = np.floor(min(low, 0) / step)
    n_above = np.ceil(max(high, 0) / step)
    return float(n_below * step), float(n_above * step)
