# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The picture of `./cube plot`: one cube of a bag over time."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from ...bags.reprocess.job import reconstruct
from ...bags.source import BagSource
from ...calibrate.recorded_loads import find_cubes
from ...core.arrays import Array, Real, Single
from ...core.errors import BagError
from ...core.modes import GRADIENT, STRESS
from ...core.rows import StressRows, concatenate
from ...core.status import INVALID, RESIDUAL
from .panels import draw_panels
from .style import format_symbol, print_style

MAX_POINTS = 20_000
"""Maximum number of samples of a line that are drawn; more cannot be distinguished on paper."""


@dataclass(frozen=True, eq=False)
class TimeSeries:
    """N samples of one cube with P pads.

    Attributes:
        name: Name of the cube.
        pads: Names of its pads.
        seconds: (N,) time after the start of the bag, in seconds.
        frequency: (N, P) frequencies of the pads, in Hz.
        rest: (P,) frequencies of the pads without load, in Hz.
        rows: N rows of stress.
    """

    name: str
    pads: list[str]
    seconds: Real
    frequency: Single
    rest: Array
    rows: StressRows


def read_cube_series(
    source: BagSource,
    name: str | None,
    start_s: float,
    end_s: float,
) -> TimeSeries:
    """Read the frequencies of one cube from a bag, and compute the stress from them.

    Args:
        source: The bag.
        name: Name of the cube; None: the first one.
        start_s: Time after the start of the bag to begin at, in seconds.
        end_s: Time after the start of the bag to end at, in seconds; infinity: the end.

    Raises:
        BagError: There is no such cube, or it has no sample in this time.
    """
    bag = source.bag
    cubes = source.recording.infos[-1].cubes
    number, *_ = find_cubes(source, bag.path, name)
    n_pads = len(cubes[number].pads)

    frequencies: list[Single] = []
    parts: list[StressRows] = []
    for segment, rows in reconstruct(source):
        seconds = (rows.stamp_ns - bag.start_ns) * 1e-9
        is_in_time = (seconds >= start_s) & (seconds <= end_s)
        chosen = is_in_time & (rows.cube == number)
        # The array has as many columns as the cube with the most pads requires. Only the first
        # `n_pads` of them are pads of this cube.
        frequencies.append(segment.messages.rows.frequency[chosen, :n_pads])
        parts.append(rows.select(chosen))
    n_samples = sum(map(len, parts))
    if not n_samples:
        length = (bag.end_ns - bag.start_ns) * 1e-9
        raise BagError(
            f"{bag.path}: no sample of {cubes[number].name} from {start_s:g} to {end_s:g} s; "
            f"the bag is {length:.3f} s long"
        )
    # In a long recording only every n-th sample is drawn, see `MAX_POINTS`.
    drawn = slice(None, None, math.ceil(n_samples / MAX_POINTS))
    drawn_rows = concatenate(parts).select(drawn)
    return TimeSeries(
        name=cubes[number].name,
        pads=list(cubes[number].pads),
        seconds=(drawn_rows.stamp_ns - bag.start_ns) * 1e-9,
        frequency=np.concatenate(frequencies)[drawn],
        rest=np.asarray(cubes[number].rest_frequency),
        rows=drawn_rows,
    )


@print_style()
def draw_series(series: TimeSeries, title: str) -> Figure:
    """Draw frequencies, stress, gradients and residual of a cube over one time axis.

    Components that the cube does not observe are left out.

    Args:
        series: The samples of the cube.
        title: First part of the title, such as the name of the bag.
    """
    change_percent = 100 * (series.frequency / series.rest - 1)
    rows = series.rows
    stress = zip(
        map(format_symbol, STRESS),
        1e-3 * rows.stress.T,
        strict=True,
    )
    gradient = zip(
        map(format_symbol, GRADIENT),
        1e-6 * rows.gradient.T,
        strict=True,
    )
    figure = draw_panels(
        series.seconds,
        "time after the start of the bag / s",
        [
            ("frequency above rest / %", dict(zip(series.pads, change_percent.T, strict=True))),
            ("stress / kPa (tension: +)", dict(stress)),
            ("gradient / (kPa/mm)", dict(gradient)),
            ("residual / expected noise", {"residual": rows.residual}),
        ],
    )
    top, *_, bottom = figure.axes
    top.set_title(f"{title}: cube {series.name}")
    for bit, label, marker in ((RESIDUAL, "residual too large", "x"), (INVALID, "invalid", "v")):
        is_marked = rows.status & bit > 0
        if is_marked.any():
            # The residual of an invalid row is NaN; its mark is drawn at zero.
            residual = np.nan_to_num(rows.residual[is_marked])
            seconds = series.seconds[is_marked]
            bottom.plot(
                seconds,
                residual,
                marker,
                color="C3",
                ms=4,
                label=label,
            )
    bottom.legend(loc="upper right", fontsize=7)
    return figure
