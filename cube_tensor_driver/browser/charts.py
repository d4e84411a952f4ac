# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Plots over the last seconds, of any cubes and any component, on the page and as files."""

from __future__ import annotations

import io
from collections.abc import Iterable, Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
import viser
from viser import uplot

from ..core.arrays import Array
from ..core.modes import COMPONENTS, STRESS
from ..views.figures.panels import draw_panels
from ..views.figures.style import render_png
from ..views.round_numbers import round_range
from ..views.scene import find_component_unit
from . import markup
from .history import History

HISTORY_S = 10.0
"""Length of the time axis of the plots, in seconds; its right end is the newest value."""

TIME_SCALE = uplot.Scale(
    time=False,
    auto=False,
    range=(-HISTORY_S, 0.0),
)
"""Time axis of the plots, in seconds relative to the newest value; its range is always the last
`HISTORY_S` seconds."""

RELAYOUT_PERIOD = 4
"""Number of updates of the page after which the range of each chart's value axis is changed by an
amount that is too small to be seen.

The browser lays a chart out again at each change of a range. This is needed because a chart that
was made before the browser knew its width has no time axis until it is laid out again.
"""

MAX_LINES = 12
"""Maximum number of lines in one chart; readers cannot distinguish more."""

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#000000", "#e69f00", "#56b4e9", "#888888")
"""Colours of the lines of a chart; the first line has the first colour, and so on.

They are those of Okabe and Ito, which colour-blind readers can distinguish, too.
"""

DASHES = ((), (7, 4))
"""Dash patterns of the lines of a chart: lengths of dash and gap, in pixels; empty: solid.

The first lines are solid, one in each colour of `COLOURS`; all further lines repeat the colours and
are dashed.
"""

AXIS_SIZES = (44, 56)
"""Space for the numbers and the label of an axis, in pixels.

The first entry is the height below the time axis, the second the width beside the value axis.
"""

TIME_LABEL = "time before now / s"
"""Label of the time axis of the plots."""

CHART_HEIGHT = 250
"""Height of a chart, in pixels."""

GROUPS = {
    "normal stress": ("xx", "yy", "zz"),
    "shear": ("yz", "zx", "xy"),
    "gradient of σzz": ("zz_x", "zz_y", "zz_z"),
    "all stresses": tuple(STRESS),
    "all gradients": tuple(COMPONENTS[len(STRESS) :]),
    "residual": ("residual",),
    **{markup.format_label(name): (name,) for name in COMPONENTS},
}
"""Name of a group of values that a chart can show -> their names in `History.COLUMNS`.

All values of a group have the same unit, because a chart has one value axis.
"""

FIRST_GROUPS = ("normal stress", "gradient of σzz")
"""Names, in `GROUPS`, of the values that the two charts show when the page opens."""


class Chart(NamedTuple):
    """What one chart shows.

    Attributes:
        axis: Label of the value axis, with the unit.
        unit: Size of this unit, in SI units.
        lines: Name of each line in the legend, such as "c05 σzz" -> index of the cube, and index
            of the value in `History.COLUMNS`.
    """

    axis: str
    unit: float
    lines: dict[str, tuple[int, int]]

    def select_values(self, history: History) -> dict[str, Array]:
        """Return the label of each line -> its values (M,) at the M instants of a history, in units
        of `unit`."""
        return {label: history.select(*place) / self.unit for label, place in self.lines.items()}


