# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Curves with labels, as most pictures of this folder draw them."""

from __future__ import annotations

from collections.abc import Mapping

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cube_tensor_driver.core.arrays import Array
from cube_tensor_driver.views.figures.style import choose_curve_style


def draw_curves(
    axis: Axes,
    x: Array,
    curves: Mapping[str, Array],
    spacing: int = 1,
    **style: object,
) -> None:
    """Draw curves in kPa or kHz over positions in mm, each in a style of its own.

    Args:
        axis: Panel.
        x: (n,) positions, in m.
        curves: (n,) values in Pa or Hz by label.
        spacing: Number of points from one marker of a curve to the next. The first markers of the
            curves are at different points, so that markers do not cover each other.
        style: Styles that all curves share, in place of those of `choose_curve_style`.
    """
    for number, (label, values) in enumerate(curves.items()):
        own_style = choose_curve_style(number) | {"markevery": (4 * number % spacing, spacing)}
        (curve,) = axis.plot(1e3 * x, 1e-3 * values, label=label)
        curve.set(**own_style | style)


def add_legend_below(figure: Figure) -> None:
    """Add a legend of the first panel's curves below all panels."""
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(
        handles,
        labels,
        handlelength=4,
        ncols=3,
        fontsize="small",
        loc="outside lower center",
    )
