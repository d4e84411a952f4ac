"""Which rest frequencies are in force when: the calibrations', and those of each tare.

A tare of the torture is made while the load of the tared cubes stays, so the frequencies of that
instant are the rest frequencies that it must give. What is in force for a row depends on when its
tensor was sent, which DDS says.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from .expected import Expected
from .record import DOWN, Record

MARGIN_NS = 100_000_000
"""So long before a change was asked for, and after it was answered, either may be in force: that is
how long a message may take."""
RESTORE_NS = 2_000_000_000
"""After a restart, until the driver has said who the cubes are and their tare is restored."""
CHANGES = ("tare", "clear")


class RestEpochs:
    """untared: rest frequencies (cubes, P) of the calibrations."""

    def __init__(self, record: Record, expected: Expected, start_time_ns: int) -> None:
        calibrations = [cube.calibration for cube in record.skin.cubes]
        self._calibrated = np.array([calibration.rest_frequency for calibration in calibrations])
        # (from when on, rest frequencies), in order
        self._epochs: list[tuple[int, NDArray[np.float64]]] = [(0, self._calibrated)]
        self._unclear: list[tuple[int, int]] = []  # when either of two may be in force
        for deed in record.deeds:
            if deed.kind in DOWN:
                self._unclear.append((deed.begin_ns - MARGIN_NS, deed.end_ns + RESTORE_NS))
            if deed.kind in CHANGES and deed.done:
                self._unclear.append((deed.begin_ns - MARGIN_NS, deed.end_ns + MARGIN_NS))
                rest = self._epochs[-1][1].copy()
                if deed.kind == "tare":
                    cubes = list(deed.cubes)
                    rest[cubes] = expected.held(cubes, deed.begin_ns - start_time_ns)
                else:
                    rest = self._calibrated
                self._epochs.append((deed.end_ns, rest))

    def choices(
        self, sent_ns: NDArray[np.int64]
    ) -> Iterator[tuple[NDArray[np.float64], NDArray[np.bool_]]]:
        """Rest frequencies, and for which rows that were sent then (N,) they may be in force."""
        unclear = self._is_unclear(sent_ns)
        ends = [begin for begin, _ in self._epochs[1:]] + [np.iinfo(np.int64).max]
        for (begin, rest), end in zip(self._epochs, ends, strict=True):
            yield rest, unclear | ((sent_ns >= begin) & (sent_ns < end))

    def untared(self, cube: NDArray[np.integer], sent_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
        """(N,) rows for which the calibrations' rest frequencies are in force for sure."""
        applies = np.zeros(len(cube), bool)
        for rest, chosen in self.choices(sent_ns):
            same = (rest == self._calibrated).all(axis=1)
            applies |= chosen & same[cube]
        tared = {cube for _, rest in self._epochs for cube in _changed(rest, self._calibrated)}
        return applies & ~(self._is_unclear(sent_ns) & np.isin(cube, list(tared)))

    def _is_unclear(self, sent_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
        unclear = np.zeros(len(sent_ns), bool)
        for begin, end in self._unclear:
            unclear |= (sent_ns >= begin) & (sent_ns <= end)
        return unclear


def _changed(rest: NDArray[np.float64], calibrated: NDArray[np.float64]) -> list[int]:
    changed: list[int] = np.flatnonzero((rest != calibrated).any(axis=1)).tolist()
    return changed