class Charts:
    """The tab with plots over time, of the chosen cube and of cubes named in a text field.

    Attributes:
        lists: Drop-down list of what each chart shows.
        plots: The charts themselves.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        tab: viser.GuiTabHandle,
        names: Sequence[str],
    ) -> None:
        """Add the text field, the charts and the buttons to the tab.

        Args:
            gui: The controls of one browser.
            tab: The tab of the panel.
            names: Names of the cubes of the skin.
        """
        self._names = list(names)
        self._history: History | None = None
        self._cubes = [0]
        self._charts = [Chart("", 1.0, {})] * len(FIRST_GROUPS)
        self.lists: list[viser.GuiDropdownHandle[str]] = []
        self.plots: list[viser.GuiUplotHandle] = []
        with tab:
            self._text = gui.add_text(
                "more cubes",
                "",
                hint="names, for example: c05 c06. The chosen cube comes first.",
            )
            for group in FIRST_GROUPS:
                self.lists.append(gui.add_dropdown("plot", tuple(GROUPS), initial_value=group))
                plot = gui.add_uplot(
                    (np.zeros(1), np.full(1, np.nan)),
                    _make_series([""]),
                    height=CHART_HEIGHT,
                    padding=(10, 12, 0, 0),
                    # Plots with the same key share one cursor: both show the values of one instant.
                    cursor={"sync": {"key": "skin"}},
                )
                self.plots.append(plot)
            files = gui.add_button_group("save as", ("CSV", "PNG"))
            zoom = "To zoom, pause the page and drag. A double click shows all again."
            gui.add_html(markup.put_in_box(zoom))

        @files.on_click
        def _(event: viser.GuiEvent[viser.GuiButtonGroupHandle]) -> None:
            self._save(event.client, str(files.value))

    def choose(self, history: History, chosen: int) -> tuple[Chart, ...]:
        """Return the charts that the user has chosen.

        Args:
            history: Values of all cubes in the last seconds; only those that are not NaN get lines.
            chosen: Index of the cube that the user chose on the page.
        """
        self._history = history
        words = str(self._text.value).replace(",", " ").split()
        named = [self._names.index(word) for word in words if word in self._names]
        # `dict.fromkeys` removes repeated cubes and keeps the order: the chosen cube is the first.
        self._cubes = list(dict.fromkeys([chosen, *named]))
        for number, one in enumerate(self.lists):
            # A browser may send any text, so the value is checked.
            group = one.value if one.value in GROUPS else FIRST_GROUPS[0]
            chart = make_chart(
                history,
                self._names,
                self._cubes,
                group,
            )
            # A chart without lines would have no axes, so the last one with lines is kept.
            if chart.lines:
                self._charts[number] = chart
        return tuple(self._charts)

    def _save(self, client: viser.ClientHandle | None, kind: str) -> None:
        history = self._history
        if client is None or history is None:
            return
        if kind == "PNG":
            panels = [(chart.axis, chart.select_values(history)) for chart in self._charts]
            content = render_png(draw_panels(history.times, TIME_LABEL, panels))
        else:
            content = format_csv(history, self._cubes, self._names)
        client.send_file_download(
            f"skin.{kind.lower()}",
            content,
            save_immediately=True,
        )


def make_chart(
    history: History,
    names: Sequence[str],
    cubes: Sequence[int],
    group: str,
) -> Chart:
    """Return a chart with one line for each cube and each value of a group that is observed.

    At most `MAX_LINES` lines are drawn. A value counts as observed if it was known for any cube at
    any instant of the history.

    Args:
        history: Values of all cubes in the last seconds.
        names: Names of all cubes.
        cubes: Indices of the cubes, in the order of their lines.
        group: Name of the values in `GROUPS`.
    """
    size, unit = find_component_unit(GROUPS[group][0])
    observed = [name for name in GROUPS[group] if name in history.observed_names]
    lines = {
        f"{names[cube]} {markup.format_label(name)}": (cube, History.COLUMNS.index(name))
        for cube, name in list(product(cubes, observed))[:MAX_LINES]
    }
    return Chart(f"{group} / {unit}", size, lines)


def make_chart_properties(history: History, chart: Chart) -> dict[str, object]:
    """Return the lines, data and axes of a plot as properties of viser; {} without lines.

    Args:
        history: Values of all cubes in the last seconds.
        chart: What the plot shows.
    """
    values = chart.select_values(history)
    if not values:
        return {}
    # The range is computed here, because uPlot cannot compute it from values with NaN.
    finite = np.concatenate(list(values.values()))
    finite = finite[np.isfinite(finite)]
    low, high = round_range(finite.min(initial=0.0), finite.max(initial=0.0))
    if history.count // RELAYOUT_PERIOD % 2:
        high += 1e-9 * (high - low)
    axes = tuple(
        uplot.Axis(
            stroke="#343a40",
            grid={"stroke": "#dee2e6", "width": 1},
            size=size,
            label=label,
            labelSize=18,
        )
        for size, label in zip(AXIS_SIZES, (TIME_LABEL, chart.axis), strict=True)
    )
    return {
        "series": _make_series(values),
        "data": (history.times, *values.values()),
        "axes": axes,
        "scales": {"x": TIME_SCALE, "y": uplot.Scale(auto=False, range=(low, high))},
    }


def _make_series(labels: Iterable[str]) -> tuple[uplot.Series, ...]:
    """Return how uPlot shows each array of data: first the times, then one line for each label."""
    lines = (
        uplot.Series(
            label=label,
            stroke=COLOURS[number % len(COLOURS)],
            width=1.8,
            dash=DASHES[number // len(COLOURS) % len(DASHES)],
        )
        for number, label in enumerate(labels)
    )
    return uplot.Series(label="s"), *lines


def format_csv(
    history: History,
    cubes: Sequence[int],
    names: Sequence[str],
) -> bytes:
    """Return the values of some cubes as a CSV table in SI units, with one row per instant.

    Args:
        history: Values of all cubes in the last seconds.
        cubes: Indices of the cubes in the table.
        names: Names of all cubes.

    Returns:
        The content of the file. Components that no cube observes have no column.
    """
    header = ["time / s"]
    columns = [history.times]
    for cube in cubes:
        for column, name in enumerate(History.COLUMNS):
            if name in history.observed_names:
                unit = "1" if name == "residual" else "Pa/m" if "_" in name else "Pa"
                header.append(f"{names[cube]} {name} / {unit}")
                columns.append(history.select(cube, column))
    content = io.BytesIO()
    np.savetxt(
        content,
        np.column_stack(columns),
        fmt="%.6g",
        delimiter=",",
        header=",".join(header),
        comments="",
    )
    return content.getvalue()
