"""Accounting of one hub's samples: which are new, which came twice or late, how many are missing."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import asdict, dataclass
from enum import Enum

MEMORY = 64
"""Samples remembered; what arrives later than that after its turn belongs to a hub that restarted."""
MAX_GAP = 1 << 20
"""A longer gap (17 minutes at 1 kHz) is a hub that restarted, not loss."""
RESTART_US = 1_000_000
"""A sample from before the first seen is late if its time is no further back than this, else of a new run."""


class Verdict(str, Enum):
    """new: next in turn, or after a gap. late: out of order, had been counted missing. duplicate: do not
    deliver. reset: the hub restarted and this is the first sample of its new count."""

    NEW = "new"
    LATE = "late"
    DUPLICATE = "duplicate"
    RESET = "reset"


@dataclass(slots=True)
class SequenceCounters:
    """Samples. At any time taken by the hub since the first seen = delivered + missing; received = delivered
    + duplicate. `out_of_order` are among the delivered; what a restart lost cannot be known."""

    delivered: int = 0
    missing: int = 0
    duplicate: int = 0
    out_of_order: int = 0
    resets: int = 0

    def as_dict(self) -> dict[str, int]:
        return asdict(self)


class SequenceTracker:
    """Follows the 32-bit sequence numbers of one hub. counters: `SequenceCounters`."""

    def __init__(self) -> None:
        self.counters = SequenceCounters()
        self._seen: OrderedDict[int, int] = OrderedDict()  # unwrapped sequence -> device time, the last MEMORY
        self._first = self._next = 0  # unwrapped: they count on past 2**32
        self._newest_us = 0

    def update(self, sequence: int, device_us: int) -> Verdict:
        """Judge one SAMPLE by its sequence number (u32) and device time (µs), and count it. Constant time."""
        if not self._seen:
            return self._begin(sequence, device_us, Verdict.NEW)
        ahead = (sequence - self._next + 0x8000_0000) % 0x1_0000_0000 - 0x8000_0000
        number = self._next + ahead
        if 0 <= ahead <= MAX_GAP:
            self.counters.missing += ahead
            # The count goes on but the clock went back: whoever maps the clock must begin anew.
            verdict = Verdict.NEW if device_us >= self._newest_us else Verdict.RESET
            self.counters.resets += verdict is Verdict.RESET
            self._next, self._newest_us = number + 1, device_us
            return self._deliver(number, device_us, verdict)
        if ahead < -MEMORY or ahead > MAX_GAP:
            return self._restart(sequence, device_us)
        if self._seen.get(number) == device_us:
            self.counters.duplicate += 1
            return Verdict.DUPLICATE
        if not self._fits(number, device_us):
            return self._restart(sequence, device_us)
        self.counters.missing += self._first - number - 1 if number < self._first else -1
        self.counters.out_of_order += 1
        self._first = min(self._first, number)
        return self._deliver(number, device_us, Verdict.LATE)

    def _fits(self, number: int, device_us: int) -> bool:
        """Whether a sample from before the newest is of the same run: its time lies where its number does."""
        if number in self._seen:
            return False
        if number < self._first:
            return 0 <= self._newest_us - device_us < RESTART_US
        return all((us <= device_us) if other < number else (us >= device_us) for other, us in self._seen.items())

    def _restart(self, sequence: int, device_us: int) -> Verdict:
        self.counters.resets += 1
        self._seen.clear()
        return self._begin(sequence, device_us, Verdict.RESET)

    def _begin(self, sequence: int, device_us: int, verdict: Verdict) -> Verdict:
        self._first, self._next, self._newest_us = sequence, sequence + 1, device_us
        return self._deliver(sequence, device_us, verdict)

    def _deliver(self, number: int, device_us: int, verdict: Verdict) -> Verdict:
        self.counters.delivered += 1
        self._seen[number] = device_us
        if len(self._seen) > MEMORY:
            self._seen.popitem(last=False)
        return verdict
