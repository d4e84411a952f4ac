"""Health of pads and cubes, from frequencies alone: what is broken, said at once and without flicker.

Every row is looked at when it comes: a pad that cannot be (open, short, out of range) is left out of that very row.
What needs statistics (stuck, noisy, drifting) is judged over windows of WINDOW_S of the rows' own time. A condition
lasts until it was absent for HOLD windows. All arrays are (cubes, pads); nothing loops over cubes.

    noise of a pad    sqrt(mean((f[n] - 2 f[n-1] + f[n-2])²) / 6), each term bounded so that one jump is no noise; a
                      load that moves slowly leaves no second difference
    strain            d/d_rest - 1 of the pad's law (oscillator.py)
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from .errors import LayoutError
from .oscillator import pad_frequency, stress_slope
from .pipeline import RESIDUAL, Pipeline

OPEN, SHORT, RANGE, STUCK, NOISY, REPORTED, DRIFT = 16, 32, 64, 128, 256, 512, 1024
WORDS = {
    OPEN: "open",
    SHORT: "short",
    RANGE: "out of range",
    STUCK: "stuck",
    NOISY: "noisy",
    REPORTED: "reported by the hub",
    DRIFT: "drifting",
}
LEFT_OUT = OPEN | SHORT | RANGE | STUCK | NOISY | REPORTED
"""A pad with one of these is not used; one that drifts still is: only tare knows better."""

WINDOW_S = 0.5
HOLD = 3
HISTORY = 20
"""Windows remembered, for tare: 10 s."""
MIN_COUNT = 20
"""Rows in a window below which its statistics say nothing."""
STRAIN_RANGE = (-0.8, 1.0)
"""Squeezed to a fifth or stretched to twice: elastomer tears before."""
STRAIN_OPEN = 3.0
NOISY_ENTER, NOISY_LEAVE = 10.0, 5.0
"""Times the calibration's noise and times the cube's other pads, to become noisy and to stay so."""
JUMP = 60.0
"""Times the usual noise, to which a second difference is bounded: two of them in 20 rows stay below NOISY_ENTER."""
STUCK_MOVING = 5.0
"""Times its noise that the cube's pads must have moved, before one that did not move at all is called stuck."""
STILL = 8.0
"""Times its noise, peak to peak, within which a pad stands still: noise alone spans 6 in 1000 rows."""
DRIFT_LIMIT = 2e-4
"""Of the rest frequency: how far one pad wanders while all stand still, before it is called drifting."""
RESIDUAL_ENTER, RESIDUAL_LEAVE = 0.5, 0.1
"""Shares of a window's rows with a residual above its limit."""


class Window(NamedTuple):
    """What is kept of a window: rows (cubes,) that came, and (cubes, P) in Hz, NaN where nothing was measured."""

    rows: np.ndarray
    mean: np.ndarray
    lowest: np.ndarray
    highest: np.ndarray
    noise: np.ndarray


