"""Statistics of every pad over a window of half a second.

    first difference     d[n] = f[n] - f[n-1]
    second difference    e[n] = d[n] - r d[n-1],   r = (t[n] - t[n-1]) / (t[n-1] - t[n-2])
    noise                sqrt(mean(w e²) / 6),     w = 6 / (1 + (1 + r)² + r²)
    roughness            sum(w e²) / sum(d²)

Second differences of white noise with variance s² have variance 6 s² (r = 1). A load that moves
slowly leaves nothing in them, also where rows are missing. For the noise each term w e² is bounded,
so that one jump does not look like noise; for the roughness it is not, else great noise would look
like a load that moves. r is 1 while two intervals are equal within EVEN, because stamps jitter; w
is 0 across a gap, and where one of the three stamps is in doubt. Roughness is 3 for noise, and
(2 pi F T)² for a load that moves with frequency F, sampled with period T.

All arrays are (cubes, pads); nothing loops over cubes.

Nobody looks at the sums before the window ends, so single scans wait until several can be added in
one go: a call of numpy costs as much as the arithmetic of 64 cubes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

WINDOW_S = 0.5
ROUGH = 0.3
"""Roughness below which a load moves and no pad becomes noisy: below 9 Hz at 100 rows a second."""
GAP_NS = 50_000_000
"""What a load did across a longer gap is not known. At MIN_COUNT rows a window, rows come twice as
often."""
EVEN = 1.5
"""Two intervals count as equal up to this ratio: stamps jitter, but a missing row makes it 2."""
TOGETHER = 8
"""Single scans that are added in one go: more of 1260 cubes would leave the processor's cache."""


class Window(NamedTuple):
    """What is kept of a window.

    rows: (cubes,) how many came
    mean, lowest, highest, noise: (cubes, P) Hz; NaN where nothing was measured
    rough: (cubes, P) bool, rougher than a load that moves
    gap_before: (cubes,) ns from the row before the window to its first one
    gap_within: (cubes,) ns, longest interval between two of its rows
    Both are 0 where no interval reached GAP_NS, and negative where time went back.
    """

    rows: np.ndarray
    mean: np.ndarray
    lowest: np.ndarray
    highest: np.ndarray
    noise: np.ndarray
    rough: np.ndarray
    gap_before: np.ndarray
    gap_within: np.ndarray


