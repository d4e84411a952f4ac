"""Health of pads and cubes, from frequencies alone: what is broken, said at once and without
flicker.

Every row is looked at when it comes: a pad that cannot be (open, short, out of range) is left out
of that very row. What needs statistics (stuck, noisy, drifting) is judged over windows of WINDOW_S
of the rows' own time. A condition lasts until it was absent for HOLD windows. All arrays are
(cubes, pads); nothing loops over cubes.

    strain    d/d_rest - 1 of the pad's law (oscillator.py)
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from .column import Columns, turns
from .errors import LayoutError
from .oscillator import pad_frequency, stress_slope
from .pipeline import Pipeline
from .status import LEFT_OUT, OPEN, RANGE, REPORTED, RESIDUAL, SHORT
from .window import WINDOW_S, Judge, Statistics, Window, still_strained

BACK_NS = round(2e9 * WINDOW_S)
"""Times that lie further back than this before the window's end are another time: a recording
played again."""
HOLD = 3
HISTORY = 20
"""Windows remembered, for tare: 10 s."""
STRAIN_RANGE = (-0.8, 1.0)
"""Squeezed to a fifth or stretched to twice: elastomer tears before."""
STRAIN_OPEN = 3.0


class _Column(NamedTuple):
    """What depends on the cube column of a message alone."""

    turns: int  # how many times the same rising cubes stand in it, 0: not so
    cube: np.ndarray  # (n,) of one turn
    cubes: (
        slice | np.ndarray
    )  # the same, as a slice where they are neighbours: numpy does not copy those
    low: np.ndarray  # (n, P)
    high: np.ndarray
    pads: int  # how many there are in a turn
    fine: np.ndarray  # (n,) status 0


class Health:
    """Watches the cubes of a pipeline.

    state: (cubes, P) uint16, the bits above, now; mask: (cubes,) uint32, bit p: pad p is left out;
    status: (cubes,) uint16, all pads' bits together; strained: (cubes,) bool, residual above its
    level; last: (cubes, P) Hz, newest frequencies; rows: (cubes,) how many came since `collect`;
    history: the last windows; still: (cubes,) bool, nothing moved in the last one; temperature:
    (cubes,) °C, newest; closed: how many windows have ended.
    """

    def __init__(self, pipeline: Pipeline) -> None:
        self._pipeline = pipeline
        calibrations = pipeline.calibrations
        width = pipeline.n_pads
        self._shape = len(calibrations), width
        self._exists = np.array([np.arange(width) < c.layout.n_pads for c in calibrations])
        self._one = np.uint32(1) << np.arange(width, dtype=np.uint32)
        self.state = np.zeros(self._shape, np.uint16)
        self.rows = np.zeros(self._shape[0], int)
        self.strained = np.zeros(self._shape[0], bool)
        self._recent = np.zeros((HOLD, *self._shape), np.uint16)
        self._seen = np.zeros(self._shape, np.uint16)
        self._strained_seen = self.strained.copy()
        self._bad_residual = np.zeros(self._shape[0], int)
        self._window_end: int | None = None
        self.history: deque[Window] = deque(maxlen=HISTORY)
        self.closed = 0
        self.newest_ns = 0
        self.temperature = np.full(self._shape[0], np.nan)
        self._columns = Columns(self._make_column, self._shape[0])
        self._judge = Judge(self._exists)
        self.refresh()
        self._statistics = Statistics(self._rest, self._judge.bound)
        self.window = self._statistics.window
        self._publish()

    @property
    def still(self) -> np.ndarray:
        return self._judge.still

    @property
    def noise(self) -> np.ndarray:
        return self._judge.noise

    @property
    def last(self) -> np.ndarray:
        return self._statistics.last

    def refresh(self) -> None:
        """Take the pipeline's rest frequencies anew, after tare."""
        pads = [(c.beta, c.modulus, c.noise) for c in self._pipeline.calibrations]
        beta, modulus, noise = (
            np.array(
                [
                    np.pad(each[k], (0, self._shape[1] - len(each[k])), constant_values=1.0)
                    for each in pads
                ]
            )
            for k in range(3)
        )
        rest = self._pipeline.rest_frequency
        self._rest = rest
        self._low, self._high, self._open = (
            pad_frequency(strain * modulus, rest, beta, modulus).astype(np.float32)
            for strain in (*STRAIN_RANGE, STRAIN_OPEN)
        )
        self._judge.set(rest, noise / stress_slope(rest, rest, beta, modulus))
        self._columns.clear()

    def update(
        self,
        cube: np.ndarray,
        frequency: np.ndarray,
        pad_fault: np.ndarray,
        stamp_ns: np.ndarray,
        temperature: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Look at the rows of a message, before they are reconstructed.

        cube (N,) indices; frequency (N, P) Hz; pad_fault (N,) bits; stamp_ns (N,) times;
        temperature (N,) °C. Cubes that stand in it several times, always in the same order, are
        looked at turn by turn. Returns (N,) uint32, bits of the pads to leave out of each row, and
        (N,) uint16, status bits of its cube.
        LayoutError: a shape or a cube that the pipeline does not have.
        """
        column = self._column(cube, frequency.shape)
        if column.turns == 1:
            return self._look(column, frequency, pad_fault, int(stamp_ns.max()), temperature)
        if column.turns == 0:
            return self._look_at_any(cube, frequency, pad_fault, stamp_ns, temperature)
        batches = column.turns, len(column.cube)
        known = None if temperature is None else temperature.reshape(batches)
        mask, status = self._look_at_many(
            column,
            frequency.reshape(*batches, -1),
            pad_fault.reshape(batches),
            stamp_ns.reshape(batches).max(axis=1),
            known,
        )
        return mask.ravel(), status.ravel()

    def update_many(
        self,
        cube: np.ndarray,
        frequency: np.ndarray,
        pad_fault: np.ndarray,
        stamp_ns: np.ndarray,
        temperature: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """`update` of B messages with the same cubes one after the other, to the same bits, for
        what was recorded.

        cube (N,), frequency (B, N, P), pad_fault, stamp_ns and temperature (B, N). Returns (B, N)
        bits of the pads to leave out, and (B, N) status.
        """
        column = self._column(cube, frequency.shape[1:])
        if column.turns == 0:
            parts = [
                self._look_at_any(cube, *one)
                for one in zip(frequency, pad_fault, stamp_ns, temperature, strict=True)
            ]
            masks, statuses = (np.array(part) for part in zip(*parts, strict=True))
            return masks, statuses
        batches = len(frequency) * column.turns, len(column.cube)
        mask, status = self._look_at_many(
            column,
            frequency.reshape(*batches, -1),
            pad_fault.reshape(batches),
            stamp_ns.reshape(batches).max(axis=1),
            temperature.reshape(batches),
        )
        return mask.reshape(pad_fault.shape), status.reshape(pad_fault.shape)

    def _look(
        self,
        column: _Column,
        frequency: np.ndarray,
        pad_fault: np.ndarray,
        stamp_ns: int,
        temperature: np.ndarray | None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Rows of one turn."""
        self._go_on(stamp_ns)
        self._statistics.add(column.cubes, frequency, stamp_ns)
        self.rows[column.cubes] += 1
        if temperature is not None:
            self.temperature[column.cubes] = temperature
        possible = frequency > column.low
        possible &= frequency < column.high
        if np.count_nonzero(possible) != column.pads:
            self._mark_impossible(column.cube, frequency, possible)
        if np.count_nonzero(pad_fault):
            self._mark_reported(column.cube, pad_fault)
        if not self._any:
            return pad_fault, column.fine
        return pad_fault | self.mask[column.cubes], self.status[column.cubes]

    def _look_at_any(
        self,
        cube: np.ndarray,
        frequency: np.ndarray,
        pad_fault: np.ndarray,
        stamp_ns: np.ndarray,
        temperature: np.ndarray | None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Rows of cubes in any order: first all first ones, then all second ones …"""
        if not len(cube):
            return pad_fault, np.zeros(0, np.uint16)
        self._go_on(int(stamp_ns.max()))
        order = np.argsort(cube, kind="stable")
        ordered = cube[order]
        turn = np.arange(len(cube)) - np.searchsorted(ordered, ordered)
        for k in range(int(turn.max()) + 1):
            chosen = order[turn == k]
            self._statistics.add(cube[chosen], frequency[chosen], stamp_ns[chosen])
            self.rows[cube[chosen]] += 1
        if temperature is not None:
            self.temperature[cube] = temperature
        self._mark_impossible(
            cube, frequency, (frequency > self._low[cube]) & (frequency < self._high[cube])
        )
        self._mark_reported(cube, pad_fault)
        return pad_fault | self.mask[cube], self.status[cube]

    def _look_at_many(
        self,
        column: _Column,
        frequency: np.ndarray,
        pad_fault: np.ndarray,
        stamp_ns: np.ndarray,
        temperature: np.ndarray | None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Rows of (B, n) turns, to the same bits as `_look` of one after the other."""
        masks, statuses = np.empty(pad_fault.shape, np.uint32), np.empty(pad_fault.shape, np.uint16)
        possible = (frequency > column.low) & (frequency < column.high)
        # What is possible and no fault changes nothing but sums within a window.
        quiet = (np.count_nonzero(possible, axis=(1, 2)) == column.pads) & ~pad_fault.any(axis=1)
        k = 0
        while k < len(frequency):
            known = None if temperature is None else temperature[k]
            masks[k], statuses[k] = self._look(
                column, frequency[k], pad_fault[k], int(stamp_ns[k]), known
            )
            end = k = k + 1
            low, high = (self._window_end or 0) - BACK_NS, self._window_end or 0
            while end < len(frequency) and quiet[end] and low <= stamp_ns[end] < high:
                end += 1
            if end > k:
                self._statistics.add_many(column.cubes, frequency[k:end], stamp_ns[k:end])
                self.rows[column.cubes] += end - k
                if temperature is not None:
                    self.temperature[column.cubes] = temperature[end - 1]
                self.newest_ns = int(stamp_ns[end - 1])
                masks[k:end], statuses[k:end] = self.mask[column.cubes], self.status[column.cubes]
                k = end
        return masks, statuses

    def _column(self, cube: np.ndarray, shape: tuple[int, ...]) -> _Column:
        """Of a message whose frequencies have this shape."""
        if shape != (len(cube), self._shape[1]):
            raise self._strange(cube, shape)
        return self._columns.of(cube)

    def _make_column(self, cube: np.ndarray) -> _Column:
        if len(cube) and int(cube.max()) >= self._shape[0]:
            raise self._strange(cube, (len(cube), self._shape[1]))
        count = turns(cube)
        one = cube[: len(cube) // count].copy() if count else cube[:0]
        together = count and int(one[-1]) - int(one[0]) + 1 == len(one)
        cubes = slice(int(one[0]), int(one[-1]) + 1) if together else one
        return _Column(
            count,
            one,
            cubes,
            self._low[cubes],
            self._high[cubes],
            int(self._exists[cubes].sum()),
            np.zeros(len(one), np.uint16),
        )

    def _strange(self, cube: np.ndarray, shape: tuple[int, ...]) -> LayoutError:
        return LayoutError(
            f"frequencies of shape {shape} for cubes up to {max(cube, default=0)}; this skin has {self._shape[0]} "
            f"cubes of {self._shape[1]} pads: use the skin file of the driver"
        )

    def _go_on(self, stamp_ns: int) -> None:
        """Time goes on; the window ends where it is over. What fell back in time begins a new
        one."""
        end = self._window_end
        if end is None or stamp_ns < end - BACK_NS:
            self._clear_window()
        elif stamp_ns >= end:
            self._close_window()
        if end is None or not end - BACK_NS <= stamp_ns < end:
            self._window_end = stamp_ns + round(1e9 * WINDOW_S)
        self.newest_ns = stamp_ns

    def residual(self, cube: np.ndarray, status: np.ndarray) -> None:
        """Take the status of reconstructed rows."""
        bad = status & RESIDUAL != 0
        if bad.any():
            np.add.at(self._bad_residual, cube[bad], 1)

    def collect(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What was found since the last call: bits (cubes, P), strained (cubes,), rows (cubes,);
        begins anew."""
        found = self._seen | self.state, self._strained_seen | self.strained, self.rows
        self._seen = np.zeros_like(self._seen)
        self._strained_seen = np.zeros_like(self._strained_seen)
        self.rows = np.zeros_like(self.rows)
        return found

    def _mark_impossible(
        self, cube: np.ndarray, frequency: np.ndarray, possible: np.ndarray
    ) -> None:
        rows = np.flatnonzero((~possible & self._exists[cube]).any(axis=1))
        cube, frequency, possible = cube[rows], frequency[rows], possible[rows]
        bits = np.where(frequency >= self._open[cube], OPEN, RANGE)
        bits[~(frequency > 0)] = SHORT
        bits[possible | ~self._exists[cube]] = 0
        self._mark(cube, bits.astype(np.uint16))

    def _mark_reported(self, cube: np.ndarray, pad_fault: np.ndarray) -> None:
        rows = np.flatnonzero(pad_fault)
        bits = (pad_fault[rows, None] & self._one > 0) & self._exists[cube[rows]]
        self._mark(cube[rows], bits * np.uint16(REPORTED))

    def _mark(self, cube: np.ndarray, bits: np.ndarray) -> None:
        # A pad that is broken for good says nothing new.
        if (bits & ~self._recent[0][cube]).any():
            np.bitwise_or.at(self._recent[0], cube, bits)
            self._publish()

    def _publish(self) -> None:
        self.state = np.bitwise_or.reduce(self._recent, axis=0)
        self._seen |= self.state
        self.mask = ((self.state & LEFT_OUT > 0) * self._one).sum(axis=1, dtype=np.uint32)
        self.status = np.bitwise_or.reduce(self.state, axis=1)
        self._any = bool(self.state.any())

    def _clear_window(self) -> None:
        self._statistics.clear()
        self._bad_residual[:] = 0

    def _close_window(self) -> None:
        """Judge the statistics of the window that ended."""
        window = self.window()
        self.history.append(window)
        self.closed += 1
        came = window.rows > 0
        found = self._judge.judge(window, self.state)
        self._statistics.bound[:] = self._judge.bound
        self.strained = still_strained(self.strained, self._bad_residual, window.rows)
        self._strained_seen |= self.strained
        self._recent[0] |= found
        self._publish()
        # Cubes of which nothing came keep what was found: silence is no recovery.
        kept = self._recent[:, ~came]
        self._recent = np.roll(self._recent, 1, axis=0)
        self._recent[0] = 0
        self._recent[:, ~came] = kept
        self._clear_window()
