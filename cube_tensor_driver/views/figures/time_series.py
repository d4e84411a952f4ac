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
from ...core.arrays import AnyArray
from ...core.errors import BagError
from ...core.modes import COMPONENTS, STRESS
from ...core.status import INVALID, RESIDUAL
from .panels import draw_panels
from .style import print_style, symbol

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
        values: (N, 15) 6 stress components in Pa and 9 gradients in Pa/m, in the frame of the
            cube; NaN where they are not observed.
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
        is_in_time = (seconds >= start) & (seconds <= end)
        chosen = is_in_time & (rows.cube == number)
        # The array has a column for each pad of the cube with the most pads; those behind the
        # pads of this cube are unused.
        frequency = segment.messages.rows.frequency[chosen, :n_pads]
        own = rows.select(chosen)
        values = np.hstack([own.stress, own.gradient])
        part = (seconds[chosen], frequency, values, own.residual, own.status)
        parts.append(part)
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
    change_percent = 100 * (series.frequency / series.rest - 1)
    symbols = [symbol(name) for name in COMPONENTS]
    lines = dict(zip(symbols, series.values.T, strict=True))
    figure = draw_panels(
        series.seconds,
        "time after the start of the bag / s",
        [
            (
                "frequency above rest / %",
                dict(zip(series.pads, change_percent.T, strict=True)),
            ),
            (
                "stress / kPa (tension: +)",
                {name: 1e-3 * lines[name] for name in symbols[: len(STRESS)]},
            ),
            (
                "gradient / (kPa/mm)",
                {name: 1e-6 * lines[name] for name in symbols[len(STRESS) :]},
            ),
            ("residual / expected noise", {"residual": series.residual}),
        ],
    )
    top, *_, bottom = figure.axes
    top.set_title(f"{title}: cube {series.name}")
    for bit, label, marker in ((RESIDUAL, "residual too large", "x"), (INVALID, "invalid", "v")):
        is_marked = series.status & bit > 0
        if is_marked.any():
            # The residual of an invalid row is NaN; its mark is drawn at zero.
            residual = np.nan_to_num(series.residual[is_marked])
            seconds = series.seconds[is_marked]
            bottom.plot(seconds, residual, marker, color="C3", ms=4, label=label)
    bottom.legend(loc="upper right", fontsize=7)
    return figure