class Health:
    """Watches the cubes of a pipeline.

    state: (cubes, P) uint16, the bits above, now; mask: (cubes,) uint32, bit p: pad p is left out; status: (cubes,)
    uint16, all pads' bits together; strained: (cubes,) bool, residual above its level; last: (cubes, P) Hz, newest
    frequencies; rows: (cubes,) how many came since `collect`; history: the last windows; still: (cubes,) bool, nothing
    moved in the last one; temperature: (cubes,) °C, newest; closed: how many windows have ended.
    """

    def __init__(self, pipeline: Pipeline) -> None:
        self._pipeline = pipeline
        calibrations = pipeline.calibrations
        width = pipeline.n_pads
        self._shape = len(calibrations), width
        self._exists = np.array([np.arange(width) < c.layout.n_pads for c in calibrations])
        self._n_pads = self._exists.sum(axis=1)
        self._one = np.uint32(1) << np.arange(width, dtype=np.uint32)
        self.state = np.zeros(self._shape, np.uint16)
        self.last = np.full(self._shape, np.nan, np.float32)
        self.rows = np.zeros(self._shape[0], int)
        self.strained = np.zeros(self._shape[0], bool)
        self.still = np.zeros(self._shape[0], bool)
        self._before = self.last.copy()
        self._recent = np.zeros((HOLD, *self._shape), np.uint16)
        self._seen = np.zeros(self._shape, np.uint16)
        self._strained_seen = self.strained.copy()
        self._reference = np.full(self._shape, np.nan)
        self._middle = np.full(self._shape, np.nan)  # means of the window before
        self._window_end: int | None = None
        self.history: deque[Window] = deque(maxlen=HISTORY)
        self.closed = 0
        self.newest_ns = 0
        self.temperature = np.full(self._shape[0], np.nan)
        self.refresh()
        self._base = np.nan_to_num(self._rest).astype(np.float32)  # sums are of what is above it
        self._jump = ((JUMP * self.noise) ** 2).astype(np.float32)
        self._clear_window()
        self._publish()

    def refresh(self) -> None:
        """Take the pipeline's rest frequencies anew, after tare."""
        pads = [(c.beta, c.modulus, c.noise) for c in self._pipeline.calibrations]
        beta, modulus, noise = (
            np.array([np.pad(each[k], (0, self._shape[1] - len(each[k])), constant_values=1.0) for each in pads])
            for k in range(3)
        )
        rest = self._pipeline.rest_frequency
        self._rest = rest
        self._low, self._high, self._open = (
            pad_frequency(strain * modulus, rest, beta, modulus).astype(np.float32)
            for strain in (*STRAIN_RANGE, STRAIN_OPEN)
        )
        self.noise = noise / stress_slope(rest, rest, beta, modulus)

    def update(
        self,
        cube: np.ndarray,
        frequency: np.ndarray,
        pad_fault: np.ndarray,
        stamp_ns: int,
        temperature: np.ndarray | None = None,
    ) -> np.ndarray:
        """Look at rows, before they are reconstructed. Returns (N,) uint32: bits of the pads to leave out of each.

        cube (N,) indices; frequency (N, P) Hz; pad_fault (N,) bits; stamp_ns: time of the rows; temperature (N,) °C.
        LayoutError: a shape or a cube that the pipeline does not have.
        """
        if frequency.shape != (len(cube), self._shape[1]) or (len(cube) and int(cube.max()) >= self._shape[0]):
            raise LayoutError(
                f"frequencies of shape {frequency.shape} for cubes up to {max(cube, default=0)}; this skin has "
                f"{self._shape[0]} cubes of {self._shape[1]} pads: use the skin file of the driver"
            )
        if not len(cube):
            return pad_fault
        if self._window_end is None or stamp_ns < self._window_end - 2e9 * WINDOW_S:
            self._window_end = stamp_ns + round(1e9 * WINDOW_S)
        elif stamp_ns >= self._window_end:
            self._close_window()
            self._window_end = stamp_ns + round(1e9 * WINDOW_S)
        self.newest_ns = stamp_ns
        rising = len(cube) == 1 or bool((cube[1:] > cube[:-1]).all())
        if rising:
            self._add(cube, frequency)
        else:
            # A cube may stand in one batch several times: first all first ones, then all second ones …
            order = np.argsort(cube, kind="stable")
            ordered = cube[order]
            turn = np.arange(len(cube)) - np.searchsorted(ordered, ordered)
            for k in range(int(turn.max()) + 1):
                chosen = order[turn == k]
                self._add(cube[chosen], frequency[chosen])
        index = _index(cube, rising)
        if temperature is not None:
            self.temperature[index] = temperature
        possible = (frequency > self._low[index]) & (frequency < self._high[index])
        if not possible.all():
            self._mark_impossible(cube, frequency, possible)
        if pad_fault.any():
            bits = (pad_fault[:, None] & self._one > 0) & self._exists[cube]
            self._mark(cube, bits * np.uint16(REPORTED))
        if not self._any:
            return pad_fault
        mask: np.ndarray = pad_fault | self.mask[cube]
        return mask

    def update_many(
        self,
        cube: np.ndarray,
        frequency: np.ndarray,
        pad_fault: np.ndarray,
        stamp_ns: np.ndarray,
        temperature: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """`update` of B batches one after the other, to the same bits, for what was recorded.

        cube (B, N), frequency (B, N, P), pad_fault (B, N), stamp_ns (B,), temperature (B, N). Returns (B, N) bits of
        the pads to leave out, as `update`, and (B, N) status after each.
        """
        masks, bits = np.empty(cube.shape, np.uint32), np.empty(cube.shape, np.uint16)
        # What is possible and no fault, of the same rising cubes all along, changes nothing but sums within a window.
        quiet = np.zeros(len(cube), bool)
        if (
            cube.size
            and (cube == cube[0]).all()
            and (cube[0, 1:] > cube[0, :-1]).all()
            and frequency.shape[2] == self._shape[1]
            and cube[0, -1] < self._shape[0]
        ):
            possible = (frequency > self._low[cube[0]]) & (frequency < self._high[cube[0]])
            quiet = possible.all(axis=(1, 2)) & ~pad_fault.any(axis=1)
        k = 0
        while k < len(cube):
            masks[k] = self.update(cube[k], frequency[k], pad_fault[k], int(stamp_ns[k]), temperature[k])
            bits[k] = self.status[cube[k]]
            end = k = k + 1
            low, high = (self._window_end or 0) - 2e9 * WINDOW_S, self._window_end or 0
            while end < len(cube) and quiet[end] and low <= stamp_ns[end] < high:
                end += 1
            if end > k:
                self._add_many(cube[k], frequency[k:end])
                self.temperature[cube[k]] = temperature[end - 1]
                self.newest_ns = int(stamp_ns[end - 1])
                masks[k:end] = self.mask[cube[k]] if self._any else 0
                bits[k:end] = self.status[cube[k]]
                k = end
        return masks, bits

    def residual(self, cube: np.ndarray, status: np.ndarray) -> None:
        """Take the status of reconstructed rows."""
        bad = status & RESIDUAL != 0
        if bad.any():
            np.add.at(self._bad_residual, cube[bad], 1)

    def collect(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What was found since the last call: bits (cubes, P), strained (cubes,), rows (cubes,); begins anew."""
        found = self._seen | self.state, self._strained_seen | self.strained, self.rows
        self._seen = np.zeros_like(self._seen)
        self._strained_seen = np.zeros_like(self._strained_seen)
        self.rows = np.zeros_like(self.rows)
        return found

    def window(self) -> Window:
        """The window that is not over yet."""
        count = np.maximum(self._count, 1)[:, None]
        with np.errstate(invalid="ignore"):
            mean = np.where(self._count[:, None] > 0, self._base + self._sum / count, np.nan)
        return Window(self._count, mean, self._lowest, self._highest, np.sqrt(self._bend / count / 6))

    def _add(self, cube: np.ndarray, frequency: np.ndarray) -> None:
        """Rows of different cubes, rising."""
        i = _index(cube, True)
        last = self.last[i]
        bend = frequency - last
        bend -= last
        bend += self._before[i]
        bend *= bend
        self._bend[i] += np.minimum(bend, self._jump[i])
        self._before[i] = last
        self.last[i] = frequency
        self._lowest[i] = np.fmin(self._lowest[i], frequency)
        self._highest[i] = np.fmax(self._highest[i], frequency)
        self._sum[i] += frequency - self._base[i]
        self._count[i] += 1
        self.rows[i] += 1

    def _add_many(self, cube: np.ndarray, frequency: np.ndarray) -> None:
        """`_add` of (B, N, P) of the same rising cubes; sums go batch by batch, so that their rounding is the same."""
        i = _index(cube, True)
        before = np.concatenate([self._before[i][None], self.last[i][None], frequency])
        last = before[1:-1]
        bend = frequency - last
        bend -= last
        bend += before[:-2]
        bend *= bend
        bend = np.minimum(bend, self._jump[i])
        self._bend[i] = np.add.reduce(np.concatenate([self._bend[i][None], bend]), axis=0)
        self._sum[i] = np.add.reduce(np.concatenate([self._sum[i][None], frequency - self._base[i]]), axis=0)
        self._lowest[i] = np.fmin(self._lowest[i], np.fmin.reduce(frequency, axis=0))
        self._highest[i] = np.fmax(self._highest[i], np.fmax.reduce(frequency, axis=0))
        self._before[i], self.last[i] = before[-2], before[-1]
        self._count[i] += len(frequency)
        self.rows[i] += len(frequency)

    def _mark_impossible(self, cube: np.ndarray, frequency: np.ndarray, possible: np.ndarray) -> None:
        bits = np.where(frequency >= self._open[cube], OPEN, RANGE)
        bits[~(frequency > 0)] = SHORT
        bits[possible | ~self._exists[cube]] = 0
        if bits.any():
            self._mark(cube, bits.astype(np.uint16))

    def _mark(self, cube: np.ndarray, bits: np.ndarray) -> None:
        np.bitwise_or.at(self._recent[0], cube, bits)
        self._publish()

    def _publish(self) -> None:
        self.state = np.bitwise_or.reduce(self._recent, axis=0)
        self._seen |= self.state
        self.mask = ((self.state & LEFT_OUT > 0) * self._one).sum(axis=1, dtype=np.uint32)
        self.status = np.bitwise_or.reduce(self.state, axis=1)
        self._any = bool(self.state.any())

    def _clear_window(self) -> None:
        self._bend = np.zeros(self._shape, np.float32)
        self._sum = self._bend.copy()
        self._lowest = np.full(self._shape, np.nan, np.float32)
        self._highest = self._lowest.copy()
        self._count = np.zeros(self._shape[0], int)
        self._bad_residual = np.zeros(self._shape[0], int)

    def _close_window(self) -> None:
        """Judge the statistics of the window that ended."""
        enough = self._count >= MIN_COUNT
        window = self.window()
        self.history.append(window)
        self.closed += 1
        noise, span, middle = window.noise, window.highest - window.lowest, window.mean
        found = np.zeros(self._shape, np.uint16)
        with np.errstate(invalid="ignore"):
            times = np.where(self.state & NOISY, NOISY_LEAVE, NOISY_ENTER)
            usual = np.fmax(self.noise, self._median(noise))
            found[noise > times * usual] |= NOISY
            self._jump = ((JUMP * usual) ** 2).astype(np.float32)
            moving = self._median(span / self.noise) > STUCK_MOVING
            # What comes and goes shows a single value now and then, which is not stuck.
            found[(span == 0) & moving & (self.state & (OPEN | SHORT | RANGE) == 0)] |= STUCK
            healthy = self.state & LEFT_OUT == 0
            # A step that falls between two windows shows in neither.
            jumped = np.abs(middle - self._middle) > STILL * self.noise
            unmoved = (span < STILL * self.noise) & ~jumped
            self.still = enough & (unmoved | ~healthy | ~self._exists).all(axis=1)
            self._middle = np.where(np.isnan(middle), self._middle, middle)
            self._reference[~self.still & (self._count > 0)] = np.nan
            fresh = self.still[:, None] & np.isnan(self._reference)
            self._reference[fresh] = middle[fresh]
            wander = (middle - self._reference) / self._rest
            found[np.abs(wander - self._median(wander)) > np.maximum(DRIFT_LIMIT, STILL * self.noise / self._rest)] |= (
                DRIFT
            )
            share = self._bad_residual / np.maximum(self._count, 1)
            limit = np.where(self.strained, RESIDUAL_LEAVE, RESIDUAL_ENTER)
        self.strained = np.where(self._count > 0, share > limit, self.strained)
        self._strained_seen |= self.strained
        self._recent[0] |= found * (enough[:, None] & self._exists)
        self._publish()
        # Cubes of which nothing came keep what was found: silence is no recovery.
        silent = self._count == 0
        kept = self._recent[:, silent]
        self._recent = np.roll(self._recent, 1, axis=0)
        self._recent[0] = 0
        self._recent[:, silent] = kept
        self._clear_window()

    def _median(self, values: np.ndarray) -> np.ndarray:
        """(cubes, 1): the lower median over each cube's pads that have a value."""
        ordered = np.sort(values, axis=1)  # NaN last
        known = self._shape[1] - np.isnan(ordered).sum(axis=1)
        return np.take_along_axis(ordered, np.maximum((known - 1) // 2, 0)[:, None], axis=1)


def _index(cube: np.ndarray, rising: bool) -> slice | np.ndarray:
    """Rows of neighbouring cubes as a slice, which numpy does not copy."""
    if rising and int(cube[-1]) - int(cube[0]) + 1 == len(cube):
        return slice(int(cube[0]), int(cube[-1]) + 1)
    return cube
