# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The picture of `./cube bench contacts`: errors of the force by shape, and as they are stated."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from cube_tensor_design.studies.field_study import FORCE
from cube_tensor_driver.views.figures.style import choose_curve_style, print_style

from .contacts import SHAPES, SKINS, TrackingResults, summarise

ERRORS = np.array([0.02, 10.0])
"""Range of errors and of their predicted standard deviations that the picture shows, in % of the
force."""


@print_style()
def draw_shapes(results: TrackingResults) -> Figure:
    """Draw the rms error of the force of each shape, and the error of each load over the stated
    standard deviation."""
    figure = Figure(figsize=(9, 4))
    by_shape, by_load = figure.subplots(1, 2, width_ratios=[3, 2])
    summary = summarise(results)
    for row, skin in enumerate(SKINS):
        style = choose_curve_style(row) | {"linestyle": "none", "alpha": 0.8}
        errors = [summary[f"{name}, {skin}"]["force_error_percent"] for name in SHAPES]
        by_shape.semilogx(errors, list(SHAPES), label=skin, **style)
        _draw_loads(by_load, results, skin, style)
    by_shape.invert_yaxis()
    by_shape.set(xlim=ERRORS, xlabel="force, rms error / %")
    by_shape.legend(
        loc="lower center",
        bbox_to_anchor=(0.4, 1),
        ncols=3,
        fontsize=7,
    )

    by_load.loglog(ERRORS, ERRORS, "k-", lw=1, label="error = stated")
    by_load.loglog(ERRORS, 2 * ERRORS, "k--", lw=1, label="twice")
    by_load.set(
        xlim=ERRORS,
        ylim=ERRORS,
        xlabel="force, stated standard deviation / %",
        ylabel="force, error of each load / %",
    )
    by_load.legend(fontsize=7)
    return figure


def _draw_loads(
    axis: Any,
    results: TrackingResults,
    skin: str,
    style: dict[str, Any],
) -> None:
    """Draw a point for each load on a skin; those without error are left out of the axes."""
    loads = [load.errors for name in SHAPES for load in results[skin, name]]
    error, deviation = 100 * np.abs(np.array(loads)[:, :2].T) / FORCE
    axis.loglog(deviation, error, **style | {"markersize": 2})
