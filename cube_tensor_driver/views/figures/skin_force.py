"""The picture of the demo: the force on a whole skin over time."""

from __future__ import annotations

from typing import Any

from matplotlib.figure import Figure

from ...core.arrays import Array
from .style import print_style

_AXES = (("x", "o", "C0", "--"), ("y", "s", "C1", ":"), ("z", "D", "black", "-"))
"""Letter, marker, colour and dashes."""


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
    """Force on a skin and its centre of pressure: as the script says (lines) and as measured.

    seconds: (N,) of the rows; force, measured_force: (N, 3) N; centre, measured_centre: (N, 3) m
    cubes: (cubes, 3) m, where the cubes are; the centre's path is drawn over them
    """
    figure = Figure(figsize=(9, 5))
    panels: Any = figure.subplot_mosaic(
        [["force", "path"], ["centre", "path"]], width_ratios=[2.2, 1]
    )
    times = seconds - seconds.min()
    _draw_components(panels["force"], times, force, measured_force)
    _draw_components(panels["centre"], times, 1e3 * centre, 1e3 * measured_centre)
    handles, labels = panels["force"].get_legend_handles_labels()
    panels["force"].legend(
        handles,
        labels,
        title="lines: script, marks: measured",
        ncol=3,
        loc="lower left",
        bbox_to_anchor=(0, 1),
    )
    panels["force"].set(ylabel="force on the skin / N")
    panels["centre"].set(
        xlabel="time / s", ylabel="centre of pressure / mm", xlim=panels["force"].get_xlim()
    )
    path = panels["path"]
    path.plot(1e3 * cubes[:, 1], 1e3 * cubes[:, 0], "s", color="0.8", ms=3)
    path.plot(1e3 * centre[:, 1], 1e3 * centre[:, 0], color="black", lw=1)
    measured = 1e3 * measured_centre
    path.plot(measured[:, 1], measured[:, 0], "o", color="C3", mfc="none", ms=3)
    path.set(xlabel="$y$ / mm", ylabel="$x$ / mm", aspect="equal")
    path.set_title("path of the centre of pressure\n(grey: cubes; circles: measured)", fontsize=9)
    return figure


def _draw_components(panel: Any, times: Array, script: Array, measured: Array) -> None:
    for axis, (letter, marker, color, dash) in enumerate(_AXES):
        panel.plot(times, script[:, axis], color=color, lw=1, ls=dash)
        panel.plot(
            times, measured[:, axis], marker, color=color, mfc="none", ms=3, label=f"${letter}$"
        )
