# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Counting of one link's samples by their numbers: new, late, duplicate and missing ones."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from enum import Enum

from ...core.rows import COUNTER_RANGE
from ..track import MAX_DEVICE_US, MAX_DISORDER, NEVER, RESTART_US, LinkTrack
from ..wire.protocol import Sample, Stats

MAX_GAP = 1 << 20
"""Largest gap in the numbers of successive samples of a hub (17 minutes at 1 kHz) that counts as
lost samples whatever the device times (hub's clock) are. A larger gap counts only if the device
time has advanced by at least `MIN_PERIOD_US` for each number; otherwise the hub has restarted."""
MIN_PERIOD_US = 100
"""Shortest sample period of a hub, in µs, because the highest sample rate that can be requested is
10 kHz (`MAX_RATE` in live.py)."""
MAX_REPEAT_US = 60_000_000
"""Longest time, in µs of device time (the hub's clock), by which a repeated sample may be older
than the newest one. No line holds samples for longer, so an older sample shows that the hub has
restarted and its device time has begun again near zero."""
_MAX_CUBES = 1 << 16
"""Largest number of cubes of a hub, because the index of a cube on its hub has 16 bits."""


class Arrival(str, Enum):
    """Class of a sample by its number.

    Attributes:
        NEW: The next sample, or the first one after a gap in the numbers.
        LATE: A sample that comes after one with a larger number; it was counted as missing before.
        DUPLICATE: A sample that has come before and must not be delivered again, or one so old that
            this cannot be excluded.
        RESET: The first sample after a restart of the hub.
    """

    NEW = "new"
    LATE = "late"
    DUPLICATE = "duplicate"
    RESET = "reset"


@dataclass(slots=True)
class SequenceCounters:
    """Numbers of samples of one hub, by what happened to them.

    Since the first received sample, the hub has taken `delivered` + `missing` samples, and
    `delivered` + `duplicate` samples were received. If the hub restarts, its samples since power-up
    that did not come count as missing. Samples that were lost just before the restart cannot be
    counted.

    Attributes:
        delivered: Samples to deliver, including those out of order.
        missing: Samples that have not come, according to the gaps in the numbers.
        duplicate: Samples that had come before.
        out_of_order: Samples that came after one with a larger number.
        resets: Number of restarts of the hub plus number of times its clock was set back.
    """

    delivered: int = 0
    missing: int = 0
    duplicate: int = 0
    out_of_order: int = 0
    resets: int = 0

    def add(self, other: SequenceCounters) -> None:
        """Increase each of these counters by the one of the same name in `other`."""
        for name in self.__slots__:
            setattr(self, name, getattr(self, name) + getattr(other, name))


