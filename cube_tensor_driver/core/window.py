"""Windows: statistics of pads over half a second, what they say of the pads, and what tare
averages.

    noise of a pad    sqrt(mean(w (f[n] - f[n-1] - r (f[n-1] - f[n-2]))²) / 6), r = (t[n] - t[n-1])
    / (t[n-1] - t[n-2]),
                      w = 6 / (1 + (1 + r)² + r²), each term bounded so that one jump is no noise; a
                      load that moves slowly leaves nothing, also where rows are missing; r = 1
                      where it is within EVEN; w = 0 across a gap
    roughness         sum w (…)² / sum (f[n] - f[n-1])²: 3 for noise, (2 pi F T)² for a load that
    moves with F Hz

All arrays are (cubes, pads); nothing loops over cubes.
"""

from __future__ import annotations

from typing import NamedTuple, TypeVar

import numpy as np

from .status import DRIFT, LEFT_OUT, NOISY, OPEN, RANGE, SHORT, STUCK

_Times = TypeVar("_Times", int, np.ndarray)

WINDOW_S = 0.5
MIN_COUNT = 20
"""Rows in a window below which its statistics say nothing."""
NOISY_ENTER, NOISY_LEAVE = 10.0, 5.0
"""Times the calibration's noise and times the cube's other pads, to become noisy and to stay so."""
ROUGH = 0.3
"""Roughness below which it is a load that moves, and no pad becomes noisy: below 9 Hz at 100 rows a
second."""
JUMP = 60.0
"""Times the usual noise, to which a second difference is bounded: two of them in 20 rows stay below
NOISY_ENTER."""
GAP_NS = 50_000_000
"""What a load did across a longer gap is not known; MIN_COUNT rows in half a second come twice as
often."""
EVEN = 1.5
"""Times each other, up to which two intervals count as equal: stamps jitter, but a missing row
makes it 2."""
STUCK_MOVING = 5.0
"""Times its noise that the cube's pads must have moved, before one that did not move at all is
called stuck."""
STILL = 8.0
"""Times its noise, peak to peak, within which a pad stands still: noise alone spans 6 in 1000
rows."""
RESIDUAL_ENTER, RESIDUAL_LEAVE = 0.5, 0.1
"""Shares of a window's rows with a residual above its limit, for a cube to become strained and to
stay so."""
WAITING = 8
"""Scans whose rows wait and are then added one after the other: the sums are fetched from memory
once for all of them, which takes several times as long as adding."""
DRIFT_LIMIT = 2e-4
"""Of the rest frequency: how far one pad wanders while all stand still, before it is called
drifting."""


class Window(NamedTuple):
    """What is kept of a window: rows (cubes,) that came; (cubes, P) in Hz, NaN where nothing was
    measured; rough: (cubes, P) bool, rougher than a load that moves."""

    rows: np.ndarray
    mean: np.ndarray
    lowest: np.ndarray
    highest: np.ndarray
    noise: np.ndarray
    rough: np.ndarray


class _Pace(NamedTuple):
    """When the newest rows of these cubes came, all at once, and how long after the rows before."""

    cubes: slice | np.ndarray
    time_ns: int
    interval_ns: int


