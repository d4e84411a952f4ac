# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The picture of the demo: force on the whole skin and centre of pressure over time."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ...core.arrays import Array
from .style import print_style

_AXIS_STYLES = (("x", "o", "C0", "--"), ("y", "s", "C1", ":"), ("z", "D", "black", "-"))
"""Name, marker, colour and line style of each coordinate axis. The curves of the axes can be
distinguished in grey, too."""

MM_PER_M = 1e3
"""Number of millimetres in a metre."""


@print_style()
def draw_forces(
    *,
    seconds: Array,
    force: Array,
    measured_force: Array,
    centre: Array,
    measured_centre: Array,
    cubes: Array,
) -> Figure:
    """Draw force and centre of pressure over time, as applied (lines) and measured (markers).

    Args:
        seconds: (T,) times, in s from any origin.
        force: (T, 3) force that the load applies to the whole skin, in N.
        measured_force: (T, 3) force that was computed from the tensors, in N.
        centre: (T, 3) centre of pressure of the load, in metres.
        measured_centre: (T, 3) centre of pressure computed from the tensors, in metres.
        cubes: (cubes, 3) positions of the cubes, in metres.
    """
    figure = Figure(figsize=(9, 5))
    panels = figure.subplot_mosaic([["force", "path"], ["centre", "path"]], width_ratios=[2.2, 1])
    # The time axis begins at 0 with the first measurement.
    times = seconds - seconds.min()
    _draw_components(panels["force"], times, force, measured_force)
    _draw_components(
        panels["centre"],
        times,
        MM_PER_M * centre,
        MM_PER_M * measured_centre,
    )
    handles, labels = panels["force"].get_legend_handles_labels()
    panels["force"].legend(
        handles,
        labels,
        ncol=3,
        loc="lower left",
        bbox_to_anchor=(0, 1),
    )
    panels["force"].set(ylabel="force on the skin / N")
    panels["centre"].set(
        xlabel="time / s",
        ylabel="centre of pressure / mm",
        xlim=panels["force"].get_xlim(),
    )

    path = panels["path"]
    for points, style in (
        (cubes, {"marker": "s", "ls": "", "color": "0.8"}),
        (centre, {"color": "black", "lw": 1}),
        (
            measured_centre,
            {
                "marker": "o",
                "ls": "",
                "color": "C3",
                "mfc": "none",
            },
        ),
    ):
        x, y, _ = MM_PER_M * points.T
        path.plot(y, x, ms=3, **style)
    path.set(
        xlabel="$y$ / mm",
        ylabel="$x$ / mm",
        aspect="equal",
    )
    title = "path of the centre of pressure\n(grey: cubes, line: load script,\ncircles: measured)"
    path.set_title(title, fontsize=9)
    return figure


def _draw_components(
    panel: Axes,
    times: Array,
    applied: Array,
    measured: Array,
) -> None:
    for axis, (letter, marker, color, dash) in enumerate(_AXIS_STYLES):
        panel.plot(
            times,
            applied[:, axis],
            color=color,
            lw=1,
            ls=dash,
            label=f"${letter}$, load script",
        )
        panel.plot(
            times,
            measured[:, axis],
            marker,
            color=color,
            mfc="none",
            ms=3,
            label=f"${letter}$, measured",
        )