class SequenceTracker:
    """Classifies samples of one hub as new, late or duplicate by their numbers, and counts them.

    Attributes:
        counters: Numbers of delivered, missing and duplicate samples.
        n_cubes: Number of cubes in each frame whose samples are tracked. A hub with many cubes
            divides each sample into several frames, which have a tracker each.
        first: Number of the first counted sample since the start or the last restart of the hub.
    """

    # Numbers of samples are unwrapped in all attributes: they continue beyond 32 bits, where those
    # of the hub wrap to 0.

    def __init__(self, track: LinkTrack | None = None) -> None:
        self.counters = SequenceCounters()
        self.n_cubes = -1
        self._track = track or LinkTrack()
        self._is_begun = False
        self.first = 0
        self._first_us = 0
        self._restart_at = -1  # number of the next sample at the last `expect_restart`

    def update(self, sequence: int, device_us: int) -> Arrival:
        """Classify one sample as new, late, duplicate or first after a restart, and count it.

        Args:
            sequence: Number of the sample, 32 bits, which wraps to 0.
            device_us: Device time (the hub's clock) of the sample, in µs.
        """
        track = self._track
        device_us = min(device_us, MAX_DEVICE_US)
        if not self._is_begun:
            return self._begin(sequence, device_us, Arrival.NEW)

        ahead = self._count_ahead(sequence)
        number = track.next + ahead
        if ahead >= 0:
            if ahead > MAX_GAP and device_us - track.newest_us < MIN_PERIOD_US * ahead:
                return self._restart(sequence, device_us)
            # If the next sample has an earlier device time, the hub's clock was set back.
            self.counters.resets += device_us < track.newest_us
            self.counters.missing += ahead
            track.next = number + 1
            track.newest_us = device_us
            return self._deliver(number, device_us, Arrival.NEW)

        # The sample has a smaller number than expected: it is late, repeated, or the first one
        # after a restart of the hub.
        if self._restart_at == track.next and device_us < track.newest_us:
            return self._restart(sequence, device_us)
        is_repeat = (number, device_us) in self._list_seen()
        if is_repeat or self._is_old_repeat(number, device_us):
            self.counters.duplicate += 1
            return Arrival.DUPLICATE
        if ahead < -MAX_DISORDER or not self._fits_run(number, device_us):
            return self._restart(sequence, device_us)

        if number < self.first:
            # A late sample that is older than the first counted one becomes the first, and the
            # samples between the two count as missing.
            self.counters.missing += self.first - number - 1
            self.first = number
            self._first_us = device_us
        else:
            self.counters.missing -= 1
        self.counters.out_of_order += 1
        return self._deliver(number, device_us, Arrival.LATE)

    def expect_restart(self) -> None:
        """Note that the hub may have restarted; see `SampleAccount.expect_restart`."""
        self._restart_at = self._track.next

    def count_missing(self, taken: int) -> None:
        """Count samples as missing that the hub has taken but that have not arrived.

        Args:
            taken: Number of samples that the hub reports to have taken since power-up, 32 bits,
                which wraps to 0.
        """
        ahead = self._count_ahead(taken)
        if self._is_begun and 0 < ahead <= MAX_GAP:
            self.counters.missing += ahead
            self._track.next += ahead

    def _count_ahead(self, sequence: int) -> int:
        """Return by how many samples a 32-bit number is ahead of the next expected number.

        The result is negative if the number is behind.
        """
        half = COUNTER_RANGE // 2
        distance = (sequence - self._track.next) % COUNTER_RANGE
        return distance if distance < half else distance - COUNTER_RANGE

    def _is_old_repeat(self, number: int, device_us: int) -> bool:
        """Return whether a sample is a repeated one that is older than the kept samples.

        By its number and time it must lie between the first sample since the last restart of the
        hub and the newest one; otherwise the hub has restarted.

        Args:
            number: Unwrapped number of the sample.
            device_us: Device time of the sample, in µs.
        """
        if not self.first <= number < self._track.next - MAX_DISORDER:
            return False
        age_us = self._track.newest_us - device_us
        return self._first_us <= device_us and 0 < age_us <= MAX_REPEAT_US

    def _fits_run(self, number: int, device_us: int) -> bool:
        """Return whether a late sample was taken since the last restart of the hub.

        This is so if its device time lies between those of the samples with the next smaller and
        the next larger number. If the hub's clock was set back between these two samples, it is
        enough that the device time is later than that of the first, or earlier than that of the
        second.

        Args:
            number: Unwrapped number of the sample.
            device_us: Device time of the sample, in µs.
        """
        if number < self.first:
            return abs(self._track.newest_us - device_us) < RESTART_US
        time_of = dict(self._list_seen())
        if number in time_of:
            return False
        # The time is not limited on a side without a sample.
        below_us = 0
        above_us = MAX_DEVICE_US
        smaller = [other for other in time_of if other < number]
        larger = [other for other in time_of if other > number]
        if smaller:
            below_us = time_of[max(smaller)]
        if larger:
            above_us = time_of[min(larger)]
        fits_below = below_us <= device_us
        fits_above = device_us <= above_us
        was_set_back = below_us > above_us
        return fits_below or fits_above if was_set_back else fits_below and fits_above

    def _restart(self, sequence: int, device_us: int) -> Arrival:
        """Begin to count the samples anew with the first one after a restart of the hub.

        Earlier samples since power-up count as missing, because numbers begin at 0 with power-up.
        If the number is above `MAX_GAP`, it is not credible that all of them were lost, and nothing
        counts as missing.

        Args:
            sequence: Number of the sample, 32 bits.
            device_us: Device time (the hub's clock) of the sample, in µs.
        """
        self.counters.resets += 1
        arrival = self._begin(sequence, device_us, Arrival.RESET)
        if sequence <= MAX_GAP:
            # Numbers begin at 0 with power-up, so all samples before this one have been lost.
            self.counters.missing += sequence
            self.first = 0
        return arrival

    def _begin(self, sequence: int, device_us: int, arrival: Arrival) -> Arrival:
        """Begin a new count with this sample: it becomes the first and the newest one.

        Args:
            sequence: Number of the sample.
            device_us: Device time of the sample, in µs.
            arrival: Class of the sample (new or reset), which is returned.
        """
        self._is_begun = True
        for entry in self._track.seen:
            entry[0] = NEVER
        self.first = sequence
        self._first_us = device_us
        self._track.next = sequence + 1
        self._track.newest_us = device_us
        return self._deliver(sequence, device_us, arrival)

    def _deliver(self, number: int, device_us: int, arrival: Arrival) -> Arrival:
        """Count a sample as delivered, and keep its number and time for later comparisons.

        Args:
            number: Number of the sample, continued beyond 32 bits.
            device_us: Device time (the hub's clock) of the sample, in µs.
            arrival: Class of the sample (new, late …), which is returned.
        """
        self.counters.delivered += 1
        self._track.seen[number % MAX_DISORDER][:] = number, device_us
        return arrival

    def _list_seen(self) -> list[tuple[int, int]]:
        """Return number and device time, in µs, of the newest `MAX_DISORDER` samples that came."""
        oldest = self._track.next - MAX_DISORDER
        return [(number, us) for number, us in self._track.seen if number >= oldest]


