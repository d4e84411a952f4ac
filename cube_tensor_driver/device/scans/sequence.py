"""The account of one link's samples: which are new, late or duplicate, and where others were
lost."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

from ..wire.protocol import Sample, Stats

MAX_DISORDER = 64
"""Number of samples that are remembered. A sample that comes later than this many others is taken
for the first one of a hub that restarted."""
MAX_GAP = 1 << 20
"""Longest gap in the numbers (17 minutes at 1 kHz) that counts as lost samples. A longer one means
that the hub restarted."""
RESTART_US = 1_000_000
"""Largest difference of device time, in µs, between the newest sample and a late one with a number
below the first. If it is larger, the hub restarted."""
_WRAP = 1 << 32


class Arrival(str, Enum):
    """Class of a sample by its number.

    NEW: the next sample, or the first after a gap. LATE: a sample out of order, which was counted
        as
    missing until now. DUPLICATE: a sample that has come before and must not be delivered. RESET:
    the first sample of a hub that restarted. SET_BACK: the next sample, but its device time went
    back.
    """

    NEW = "new"
    LATE = "late"
    DUPLICATE = "duplicate"
    RESET = "reset"
    SET_BACK = "set_back"


@dataclass(slots=True)
class SequenceCounters:
    """Numbers of samples of one hub.

    Samples taken since the first one seen = delivered + missing. Samples received = delivered +
    duplicate. After a restart, the samples since power-up that did not come count as missing; the
    last samples before the restart are unknown and not counted.

    Attributes:
        delivered: Samples to deliver, including those out of order.
        missing: Samples that did not come.
        duplicate: Samples that had come before.
        out_of_order: Samples that came after a later one.
        resets: Restarts of the hub, and steps back of its clock.
    """

    delivered: int = 0
    missing: int = 0
    duplicate: int = 0
    out_of_order: int = 0
    resets: int = 0

    def as_dict(self) -> dict[str, int]:
        """Return the counters by name."""
        return {name: getattr(self, name) for name in self.__slots__}


class SequenceTracker:
    """Classifies and counts samples by their 32-bit numbers.

    Attributes:
        counters: Numbers of samples.
    """

    # Numbers are unwrapped here: they continue beyond 2**32.

    def __init__(self) -> None:
        self.counters = SequenceCounters()
        self._seen: deque[tuple[int, int]] = deque(maxlen=MAX_DISORDER)  # number, device time
        self._first = 0
        self._next = 0
        self._newest_us = 0
        self._set_back = 0  # number of the first sample after the clock was last set back

    def update(self, sequence: int, device_us: int) -> Arrival:
        """Classify and count one sample in constant time.

        Args:
            sequence: Number of the sample, u32.
            device_us: Device time of the sample, in µs.
        """
        # The next number is the usual case and is handled first, for speed.
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

        if ahead < -MAX_DISORDER or ahead > MAX_GAP:
            return self._restart(sequence, device_us)
        if (number, device_us) in self._seen:
            self.counters.duplicate += 1
            return Arrival.DUPLICATE
        if not self._fits_run(number, device_us):
            return self._restart(sequence, device_us)

        if number < self._first:
            # The account begins with an earlier sample than it did until now.
            self.counters.missing += self._first - number - 1
            self._first = number
        else:
            self.counters.missing -= 1
        self.counters.out_of_order += 1
        return self._deliver(number, device_us, Arrival.LATE)

    def count_missing(self, taken: int) -> None:
        """Count the samples that have not come by now as missing.

        Args:
            taken: Number of samples that the hub has taken, u32.
        """
        ahead = self._ahead(taken)
        if self._seen and 0 < ahead <= MAX_GAP:
            self.counters.missing += ahead
            self._next += ahead

    @property
    def first(self) -> int:
        """Number of the first sample since the restart that is counted."""
        return self._first

    def _ahead(self, sequence: int) -> int:
        """Return the distance of a number (u32) from the next one; negative if it is behind."""
        half = _WRAP // 2
        distance = (sequence - self._next) % _WRAP
        return distance if distance < half else distance - _WRAP

    def _fits_run(self, number: int, device_us: int) -> bool:
        """Return whether a late sample belongs to the current run of the hub.

        It does if its device time lies between those of its neighbours. Where the clock was set
        back, only the neighbours on the same side of the step count.
        """
        if any(other == number for other, _ in self._seen):
            return False
        if number < self._first:
            return abs(self._newest_us - device_us) < RESTART_US

        before = [entry for entry in self._seen if entry[0] < self._set_back]
        after = [entry for entry in self._seen if entry[0] >= self._set_back]
        fits_after = _is_in_order(number, device_us, after)
        if number >= self._set_back:
            return fits_after
        fits_before = _is_in_order(number, device_us, before)
        last_before, _ = max(before)
        if number < last_before:
            return fits_before
        # The sample lies between the last one before the step and the first one after it.
        return fits_before or fits_after

    def _restart(self, sequence: int, device_us: int) -> Arrival:
        """Begin again with a sample of a hub that restarted."""
        self.counters.resets += 1
        self._seen.clear()
        arrival = self._begin(sequence, device_us, Arrival.RESET)
        if sequence <= MAX_GAP:
            # Numbers begin at 0 with power-up, so all samples before this one are missing.
            self.counters.missing += sequence
            self._first = self._set_back = 0
        return arrival

    def _begin(self, sequence: int, device_us: int, arrival: Arrival) -> Arrival:
        """Begin a new count with this sample."""
        self._first = self._set_back = sequence
        self._next = sequence + 1
        self._newest_us = device_us
        return self._deliver(sequence, device_us, arrival)

    def _deliver(self, number: int, device_us: int, arrival: Arrival) -> Arrival:
        """Count and remember a sample that is to be delivered."""
        self.counters.delivered += 1
        self._seen.append((number, device_us))
        return arrival


def _is_in_order(number: int, device_us: int, seen: Sequence[tuple[int, int]]) -> bool:
    """Return whether a sample fits those seen: device times must grow with the numbers."""
    for other, other_us in seen:
        is_wrong = other_us > device_us if other < number else other_us < device_us
        if is_wrong:
            return False
    return True


class SampleAccount:
    """Account of the samples of one link.

    Each sample that the hub took was delivered, dropped in the hub, or lost on the way. A hub with
    many cubes spreads a sample over several frames, and each frame counts as one sample.

    Attributes:
        received: Number of frames received.
        stats_frame: Last STATS of the hub; None before the first.
    """

    def __init__(self) -> None:
        self.received = 0
        self.stats_frame: Stats | None = None
        self._trackers: dict[int, SequenceTracker] = {}  # by first_cube
        self._dropped = 0
        self._dropped_before = 0

    def sample(self, frame: Sample) -> Arrival:
        """Classify and count one SAMPLE."""
        tracker = self._trackers.get(frame.first_cube)
        if tracker is None:
            tracker = self._trackers[frame.first_cube] = SequenceTracker()
        self.received += 1
        return tracker.update(frame.sequence, frame.device_us)

    def stats(self, frame: Stats) -> None:
        """Compare the account with the counters of the hub."""
        last, self.stats_frame = self.stats_frame, frame
        joined_late = all(tracker.first for tracker in self._trackers.values())
        if last is None and joined_late:
            # Samples that the hub dropped before the first one received are not part of the
            # account.
            self._dropped_before = frame.dropped
        elif last is not None and frame.uptime_ms < last.uptime_ms:
            # The hub restarted, perhaps before a sample after the restart has come.
            self._dropped_before = 0
            return
        dropped = (frame.dropped - self._dropped_before) % _WRAP
        self._dropped += dropped * len(self._trackers)
        self._dropped_before = frame.dropped
        for tracker in self._trackers.values():
            tracker.count_missing(frame.taken)

    @property
    def resets(self) -> int:
        """Number of restarts of the hub and steps back of its clock."""
        return sum(tracker.counters.resets for tracker in self._trackers.values())

    def counters(self) -> dict[str, int]:
        """Return the numbers of samples by name.

        taken = delivered + dropped_in_hub + lost_on_the_way; received = delivered + duplicate.
        """
        # The copy is necessary because another thread may add a tracker.
        parts = [tracker.counters for tracker in list(self._trackers.values())]
        total = SequenceCounters().as_dict()
        for part in parts:
            for name, value in part.as_dict().items():
                total[name] += value
        missing = total.pop("missing")
        # A sample dropped in the hub counts as lost on the way until the next STATS, but no sample
        # lost on the way ever counts as dropped.
        dropped = min(self._dropped, missing)
        return {
            "taken": total["delivered"] + missing,
            "dropped_in_hub": dropped,
            "lost_on_the_way": missing - dropped,
            **total,
        }

    def contradictions(self) -> list[str]:
        """Return errors of the account in words; empty unless the driver lost count."""
        counters = self.counters()
        delivered, duplicate = counters["delivered"], counters["duplicate"]
        if self.received == delivered + duplicate:
            return []
        return [
            f"{self.received} samples received, {delivered} delivered and {duplicate} duplicate: "
            "the driver lost count, please report it",
        ]
