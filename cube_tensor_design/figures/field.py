"""Pictures and tables of the pressure field between the cubes, and of its study."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from cube_tensor_driver.core.arrays import Array
from cube_tensor_driver.views.figures.style import print_style

from ..studies.field_study import SKIN_KINDS, FieldExample, FieldStudy

VIEW_MM = 22.0
"""The example is drawn from minus to plus this."""
_ERROR_LEVELS = (0.1, 0.2, 0.3, 0.5)
"""Of the table that tells how many cubes the gradients save."""


@print_style()
def draw_field(example: FieldExample) -> Figure:
    """One contact between the cubes: the true pressure, and the field without and with gradients.

    The titles tell the rms of the error over the rms of the pressure.
    """
    figure = Figure(figsize=(9, 3.2))
    axes = figure.subplots(1, 3, sharey=True)
    top = 1e-3 * max(pressure.max() for pressure in example.pressure.values())
    for axis, (name, pressure) in zip(axes, example.pressure.items(), strict=True):
        image = draw_pressure(axis, example, pressure, top)
        title = name
        if name != "truth":
            error = relative_rms(pressure, example.pressure["truth"])
            title = f"{name}\nrms error {100 * error:.0f} %"
        limits = (-VIEW_MM, VIEW_MM)
        axis.set(title=title, xlabel="$x$ / mm", aspect="equal", xlim=limits, ylim=limits)
        axis.grid(False)
    axes[0].set_ylabel("$y$ / mm")
    axes[0].legend(fontsize=7, loc="lower left", facecolor="0.3", labelcolor="white")
    figure.colorbar(
        image, ax=axes, label="pressure in the cubes' plane / kPa\n(white contours: 4 kPa apart)"
    )
    return figure


def draw_pressure(axis: Any, example: FieldExample, pressure: Array, top: float) -> Any:
    """One map (M,) Pa with cubes and load, from 0 to `top` kPa."""
    points = example.points
    order = np.lexsort((points[:, 0].round(9), points[:, 1].round(9)))
    n = round(np.sqrt(len(points)))
    x, y = (1e3 * points[order, k].reshape(n, n) for k in (0, 1))
    kilopascal = 1e-3 * pressure[order].reshape(n, n)
    image = axis.pcolormesh(x, y, kilopascal, vmin=0, vmax=top, shading="nearest", rasterized=True)
    axis.contour(x, y, kilopascal, levels=np.arange(2, top, 4), colors="white", linewidths=0.5)
    cubes, load = 1e3 * example.cubes[:, :2].T, 1e3 * example.centre
    axis.plot(*cubes, "s", ms=4, mfc="none", mec="0.8", label="cube")
    axis.plot(*load, "P", ms=7, mfc="red", mec="white", mew=0.8, label="load")
    return image


def relative_rms(pressure: Array, truth: Array) -> float:
    return float(np.sqrt(((pressure - truth) ** 2).mean() / (truth**2).mean()))


@print_style()
def draw_field_study(study: FieldStudy) -> Figure:
    """Error of the field over pitch for each width; dashed: of values alone.

    Left: cubes that see every gradient. Right: planar cubes.
    """
    figure = Figure(figsize=(9, 3.8))
    axes = figure.subplots(1, 2, sharey=True)
    titles = ("cubes that see every gradient", "planar cubes")
    pitches = 1e3 * study.pitches
    for kind, (axis, title) in enumerate(zip(axes, titles, strict=True), 1):
        for row, (width, marker) in enumerate(zip(study.widths, "os^Dv", strict=True)):
            style: dict[str, Any] = {
                "color": str(0.7 * row / len(study.widths)),
                "marker": marker,
                "ms": 4,
                "lw": 1,
            }
            axis.loglog(pitches, study.error[row, :, 0], ls="--", mfc="none", **style)
            axis.loglog(pitches, study.error[row, :, kind], label=f"{1e3 * width:.0f} mm", **style)
        axis.set(xlabel="pitch of the cubes / mm", title=title)
        axis.set_xticks(pitches, [f"{pitch:.0f}" for pitch in pitches], minor=False)
        axis.minorticks_off()
    axes[0].set_ylabel("rms error / rms pressure")
    axes[0].legend(
        title="width of the contact\n(dashed: without gradients)", fontsize=7, title_fontsize=7
    )
    return figure


def field_tables(study: FieldStudy) -> str:
    """Markdown: the field's error for each kind of skin, position and force of a contact.

    Then how many times fewer cubes give the same error as values alone.
    """
    error, position, force = study.error, 1e3 * study.position, study.force
    parts = [
        "field: " + " / ".join(SKIN_KINDS),
        _table(study, lambda i, j: " / ".join(f"{one:.2f}" for one in error[i, j])),
        "position, 95th percentile in mm: all components / planar",
        _table(study, lambda i, j: " / ".join(f"{one:.2g}" for one in position[i, j, 1:])),
        "force, rms: all components / planar",
        _table(study, lambda i, j: " / ".join(f"{one:.2f}" for one in force[i, j, 1:])),
    ]
    for level in _ERROR_LEVELS:
        saved = np.round(study.cubes_saved(level)[:, 1:], 1).tolist()
        parts.append(f"cubes saved at an error of {level}, per width, all / planar: {saved}")
    return "\n\n".join(parts)


def _table(study: FieldStudy, cell: Callable[[int, int], str]) -> str:
    """A row per width and a column per pitch; cell(row, column) is the text of one cell."""
    pitches = " | ".join(f"{1e3 * pitch:.0f} mm" for pitch in study.pitches)
    lines = [f"| width \\ pitch | {pitches} |", "|---" * (1 + len(study.pitches)) + "|"]
    for row, width in enumerate(study.widths):
        cells = " | ".join(cell(row, column) for column in range(len(study.pitches)))
        lines.append(f"| {1e3 * width:.0f} mm | {cells} |")
    return "\n".join(lines)