class Statistics:
    """Of the window that is not over yet. bound: (cubes, P) Hz², to which a squared second
    difference is cut."""

    def __init__(self, rest: np.ndarray, bound: np.ndarray) -> None:
        """rest: (cubes, P) Hz, NaN where there is no pad; float32 sums are of what is above it."""
        self._all = np.full((9, *rest.shape), np.nan, np.float32)
        # step: the newest first difference; way, bend: sums of squared first and second
        # differences.
        (
            self._last,
            self._step,
            self._way,
            self._bend,
            self._sum,
            self._lowest,
            self._highest,
            self._base,
            self.bound,
        ) = self._all
        self._base[:] = np.nan_to_num(rest)
        self.bound[:] = bound
        self._count = np.zeros(len(rest), int)
        # When the newest row of each cube came, and how long after the one before: 0 is unknown.
        self._time_ns, self._interval_ns = np.zeros((2, len(rest)), np.int64)
        self._together: _Pace | None = None
        self._waiting: list[tuple[slice | np.ndarray, np.ndarray, int | np.ndarray]] = []
        self._kept = np.empty((WAITING, *rest.shape), np.float32)
        self.clear()

    @property
    def last(self) -> np.ndarray:
        """(cubes, P) Hz float32, newest frequencies."""
        self._settle()
        return self._last

    def clear(self) -> None:
        """Begin a window; differences go on."""
        self._settle()
        self._way[:] = self._bend[:] = self._sum[:] = self._count[:] = 0
        self._lowest[:] = self._highest[:] = np.nan

    def add(
        self, cubes: slice | np.ndarray, frequency: np.ndarray, stamp_ns: int | np.ndarray
    ) -> None:
        """Rows (N, P) of different cubes, taken at one time or (N,) times."""
        kept = self._kept[len(self._waiting), : len(frequency)]
        kept[:] = frequency
        self._waiting.append((cubes, kept, stamp_ns))
        if len(self._waiting) == WAITING:
            self._settle()

    def _settle(self) -> None:
        waiting, self._waiting = self._waiting, []
        for one in waiting:
            self._add(*one)

    def _add(
        self, cubes: slice | np.ndarray, frequency: np.ndarray, stamp_ns: int | np.ndarray
    ) -> None:
        part = self._all[:, cubes]
        last, step, way, bend, total, lowest, highest, base, bound = part
        uneven = self._pace(cubes, stamp_ns)
        new = frequency - last
        if uneven is None:
            work = new - step
            work *= work
        else:
            ratio, weight = uneven
            work = new - ratio * step
            work *= work
            work *= weight
        bend += np.minimum(work, bound, out=work)
        way += np.multiply(new, new, out=work)
        step[:] = new
        np.fmin(lowest, frequency, out=lowest)
        np.fmax(highest, frequency, out=highest)
        total += np.subtract(frequency, base, out=work)
        last[:] = frequency
        if not isinstance(cubes, slice):
            self._all[:, cubes] = part
        self._count[cubes] += 1

    def add_many(
        self, cubes: slice | np.ndarray, frequency: np.ndarray, stamp_ns: np.ndarray
    ) -> None:
        """`add` of (B, N, P) taken at (B,) times, one after the other, to the same bits: sums go
        batch by batch."""
        self._settle()
        k = 0
        while k < len(frequency):
            even = self._count_even(cubes, stamp_ns[k:])
            if even:
                self._add_even(cubes, frequency[k : k + even])
            else:
                self._add(cubes, frequency[k], int(stamp_ns[k]))
            k += even or 1

    def _add_even(self, cubes: slice | np.ndarray, frequency: np.ndarray) -> None:
        """(B, N, P) that came at even intervals."""
        part = self._all[:, cubes]
        last, step, way, bend, total, lowest, highest, base, bound = part
        new = np.diff(np.concatenate([last[None], frequency]), axis=0)
        work = np.diff(np.concatenate([step[None], new]), axis=0)
        work *= work
        np.minimum(work, bound, out=work)
        bend[:] = np.add.reduce(np.concatenate([bend[None], work]), axis=0)
        np.multiply(new, new, out=work)
        way[:] = np.add.reduce(np.concatenate([way[None], work]), axis=0)
        np.subtract(frequency, base, out=work)
        total[:] = np.add.reduce(np.concatenate([total[None], work]), axis=0)
        np.fmin(lowest, np.fmin.reduce(frequency, axis=0), out=lowest)
        np.fmax(highest, np.fmax.reduce(frequency, axis=0), out=highest)
        step[:], last[:] = new[-1], frequency[-1]
        if not isinstance(cubes, slice):
            self._all[:, cubes] = part
        self._count[cubes] += len(frequency)

    def _pace(
        self, cubes: slice | np.ndarray, stamp_ns: int | np.ndarray
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """r and w of the rows, (N, 1) each; None where all are even, which for the same cubes as
        before is known without looking at each. Where an interval is unknown, not positive or a
        gap, w = 0."""
        one = self._together
        if one is not None and one.cubes is cubes and isinstance(stamp_ns, int):
            interval_ns = stamp_ns - one.time_ns
            if _even(interval_ns, one.interval_ns):
                self._together = _Pace(cubes, stamp_ns, interval_ns)
                return None
        if one is not None:
            self._time_ns[one.cubes], self._interval_ns[one.cubes] = one.time_ns, one.interval_ns
            self._together = None
        before = self._interval_ns[cubes].copy()
        interval = stamp_ns - self._time_ns[cubes]
        self._time_ns[cubes], self._interval_ns[cubes] = stamp_ns, interval
        if isinstance(stamp_ns, int) and (interval == interval[0]).all():
            self._together = _Pace(cubes, stamp_ns, int(interval[0]))
        known = (interval > 0) & (before > 0) & (np.maximum(interval, before) < GAP_NS)
        ratio = np.where(
            known & ~_even(interval, before), interval / np.where(known, before, 1), 1.0
        )
        weight = known * 6 / (1 + (1 + ratio) ** 2 + ratio**2)
        return ratio.astype(np.float32)[:, None], weight.astype(np.float32)[:, None]

    def _count_even(self, cubes: slice | np.ndarray, stamp_ns: np.ndarray) -> int:
        """How many of the first rows of (B,) times are even; goes on to the last of them."""
        one = self._together
        if one is None or one.cubes is not cubes:
            return 0
        interval = np.diff(stamp_ns, prepend=one.time_ns)
        even = _even(interval, np.concatenate([[one.interval_ns], interval[:-1]]))
        count = len(even) if even.all() else int(np.argmin(even))
        if count:
            self._together = _Pace(cubes, int(stamp_ns[count - 1]), int(interval[count - 1]))
        return count

    def window(self) -> Window:
        """The statistics so far."""
        self._settle()
        count = np.maximum(self._count, 1)[:, None]
        with np.errstate(invalid="ignore"):
            mean = np.where(self._count[:, None] > 0, self._base + self._sum / count, np.nan)
        noise = np.sqrt(self._bend / count / 6)
        return Window(
            self._count.copy(),
            mean,
            self._lowest.copy(),
            self._highest.copy(),
            noise,
            self._bend > ROUGH * self._way,
        )


class Judge:
    """What windows say of pads: stuck, noisy, drifting. still: (cubes,) bool, nothing moved in the
    last one; noise: (cubes, P) Hz, by the calibration; bound: for the statistics of the next
    window."""

    def __init__(self, exists: np.ndarray) -> None:
        self._exists = exists
        self.still = np.zeros(len(exists), bool)
        self._reference = np.full(exists.shape, np.nan)
        self._middle = self._reference.copy()  # means of the window before

    def set(self, rest: np.ndarray, noise: np.ndarray) -> None:
        """Rest frequencies and noise of the pads, (cubes, P) Hz, NaN where there is none."""
        self._rest, self.noise = rest, noise
        self.bound = self._bound(noise)

    def judge(self, window: Window, state: np.ndarray) -> np.ndarray:
        """(cubes, P) bits found in a window that ended; state: bits of the pads until now."""
        enough = window.rows >= MIN_COUNT
        noise, span, middle = window.noise, window.highest - window.lowest, window.mean
        found = np.zeros(state.shape, np.uint16)
        with np.errstate(invalid="ignore"):
            times = np.where(state & NOISY, NOISY_LEAVE, NOISY_ENTER)
            usual = np.fmax(self.noise, _median(noise))
            # One that is noisy already stays so while a load moves it.
            found[(noise > times * usual) & (window.rough | (state & NOISY > 0))] |= NOISY
            self.bound = self._bound(usual)
            moving = _median(span / self.noise) > STUCK_MOVING
            # What comes and goes shows a single value now and then, which is not stuck.
            found[(span == 0) & moving & (state & (OPEN | SHORT | RANGE) == 0)] |= STUCK
            healthy = state & LEFT_OUT == 0
            # A step that falls between two windows shows in neither.
            jumped = np.abs(middle - self._middle) > STILL * self.noise
            unmoved = (span < STILL * self.noise) & ~jumped
            self.still = enough & (unmoved | ~healthy | ~self._exists).all(axis=1)
            self._middle = np.where(np.isnan(middle), self._middle, middle)
            self._reference[~self.still & (window.rows > 0)] = np.nan
            fresh = self.still[:, None] & np.isnan(self._reference)
            self._reference[fresh] = middle[fresh]
            wander = (middle - self._reference) / self._rest
            limit = np.maximum(DRIFT_LIMIT, STILL * self.noise / self._rest)
            found[np.abs(wander - _median(wander)) > limit] |= DRIFT
        return found * (enough[:, None] & self._exists)

    @staticmethod
    def _bound(noise: np.ndarray) -> np.ndarray:
        bound: np.ndarray = ((JUMP * noise) ** 2).astype(np.float32)
        return bound


def still_strained(strained: np.ndarray, over: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """(cubes,) bool after a window: strained (cubes,) bool before it; over (cubes,) of its rows
    (cubes,) had a residual above its limit, as noise alone does to one in a thousand. Cubes without
    rows stay as they were."""
    limit = np.where(strained, RESIDUAL_LEAVE, RESIDUAL_ENTER)
    return np.where(rows > 0, over > limit * rows, strained)


def _even(interval: _Times, before: _Times) -> _Times:
    """Whether two intervals count as equal; never where one is not positive."""
    return (interval < EVEN * before) & (before < EVEN * interval)


def _median(values: np.ndarray) -> np.ndarray:
    """(cubes, 1): the lower median over each cube's pads that have a value."""
    ordered = np.sort(values, axis=1)  # NaN last
    known = values.shape[1] - np.isnan(ordered).sum(axis=1)
    return np.take_along_axis(ordered, np.maximum((known - 1) // 2, 0)[:, None], axis=1)
