"""The usual samples of a link, in C: each is the next one, comes when it is due, and is no earlier
than the line of its hub's clock allows.

They change counts and running values alone, which the account and the clock of the link lend for
that. Everything else is decided there, in Python: what is not usual, one sample in 64, and the
first of each second. Where the wire was not compiled that is every sample.
"""

from __future__ import annotations

from collections.abc import Sequence

from ..clock.clock import ClockMap, LentLine
from ..clock.step import LentSteps
from ..wire.native import wire
from ..wire.protocol import Sample
from .sequence import Account


class Follower:
    """Follows the samples of one link in the place of its account and its clock."""

    def __init__(self, account: Account, clock: ClockMap) -> None:
        self._account, self._clock = account, clock
        self._wire = None if wire is None else wire.Follower()

    def follow(self, samples: Sequence[Sample], arrival_ns: int) -> list[int] | None:
        """Stamps of samples that arrived together, ns; None: nothing has changed, and they are for
        the account and the clock."""
        if self._wire is None:
            return None
        return self._wire.follow([sample.raw for sample in samples], arrival_ns)

    def lend(self) -> None:
        """Follow the samples that come now, if nothing about the last one is in doubt."""
        if self._wire is None:
            return
        last, lent = self._account.lend(), self._clock.lend()
        if lent is None:
            return
        steps, line = lent
        if last == (steps.sequence, steps.device_us):
            self._wire.lend(*steps, *line)

    def take_back(self) -> None:
        """Account and clock become as if they had seen all samples."""
        back = None if self._wire is None else self._wire.take_back()
        if back is None:
            return
        times_us, steps, line = back
        if times_us:
            self._account.take_back(times_us)
            self._clock.take_back(LentSteps(*steps), LentLine(*line))
