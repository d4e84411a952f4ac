# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Curves over time in panels one below the other, for `./cube plot` and for the browser page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from ...core.arrays import AnyArray, Real
from .style import choose_curve_style, print_style

Panel = tuple[str, Mapping[str, AnyArray]]
"""A panel: label of its value axis; name of each line -> its values (M,), in the unit of the label.
"""

MIN_GAP_STEPS = 3.0
"""Minimum time between two successive samples that counts as a gap, divided by the median of the
times between all successive samples. No line connects the two samples at a gap."""

MARKERS_PER_LINE = 12
"""Approximate number of markers on a line; they show which line it is, not single samples."""


MAX_LEGEND_LINES = 12
"""Maximum number of lines in a panel whose legend has one column; for more it has two."""


@print_style()
def draw_panels(
    times: Real,
    time_label: str,
    panels: Sequence[Panel],
) -> Figure:
    """Draw panels one below the other over a common time axis.

    Args:
        times: (M,) times of all values, in s.
        time_label: Label of the time axis.
        panels: The panels, from top to bottom; a line that is NaN everywhere is left out.
    """
    figure = Figure(figsize=(8, 2.5 * len(panels)))
    grid = figure.subplots(
        len(panels),
        1,
        sharex=True,
        squeeze=False,
    )
    axes = grid[:, 0]
    steps = np.diff(times)
    usual_step = float(np.median(steps)) if len(steps) else 0.0
    gaps = 1 + np.flatnonzero(steps > MIN_GAP_STEPS * usual_step)
    # matplotlib interrupts a line at NaN.
    broken_times = np.insert(times, gaps, np.nan)
    spacing = max(1, len(times) // MARKERS_PER_LINE)
    for axis, (label, lines) in zip(axes, panels, strict=True):
        shown = {}
        for name, values in lines.items():
            if np.isfinite(values).any():
                shown[name] = values
        for number, (name, values) in enumerate(shown.items()):
            # The first marker of each line is at another sample, so that markers do not overlap.
            first_marker = number * spacing // len(shown)
            axis.plot(
                broken_times,
                np.insert(values, gaps, np.nan),
                label=name,
                markevery=(first_marker, spacing),
                **choose_curve_style(number) | {"linewidth": 0.9},
            )
        axis.set_ylabel(label)
        axis.legend(
            loc="center left",
            bbox_to_anchor=(1.0, 0.5),
            fontsize=7,
            handlelength=3,
            ncol=1 if len(shown) <= MAX_LEGEND_LINES else 2,
        )
    axes[-1].set_xlabel(time_label)
    return figure
