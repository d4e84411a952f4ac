# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Picture of `./cube bench scale`: cost and latency over the number of cubes."""

from __future__ import annotations

from typing import Any

from matplotlib.figure import Figure

from cube_tensor_driver.views.figures.style import print_style

CPU_LINES = (
    ("driver", "cpu_driver_percent", "o-", "black"),
    ("reconstruction", "cpu_reconstruction_percent", "s-", "black"),
    ("echo: the same messages, no work", "echo_cpu_percent", "^:", "0.55"),
)
"""Label, key in the result of `./cube bench skin`, line style and colour of each processor time."""

MARKER: dict[str, Any] = {"mfc": "white", "ms": 5}
"""Style of the markers of all drawn lines."""

LATENCY_LINES = (
    ("median", "latency_p50_ms", "o-"),
    ("99th percentile", "latency_p99_ms", "s--"),
)
"""Label, key in the result of `./cube bench skin` and line style of each drawn latency."""


@print_style()
def draw_scale(rows: list[dict[str, Any]]) -> Figure:
    """Draw processor time per scan and latency over the number of cubes.

    The time of the echo is a lower bound: it sends and receives the same messages, without work.

    Args:
        rows: Figures of `./cube bench skin`, one table for each number of cubes.
    """
    figure = Figure(figsize=(8, 3.6))
    left, right = figure.subplots(1, 2)
    cubes = [row["cubes"] for row in rows]
    for label, key, style, color in CPU_LINES:
        # One percent of a core is 10 ms per second.
        cpu_us = [1e4 * row[key] / row["rate_hz"] for row in rows]
        left.plot(cubes, cpu_us, style, color=color, label=label, **MARKER)
    for label, key, style in LATENCY_LINES:
        latency_ms = [row[key] for row in rows]
        right.plot(
            cubes,
            latency_ms,
            style,
            color="black",
            label=label,
            **MARKER,
        )
    left.set(ylabel="CPU per scan / µs", title="cost of one scan of all cubes")
    right.set(ylabel="latency / ms", title="from reading the pads to receiving the tensor")
    for axes in (left, right):
        axes.set(
            xscale="log",
            xlabel="number of cubes",
            ylim=(0, None),
        )
        # The ticks are the numbers of cubes, not powers of ten.
        axes.set_xticks(cubes, [str(count) for count in cubes])
        axes.xaxis.minorticks_off()
        axes.legend()
    return figure
