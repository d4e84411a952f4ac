"""Health of pads and cubes, from frequencies alone: what is broken, at once and without flicker.

Every row is checked when it comes: a pad whose frequency is impossible (open, short, out of range)
is left out of that very row. What needs statistics (stuck, noisy, drifting) is decided over windows
of WINDOW_S of the rows' own time. All arrays are (cubes, pads); nothing loops over cubes.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from ..errors import LayoutError
from ..oscillator import pad_frequency, stress_slope
from ..pattern import PatternCache, count_repeats
from ..pipeline import Pipeline
from ..rows import FrequencyRows
from ..status import OPEN, RANGE, REPORTED, RESIDUAL, SHORT, STAMP
from .conditions import Conditions
from .diagnosis import PadDiagnosis, still_strained
from .statistics import WINDOW_S, Window, WindowStatistics

BACK_NS = round(2e9 * WINDOW_S)
"""A time further back than this before the window's end is another time: a recording that starts
again."""
HISTORY = 20
"""Windows remembered for tare: 10 s."""
STRAIN_RANGE = (-0.8, 1.0)
"""d/d_rest - 1 that elastomer survives: squeezed to a fifth, stretched to twice."""
STRAIN_OPEN = 3.0


class _Limits(NamedTuple):
    """Frequencies (cubes, P) Hz float32 of the pads' law: the possible range, and from where on a
    pad is open."""

    low: np.ndarray
    high: np.ndarray
    open: np.ndarray


class _Pattern(NamedTuple):
    """What depends on the cube indices of a message alone."""

    repeats: int  # scans in the message; 0: the cubes come in another order
    cube: np.ndarray  # (n,) of one scan
    cubes: slice | np.ndarray  # the same; a slice where they are neighbours, which is not copied
    low: np.ndarray  # (n, P)
    high: np.ndarray
    n_pads: int  # pads of all cubes of a scan


class Health:
    """Watches the cubes of a pipeline.

    strained: (cubes,) bool, the residual stays above its limit
    temperature: (cubes,) °C, newest
    history: the last windows; closed: how many have ended; newest_ns: newest stamp
    """

    def __init__(self, pipeline: Pipeline) -> None:
        self._pipeline = pipeline
        n_cubes, n_pads = len(pipeline.calibrations), pipeline.n_pads
        layouts = [calibration.layout for calibration in pipeline.calibrations]
        self._exists = np.array([np.arange(n_pads) < layout.n_pads for layout in layouts])
        self._conditions = Conditions(n_cubes, n_pads)
        self._diagnosis = PadDiagnosis(self._exists)
        self._patterns = PatternCache(self._make_pattern, n_cubes)
        self.strained = np.zeros(n_cubes, bool)
        self.temperature = np.full(n_cubes, np.nan)
        self.history: deque[Window] = deque(maxlen=HISTORY)
        self.closed = 0
        self.newest_ns = 0
        self._window_end_ns: int | None = None
        self._over_limit = np.zeros(n_cubes, int)  # rows of this window with RESIDUAL
        self._rows = np.zeros(n_cubes, int)  # since `collect`
        self._strained_since = np.zeros(n_cubes, bool)  # since `collect`
        self.refresh()
        self._statistics = WindowStatistics(pipeline.rest_frequency)
        self._statistics.bound = self._diagnosis.bound

    @property
    def state(self) -> np.ndarray:
        """(cubes, P) uint16, bits of each pad now."""
        return self._conditions.state

    @property
    def mask(self) -> np.ndarray:
        """(cubes,) uint32, bit p: pad p is left out."""
        return self._conditions.mask

    @property
    def still(self) -> np.ndarray:
        """(cubes,) bool, nothing moved in the last window."""
        return self._diagnosis.still

    @property
    def noise(self) -> np.ndarray:
        """(cubes, P) Hz, as the calibration says."""
        return self._diagnosis.noise

    @property
    def last(self) -> np.ndarray:
        """(cubes, P) Hz, newest frequencies."""
        return self._statistics.last

    @property
    def age_ns(self) -> np.ndarray:
        """(cubes,) how far the newest row of each cube is behind the newest of all, ns."""
        age: np.ndarray = self.newest_ns - self._statistics.newest_ns
        return age

    def window(self) -> Window:
        """The window that is not over yet."""
        return self._statistics.window()

    def refresh(self) -> None:
        """Take over the pipeline's rest frequencies, after tare."""
        calibrations = self._pipeline.calibrations
        beta = self._per_pad([calibration.beta for calibration in calibrations])
        modulus = self._per_pad([calibration.modulus for calibration in calibrations])
        noise = self._per_pad([calibration.noise for calibration in calibrations])
        rest = self._pipeline.rest_frequency

        def at_strain(strain: float) -> np.ndarray:
            return pad_frequency(strain * modulus, rest, beta, modulus).astype(np.float32)

        self._limits = _Limits(*map(at_strain, (*STRAIN_RANGE, STRAIN_OPEN)))
        self._diagnosis.set_reference(rest, noise / stress_slope(rest, rest, beta, modulus))
        self._patterns.clear()

    def update(self, rows: FrequencyRows) -> tuple[np.ndarray, np.ndarray]:
        """Check rows before they are reconstructed: of one scan, or of several one after the other.

        Returns (N,) uint32, bits of the pads to leave out of each row (what the device reports
        included), and (N,) uint16, status bits of its cube. Several scans at once give the bits
        that they give one by one.
        LayoutError: frequencies of another shape, or a cube that the skin does not have.
        """
        if rows.frequency.shape != (len(rows), self._exists.shape[1]):
            raise self._misfit(rows.cube, rows.frequency.shape)
        pattern = self._patterns.get(rows.cube)
        if pattern.repeats:
            return self._check(pattern, rows)
        left_out, status = np.empty(len(rows), np.uint32), np.empty(len(rows), np.uint16)
        for chosen in _regular_parts(rows.cube):
            part = rows.select(chosen)
            left_out[chosen], status[chosen] = self._check(self._make_pattern(part.cube), part)
        return left_out, status

    def count_residuals(self, cube: np.ndarray, status: np.ndarray) -> None:
        """Take the status (N,) of reconstructed rows of cubes (N,)."""
        over = status & RESIDUAL != 0
        if over.any():
            np.add.at(self._over_limit, cube[over], 1)

    def collect(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What was found since the last call: bits (cubes, P), strained (cubes,) bool, rows
        (cubes,)."""
        strained, rows = self._strained_since | self.strained, self._rows
        self._strained_since = np.zeros_like(strained)
        self._rows = np.zeros_like(rows)
        return self._conditions.collect(), strained, rows

    def _check(self, pattern: _Pattern, rows: FrequencyRows) -> tuple[np.ndarray, np.ndarray]:
        """Rows of B scans of the same n cubes."""
        scans = pattern.repeats, len(pattern.cube)
        frequency = rows.frequency.reshape(*scans, -1)
        pad_fault = rows.pad_fault.reshape(scans)
        stamp_ns = rows.stamp_ns.reshape(scans)
        temperature = rows.temperature.reshape(scans)
        doubtful = rows.status.reshape(scans) & STAMP != 0
        in_doubt = bool(doubtful.any())
        newest_ns = stamp_ns.max(axis=1).tolist()
        possible = (frequency > pattern.low) & (frequency < pattern.high)
        healthy = [
            np.count_nonzero(scan) == pattern.n_pads and not np.count_nonzero(faults)
            for scan, faults in zip(possible, pad_fault, strict=True)
        ]
        left_out, status = np.empty(scans, np.uint32), np.empty(scans, np.uint16)
        start = 0
        while start < len(frequency):
            self._advance(newest_ns[start])
            # Healthy scans of the same window change nothing but sums: they are added at once.
            end = start + 1
            while end < len(frequency) and healthy[end] and self._in_window(newest_ns[end]):
                end += 1
            if not healthy[start]:
                self._mark_impossible(pattern.cube, frequency[start], possible[start])
                self._mark_reported(pattern.cube, pad_fault[start])
            self._statistics.add(
                pattern.cubes,
                frequency[start:end],
                stamp_ns[start:end],
                doubtful[start:end] if in_doubt else None,
            )
            self._rows[pattern.cubes] += end - start
            self.temperature[pattern.cubes] = temperature[end - 1]
            self.newest_ns = newest_ns[end - 1]
            left_out[start:end] = pad_fault[start:end] | self.mask[pattern.cubes]
            status[start:end] = self._conditions.status[pattern.cubes]
            start = end
        return left_out.ravel(), status.ravel()

    def _advance(self, stamp_ns: int) -> None:
        """Time goes on: the window ends where it is over. After a jump back another one begins."""
        if self._in_window(stamp_ns):
            return
        if self._window_end_ns is None or stamp_ns < self._window_end_ns:
            self._clear_window()
        else:
            self._close_window()
        self._window_end_ns = stamp_ns + round(1e9 * WINDOW_S)

    def _in_window(self, stamp_ns: int) -> bool:
        end = self._window_end_ns
        return end is not None and end - BACK_NS <= stamp_ns < end

    def _clear_window(self) -> None:
        self._statistics.clear()
        self._over_limit[:] = 0

    def _close_window(self) -> None:
        window = self.window()
        self.history.append(window)
        self.closed += 1
        found = self._diagnosis.examine(window, self.state)
        self._statistics.bound = self._diagnosis.bound
        self.strained = still_strained(self.strained, self._over_limit, window.rows)
        self._strained_since |= self.strained
        self._conditions.end_window(found, window.rows > 0)
        self._clear_window()

    def _mark_impossible(
        self, cube: np.ndarray, frequency: np.ndarray, possible: np.ndarray
    ) -> None:
        impossible = ~possible & self._exists[cube]
        rows = np.flatnonzero(impossible.any(axis=1))
        cube, frequency = cube[rows], frequency[rows]
        bits = np.where(frequency >= self._limits.open[cube], OPEN, RANGE)
        bits[~(frequency > 0)] = SHORT
        bits[~impossible[rows]] = 0
        self._conditions.add(cube, bits.astype(np.uint16))

    def _mark_reported(self, cube: np.ndarray, pad_fault: np.ndarray) -> None:
        rows = np.flatnonzero(pad_fault)
        reported = pad_fault[rows, None] >> np.arange(self._exists.shape[1]) & 1 > 0
        reported &= self._exists[cube[rows]]
        self._conditions.add(cube[rows], reported * np.uint16(REPORTED))

    def _make_pattern(self, cube: np.ndarray) -> _Pattern:
        if len(cube) and not 0 <= int(cube.min()) <= int(cube.max()) < len(self._exists):
            raise self._misfit(cube, (len(cube), self._exists.shape[1]))
        repeats = count_repeats(cube)
        scan = cube[: len(cube) // repeats].copy() if repeats else cube[:0]
        neighbours = repeats and int(scan[-1]) - int(scan[0]) + 1 == len(scan)
        cubes = slice(int(scan[0]), int(scan[-1]) + 1) if neighbours else scan
        return _Pattern(
            repeats,
            scan,
            cubes,
            self._limits.low[cubes],
            self._limits.high[cubes],
            int(self._exists[cubes].sum()),
        )

    def _per_pad(self, values: list[np.ndarray]) -> np.ndarray:
        """(cubes, P) of one array per cube; 1 where a cube has no such pad."""
        width = self._exists.shape[1]
        return np.array([np.pad(v, (0, width - len(v)), constant_values=1.0) for v in values])

    def _misfit(self, cube: np.ndarray, shape: tuple[int, ...]) -> LayoutError:
        n_cubes, n_pads = self._exists.shape
        return LayoutError(
            f"frequencies of shape {shape} for cubes up to {max(cube, default=0)}; this skin has "
            f"{n_cubes} cubes of {n_pads} pads: use the skin file of the driver"
        )


def _regular_parts(cube: np.ndarray) -> list[np.ndarray]:
    """Row numbers in parts, each of several scans of the same cubes: of the first row of each cube,
    of the second row of each, and so on.

    The cubes that come k times are among those that come k - 1 times, so there are at most as many
    parts as cubes.
    """
    if not len(cube):
        return []
    order = np.argsort(cube, kind="stable")
    ordered = cube[order]
    occurrence = np.arange(len(cube)) - np.searchsorted(ordered, ordered)
    by_occurrence = np.argsort(occurrence, kind="stable")
    sizes = np.bincount(occurrence)
    ends = np.cumsum(sizes)[:-1]
    return np.split(order[by_occurrence], ends[sizes[1:] != sizes[:-1]])
