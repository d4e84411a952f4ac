"""Accounts of one link's samples: which are new, which came twice or late, how many are missing and
where they were lost."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

from ..wire.protocol import Sample, Stats

MEMORY = 64
"""How many samples are remembered. A sample that comes later than so many others is taken for the
first of a hub that restarted."""
MAX_GAP = 1 << 20
"""A longer gap (17 minutes at 1 kHz) means that the hub restarted, not that samples were lost."""
RESTART_US = 1_000_000
"""A sample with a number below the first one seen is late if its device time is at most so far
away; otherwise it belongs to a new run of the hub."""
_WRAP = 0x1_0000_0000


class Arrival(str, Enum):
    """What a sample is, by its number.

    new: the next one, or the first after a gap. late: out of order, and counted as missing until
    now. duplicate: it has come before; do not deliver it. reset: the hub restarted, and this is the
    first sample of its new count. set_back: the next one, but its device time went back.
    """

    NEW = "new"
    LATE = "late"
    DUPLICATE = "duplicate"
    RESET = "reset"
    SET_BACK = "set_back"


@dataclass(slots=True)
class SequenceCounters:
    """Numbers of samples.

    Samples taken by the hub since the first one seen = delivered + missing.
    Samples received = delivered + duplicate. Those out of order are among the delivered.
    After a restart, the samples since power-up that did not come count as missing; the last samples
    before the restart are unknown and not counted.
    """

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
        # Numbers are unwrapped: they count on past 2**32.
        self._seen: deque[tuple[int, int]] = deque(maxlen=MEMORY)  # number, device time
        self._first = 0
        self._next = 0
        self._newest_us = 0
        self._set_back = 0  # number of the first sample after the clock was last set back

    def update(self, sequence: int, device_us: int) -> Arrival:
        """Classify and count one sample by its sequence number (u32) and device time (µs).

        Constant time.
        """
        # The next number is the common case, and it is quick.
        if sequence == self._next % _WRAP and device_us >= self._newest_us:
            self._seen.append((self._next, device_us))
            self._next += 1
            self._newest_us = device_us
            self.counters.delivered += 1
            return Arrival.NEW
        if not self._seen:
            return self._begin(sequence, device_us, Arrival.NEW)
        ahead = self._ahead(sequence)
        number = self._next + ahead
        if 0 <= ahead <= MAX_GAP:
            self.counters.missing += ahead
            arrival = Arrival.NEW
            if device_us < self._newest_us:
                arrival, self._set_back = Arrival.SET_BACK, number
                self.counters.resets += 1
            self._next = number + 1
            self._newest_us = device_us
            return self._deliver(number, device_us, arrival)
        if ahead < -MEMORY or ahead > MAX_GAP:
            return self._restart(sequence, device_us)
        if (number, device_us) in self._seen:
            self.counters.duplicate += 1
            return Arrival.DUPLICATE
        if not self._fits(number, device_us):
            return self._restart(sequence, device_us)
        if number < self._first:
            self.counters.missing += self._first - number - 1
            self._first = number
        else:
            self.counters.missing -= 1
        self.counters.out_of_order += 1
        return self._deliver(number, device_us, Arrival.LATE)

    def count_missing(self, taken: int) -> None:
        """The hub has taken so many samples (u32): those that have not come by now are missing."""
        ahead = self._ahead(taken)
        if self._seen and 0 < ahead <= MAX_GAP:
            self.counters.missing += ahead
            self._next += ahead

    @property
    def first(self) -> int:
        """Number of the first sample of the present run that is counted, delivered or missing."""
        return self._first

    def _ahead(self, sequence: int) -> int:
        """How far a u32 lies ahead of the next number; negative: behind it."""
        half = _WRAP // 2
        return (sequence - self._next + half) % _WRAP - half

    def _fits(self, number: int, device_us: int) -> bool:
        """Whether a sample from before the newest belongs to the same run.

        It does if its device time lies between those of its neighbours; where the clock was set
        back, between those before or between those after that.
        """
        if any(other == number for other, _ in self._seen):
            return False
        if number < self._first:
            return abs(self._newest_us - device_us) < RESTART_US
        before = [entry for entry in self._seen if entry[0] < self._set_back]
        after = [entry for entry in self._seen if entry[0] >= self._set_back]
        if number >= self._set_back:
            return _is_in_order(number, device_us, after)
        if number < max(before)[0]:
            return _is_in_order(number, device_us, before)
        return any(_is_in_order(number, device_us, entries) for entries in (before, after))

    def _restart(self, sequence: int, device_us: int) -> Arrival:
        self.counters.resets += 1
        self._seen.clear()
        arrival = self._begin(sequence, device_us, Arrival.RESET)
        if sequence <= MAX_GAP:
            # Numbers begin at 0 with power-up, so all before this one are missing.
            self.counters.missing += sequence
            self._first = self._set_back = 0
        return arrival

    def _begin(self, sequence: int, device_us: int, arrival: Arrival) -> Arrival:
        self._first = self._set_back = sequence
        self._next = sequence + 1
        self._newest_us = device_us
        return self._deliver(sequence, device_us, arrival)

    def _deliver(self, number: int, device_us: int, arrival: Arrival) -> Arrival:
        self.counters.delivered += 1
        self._seen.append((number, device_us))
        return arrival


def _is_in_order(number: int, device_us: int, seen: Sequence[tuple[int, int]]) -> bool:
    """Whether the device times grow with the numbers."""
    return all((us <= device_us) if other < number else (us >= device_us) for other, us in seen)


class Account:
    """The account of one link: each sample that the hub took was delivered, dropped in the hub, or
    lost on the way.

    A hub with many cubes spreads a sample over several frames. Each frame counts as one sample.
    """

    def __init__(self) -> None:
        self.received = 0
        self.stats_frame: Stats | None = None
        self._trackers: dict[int, SequenceTracker] = {}  # by first_cube
        self._dropped = 0
        self._dropped_before = 0

    def sample(self, frame: Sample) -> Arrival:
        """Classify and count one frame."""
        tracker = self._trackers.get(frame.first_cube)
        if tracker is None:
            tracker = self._trackers[frame.first_cube] = SequenceTracker()
        self.received += 1
        return tracker.update(frame.sequence, frame.device_us)

    def stats(self, frame: Stats) -> None:
        """Compare with the hub's own count."""
        last, self.stats_frame = self.stats_frame, frame
        joined_late = all(tracker.first for tracker in self._trackers.values())
        if last is None and joined_late:
            # What the hub dropped before our first sample is not ours to count.
            self._dropped_before = frame.dropped
        elif last is not None and frame.uptime_ms < last.uptime_ms:
            # The hub restarted, perhaps before any sample of the new run came.
            self._dropped_before = 0
            return
        dropped = (frame.dropped - self._dropped_before) % _WRAP
        self._dropped += dropped * len(self._trackers)
        self._dropped_before = frame.dropped
        for tracker in self._trackers.values():
            tracker.count_missing(frame.taken)

    @property
    def resets(self) -> int:
        return sum(tracker.counters.resets for tracker in self._trackers.values())

    def counters(self) -> dict[str, int]:
        """taken = delivered + dropped_in_hub + lost_on_the_way; received = delivered +
        duplicate."""
        # A copy, because another thread may add a tracker.
        parts = [tracker.counters for tracker in list(self._trackers.values())]
        total = {
            name: sum(getattr(part, name) for part in parts)
            for name in SequenceCounters().as_dict()
        }
        missing = total.pop("missing")
        # Until the next STATS, a sample dropped in the hub counts as lost on the way; never the
        # other way round.
        dropped = min(self._dropped, missing)
        return {
            "taken": total["delivered"] + missing,
            "dropped_in_hub": dropped,
            "lost_on_the_way": missing - dropped,
            **total,
        }

    def contradictions(self) -> list[str]:
        """What does not add up, in words. Empty unless this program lost count."""
        counters = self.counters()
        delivered, duplicate = counters["delivered"], counters["duplicate"]
        if self.received == delivered + duplicate:
            return []
        return [
            f"{self.received} samples received, {delivered} delivered and {duplicate} duplicate: "
            "the driver lost count, please report it"
        ]
