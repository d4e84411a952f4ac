# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The picture of `./cube plot`: one cube of a bag over time."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ...bags.reprocess.job import reconstruct
from ...bags.source import BagSource
from ...core.arrays import AnyArray
from ...core.errors import BagError
from ...core.modes import COMPONENTS, STRESS
from ...core.status import INVALID, RESIDUAL
from .style import MARKERS, print_style, symbol

DASHES = ("-", "--", "-.", ":")
"""Line styles of matplotlib, in the order in which the lines of a panel use them."""

MIN_GAP_STEPS = 3.0
"""Minimum time between two samples, relative to the median of this time, that counts as a gap.

No line connects the two samples at a gap.
"""

MARKERS_PER_LINE = 12
"""Approximate number of markers on a line; they show which line it is, not single samples."""

MAX_POINTS = 20_000
"""Maximum number of samples of a line that are drawn; more cannot be distinguished on paper."""

MAX_NAMED_CUBES = 20
"""Maximum number of cube names that an error message lists."""


@dataclass(frozen=True, eq=False)
class TimeSeries:
    """N samples of one cube with P pads.

    Attributes:
        name: Name of the cube.
        pads: Names of its pads.
        seconds: (N,) time after the start of the bag, in seconds.
        frequency: (N, P) frequencies of the pads, in Hz.
        rest: (P,) frequencies of the pads without load, in Hz.
        values: (N, 15) 6 stress components in Pa and 9 gradients in Pa/m, in the frames of the
            cubes; NaN where it is not observed.
        residual: (N,) misfit between pads and tensor relative to the noise; 1 for noise alone.
        status: (N,) status bits, as in core/status.py.
    """

    name: str
    pads: list[str]
    seconds: AnyArray
    frequency: AnyArray
    rest: AnyArray
    values: AnyArray
    residual: AnyArray
    status: AnyArray


def cube_series(
    source: BagSource, name: str | None, start_s: float | None, end_s: float | None
) -> TimeSeries:
    """Read the frequencies of one cube from a bag, and compute the stress from them.

    Args:
        source: The bag.
        name: Name of the cube; None: the first one.
        start_s: Time after the start of the bag to begin at, in seconds; None: the start.
        end_s: Time after the start of the bag to end at, in seconds; None: the end.

    Raises:
        BagError: There is no such cube, or it has no sample in this time.
    """
    bag = source.bag
    cubes = source.recording.infos[-1].cubes
    names = [cube.name for cube in cubes]
    if name is not None and name not in names:
        raise BagError(
            f"{bag.path}: no cube {name!r}; there are {', '.join(names[:MAX_NAMED_CUBES])}"
        )
    number = 0 if name is None else names.index(name)
    n_pads = len(cubes[number].pads)
    start = 0.0 if start_s is None else start_s
    end = np.inf if end_s is None else end_s

    parts = []
    for segment, rows in reconstruct(source):
        seconds = (rows.stamp_ns - bag.start_ns) * 1e-9
        chosen = (rows.cube == number) & (seconds >= start) & (seconds <= end)
        # The array has a column for each pad of the cube with the most pads; those behind the
        # pads of this cube are unused.
        frequency = segment.messages.rows.frequency[chosen, :n_pads]
        values = np.hstack([rows.stress, rows.gradient])[chosen]
        parts.append(
            (seconds[chosen], frequency, values, rows.residual[chosen], rows.status[chosen])
        )
    if not sum(len(part[0]) for part in parts):
        length = (bag.end_ns - bag.start_ns) * 1e-9
        raise BagError(
            f"{bag.path}: no sample of {names[number]} from {start:g} to {end:g} s; "
            f"the bag is {length:.3f} s long"
        )
    joined = [np.concatenate(column) for column in zip(*parts, strict=True)]
    # Of a long recording only every n-th sample is drawn, see `MAX_POINTS`.
    every = math.ceil(len(joined[0]) / MAX_POINTS)
    seconds, frequency, values, residual, status = (column[::every] for column in joined)
    return TimeSeries(
        name=names[number],
        pads=list(cubes[number].pads),
        seconds=seconds,
        frequency=frequency,
        rest=np.asarray(cubes[number].rest_frequency),
        values=values,
        residual=residual,
        status=status,
    )


