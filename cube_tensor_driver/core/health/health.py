"""Health of pads and cubes: which pads are broken, found from their frequencies alone.

Every row (sample of one cube) is checked when it arrives. A pad whose frequency is impossible
(open, short, out of range) is already left out of the reconstruction of this row. Conditions that
need statistics (stuck, noisy, drifting) are found at the end of windows of `WINDOW_S`, measured by
the time stamps of the rows. All arrays are (cubes, pads); nothing loops over cubes.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from ..arrays import AnyArray, Array, Index, Mask, PadMasks, Single, StatusBits, Times, pad_table
from ..errors import LayoutError
from ..oscillator import pad_frequency, stress_slope
from ..pattern import PatternCache, count_repeats
from ..pipeline import Pipeline
from ..rows import FrequencyRows
from ..status import OPEN, RANGE, REPORTED, RESIDUAL, SHORT, STAMP
from .diagnosis import Conditions, PadDiagnosis, has_high_residual
from .statistics import WINDOW_S, Cubes, Window, WindowStatistics

WINDOW_NS = round(1e9 * WINDOW_S)
"""Length of a window over which statistics of the pads are formed, in ns."""

MAX_BACKWARD_NS = 2 * WINDOW_NS
"""Longest time, in ns, by which the time stamp of a row may precede the end of the present window
for the row to be counted in this window.

An older row is from another recording, or from a clock that was set, so a new window starts.
"""

HISTORY_WINDOWS = 20
"""Number of ended windows whose statistics are kept for a tare: 10 s of data."""

MIN_STRAIN = -0.8
"""Smallest possible strain of a pad's foam (relative change of its thickness): pressed to a fifth
of the thickness without load.

A frequency that the pad law (frequency to strain and stress) relates to a smaller strain counts as
out of range.
"""

MAX_STRAIN = 1.0
"""Largest possible strain of a pad's foam (relative change of its thickness): stretched to twice
the thickness without load.

A frequency that the pad law (frequency to strain and stress) relates to a larger strain counts as
out of range.
"""

OPEN_STRAIN = 3.0
"""Strain of a pad's foam (relative change of its thickness) from which on the pad counts as
disconnected.