class WindowStatistics:
    """Sums over the window that is not over yet; differences go on from window to window."""

    def __init__(self, rest_frequency: np.ndarray) -> None:
        """rest_frequency: (cubes, P) Hz, NaN where a cube has no such pad; sums are of what is
        above it, so that float32 is enough."""
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
        self._count = np.zeros(len(rest_frequency), int)
        self._gap_before, self._gap_within = np.zeros((2, len(rest_frequency)), np.int64)
        # When the newest row of each cube came, and how long after the one before: 0 is unknown.
        self._time_ns, self._interval_ns = np.zeros((2, len(rest_frequency)), np.int64)
        self._doubtful = np.zeros(len(rest_frequency), bool)  # the stamp of the newest row
        self._waiting = _WaitingScans(slice(0), np.empty((0, 0, 0)), np.empty((0, 0)))
        self.clear()

    @property
    def last(self) -> np.ndarray:
        """(cubes, P) Hz, newest frequencies."""
        self._add_waiting()
        return self._last

    @property
    def newest_ns(self) -> np.ndarray:
        """(cubes,) stamp of the newest row; 0 before the first."""
        self._add_waiting()
        return self._time_ns

    @property
    def bound(self) -> np.ndarray:
        """(cubes, P) Hz², the largest term of the noise."""
        return self._bound

    @bound.setter
    def bound(self, value: np.ndarray) -> None:
        self._add_waiting()
        self._bound[:] = value

    def clear(self) -> None:
        """Begin a window."""
        self._add_waiting()
        squares = self._first_squares, self._second_squares, self._bounded_squares
        for total in (*squares, self._sum, self._count):
            total[:] = 0
        self._lowest[:] = self._highest[:] = np.nan
        self._gap_before[:] = self._gap_within[:] = 0

    def add(
        self,
        cubes: slice | np.ndarray,
        frequency: np.ndarray,
        stamp_ns: np.ndarray,
        doubtful: np.ndarray | None = None,
    ) -> None:
        """B scans of the same N cubes: frequency (B, N, P) Hz, stamp_ns (B, N); doubtful (B, N)
        bool, the stamps that are in doubt, None: none of them.

        Sums go scan by scan, so their bits do not depend on how many scans are added at a time.
        """
        frequency = frequency.astype(np.float32, copy=False)
        if len(frequency) > 1 or doubtful is not None or self._doubtful.any():
            self._add_waiting()
            self._add(cubes, frequency, stamp_ns, doubtful)
            return
        if cubes is not self._waiting.cubes:
            self._add_waiting()
            self._waiting = _WaitingScans.room(cubes, frequency.shape[1:])
        self._waiting.append(frequency[0], stamp_ns[0])
        if self._waiting.count == TOGETHER:
            self._add_waiting()

    def _add_waiting(self) -> None:
        waiting, count = self._waiting, self._waiting.count
        if count:
            waiting.count = 0
            self._add(waiting.cubes, waiting.frequency[:count], waiting.stamp_ns[:count])

    def _add(
        self,
        cubes: slice | np.ndarray,
        frequency: np.ndarray,
        stamp_ns: np.ndarray,
        doubtful: np.ndarray | None = None,
    ) -> None:
        chosen = self._pads[:, cubes]  # a view for a slice, a copy for an index
        last, difference, first_squares, second_squares, bounded_squares = chosen[:5]
        total, lowest, highest, base, bound = chosen[5:]
        pace = self._pace(cubes, stamp_ns, self._doubtful_intervals(cubes, doubtful, len(stamp_ns)))
        first = _differences(last, frequency)
        if pace is None:
            second = _differences(difference, first)
            second *= second
        else:
            ratio, weight = pace
            second = first - ratio * np.concatenate([difference[None], first[:-1]])
            second *= second
            second *= weight
        _add_in_order(second_squares, second)
        np.minimum(second, bound, out=second)
        _add_in_order(bounded_squares, second)
        _add_in_order(first_squares, first * first)
        _add_in_order(total, frequency - base)
        np.fmin(lowest, np.fmin.reduce(frequency, axis=0), out=lowest)
        np.fmax(highest, np.fmax.reduce(frequency, axis=0), out=highest)
        difference[:], last[:] = first[-1], frequency[-1]
        if not isinstance(cubes, slice):
            self._pads[:, cubes] = chosen
        self._count[cubes] += len(frequency)

    def window(self) -> Window:
        """The statistics so far."""
        self._add_waiting()
        count = np.maximum(self._count, 1)[:, None]
        with np.errstate(invalid="ignore"):
            mean = np.where(self._count[:, None] > 0, self._base + self._sum / count, np.nan)
        return Window(
            rows=self._count.copy(),
            mean=mean,
            lowest=self._lowest.copy(),
            highest=self._highest.copy(),
            noise=np.sqrt(self._bounded_squares / count / 6),
            rough=self._second_squares > ROUGH * self._first_squares,
            gap_before=self._gap_before.copy(),
            gap_within=self._gap_within.copy(),
        )

    def _doubtful_intervals(
        self, cubes: slice | np.ndarray, doubtful: np.ndarray | None, scans: int
    ) -> np.ndarray | None:
        """(B, N) bool, intervals with a doubtful stamp at one of their ends; None: none."""
        before = self._doubtful[cubes]
        if doubtful is None:
            if not before.any():
                return None
            doubtful = np.zeros((scans, len(before)), bool)
        intervals: np.ndarray = doubtful | np.concatenate([before[None], doubtful[:-1]])
        self._doubtful[cubes] = doubtful[-1]
        return intervals

    def _pace(
        self, cubes: slice | np.ndarray, stamp_ns: np.ndarray, doubtful: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """r and w (B, N, 1) of B scans from the intervals between the rows of a cube; None where
        all are 1. doubtful: (B, N) bool, intervals that are not known."""
        between = _differences(self._time_ns[cubes], stamp_ns)
        interval = between if doubtful is None else np.where(doubtful, 0, between)
        before = np.concatenate([self._interval_ns[cubes][None], interval[:-1]])
        self._time_ns[cubes], self._interval_ns[cubes] = stamp_ns[-1], interval[-1]
        even = (interval < EVEN * before) & (before < EVEN * interval)
        short = max(interval.max(), before.max()) < GAP_NS
        if short and even.all():  # as it mostly is: saves a third of the time of `add`
            return None
        self._note_gaps(cubes, between)
        known = (np.minimum(interval, before) > 0) & (np.maximum(interval, before) < GAP_NS)
        ratio = np.where(known & ~even, interval / np.where(known, before, 1), 1.0)
        weight = known * 6 / (1 + (1 + ratio) ** 2 + ratio**2)
        return ratio.astype(np.float32)[..., None], weight.astype(np.float32)[..., None]

    def _note_gaps(self, cubes: slice | np.ndarray, interval: np.ndarray) -> None:
        """Keep the longest of intervals (B, N), ns, forward or back."""
        gap = np.where((interval < 0) | (interval >= GAP_NS), interval, 0)
        if not gap.any():
            return
        is_first = self._count[cubes] == 0
        self._gap_before[cubes] = np.where(is_first, gap[0], self._gap_before[cubes])
        gap[0] = np.where(is_first, 0, gap[0])
        widest = np.concatenate([self._gap_within[cubes][None], gap])
        chosen = np.abs(widest).argmax(axis=0)
        self._gap_within[cubes] = np.take_along_axis(widest, chosen[None], axis=0)[0]


class _WaitingScans:
    """Copies of scans of the same cubes, until they are added.

    count: how many wait; cubes: of a scan; frequency (TOGETHER, N, P), stamp_ns (TOGETHER, N)
    """

    def __init__(
        self, cubes: slice | np.ndarray, frequency: np.ndarray, stamp_ns: np.ndarray
    ) -> None:
        self.cubes, self.frequency, self.stamp_ns = cubes, frequency, stamp_ns
        self.count = 0

    @classmethod
    def room(cls, cubes: slice | np.ndarray, shape: tuple[int, ...]) -> _WaitingScans:
        """For scans of frequencies of this shape (N, P)."""
        return cls(
            cubes,
            np.empty((TOGETHER, *shape), np.float32),
            np.empty((TOGETHER, shape[0]), np.int64),
        )

    def append(self, frequency: np.ndarray, stamp_ns: np.ndarray) -> None:
        self.frequency[self.count], self.stamp_ns[self.count] = frequency, stamp_ns
        self.count += 1


def _differences(before: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(B, ...) of each value to the one before it; `before` is the one before the first."""
    result = np.empty_like(values)
    np.subtract(values[0], before, out=result[0])
    np.subtract(values[1:], values[:-1], out=result[1:])
    return result


def _add_in_order(total: np.ndarray, terms: np.ndarray) -> None:
    """Add (B, N, P) terms to a total (N, P), one after the other."""
    for term in terms:
        total += term
