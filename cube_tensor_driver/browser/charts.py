"""Plots over the last seconds: of any cubes and any component, as files too."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import viser
from viser import uplot

from ..core.arrays import Array
from ..core.modes import COMPONENTS, STRESS
from ..views.figures.style import png, symbol
from . import markup
from .history import History
from .plot_colours import draw_lines

HISTORY_S = 10.0
TIME_SCALE = uplot.Scale(time=False, auto=False, range=(-HISTORY_S, 0.0))
RENEW = 3
"""After so many pictures the charts are laid out again, see `Chart.draw`."""
MOST_LINES = 12
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#000000", "#e69f00", "#56b4e9", "#888888")
DASHES = ((), (7, 4))
AXIS_SIZES = (44, 56)
"""Room for the numbers and the label of the axis of time and of the axis of values, pixels."""
HEIGHT = 250
NOISE = 0.02
"""Relative to the largest value: smaller ones on the other side of zero are taken for noise."""
GROUPS = {
    "normal stress": ("xx", "yy", "zz"),
    "shear": ("yz", "zx", "xy"),
    "gradient of σzz": ("zz_x", "zz_y", "zz_z"),
    "all stresses": tuple(STRESS),
    "all gradients": tuple(COMPONENTS[len(STRESS) :]),
    "residual": ("residual",),
    **{markup.label(name): (name,) for name in COMPONENTS},
}
"""What a chart can show, by its name. All columns of a group have one unit."""
AT_FIRST = ("normal stress", "gradient of σzz")


class Line(NamedTuple):
    """One line of a chart: a column of the history of one cube.

    label, printed: its name on the page, and in a picture with mathematical type.
    """

    cube: int
    column: int
    label: str
    printed: str


class Charts:
    """The tab with the plots of some cubes.

    The chosen cube is always among them; others are named in a text field.
    """

    def __init__(self, gui: viser.GuiApi, tab: viser.GuiTabHandle, names: Sequence[str]) -> None:
        self._names = list(names)
        self._drawn = 0
        self._latest: History | None = None
        self._cubes = [0]
        with tab:
            self._text = gui.add_text(
                "more cubes",
                "",
                hint="names, for example: c05 c06. The chosen cube comes first.",
                order=0,
            )
            self._charts = [
                Chart(gui, tab, group, 1 + 2 * number) for number, group in enumerate(AT_FIRST)
            ]
            files = gui.add_button_group("save as", ("CSV", "PNG"), order=10)
            zoom = "To zoom, pause the page and drag. A double click shows all again."
            gui.add_html(markup.box(zoom), order=11)

        @files.on_click
        def _(event: viser.GuiEvent) -> None:
            self._save(event.client, str(files.value))

    def draw(self, history: History, chosen: int) -> None:
        self._drawn += 1
        self._latest = history
        known = {name: number for number, name in enumerate(self._names)}
        words = str(self._text.value).replace(",", " ").split()
        self._cubes = list(dict.fromkeys([chosen, *(known[w] for w in words if w in known)]))
        for chart in self._charts:
            chart.choose(self._lines(chart, history))
            chart.draw(history, nudge=bool(self._drawn // RENEW % 2))

    def offer_observed(self, history: History) -> None:
        """Offer only what some cube observes."""
        seen = dict(zip(History.COLUMNS, history.observed, strict=True))
        if not any(seen[name] for name in COMPONENTS):
            return
        groups = [name for name, columns in GROUPS.items() if any(seen[c] for c in columns)]
        for chart in self._charts:
            chart.offer(groups)

    def _lines(self, chart: Chart, history: History) -> list[Line]:
        seen = dict(zip(History.COLUMNS, history.observed, strict=True))
        wanted = [name for name in GROUPS[chart.group] if seen[name]]
        lines = [
            Line(
                cube,
                History.COLUMNS.index(name),
                f"{self._names[cube]} {markup.label(name)}",
                f"{self._names[cube]} {name if name == 'residual' else symbol(name)}",
            )
            for cube in self._cubes
            for name in wanted
        ]
        return lines[:MOST_LINES]

    def _save(self, client: viser.ClientHandle | None, kind: str) -> None:
        if client is None or self._latest is None:
            return
        if kind == "CSV":
            content = csv_of(self._latest, self._cubes, self._names)
            client.send_file_download("skin.csv", content, save_immediately=True)
        elif kind == "PNG":
            panels = [chart.panel(self._latest) for chart in self._charts]
            client.send_file_download("skin.png", png(draw_lines(panels)), save_immediately=True)


class Chart:
    """One chart; group: which of GROUPS it shows."""

    def __init__(
        self, gui: viser.GuiApi, tab: viser.GuiTabHandle, group: str, order: float
    ) -> None:
        """order: of its choice in the tab; the plot is the next."""
        self._gui, self._tab, self._order = gui, tab, order
        self._range = (0.0, 1.0)
        self._lines: list[Line] = []
        self._choice = gui.add_dropdown("plot", tuple(GROUPS), initial_value=group, order=order)
        self._plot: viser.GuiUplotHandle | None = None

    @property
    def group(self) -> str:
        # A browser may send any text.
        return self._choice.value if self._choice.value in GROUPS else "normal stress"

    def offer(self, groups: list[str]) -> None:
        if tuple(groups) != tuple(self._choice.options):
            self._choice.options = groups

    def choose(self, lines: list[Line]) -> None:
        """Show these lines from now on; another chart if they are others."""
        if lines == self._lines or not lines:
            return
        self._lines = lines
        if self._plot is not None:
            self._plot.remove()
        self._range = (0.0, 1.0)
        grid: uplot.Axis_Grid = {"stroke": "#dee2e6", "width": 1}
        labels = ("time before now / s", self._label)
        axes = tuple(
            uplot.Axis(stroke="#343a40", grid=grid, size=size, label=label, labelSize=18)
            for size, label in zip(AXIS_SIZES, labels, strict=True)
        )
        with self._tab:
            self._plot = self._gui.add_uplot(
                (np.array([0.0]),) * (1 + len(lines)),
                (
                    uplot.Series(label="s"),
                    *(
                        uplot.Series(
                            label=line.label,
                            stroke=COLOURS[number % len(COLOURS)],
                            width=1.8,
                            dash=DASHES[number // len(COLOURS) % len(DASHES)],
                        )
                        for number, line in enumerate(lines)
                    ),
                ),
                height=HEIGHT,
                axes=axes,
                scales=self._scales(),
                padding=(10, 12, 0, 0),
                cursor={"sync": {"key": "skin"}},  # both plots show the values of one instant
                order=self._order + 1,
            )

    def draw(self, history: History, nudge: bool) -> None:
        """nudge: change the scale by an invisible amount.

        A chart that the browser made before it knew its width has no time axis until its scales
        change.
        """
        if self._plot is None:
            return
        shown = self._values(history)
        self._plot.data = (history.times, *shown)
        # uPlot cannot find the range of values with NaN.
        finite = np.concatenate(shown)
        finite = finite[np.isfinite(finite)]
        low, high = round_range(finite.min(initial=0.0), finite.max(initial=0.0))
        if nudge:
            high += 1e-9 * (high - low)
        if self._range != (low, high):
            self._range = (low, high)
            self._plot.scales = self._scales()

    def panel(self, history: History) -> tuple[str, Array, dict[str, Array]]:
        """Label of the values, times and values by the name of the line, as they are shown."""
        lines = zip(self._lines, self._values(history), strict=True)
        label = self._label.replace("σzz", symbol("zz"))
        return label, history.times, {line.printed: values for line, values in lines}

    @property
    def _label(self) -> str:
        return f"{self.group} / {markup.unit(GROUPS[self.group][0])[1]}"

    def _values(self, history: History) -> list[Array]:
        size = markup.unit(GROUPS[self.group][0])[0]
        return [history.of(line.cube, line.column) / size for line in self._lines]

    def _scales(self) -> dict[str, uplot.Scale]:
        return {"x": TIME_SCALE, "y": uplot.Scale(auto=False, range=self._range)}


def csv_of(history: History, cubes: Sequence[int], names: Sequence[str]) -> bytes:
    """All observed columns of some cubes as a table in SI units; a row per instant."""
    seen = np.flatnonzero(history.observed).tolist()
    header = ["time / s"]
    columns = [history.times]
    for cube in cubes:
        for column in seen:
            name = History.COLUMNS[column]
            si = "1" if name == "residual" else "Pa/m" if "_" in name else "Pa"
            header.append(f"{names[cube]} {name} / {si}")
            columns.append(history.of(cube, column))
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(header)
    table.writerows([f"{value:.6g}" for value in row] for row in zip(*columns, strict=True))
    return text.getvalue().encode()


def round_range(low: float, high: float) -> tuple[float, float]:
    """A range for an axis that contains low .. high and zero.

    Its ends are multiples of half of 1, 2, 5 or 10 times a power of ten: they change seldom. Noise
    beyond zero gets no room.
    """
    size = max(-low, high, 1e-9)
    low, high = (end if abs(end) > NOISE * size else 0.0 for end in (low, high))
    power = 10.0 ** np.floor(np.log10(size))
    enough = size * (1 - 1e-9)
    step = power * next(k for k in (1, 2, 5, 10) if k * power >= enough) / 2
    return float(np.floor(min(low, 0) / step) * step), float(np.ceil(max(high, 0) / step) * step)
