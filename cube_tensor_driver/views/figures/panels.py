# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Curves over time in panels one below the other, as the page saves its plots."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.figure import Figure

from ...core.arrays import Array
from .style import curve_style, print_style

Panel = tuple[str, Array, dict[str, Array]]
"""A chart for a picture: label of its value axis; times (M,) in s before now; name of a line -> its
values (M,), in the unit of the label."""


@print_style()
def draw_panels(panels: Sequence[Panel]) -> Figure:
    """Draw panels one below the other over a common time axis.

    Args:
        panels: Label, times and values of each panel, in the order from top to bottom.
    """
    figure = Figure(figsize=(8, 3 * len(panels)))
    axes = figure.subplots(
        len(panels),
        1,
        sharex=True,
        squeeze=False,
    )[:, 0]
    for axis, (label, times, lines) in zip(
        axes,
        panels,
        strict=True,
    ):
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
