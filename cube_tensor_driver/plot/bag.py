"""./cube plot: frequencies, stress, gradient and residual of one cube of a bag over time."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from ..bags.read import Bag
from ..bags.reprocess import Recording
from ..core.errors import BagError
from ..core.modes import COMPONENTS, STRESS
from ..core.status import INVALID, RESIDUAL
from .plots import MARKERS, save

STYLES = ("-", "--", "-.", ":")
MARKS = 12
"""Of a line."""
POINTS = 20_000
"""More do not show on paper."""


@dataclass(frozen=True)
class Options:
    """As on the command line; times in s after the start of the bag, None: not given."""

    bag: Path
    cube: str | None
    start: float | None
    end: float | None
    output: Path


@dataclass(frozen=True, eq=False)
class Series:
    """One cube over time: seconds (N,) after the start of the bag; frequency (N, P) Hz; values (N,
    15) Pa and Pa/m."""

    name: str
    pads: list[str]
    seconds: np.ndarray
    frequency: np.ndarray
    rest: np.ndarray
    values: np.ndarray
    residual: np.ndarray
    status: np.ndarray


def run_plot(options: Options) -> int:
    """Draw and write. BagError: no such cube, nothing in that time, several skins."""
    with Bag(options.bag) as bag:
        series = cube_series(bag, options.cube, options.start, options.end)
    save(draw_series(series, options.bag.resolve().name), options.output)
    print(f"wrote {options.output}: cube {series.name}, {len(series.seconds)} samples")
    return 0


def cube_series(bag: Bag, name: str | None, start_s: float | None, end_s: float | None) -> Series:
    """A cube (None: the first) between two times. Stress is made of the frequencies, as it was when
    recorded."""
    recording = Recording(bag, f"{bag.skin()}frequencies")
    cubes = recording.infos[-1].cubes
    names = [cube.name for cube in cubes]
    if name is not None and name not in names:
        raise BagError(f"{bag.path}: no cube {name!r}; there are {', '.join(names[:20])}")
    number = 0 if name is None else names.index(name)
    n_pads = len(cubes[number].pads)
    start, end = 0.0 if start_s is None else start_s, np.inf if end_s is None else end_s
    parts = []
    for source, _, rows in recording.batches():
        seconds = (rows.stamp_ns - bag.start_ns) * 1e-9
        chosen = (rows.cube == number) & (seconds >= start) & (seconds <= end)
        frequency = source.rows.frequency[chosen, :n_pads]
        values = np.hstack([rows.stress, rows.gradient])[chosen]
        parts.append(
            (seconds[chosen], frequency, values, rows.residual[chosen], rows.status[chosen])
        )
    if not sum(len(part[0]) for part in parts):
        length = (bag.end_ns - bag.start_ns) * 1e-9
        raise BagError(
            f"{bag.path}: no sample of {names[number]} from {start:g} to {end:g} s; the bag is {length:.3f} s long"
        )
    joined = [np.concatenate(column) for column in zip(*parts, strict=True)]
    thin = slice(None, None, -(-len(joined[0]) // POINTS))
    seconds, frequency, values, residual, status = (column[thin] for column in joined)
    rest = np.asarray(cubes[number].rest_frequency)
    return Series(
        names[number], list(cubes[number].pads), seconds, frequency, rest, values, residual, status
    )


def draw_series(series: Series, title: str) -> Figure:
    """Four panels over one axis of time; components that are not observed are left out."""
    figure, axes = plt.subplots(4, 1, figsize=(8, 9), sharex=True)
    change = 100 * (series.frequency / series.rest - 1)
    _lines(axes[0], series.seconds, change, series.pads)
    axes[0].set(ylabel="frequency above rest / %", title=f"{title}: cube {series.name}")
    count = len(STRESS)
    _lines(axes[1], series.seconds, series.values[:, :count] * 1e-3, list(STRESS))
    axes[1].set(ylabel="stress / kPa (tension +)")
    labels = [f"∂{name[:2]}/∂{name[3]}" for name in COMPONENTS[count:]]
    _lines(axes[2], series.seconds, series.values[:, count:] * 1e-6, labels)
    axes[2].set(ylabel="gradient / kPa per mm")
    axes[3].plot(series.seconds, series.residual, color="0.3", lw=0.8, label="residual")
    for bit, word, marker in ((RESIDUAL, "residual too large", "x"), (INVALID, "invalid", "v")):
        bad = series.status & bit > 0
        if bad.any():
            axes[3].plot(
                series.seconds[bad],
                np.nan_to_num(series.residual[bad]),
                marker,
                color="C3",
                ms=4,
                label=word,
            )
    axes[3].set(ylabel="residual / noise", xlabel="time after the start of the bag / s")
    axes[3].legend(loc="upper right", fontsize=7)
    return figure


def _lines(axes, seconds: np.ndarray, columns: np.ndarray, names: list[str]) -> None:  # type: ignore[no-untyped-def]
    """Told apart by dashes, markers and lightness: a copier knows no colour."""
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
            STYLES[number % len(STYLES)],
            lw=0.9,
            color=str(0.6 * number / len(shown)),
            ms=4,
            marker=MARKERS[number % len(MARKERS)],
            mfc="white",
            markevery=(number * step // len(shown), step),
            label=name,
        )
    axes.legend(
        loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=7, ncols=1 if len(names) <= 12 else 2
    )
