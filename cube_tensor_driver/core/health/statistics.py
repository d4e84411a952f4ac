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

The sums are only needed at the end of a window. Single scans therefore wait until several can be
added in one pass: a call of numpy costs as much as the arithmetic of 64 cubes. All arrays are
(cubes, pads); nothing loops over cubes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..arrays import AnyArray, Array, Index, Mask, Single, Times

Cubes = slice | Index
"""Numbers of the cubes of a scan, as an index array or as a slice. Indexing an array with a slice
gives a view, indexing with an index array makes a copy."""

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

Statistics need at least `MIN_ROWS` rows in 0.5 s, so intervals are usually at most 25 ms.
"""

MAX_JITTER_RATIO = 1.5
"""Ratio of two successive intervals between rows up to which the intervals count as equal.

The jitter of time stamps changes intervals by less, and a missing row doubles an interval.
"""

MAX_WAITING_SCANS = 8
"""Number of single scans (one row of each of some cubes) that are collected and then added to the
statistics in one pass. More scans of 1260 cubes would not fit into the cache of the processor."""


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


class WindowStatistics:
    """Sums over the rows of the present window, from which `Window` is computed.

    Differences are formed from row to row also across the end of a window.
    """

    def __init__(self, rest_frequency: Array) -> None:
        """Start the first window.

        Args:
            rest_frequency: Frequencies without load (cubes, P), in Hz, NaN where a cube has no such
                pad. Frequencies are summed after these are subtracted, because float32 is precise
                enough only for the differences.
        """
        n_cubes = len(rest_frequency)
        # One array holds all quantities of the pads, so that one indexing operation per scan
        # selects the cubes in all of them.
        self._pads = np.full((10, *rest_frequency.shape), np.nan, np.float32)
        (
            self._last,
            self._difference,
            self._first_squares,
            self._second_squares,
            self._bounded_squares,
            self._sum,
            self._lowest,
            self._highest,
            self._base,
            self._bound,
        ) = self._pads
        self._base[:] = np.nan_to_num(rest_frequency)
        self._count = np.zeros(n_cubes, int)
        self._gap_before = np.zeros(n_cubes, np.int64)
        self._gap_within = np.zeros(n_cubes, np.int64)
        # Time stamp of the newest row of each cube, and the interval before it; 0 means unknown.
        self._time_ns = np.zeros(n_cubes, np.int64)
        self._interval_ns = np.zeros(n_cubes, np.int64)
        # Whether the newest time stamp of each cube is doubtful. The interval to the next row is
        # then doubtful, too.
        self._is_doubtful = np.zeros(n_cubes, bool)
        self._waiting = _WaitingScans(slice(0), (0, 0))
        self.clear()

    @property
    def last(self) -> Single:
        """Newest frequency of each pad (cubes, P), in Hz."""
        self._add_waiting()
        last: Single = self._last
        return last

    @property
    def newest_ns(self) -> Times:
        """Time stamp of the newest row of each cube (cubes,), in ns; 0 before the first."""
        self._add_waiting()
        return self._time_ns

    @property
    def bound(self) -> Single:
        """Limit to which each squared second difference in the noise is cut (cubes, P), in Hz²."""
        bound: Single = self._bound
        return bound

    @bound.setter
    def bound(self, value: Array) -> None:
        # Scans that were received but not added yet are added first, because the old limit holds
        # for them.
        self._add_waiting()
        self._bound[:] = value

    def clear(self) -> None:
        """Set all sums to zero, to start a new window."""
        self._add_waiting()
        self._first_squares[:] = 0
        self._second_squares[:] = 0
        self._bounded_squares[:] = 0
        self._sum[:] = 0
        self._count[:] = 0
        self._lowest[:] = np.nan
        self._highest[:] = np.nan
        self._gap_before[:] = 0
        self._gap_within[:] = 0

    def add(
        self,
        cubes: Cubes,
        frequency: Single,
        stamp_ns: Times,
        doubtful: Mask | None = None,
    ) -> None:
        """Add B scans, each with one row of the same N cubes.

        Sums are formed scan by scan, so their bits do not depend on the number of scans per call.

        Args:
            cubes: Numbers of the N cubes.
            frequency: Frequencies (B, N, P), in Hz.
            stamp_ns: Time stamps (B, N), in ns.
            doubtful: Whether a time stamp is doubtful (B, N); None if none of them is.
        """
        frequency = frequency.astype(np.float32, copy=False)
        if len(frequency) > 1 or doubtful is not None or self._is_doubtful.any():
            # Single scans that wait to be added are older than the new ones, so they are added
            # first.
            self._add_waiting()
            self._add(cubes, frequency, stamp_ns, doubtful)
            return
        # `PatternCache` returns the same object for the same cubes, so comparing the objects with
        # `is not` suffices.
        if cubes is not self._waiting.cubes:
            self._add_waiting()
            self._waiting = _WaitingScans(cubes, frequency.shape[1:])
        self._waiting.append(frequency[0], stamp_ns[0])
        if self._waiting.count == MAX_WAITING_SCANS:
            self._add_waiting()

    def _add_waiting(self) -> None:
        """Add the scans that wait, if there are any, to the sums."""
        waiting, count = self._waiting, self._waiting.count
        if count:
            waiting.count = 0
            self._add(waiting.cubes, waiting.frequency[:count], waiting.stamp_ns[:count])

    def _add(
        self,
        cubes: Cubes,
        frequency: Single,
        stamp_ns: Times,
        doubtful: Mask | None = None,
    ) -> None:
        """Add B scans of the same N cubes to the sums; the arguments are those of `add`."""
        chosen = self._pads[:, cubes]
        last, difference, first_squares, second_squares, bounded_squares = chosen[:5]
        total, lowest, highest, base, bound = chosen[5:]
        intervals = self._find_doubtful_intervals(cubes, doubtful, len(stamp_ns))
        pace = self._measure_pace(cubes, stamp_ns, intervals)

        first = _differences(last, frequency)
        if pace is None:
            second = _differences(difference, first)
            second *= second
        else:
            ratio, weight = pace
            before = np.concatenate([difference[None], first[:-1]])
            second = first - ratio * before
            second *= second
            second *= weight
        _add_in_order(second_squares, second)
        np.minimum(second, bound, out=second)
        _add_in_order(bounded_squares, second)
        _add_in_order(first_squares, first * first)
        _add_in_order(total, frequency - base)
        # fmin and fmax ignore NaN, which stands for a sample in which the pad had no frequency.
        lowest_now = np.fmin.reduce(frequency, axis=0)
        highest_now = np.fmax.reduce(frequency, axis=0)
        np.fmin(lowest, lowest_now, out=lowest)
        np.fmax(highest, highest_now, out=highest)
        difference[:] = first[-1]
        last[:] = frequency[-1]

        if not isinstance(cubes, slice):
            # Indexing with an array made a copy, so the changed sums are written back.
            self._pads[:, cubes] = chosen
        self._count[cubes] += len(frequency)

    def window(self) -> Window:
        """Return the statistics of the present window so far."""
        self._add_waiting()
        has_rows = self._count[:, None] > 0
        count = np.maximum(self._count, 1)[:, None]
        with np.errstate(invalid="ignore"):  # NaN where a cube has no such pad
            mean = np.where(has_rows, self._base + self._sum / count, np.nan)
        return Window(
            rows=self._count.copy(),
            mean=mean,
            lowest=self._lowest.copy(),
            highest=self._highest.copy(),
            noise=np.sqrt(self._bounded_squares / count / 6),
            rough=self._second_squares > MAX_SMOOTH_ROUGHNESS * self._first_squares,
            gap_before=self._gap_before.copy(),
            gap_within=self._gap_within.copy(),
        )

    def _find_doubtful_intervals(
        self,
        cubes: Cubes,
        doubtful: Mask | None,
        scans: int,
    ) -> Mask | None:
        """Return whether an interval between rows begins or ends with a doubtful time stamp.

        Args:
            cubes: Numbers of the N cubes.
            doubtful: Whether a time stamp is doubtful (B, N); None if none of them is.
            scans: Number B of scans.

        Returns:
            Whether the interval before each row is doubtful (B, N); None if none of them is.
        """
        before = self._is_doubtful[cubes]
        if doubtful is None:
            if not before.any():
                return None
            doubtful = np.zeros((scans, len(before)), bool)
        at_start = np.concatenate([before[None], doubtful[:-1]])
        intervals: Mask = doubtful | at_start
        self._is_doubtful[cubes] = doubtful[-1]
        return intervals

    def _measure_pace(
        self,
        cubes: Cubes,
        stamp_ns: Times,
        doubtful: Mask | None,
    ) -> tuple[Single, Single] | None:
        """Compute ratios and weights for second differences from the intervals between rows.

        The ratio r of two successive intervals makes the second difference of a linear drift
        vanish, and the weight w gives it the variance of the noise; the formulas are in the
        docstring of this module.

        Args:
            cubes: Numbers of the N cubes.
            stamp_ns: Time stamps (B, N), in ns.
            doubtful: Whether the interval before each row is doubtful (B, N); None if none is.

        Returns:
            Ratios r and weights w (B, N, 1), or None if all of them are 1.
        """
        between = _differences(self._time_ns[cubes], stamp_ns)
        interval = between if doubtful is None else np.where(doubtful, 0, between)
        newest = self._interval_ns[cubes]
        before = np.concatenate([newest[None], interval[:-1]])
        self._time_ns[cubes] = stamp_ns[-1]
        self._interval_ns[cubes] = interval[-1]

        is_not_longer = interval < MAX_JITTER_RATIO * before
        is_not_shorter = before < MAX_JITTER_RATIO * interval
        is_even = is_not_longer & is_not_shorter
        longest = max(interval.max(), before.max())
        # Usually all intervals are even. Returning early then saves a third of the time of `add`.
        if longest < GAP_NS and is_even.all():
            return None
        self._note_gaps(cubes, between)
        shorter = np.minimum(interval, before)
        longer = np.maximum(interval, before)
        is_known = (shorter > 0) & (longer < GAP_NS)
        safe_before = np.where(is_known, before, 1)
        ratio = np.where(is_known & ~is_even, interval / safe_before, 1.0)
        weight = is_known * 6 / (1 + (1 + ratio) ** 2 + ratio**2)
        # The added axis applies one value to all pads of a row.
        ratio, weight = ratio[..., None], weight[..., None]
        return ratio.astype(np.float32), weight.astype(np.float32)

    def _note_gaps(self, cubes: Cubes, interval: Times) -> None:
        """Keep the longest gap between two rows (samples) of each cube, for the statistics.

        Args:
            cubes: Numbers of the N cubes.
            interval: Interval before each row (B, N), in ns; negative if time went back, which
                counts as a gap, too.
        """
        is_gap = (interval < 0) | (interval >= GAP_NS)
        gap = np.where(is_gap, interval, 0)
        if not gap.any():
            return
        is_first = self._count[cubes] == 0
        before, within = self._gap_before[cubes], self._gap_within[cubes]
        # The interval between the last row of a window and the first row of the next one counts as
        # the gap before the next window, not within it.
        self._gap_before[cubes] = np.where(is_first, gap[0], before)
        gap[0] = np.where(is_first, 0, gap[0])
        candidates = np.concatenate([within[None], gap])
        chosen = np.abs(candidates).argmax(axis=0)
        longest = np.take_along_axis(candidates, chosen[None], axis=0)
        self._gap_within[cubes] = longest[0]


class _WaitingScans:
    """Copies of single scans of the same N cubes that wait to be added to the statistics.

    Attributes:
        count: Number of scans that wait.
        cubes: Numbers of the cubes of a scan.
        frequency: Frequencies (MAX_WAITING_SCANS, N, P), in Hz.
        stamp_ns: Time stamps (MAX_WAITING_SCANS, N), in ns.
    """

    def __init__(self, cubes: Cubes, shape: tuple[int, ...]) -> None:
        """Allocate memory for `MAX_WAITING_SCANS` scans.

        Args:
            cubes: Numbers of the N cubes of a scan.
            shape: Shape (N, P) of the frequencies of a scan.
        """
        self.cubes = cubes
        self.frequency = np.empty((MAX_WAITING_SCANS, *shape), np.float32)
        self.stamp_ns = np.empty((MAX_WAITING_SCANS, shape[0]), np.int64)
        self.count = 0

    def append(self, frequency: Single, stamp_ns: Times) -> None:
        self.frequency[self.count] = frequency
        self.stamp_ns[self.count] = stamp_ns
        self.count += 1


def _differences(before: AnyArray, values: AnyArray) -> AnyArray:
    """Return the difference (B, ...) between each value and the previous one.

    Args:
        before: Value before the first one (...).
        values: Successive values (B, ...).
    """
    result = np.empty_like(values)
    np.subtract(values[0], before, out=result[0])
    np.subtract(values[1:], values[:-1], out=result[1:])
    return result


def _add_in_order(total: Single, terms: Single) -> None:
    """Add the terms of B scans to a total in place, one scan after the other.

    The sum is then the same, to the last bit, as if the scans were added in separate calls.

    Args:
        total: Sum for each cube and pad (N, P), which is changed.
        terms: Terms of each scan (B, N, P).
    """
    for term in terms:
        total += term
