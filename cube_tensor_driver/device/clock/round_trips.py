"""How far a hub's clock can be off, from questions and answers.

A hub reads its clock for the answer TIME after the question was sent and before the answer has
come, so each round trip puts a lower and an upper bound on the offset between the two clocks (F.
Cristian, "Probabilistic clock synchronization", Distributed Computing 3, 1989). All bounds hold at
once. The middle between the highest lower one and the lowest upper one is right if the line is as
slow in both directions, and never wrong by more than half their distance.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

KEPT = 64
"""Round trips that are kept: about a minute."""


class RoundTrip(NamedTuple):
    """device_ns: the hub's clock; low_ns, high_ns: host time minus that when the question was sent
    and when the answer came."""

    device_ns: float
    low_ns: float
    high_ns: float


class RoundTrips:
    """The newest round trips of one hub that agree, and what they say.

    offset_ns: host time minus (1 + drift) * device time; inf without round trips
    bound_ns: how far that can be off
    """

    def __init__(self) -> None:
        self.offset_ns, self.bound_ns = math.inf, 0.0
        self._kept: deque[RoundTrip] = deque(maxlen=KEPT)

    def __len__(self) -> int:
        return len(self._kept)

    @property
    def least_ns(self) -> float:
        """The shortest."""
        return min((one.high_ns - one.low_ns for one in self._kept), default=0.0)

    def add(self, one: RoundTrip) -> None:
        """Remember one; to be called in the order in which the answers came."""
        self._kept.append(one)

    def forget_since(self, host_ns: float) -> None:
        """Forget those whose answer came later."""
        while self._kept and self._kept[-1].device_ns + self._kept[-1].high_ns > host_ns:
            self._kept.pop()

    def find_offset(self, drift: float, uncertainty: float) -> None:
        """Find the offset for this drift, which may be off by `uncertainty`."""
        if not self._kept:
            self.offset_ns, self.bound_ns = math.inf, 0.0
            return
        newest = self._kept[-1].device_ns
        low, high = -math.inf, math.inf
        for one in reversed(self._kept):
            drifted = drift * one.device_ns
            slack = uncertainty * abs(newest - one.device_ns)
            next_low = max(low, one.low_ns - drifted - slack)
            next_high = min(high, one.high_ns - drifted + slack)
            if next_low > next_high:
                break  # a clock was set: those before tell nothing any more
            low, high = next_low, next_high
        self.offset_ns, self.bound_ns = (low + high) / 2, (high - low) / 2