class SampleAccount:
    """Counters of the samples of one link.

    Each sample that the hub took was delivered, dropped in the hub, or lost on the way. A hub with
    many cubes spreads a sample over several frames, and each frame counts as one sample.

    Attributes:
        stats_frame: Last STATS frame (counters of the hub); None before the first.
    """

    def __init__(self, track: LinkTrack | None = None) -> None:
        self._track = track or LinkTrack()
        self._track.n_cubes = _MAX_CUBES  # until HELLO states the number
        self.stats_frame: Stats | None = None
        # Trackers by the first cube of the frame: a sample of many cubes comes in several frames.
        self._trackers: dict[int, SequenceTracker] = {}
        # Sums of the counters of frames that the hub no longer sends, after its cubes changed.
        self._ended = SequenceCounters()
        self._dropped = 0
        self._dropped_before = 0

    def classify(self, frame: Sample) -> Arrival:
        """Classify one SAMPLE frame by its number (new, late, duplicate …), and count it."""
        tracker = self._trackers.get(frame.first_cube)
        if tracker is None or tracker.n_cubes != frame.n_cubes:
            if frame.first_cube >= self._track.n_cubes:
                # HELLO has not reported such cubes, so their rows are left out (`CubeTable`).
                self._ended.delivered += 1
                return Arrival.NEW
            tracker = self._begin_part(frame)
        return tracker.update(frame.sequence, frame.device_us)

    def announce(self, n_cubes: int, n_pads: int) -> None:
        """Store the numbers of cubes and of pads per cube that the hub has reported by HELLO.

        Frames (parts of samples) whose first cube does not exist any more do not count as missing.

        Args:
            n_cubes: Number of cubes of the hub.
            n_pads: Number of pads of each cube.
        """
        self._track.n_cubes = n_cubes
        self._track.n_pads = n_pads
        self._end_parts(n_cubes, _MAX_CUBES)

    def expect_restart(self) -> None:
        """Note that the hub may have restarted, because it was started, silent or not connected.

        If the number and the device time (hub's clock) of the next sample are then smaller than
        those of the newest one, it is the first sample after a restart and no repeated one.
        """
        for tracker in self._trackers.values():
            tracker.expect_restart()

    def add_stats(self, frame: Stats) -> None:
        """Take over how many samples the hub has taken and dropped, from its STATS frame.

        Samples that the hub has taken but that have not arrived are then counted as missing.
        """
        last = self.stats_frame
        self.stats_frame = frame
        joined_late = all(tracker.first for tracker in self._trackers.values())
        if last is None and joined_late:
            # This driver connected while the hub was already sampling. Samples that the hub had
            # dropped before are not counted.
            self._dropped_before = frame.dropped
        elif last is not None and frame.uptime_ms < last.uptime_ms:
            # The hub has restarted. Its sample counter began again at 0 and must not be compared
            # with the last sample, which may be from before the restart.
            self._dropped_before = 0
            self.expect_restart()
            return
        dropped = (frame.dropped - self._dropped_before) % COUNTER_RANGE
        self._dropped += dropped * len(self._trackers)
        self._dropped_before = frame.dropped
        for tracker in self._trackers.values():
            tracker.count_missing(frame.taken)

    def _begin_part(self, frame: Sample) -> SequenceTracker:
        """Return the tracker for a frame whose first cube or number of cubes is new.

        A hub with many cubes divides each sample into several frames (parts). The counts of other
        parts, whose cubes are in this frame now, are ended, so that these parts do not count as
        missing.

        Args:
            frame: The SAMPLE frame.
        """
        first = frame.first_cube
        self._end_parts(first + 1, first + frame.n_cubes)
        if first not in self._trackers:
            # The module in C counts only samples that come whole in one frame, which begins with
            # cube 0. So only the tracker of such frames shares the state that the module changes.
            self._trackers[first] = SequenceTracker(None if first else self._track)
        tracker = self._trackers[first]
        tracker.n_cubes = frame.n_cubes
        return tracker

    def _end_parts(self, begin: int, end: int) -> None:
        """Stop counting the parts (frames) of samples whose first cube is in a range of indices.

        Args:
            begin: Smallest index of the first cube.
            end: Largest index of the first cube plus one.
        """
        for first in [first for first in self._trackers if begin <= first < end]:
            self._ended.add(self._trackers.pop(first).counters)

    @property
    def has_whole_samples(self) -> bool:
        """Whether each sample comes in one frame, which holds all cubes of the hub."""
        tracker = self._trackers.get(0)
        if tracker is None or len(self._trackers) > 1:
            return False
        return tracker.n_cubes == self._track.n_cubes

    @property
    def missing(self) -> int:
        """Number of samples that the hub has taken, by their numbers, but that have not come."""
        return self._sum_parts().missing

    def count_samples(self) -> dict[str, int]:
        """Return the numbers of samples by name.

        Two sums hold: taken = delivered + dropped_in_hub + lost_on_the_way, and received =
        delivered + duplicate.
        """
        total = asdict(self._sum_parts())
        missing = total.pop("missing")
        total["delivered"] += self._track.n_native
        # Missing samples count as lost on the way until a STATS frame reports that the hub has
        # dropped them.
        dropped = min(self._dropped, missing)
        return {
            "taken": total["delivered"] + missing,
            "dropped_in_hub": dropped,
            "lost_on_the_way": missing - dropped,
            **total,
        }

    def _sum_parts(self) -> SequenceCounters:
        """Return the sums of the counters of all parts (frames into which a sample is divided).

        Parts that the hub no longer sends are included; samples counted by the module in C are not.
        """
        total = replace(self._ended)
        for tracker in self._trackers.values():
            total.add(tracker.counters)
        return total