The foam cannot reach it, so a frequency that the pad law relates to this strain or a larger one
shows that the capacitor is disconnected.
"""


class _Limits(NamedTuple):
    """Limits of the frequencies of pads (cubes, P), in Hz.

    Attributes:
        low, high: Possible range of the frequency.
        open: Frequency from which on the pad counts as disconnected.
    """

    low: Single
    high: Single
    open: Single


class _HealthPattern(NamedTuple):
    """Quantities that depend only on the cube numbers of a message.

    Attributes:
        repeats: Number of scans (at most one row per cube, with rising cube numbers) in the
            message; 0 if its rows are in another order.
        cube: Numbers of the cubes of one scan (n,).
        cubes: The same numbers; a slice if they are consecutive, because indexing with a slice
            makes no copy.
        low, high: Possible range of the frequencies (n, P), in Hz.
        n_pads: Number of pads of all cubes of a scan together.
    """

    repeats: int
    cube: Index
    cubes: Cubes
    low: Single
    high: Single
    n_pads: int


class Health:
    """Checks the pads of all cubes of a pipeline, and keeps their statistics.

    Attributes:
        high_residual: Whether the residual of a cube is high by `has_high_residual` (cubes,).
        temperature: Newest temperature of each cube (cubes,), in °C.
        history: Statistics of the last `HISTORY_WINDOWS` windows that have ended.
        closed: Number of windows that have ended so far.
        newest_ns: Newest time stamp of a row, in ns.
    """

    def __init__(self, pipeline: Pipeline) -> None:
        self._pipeline = pipeline
        n_cubes, n_pads = len(pipeline.calibrations), pipeline.n_pads
        pad_counts = np.array([c.layout.n_pads for c in pipeline.calibrations])
        self._exists: Mask = np.arange(n_pads) < pad_counts[:, None]
        self._conditions = Conditions(n_cubes, n_pads)
        self._diagnosis = PadDiagnosis(self._exists)
        self._patterns = PatternCache(self._make_pattern, n_cubes)
        self.high_residual = np.zeros(n_cubes, bool)
        self.temperature = np.full(n_cubes, np.nan)
        self.history: deque[Window] = deque(maxlen=HISTORY_WINDOWS)
        self.closed = 0
        self.newest_ns = 0
        self._window_end_ns: int | None = None
        # Number of rows (samples) of each cube in the present window of 0.5 s whose residual is
        # above its limit.
        self._over_limit = np.zeros(n_cubes, int)
        # Number of rows, and whether the residual was high, since the last call of `collect`.
        self._rows = np.zeros(n_cubes, int)
        self._had_high_residual = np.zeros(n_cubes, bool)
        self.refresh()
        self._statistics = WindowStatistics(pipeline.rest_frequency)
        self._statistics.bound = self._diagnosis.bound

    @property
    def state(self) -> StatusBits:
        """Present conditions (such as open) of each pad (cubes, P), bits of `status.py`."""
        return self._conditions.state

    @property
    def mask(self) -> PadMasks:
        """Bit masks of the pads that are not used, because of their conditions (cubes,)."""
        return self._conditions.mask

    @property
    def still(self) -> Mask:
        """Whether the frequency of no usable pad of a cube moved in the last window (cubes,)."""
        return self._diagnosis.still

    @property
    def noise(self) -> Array:
        """Standard deviation of each pad's frequency (cubes, P), in Hz, by the calibration."""
        return self._diagnosis.noise

    @property
    def last(self) -> Single:
        """Newest frequency of each pad (cubes, P), in Hz."""
        return self._statistics.last

    @property
    def age_ns(self) -> Times:
        """Time from the newest row of each cube to the newest row of any cube (cubes,), in ns."""
        age: Times = self.newest_ns - self._statistics.newest_ns
        return age

    def window(self) -> Window:
        """Return the statistics of the present window, which has not ended."""
        return self._statistics.window()

    def refresh(self) -> None:
        """Compute the possible range of each frequency again.

        The caller must do this after a tare or the tracking of drift has changed the rest
        frequencies (frequencies without load) of the pipeline, from which the range follows.
        """
        calibrations, n_pads = self._pipeline.calibrations, self._pipeline.n_pads
        beta = pad_table([c.beta for c in calibrations], n_pads, fill=1.0)
        modulus = pad_table([c.modulus for c in calibrations], n_pads, fill=1.0)
        noise = pad_table([c.noise for c in calibrations], n_pads, fill=1.0)
        rest = self._pipeline.rest_frequency

        def frequency_at(strain: float) -> Single:
            frequency = pad_frequency(strain * modulus, rest, beta, modulus)
            return frequency.astype(np.float32)

        self._limits = _Limits(
            low=frequency_at(MIN_STRAIN),
            high=frequency_at(MAX_STRAIN),
            open=frequency_at(OPEN_STRAIN),
        )
        slope = stress_slope(rest, rest, beta, modulus)
        self._diagnosis.set_reference(rest, noise / slope)
        self._patterns.clear()

    def update(self, rows: FrequencyRows) -> tuple[PadMasks, StatusBits]:
        """Check rows before their stress is reconstructed.

        The results do not depend on the number of scans per call.

        Args:
            rows: N rows of one scan, or of several scans one after the other.

        Returns:
            Bit masks of the pads to leave out of each row (N,), including those that the device
            reports as broken, and the conditions that any pad of the row's cube has (N,).

        Raises:
            LayoutError: The frequencies have the wrong shape, or a row is of a cube that the skin
                does not have.
        """
        if rows.frequency.shape != (len(rows), self._exists.shape[1]):
            raise self._misfit(rows.cube, rows.frequency.shape)
        pattern = self._patterns.get(rows.cube)
        if pattern.repeats:
            return self._check(pattern, rows)
        # Rows in another order than that of scans are rare, so what is computed for them is not
        # kept in the cache.
        left_out = np.empty(len(rows), np.uint32)
        status = np.empty(len(rows), np.uint16)
        for chosen in _split_into_scans(rows.cube):
            part = rows.select(chosen)
            pattern = self._make_pattern(part.cube)
            left_out[chosen], status[chosen] = self._check(pattern, part)
        return left_out, status

    def count_residuals(self, cube: AnyArray, status: StatusBits) -> None:
        """Count the rows (samples of one cube) with a high residual (disagreement of the pads).

        Args:
            cube: Numbers of the cubes (N,).
            status: Status bits of the rows of stress (N,).
        """
        is_over_limit = status & RESIDUAL != 0
        if is_over_limit.any():
            np.add.at(self._over_limit, cube[is_over_limit], 1)

    def collect(self) -> tuple[StatusBits, Mask, Index]:
        """Return what was found and counted since the last call of this method.

        Returns:
            All conditions that a pad had (cubes, P), whether the residual was ever high (cubes,),
            and the number of rows (cubes,).
        """
        had_high_residual: Mask = self._had_high_residual | self.high_residual
        rows = self._rows
        self._had_high_residual = np.zeros_like(had_high_residual)
        self._rows = np.zeros_like(rows)
        return self._conditions.collect(), had_high_residual, rows

    def _check(self, pattern: _HealthPattern, rows: FrequencyRows) -> tuple[PadMasks, StatusBits]:
        """Check the rows of one or more scans of the same cubes, and add them to the statistics.

        Args:
            pattern: Quantities that depend only on the cube numbers of the rows.
            rows: N rows (samples of one cube).

        Returns:
            Bit masks of the pads to leave out of each row (N,), and conditions of its cube (N,).
        """
        scans = pattern.repeats, len(pattern.cube)
        frequency = rows.frequency.reshape(*scans, -1)
        pad_fault = rows.pad_fault.reshape(scans)
        stamp_ns = rows.stamp_ns.reshape(scans)
        temperature = rows.temperature.reshape(scans)
        is_doubtful = rows.status.reshape(scans) & STAMP != 0
        any_doubtful = bool(is_doubtful.any())
        newest_ns = stamp_ns.max(axis=1).tolist()
        is_possible = (frequency > pattern.low) & (frequency < pattern.high)
        # Scans are examined one by one, because a scan with a bad pad changes which pads are left
        # out of the scans after it.
        is_healthy = [
            np.count_nonzero(scan) == pattern.n_pads and not np.count_nonzero(faults)
            for scan, faults in zip(is_possible, pad_fault, strict=True)
        ]
        left_out = np.empty(scans, np.uint32)
        status = np.empty(scans, np.uint16)
        start = 0
        while start < len(frequency):
            self._advance(newest_ns[start])
            # Scans without a bad pad in the same window change only sums, so they are added in one
            # step.
            end = start + 1
            while end < len(frequency) and is_healthy[end] and self._in_window(newest_ns[end]):
                end += 1
            if not is_healthy[start]:
                # The conditions change before the masks are read below, so that the pad is left out
                # of this very row.
                self._mark_impossible(pattern.cube, frequency[start], is_possible[start])
                self._mark_reported(pattern.cube, pad_fault[start])
            self._statistics.add(
                pattern.cubes,
                frequency[start:end],
                stamp_ns[start:end],
                is_doubtful[start:end] if any_doubtful else None,
            )
            self._rows[pattern.cubes] += end - start
            self.temperature[pattern.cubes] = temperature[end - 1]
            self.newest_ns = newest_ns[end - 1]
            left_out[start:end] = pad_fault[start:end] | self.mask[pattern.cubes]
            status[start:end] = self._conditions.status[pattern.cubes]
            start = end
        return left_out.ravel(), status.ravel()

    def _advance(self, stamp_ns: int) -> None:
        """End the present window if a time stamp, in ns, lies outside it, and start the next one.

        If time went back, the statistics of the window are discarded and not evaluated.
        """
        if self._in_window(stamp_ns):
            return
        if self._window_end_ns is None or stamp_ns < self._window_end_ns:
            self._clear_window()
        else:
            self._close_window()
        self._window_end_ns = stamp_ns + WINDOW_NS

    def _in_window(self, stamp_ns: int) -> bool:
        end = self._window_end_ns
        return end is not None and end - MAX_BACKWARD_NS <= stamp_ns < end

    def _clear_window(self) -> None:
        self._statistics.clear()
        self._over_limit[:] = 0

    def _close_window(self) -> None:
        """Evaluate the statistics of the present window, and start the next window."""
        window = self.window()
        self.history.append(window)
        self.closed += 1
        found = self._diagnosis.examine(window, self.state)
        self._statistics.bound = self._diagnosis.bound
        self.high_residual = has_high_residual(self.high_residual, self._over_limit, window.rows)
        self._had_high_residual |= self.high_residual
        self._conditions.end_window(found, window.rows > 0)
        self._clear_window()

    def _mark_impossible(
        self,
        cube: Index,
        frequency: Single,
        is_possible: Mask,
    ) -> None:
        """Add the condition OPEN, SHORT or RANGE of pads whose frequency is impossible.

        Args:
            cube: Numbers of the cubes (n,).
            frequency: Frequencies (n, P), in Hz.
            is_possible: Whether a frequency lies in the possible range (n, P).
        """
        is_impossible = ~is_possible & self._exists[cube]
        rows = np.flatnonzero(is_impossible.any(axis=1))
        cube, frequency = cube[rows], frequency[rows]
        bits = np.where(frequency >= self._limits.open[cube], OPEN, RANGE)
        bits[~(frequency > 0)] = SHORT  # true for NaN, too
        bits[~is_impossible[rows]] = 0
        self._conditions.add(cube, bits.astype(np.uint16))

    def _mark_reported(self, cube: Index, pad_fault: PadMasks) -> None:
        """Add the condition REPORTED of pads that the device reports as broken.

        Args:
            cube: Numbers of the cubes (n,).
            pad_fault: Bit masks of the pads that the device reports (n,).
        """
        rows = np.flatnonzero(pad_fault)
        cube = cube[rows]
        pads = np.arange(self._exists.shape[1])
        is_reported = pad_fault[rows, None] >> pads & 1 > 0
        # The hub may set the bit of a pad that the cube does not have.
        is_reported &= self._exists[cube]
        self._conditions.add(cube, is_reported * np.uint16(REPORTED))

    def _make_pattern(self, cube: AnyArray) -> _HealthPattern:
        """Compute the quantities that depend only on the cube numbers (N,) of a message.

        Raises:
            LayoutError: The skin does not have one of the cubes.
        """
        n_cubes, n_pads = self._exists.shape
        is_known = (cube >= 0) & (cube < n_cubes)
        if not is_known.all():
            raise self._misfit(cube, (len(cube), n_pads))
        repeats = count_repeats(cube)
        scan = cube[:0]
        cubes: Cubes = scan
        if repeats:
            scan = cubes = cube[: len(cube) // repeats].copy()
            first, last = int(scan[0]), int(scan[-1])
            # The cube numbers of a scan rise, so they have no gaps if the range from the first to
            # the last is as long as the scan.
            if last - first + 1 == len(scan):
                cubes = slice(first, last + 1)
        return _HealthPattern(
            repeats=repeats,
            cube=scan,
            cubes=cubes,
            low=self._limits.low[cubes],
            high=self._limits.high[cubes],
            n_pads=int(self._exists[cubes].sum()),
        )

    def _misfit(self, cube: AnyArray, shape: tuple[int, ...]) -> LayoutError:
        """Return the error for frequencies that do not fit the skin.

        Args:
            cube: Cube number of each row (N,).
            shape: Shape of the frequencies.
        """
        n_cubes, n_pads = self._exists.shape
        return LayoutError(
            f"frequencies of shape {shape} for cubes up to {max(cube, default=0)}; this skin has "
            f"{n_cubes} cubes of {n_pads} pads: use the skin file of the driver"
        )


def _split_into_scans(cube: AnyArray) -> list[Index]:
    """Split rows in any order into parts, each of one or more scans of the same cubes.

    The first scan has the first row of each cube, the second scan the second row of each, and so
    on. Consecutive scans of the same cubes are one part. A cube with k rows also has k - 1 rows, so
    the scans only lose cubes, and there are at most as many parts as cubes.

    Args:
        cube: Cube number of each row (N,).

    Returns:
        Row numbers of each part.
    """
    if not len(cube):
        return []
    order = np.argsort(cube, kind="stable")
    ordered = cube[order]
    occurrence = np.arange(len(cube)) - np.searchsorted(ordered, ordered)
    by_occurrence = np.argsort(occurrence, kind="stable")
    sizes = np.bincount(occurrence)
    ends = np.cumsum(sizes)[:-1]
    is_other_scan = sizes[1:] != sizes[:-1]
    return np.split(order[by_occurrence], ends[is_other_scan])
