# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Pictures of the pressure between the cubes as different methods compute it, and of its study."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.collections import TriMesh
from matplotlib.figure import Figure
from numpy.typing import NDArray

from cube_tensor_driver.core.arrays import Array
from cube_tensor_driver.views.figures.style import choose_curve_style, print_style

from ..studies.field_study import FieldExample, FieldStudy
from ..studies.traction_study import METHODS

VIEW_MM = 22.0
"""Half side of the square that each map of the pressure shows, in mm."""
CONTOUR_STEP_KPA = 4
"""Difference in pressure between two neighbouring contour lines of a map, in kPa."""
PRESSURE_LABEL = f"pressure at the cubes' depth / kPa\n(contours: {CONTOUR_STEP_KPA} kPa apart)"
"""Label of the colour bar of pressures."""


@print_style()
def draw_methods(example: FieldExample, prefix: str = "") -> Figure:
    """Draw the true pressure below one contact and that of each method.

    Args:
        example: The contact. The titles give the rms error over the rms of the true pressure.
        prefix: Words before the name of each method.
    """
    figure = Figure(figsize=(9, 3.3))
    axes = _make_map_panels(figure, 1, len(example.pressure))
    truth = example.pressure["truth"]
    maps = {}
    for name, pressure in example.pressure.items():
        share = compute_relative_rms(pressure - truth, truth)
        title = f"{prefix}{name}\nrms error {100 * share:.0f} %"
        maps[name if name == "truth" else title] = pressure
    image = _draw_maps(axes[0], example, maps)
    figure.colorbar(image, ax=axes, label=PRESSURE_LABEL, shrink=0.8)
    return figure


@print_style()
def draw_traction(example: FieldExample) -> Figure:
    """Draw one contact as each of METHODS computes it, and the error of the last method.

    The error and the predicted deviation have a scale of their own. The titles give the rms of the
    errors over that of the pressure.
    """
    figure = Figure(figsize=(9, 5.6))
    axes = _make_map_panels(figure, 2, 3)
    truth = example.pressure["truth"]
    predicted = example.pressure["standard deviation"]

    maps = {"truth": truth}
    for name in METHODS:
        share = compute_relative_rms(example.pressure[name] - truth, truth)
        maps[f"{name}: {100 * share:.1f} %"] = example.pressure[name]
    image = _draw_maps(axes.flat[:4], example, maps)
    figure.colorbar(image, ax=axes[0], label=PRESSURE_LABEL)

    error = np.abs(example.pressure[METHODS[-1]] - truth)
    errors = {
        f"its error: {100 * compute_relative_rms(error, truth):.1f} %": error,
        f"predicted: {100 * compute_relative_rms(predicted, truth):.1f} %": predicted,
    }
    image = _draw_maps(axes.flat[4:], example, errors)
    # A colour bar of the whole row keeps the columns of both rows aligned.
    figure.colorbar(
        image,
        ax=axes[1],
        label="error and predicted\ndeviation / kPa",
    )
    return figure


def compute_relative_rms(values: Array, reference: Array) -> float:
    """Return the rms of values over the rms of a reference."""
    return float(np.linalg.norm(values) / np.linalg.norm(reference))


def _make_map_panels(
    figure: Figure,
    rows: int,
    columns: int,
) -> NDArray[np.object_]:
    """Return panels (rows, columns) for maps of the same square, with labels at the outer ones."""
    axes = figure.subplots(
        rows,
        columns,
        sharex=True,
        sharey=True,
        squeeze=False,
    )
    view = (-VIEW_MM, VIEW_MM)
    for axis in axes.flat:
        axis.set(
            aspect="equal",
            xlim=view,
            ylim=view,
            xlabel="$x$ / mm",
            ylabel="$y$ / mm",
        )
        axis.grid(False)
        axis.label_outer()
    return axes


def _draw_maps(
    axes: NDArray[np.object_],
    example: FieldExample,
    maps: Mapping[str, Array],
) -> TriMesh:
    """Draw maps (M,) in Pa by their title, with cubes and load, from 0 to the largest of all."""
    x, y = 1e3 * example.points[:, :2].T
    cubes = 1e3 * example.cubes[:, :2].T
    load = 1e3 * example.centre
    top = 1e-3 * max(values.max() for values in maps.values())
    levels = np.arange(CONTOUR_STEP_KPA / 2, top, CONTOUR_STEP_KPA)
    for axis, (title, values) in zip(axes, maps.items(), strict=True):
        # A method may compute tension, which no contact makes.
        kilopascal = 1e-3 * np.maximum(values, 0)
        image: TriMesh = axis.tripcolor(
            x,
            y,
            kilopascal,
            vmin=0,
            vmax=top,
            shading="gouraud",
        )
        image.set_rasterized(True)
        axis.tricontour(
            x,
            y,
            kilopascal,
            levels=levels,
            colors="white",
            linewidths=0.5,
        )
        axis.plot(*cubes, "s", ms=4, mfc="none", mec="0.8", label="cube")
        axis.plot(
            *load,
            "P",
            ms=7,
            mfc="red",
            mec="white",
            mew=0.8,
            label="load",
        )
        axis.set_title(title)
    axes[0].legend(
        fontsize=7,
        loc="lower left",
        facecolor="0.3",
        labelcolor="white",
    )
    return image


@print_style()
def draw_field_study(study: FieldStudy) -> Figure:
    """Draw the error of the field over pitch for each width; dashed: from values alone.

    The left panel is for cubes that observe every gradient, the right one for planar cubes.
    """
    figure = Figure(figsize=(9, 3.8))
    axes = figure.subplots(1, 2, sharey=True)
    titles = ("cubes that observe every gradient", "planar cubes")
    pitches = 1e3 * study.pitches
    for kind, (axis, title) in enumerate(zip(axes, titles, strict=True), 1):
        for row, width in enumerate(study.widths):
            style = choose_curve_style(row) | {"linestyle": "-"}
            errors = study.error[row]
            axis.loglog(pitches, errors[:, 0], **style | {"linestyle": "--"})
            axis.loglog(
                pitches,
                errors[:, kind],
                label=f"{1e3 * width:.0f} mm",
                **style,
            )
        axis.set(xlabel="pitch of the cubes / mm", title=title)
        axis.set_xticks(
            pitches,
            [f"{pitch:.0f}" for pitch in pitches],
            minor=False,
        )
        axis.minorticks_off()
    # Both panels share the legend: their widths have the same colours and markers.
    axes[0].set_ylabel("rms error / rms pressure")
    legend = "width of the contact\n(dashed: without gradients)"
    axes[0].legend(
        title=legend,
        fontsize=7,
        title_fontsize=7,
    )
    return figure
