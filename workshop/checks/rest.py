"""Which rest frequencies are in force when: the calibrations', and those of each tare.

A tare of the torture is made while the load of the tared cubes stays, so the frequencies of that
instant are the rest frequencies that it must give. On a busy host it may come so late that the load
did not stay all the while: then nobody knows what it gave, and tensors of these cubes are not
judged until the next change. What is in force for a row depends on when its tensor was sent, which
DDS says.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .expected import Expected
from .record import DOWN, Record

MARGIN_NS = 100_000_000
"""So long before a change was asked for, and after it was answered, either may be in force: that is
how long a message may take."""
RESTORE_NS = 2_000_000_000
"""After a restart, until the driver has said who the cubes are and their tare is restored."""
AVERAGED_NS = 2_500_000_000
"""A tare averages a second, in whole windows of half a second and the one that is not over, of data
that may be a second old."""
CHANGES = ("tare", "clear")


class _Epoch(NamedTuple):
    """begin_ns: from when on; rest: (cubes, P) Hz; known: (cubes,) bool, whether they are sure."""

    begin_ns: int
    rest: NDArray[np.float64]
    known: NDArray[np.bool_]

    def tared(self, cubes: list[int], held: NDArray[np.float64] | None) -> _Epoch:
        """After a tare of cubes that read `held` (len(cubes), P); None: nobody knows what."""
        rest, known = self.rest.copy(), self.known.copy()
        known[cubes] = held is not None
        if held is not None:
            rest[cubes] = held
        return self._replace(rest=rest, known=known)


class Choice(NamedTuple):
    """Rest frequencies that may be in force.

    rest: (cubes, P) Hz
    known: (cubes,) bool, False where nobody knows what a tare gave
    applies: (N,) bool, the rows that they may be in force for
    """

    rest: NDArray[np.float64]
    known: NDArray[np.bool_]
    applies: NDArray[np.bool_]


class RestEpochs:
    """untared: rest frequencies (cubes, P) of the calibrations."""

    def __init__(self, record: Record, expected: Expected, start_time_ns: int) -> None:
        calibrations = [cube.calibration for cube in record.skin.cubes]
        self._calibrated = np.array([calibration.rest_frequency for calibration in calibrations])
        untared = _Epoch(0, self._calibrated, np.ones(len(calibrations), bool))
        self._epochs = [untared]
        self._unclear: list[tuple[int, int]] = []  # when either of two may be in force
        for deed in record.deeds:
            if deed.kind in DOWN:
                self._unclear.append((deed.begin_ns - MARGIN_NS, deed.end_ns + RESTORE_NS))
            if deed.kind in CHANGES and deed.done:
                self._unclear.append((deed.begin_ns - MARGIN_NS, deed.end_ns + MARGIN_NS))
                epoch = untared
                if deed.kind == "tare":
                    cubes, begin_ns = list(deed.cubes), deed.begin_ns - AVERAGED_NS
                    held = expected.held(
                        cubes, begin_ns - start_time_ns, deed.end_ns - start_time_ns
                    )
                    epoch = self._epochs[-1].tared(cubes, held)
                self._epochs.append(epoch._replace(begin_ns=deed.end_ns))

    def choices(self, sent_ns: NDArray[np.int64]) -> Iterator[Choice]:
        """What may be in force for rows that were sent then (N,)."""
        unclear = self._is_unclear(sent_ns)
        ends = [epoch.begin_ns for epoch in self._epochs[1:]] + [np.iinfo(np.int64).max]
        for epoch, end_ns in zip(self._epochs, ends, strict=True):
            within = (sent_ns >= epoch.begin_ns) & (sent_ns < end_ns)
            yield Choice(epoch.rest, epoch.known, unclear | within)

    def untared(self, cube: NDArray[np.integer], sent_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
        """(N,) rows for which the calibrations' rest frequencies are in force for sure."""
        applies = np.zeros(len(cube), bool)
        ever_tared = np.zeros(len(self._calibrated), bool)
        for choice in self.choices(sent_ns):
            tared = ~choice.known | (choice.rest != self._calibrated).any(axis=1)
            applies |= choice.applies & ~tared[cube]
            ever_tared |= tared
        return applies & ~(self._is_unclear(sent_ns) & ever_tared[cube])

    def _is_unclear(self, sent_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
        unclear = np.zeros(len(sent_ns), bool)
        for begin, end in self._unclear:
            unclear |= (sent_ns >= begin) & (sent_ns <= end)
        return unclear
