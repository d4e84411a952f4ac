"""./cube plot: frequencies, stress, gradient and residual of one cube of a bag over time."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ...bags.reprocess.job import reconstruct
from ...bags.source import BagSource
from ...core.errors import BagError
from ...core.modes import COMPONENTS, STRESS
from ...core.status import INVALID, RESIDUAL
from .style import MARKERS, print_style, symbol

DASHES = ("-", "--", "-.", ":")
GAP = 3.0
"""Times the usual step: a longer one is a gap, which no line bridges."""
MARKS = 12
"""Markers on a line."""
POINTS = 20_000
"""Most points of a line; more do not show on paper."""


@dataclass(frozen=True, eq=False)
class TimeSeries:
    """One cube over time, a row per sample.

    seconds: (N,) after the start of the bag
    frequency: (N, P) Hz; rest: (P,) Hz, the frequencies at rest
    values: (N, 15) stress in Pa and gradient in Pa/m; NaN: not observed
    residual: (N,) over noise; status: (N,) bits of core.status
    """

    name: str
    pads: list[str]
    seconds: np.ndarray
    frequency: np.ndarray
    rest: np.ndarray
    values: np.ndarray
    residual: np.ndarray
    status: np.ndarray


def cube_series(
    source: BagSource, name: str | None, start_s: float | None, end_s: float | None
) -> TimeSeries:
    """A cube between two times after the bag's start; None: the first cube, from start to end.

    Stress is reconstructed from the frequencies, as it was when they were recorded. Raises BagError
    when there is no such cube, or no sample in that time.
    """
    bag = source.bag
    cubes = source.recording.infos[-1].cubes
    names = [cube.name for cube in cubes]
    if name is not None and name not in names:
        raise BagError(f"{bag.path}: no cube {name!r}; there are {', '.join(names[:20])}")
    number = 0 if name is None else names.index(name)
    n_pads = len(cubes[number].pads)
    start = 0.0 if start_s is None else start_s
    end = np.inf if end_s is None else end_s
    parts = []
    for segment, rows in reconstruct(source):
        seconds = (rows.stamp_ns - bag.start_ns) * 1e-9
        chosen = (rows.cube == number) & (seconds >= start) & (seconds <= end)
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
    every = -(-len(joined[0]) // POINTS)
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
    """Four panels over one axis of time; components that are not observed are left out."""
    series = _with_breaks(series)
    figure = Figure(figsize=(8, 9))
    axes = figure.subplots(4, 1, sharex=True)
    seconds, stresses = series.seconds, len(STRESS)
    change = 100 * (series.frequency / series.rest - 1)
    _draw_columns(axes[0], seconds, change, series.pads)
    axes[0].set(ylabel="frequency above rest / %", title=f"{title}: cube {series.name}")
    _draw_columns(
        axes[1], seconds, series.values[:, :stresses] * 1e-3, [symbol(name) for name in STRESS]
    )
    axes[1].set(ylabel="stress / kPa (tension: +)")
    gradients = [symbol(name) for name in COMPONENTS[stresses:]]
    _draw_columns(axes[2], seconds, series.values[:, stresses:] * 1e-6, gradients)
    axes[2].set(ylabel="gradient / (kPa/mm)")
    axes[3].plot(seconds, series.residual, color="0.3", lw=0.8, label="residual")
    for bit, label, marker in ((RESIDUAL, "residual too large", "x"), (INVALID, "invalid", "v")):
        bad = series.status & bit > 0
        if bad.any():
            residual = np.nan_to_num(series.residual[bad])
            axes[3].plot(seconds[bad], residual, marker, color="C3", ms=4, label=label)
    axes[3].set(ylabel="residual / expected noise", xlabel="time after the start of the bag / s")
    axes[3].legend(loc="upper right", fontsize=7)
    return figure


def _with_breaks(series: TimeSeries) -> TimeSeries:
    """The series with a row of NaN in each gap, where a line breaks off."""
    step = np.diff(series.seconds)
    if not len(step):
        return series
    at = np.flatnonzero(step > GAP * np.median(step)) + 1
    return replace(
        series,
        seconds=np.insert(series.seconds, at, np.nan),
        frequency=np.insert(series.frequency, at, np.nan, axis=0),
        values=np.insert(series.values, at, np.nan, axis=0),
        residual=np.insert(series.residual, at, np.nan),
        status=np.insert(series.status, at, 0),
    )


def _draw_columns(axes: Any, seconds: np.ndarray, columns: np.ndarray, names: list[str]) -> None:
    """Lines that differ in dashes, markers and lightness: they can be told apart in grey."""
    shown = [
        (values, name)
        for values, name in zip(columns.T, names, strict=True)
        if np.isfinite(values).any()
    ]
    step = max(1, len(seconds) // MARKS)
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
            markevery=(number * step // len(shown), step),
            label=name,
        )
    columns_of_legend = 1 if len(names) <= 12 else 2
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=7, ncol=columns_of_legend)
