# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Statistics of every pad over windows of half a second.

From the frequencies f[n] of a pad at the times t[n] of successive rows are computed:

    first difference     d[n] = f[n] - f[n-1]
    second difference    e[n] = d[n] - r d[n-1],   r = (t[n] - t[n-1]) / (t[n-1] - t[n-2])
    noise                sqrt(mean(w e²) / 6),     w = 6 / (1 + (1 + r)² + r²)
    roughness            sum(w e²) / sum(d²)

Second differences of white noise with variance s² have the variance 6 s² (for r = 1). The frequency
shift by a load that moves slowly has almost no second difference, not even where rows are missing,
because the ratio r of the time intervals takes them into account.

In the noise each term w e² is cut to a limit, so that one jump does not look like noise. In the
roughness it is not cut, because strong noise would then look like a moving load. The roughness is 3
for noise, and (2 pi F T)² for a load that oscillates with frequency F and is sampled with period T.

r is set to 1 if two intervals are equal within `MAX_JITTER_RATIO`. w is set to 0 if an interval is
`GAP_NS` or longer, and if one of the three time stamps is doubtful.

The kernel (`kernel/`) adds the rows to the sums; this module makes the statistics of a window from
them. All arrays are (cubes, pads); nothing loops over cubes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..arrays import Array, Index, Mask, Single, Times
from ..kernel.contract import CUBE_STATE, PAD_QUANTITIES, HealthState

WINDOW_S = 0.5
"""Length of a window over which statistics of the pads are formed, in seconds.

It is measured by the time stamps of the rows and not by a clock, so that a replay gives the same
windows.
"""

MAX_SMOOTH_ROUGHNESS = 0.3
"""Roughness (squared second differences / squared first differences of a pad's frequency, summed
over a window) below which a moving load, and not noise, explains the changes of the frequency.

At 100 rows per second, the roughness of a load that oscillates at up to 9 Hz is below it.
"""

GAP_NS = 50_000_000
"""Interval between the time stamps of two rows of a cube, in ns, from which on the interval counts
as a gap: how the frequencies changed within it is unknown.

Statistics need at least 20 rows in a window of 0.5 s, so intervals are usually at most 25 ms.
"""

MAX_JITTER_RATIO = 1.5
"""Ratio of the longer to the shorter one of two successive intervals between the rows (samples) of
a cube up to which the intervals count as equal.

The jitter of time stamps changes intervals by less, and a missing row doubles an interval.
"""


class Window(NamedTuple):
    """Statistics of the frequencies of all pads in one window of 0.5 s.

    Attributes:
        rows: Number of rows of each cube (cubes,).
        mean, lowest, highest: Mean, lowest and highest frequency of each pad (cubes, P), in Hz. NaN
            where nothing was measured.
        noise: Noise (standard deviation without slow changes) of each pad's frequency (cubes, P),
            in Hz. NaN where nothing was measured.
        rough: Whether the roughness of a pad's frequency is above `MAX_SMOOTH_ROUGHNESS`, so that
            noise and not a moving load explains its changes (cubes, P).
        gap_before: Interval from the last row before the window to its first row (cubes,), in ns.
        gap_within: Longest interval between two rows of the window (cubes,), in ns.

    Both gaps are 0 where no interval reached `GAP_NS`, and negative where time went back.
    """

    rows: Index
    mean: Array
    lowest: Single
    highest: Single
    noise: Array
    rough: Mask
    gap_before: Times
    gap_within: Times


def make_state(rest_frequency: Array) -> HealthState:
    """Return the state of the health of a skin before its first row.

    Differences are formed from row to row also across the end of a window.

    Args:
        rest_frequency: Frequencies without load (cubes, P), in Hz, NaN where a cube has no such
            pad. Frequencies are summed after these are subtracted, because float32 is precise
            enough only for the differences.
    """
    n_cubes, n_pads = rest_frequency.shape
    shape = len(PAD_QUANTITIES), n_cubes, n_pads
    n_words = CUBE_STATE.itemsize // 8
    state = HealthState(
        words=np.zeros((n_cubes, n_words), np.int64),
        quantities=np.full(shape, np.nan, np.float32),
        window_ns=np.array([1, 0, 0]),  # holds no time, so that the first row opens a window
    )
    state.cubes["temperature"] = np.nan
    state.view_pads("base")[:] = rest_frequency
    clear_sums(state)
    return state


def clear_sums(state: HealthState) -> None:
    """Start a new window: reset the sums, extremes, counts and gaps between rows, in place."""
    for name in ("first_squares", "second_squares", "bounded_squares", "sum"):
        state.view_pads(name)[:] = 0
    state.view_pads("lowest")[:] = np.inf
    state.view_pads("highest")[:] = -np.inf
    for name in ("gap_before", "gap_within", "rows", "over_limit"):
        state.cubes[name] = 0


def make_window(state: HealthState) -> Window:
    """Compute the statistics of the rows that the present window has so far."""
    rows = state.cubes["rows"]
    count = np.maximum(rows, 1)[:, None]
    base = state.view_pads("base")
    lowest = state.view_pads("lowest")
    highest = state.view_pads("highest")
    is_measured = (rows[:, None] > 0) & ~np.isnan(base)
    mean = base + state.view_pads("sum") / count
    noise = np.sqrt(state.view_pads("bounded_squares") / count / 6)
    # The minimum is above the maximum where no frequency was measured in the window.
    has_span = is_measured & (lowest <= highest)
    first_squares = state.view_pads("first_squares")
    second_squares = state.view_pads("second_squares")
    with np.errstate(invalid="ignore"):  # NaN where a frequency was not measured
        rough = second_squares > MAX_SMOOTH_ROUGHNESS * first_squares
    return Window(
        rows=rows.copy(),
        mean=np.where(is_measured, mean, np.nan),
        lowest=np.where(has_span, lowest, np.nan),
        highest=np.where(has_span, highest, np.nan),
        noise=np.where(is_measured, noise, np.nan),
        rough=rough,
        gap_before=state.cubes["gap_before"].copy(),
        gap_within=state.cubes["gap_within"].copy(),
    )