@print_style()
def draw_series(series: TimeSeries, title: str) -> Figure:
    """Draw frequencies, stress, gradients and residual of a cube over one time axis.

    Components that the cube does not observe are left out.

    Args:
        series: The samples of the cube.
        title: First part of the title, such as the name of the bag.
    """
    series = _with_breaks(series)
    figure = Figure(figsize=(8, 9))
    top, stress_axes, gradient_axes, bottom = figure.subplots(
        4,
        1,
        sharex=True,
    )
    seconds, n_stress = series.seconds, len(STRESS)

    change_percent = 100 * (series.frequency / series.rest - 1)
    _draw_columns(top, seconds, change_percent, series.pads)
    top.set(ylabel="frequency above rest / %", title=f"{title}: cube {series.name}")

    symbols = [symbol(name) for name in COMPONENTS]
    stress_kpa = series.values[:, :n_stress] * 1e-3
    _draw_columns(
        stress_axes,
        seconds,
        stress_kpa,
        symbols[:n_stress],
    )
    stress_axes.set(ylabel="stress / kPa (tension: +)")
    gradient_kpa_per_mm = series.values[:, n_stress:] * 1e-6
    _draw_columns(
        gradient_axes,
        seconds,
        gradient_kpa_per_mm,
        symbols[n_stress:],
    )
    gradient_axes.set(ylabel="gradient / (kPa/mm)")

    bottom.plot(
        seconds,
        series.residual,
        color="0.3",
        lw=0.8,
        label="residual",
    )
    for bit, label, marker in ((RESIDUAL, "residual too large", "x"), (INVALID, "invalid", "v")):
        is_marked = series.status & bit > 0
        if is_marked.any():
            # The residual of an invalid row is NaN; its mark is drawn at zero.
            residual = np.nan_to_num(series.residual[is_marked])
            bottom.plot(
                seconds[is_marked],
                residual,
                marker,
                color="C3",
                ms=4,
                label=label,
            )
    bottom.set(ylabel="residual / expected noise", xlabel="time after the start of the bag / s")
    bottom.legend(loc="upper right", fontsize=7)
    return figure


def _with_breaks(series: TimeSeries) -> TimeSeries:
    """Insert a sample of NaN into each gap (see `MIN_GAP_STEPS`) of a series of samples.

    matplotlib interrupts a line at NaN, so that no line connects the samples beside a gap.
    """
    step = np.diff(series.seconds)
    if not len(step):
        return series
    gaps = np.flatnonzero(step > MIN_GAP_STEPS * np.median(step)) + 1
    return replace(
        series,
        seconds=np.insert(series.seconds, gaps, np.nan),
        frequency=np.insert(series.frequency, gaps, np.nan, axis=0),
        values=np.insert(series.values, gaps, np.nan, axis=0),
        residual=np.insert(series.residual, gaps, np.nan),
        status=np.insert(series.status, gaps, 0),
    )


def _draw_columns(
    axes: Any,
    seconds: AnyArray,
    columns: AnyArray,
    names: list[str],
) -> None:
    """Draw lines that differ in dashes, markers and lightness, so that no colour is needed.

    Args:
        axes: The axes of matplotlib to draw into.
        seconds: (N,) times, in s.
        columns: (N, K) values of K lines; a line that is NaN everywhere is left out.
        names: K labels of the lines.
    """
    shown = [
        (values, name)
        for values, name in zip(columns.T, names, strict=True)
        if np.isfinite(values).any()
    ]
    step = max(1, len(seconds) // MARKERS_PER_LINE)
    for number, (values, name) in enumerate(shown):
        axes.plot(
            seconds,
            values,
            DASHES[number % len(DASHES)],
            lw=0.9,
            color=str(0.6 * number / len(shown)),
            ms=4,
            marker=MARKERS[number % len(MARKERS)],
            mfc="white",
            # The first marker of each line is at another sample, so that markers do not overlap.
            markevery=(number * step // len(shown), step),
            label=name,
        )
    columns_of_legend = 1 if len(names) <= 12 else 2
    axes.legend(
        loc="center left",
        bbox_to_anchor=(1.0, 0.5),
        fontsize=7,
        ncol=columns_of_legend,
    )
