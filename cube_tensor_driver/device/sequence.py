"""Accounting of one hub's samples: which are new, which came twice or late, how many are missing
and why."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from enum import Enum

from .protocol import Sample, Stats

MEMORY = 64
"""Samples remembered; what arrives later than that after its turn belongs to a hub that
restarted."""
MAX_GAP = 1 << 20
"""A longer gap (17 minutes at 1 kHz) is a hub that restarted, not loss."""
RESTART_US = 1_000_000
"""A sample from before the first seen is late if its time is no further back than this, else of a
new run."""


class Verdict(str, Enum):
    """new: next in turn, or after a gap. late: out of order, had been counted missing. duplicate:
    do not deliver. reset: the hub restarted and this is the first sample of its new count."""

    NEW = "new"
    LATE = "late"
    DUPLICATE = "duplicate"
    RESET = "reset"


@dataclass(slots=True)
class SequenceCounters:
    """Samples. At any time taken by the hub since the first seen = delivered + missing; received =
    delivered + duplicate. `out_of_order` are among the delivered. Of what a restart lost, the
    samples since power-up are among the missing; those that the hub took last before it restarted
    nobody can know."""

    delivered: int = 0
    missing: int = 0
    duplicate: int = 0
    out_of_order: int = 0
    resets: int = 0

    def as_dict(self) -> dict[str, int]:
        return {name: getattr(self, name) for name in self.__slots__}


class SequenceTracker:
    """Follows the 32-bit sequence numbers of one hub. counters: `SequenceCounters`."""

    def __init__(self) -> None:
        self.counters = SequenceCounters()
        self._seen: deque[tuple[int, int]] = deque(maxlen=MEMORY)  # unwrapped sequence, device time
        self._first = self._next = 0  # unwrapped: they count on past 2**32
        self._newest_us = 0

    def update(self, sequence: int, device_us: int) -> Verdict:
        """Judge one SAMPLE by its sequence number (u32) and device time (µs), and count it.
        Constant time."""
        if (
            sequence == self._next % 0x1_0000_0000 and device_us >= self._newest_us
        ):  # as it mostly is
            self._next, self._newest_us = self._next + 1, device_us
            return self._deliver(self._next - 1, device_us, Verdict.NEW)
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
        if (number, device_us) in self._seen:
            self.counters.duplicate += 1
            return Verdict.DUPLICATE
        if not self._fits(number, device_us):
            return self._restart(sequence, device_us)
        self.counters.missing += self._first - number - 1 if number < self._first else -1
        self.counters.out_of_order += 1
        self._first = min(self._first, number)
        return self._deliver(number, device_us, Verdict.LATE)

    def book(self, taken: int) -> None:
        """The hub says how many samples it has taken (u32): what has not come by now is missing."""
        ahead = (taken - self._next + 0x8000_0000) % 0x1_0000_0000 - 0x8000_0000
        if self._seen and 0 < ahead <= MAX_GAP:
            self.counters.missing += ahead
            self._next += ahead

    @property
    def first(self) -> int:
        """Number of the first sample that is counted, delivered or missing, of the present run."""
        return self._first

    def _fits(self, number: int, device_us: int) -> bool:
        """Whether a sample from before the newest is of the same run: its time lies where its
        number does."""
        if any(other == number for other, _ in self._seen):
            return False
        if number < self._first:
            return 0 <= self._newest_us - device_us < RESTART_US
        return all(
            (us <= device_us) if other < number else (us >= device_us) for other, us in self._seen
        )

    def _restart(self, sequence: int, device_us: int) -> Verdict:
        self.counters.resets += 1
        self._seen.clear()
        verdict = self._begin(sequence, device_us, Verdict.RESET)
        if sequence <= MAX_GAP:
            # Numbers begin at 0 with power-up, so what came before this one is missing.
            self.counters.missing += sequence
            self._first = 0
        return verdict

    def _begin(self, sequence: int, device_us: int, verdict: Verdict) -> Verdict:
        self._first, self._next, self._newest_us = sequence, sequence + 1, device_us
        return self._deliver(sequence, device_us, verdict)

    def _deliver(self, number: int, device_us: int, verdict: Verdict) -> Verdict:
        self.counters.delivered += 1
        self._seen.append((number, device_us))
        return verdict


class Account:
    """The book of one link: every sample the hub took is delivered, dropped in the hub, or lost on
    the way.

    A hub with many cubes spreads a sample over several frames; each counts here, for itself, as a
    sample.
    """

    def __init__(self) -> None:
        self.received = 0
        self.stats_frame: Stats | None = None
        self._trackers: dict[int, SequenceTracker] = {}  # by first_cube
        self._dropped = 0
        self._dropped_before = 0

    def sample(self, frame: Sample) -> Verdict:
        """Judge and count one frame."""
        tracker = self._trackers.get(frame.first_cube)
        if tracker is None:
            tracker = self._trackers[frame.first_cube] = SequenceTracker()
        self.received += 1
        return tracker.update(frame.sequence, frame.device_us)

    def stats(self, frame: Stats) -> None:
        """Compare with the hub's own book."""
        last, self.stats_frame = self.stats_frame, frame
        if last is None and all(tracker.first for tracker in self._trackers.values()):
            self._dropped_before = (
                frame.dropped
            )  # we joined late: what was dropped before is not ours to count
        elif last is not None and frame.uptime_ms < last.uptime_ms:
            self._dropped_before = 0  # it restarted, perhaps before any sample of the new run came
            return
        self._dropped += (
            (frame.dropped - self._dropped_before) % 0x1_0000_0000 * len(self._trackers)
        )
        self._dropped_before = frame.dropped
        for tracker in self._trackers.values():
            tracker.book(frame.taken)

    @property
    def resets(self) -> int:
        return sum(tracker.counters.resets for tracker in self._trackers.values())

    def counters(self) -> dict[str, int]:
        """taken = delivered + dropped_in_hub + lost_on_the_way; received = delivered +
        duplicate."""
        parts = [tracker.counters for tracker in list(self._trackers.values())]
        total = {
            name: sum(getattr(part, name) for part in parts)
            for name in SequenceCounters().as_dict()
        }
        missing = total.pop("missing")
        # Until the next STATS a drop looks like loss, never the other way round.
        dropped = min(self._dropped, missing)
        book = {
            "taken": total["delivered"] + missing,
            "dropped_in_hub": dropped,
            "lost_on_the_way": missing - dropped,
        }
        return {**book, **total}

    def contradictions(self) -> list[str]:
        """What does not add up, in words. Right after `stats` there must be nothing."""
        counters = self.counters()
        found = []
        if self.received != counters["delivered"] + counters["duplicate"]:
            found.append(
                f"{self.received} samples received, {counters['delivered']} delivered and {counters['duplicate']} "
                "duplicate: the driver lost count, please report it"
            )
        return found
