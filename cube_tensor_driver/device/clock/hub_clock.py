# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Conversion of one hub's device times to host times (stamps).

Host time is a straight line over device time (`line.py`). Both are counted from the first sample,
because a float would round absolute times to 256 ns.

A hub takes one sample in each period and numbers the samples. If a device time does not agree with
number and period, the hub's clock was set or the hub sampled late; the delays of the next samples
show which. After a step of the clock, the origin of device times is moved by the step, so that the
line stays valid. While a clock stands still or keeps stepping, arrival times are used as stamps.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence

from ...core.rows import COUNTER_RANGE
from ..track import MAX_DEVICE_US, NEVER, LinkTrack
from .line import MAX_DELAY_NS, MAX_RISE_NS, ClockLine

MAX_PAUSE_NS = 60_000_000_000
"""Longest pause between samples, in ns, after which the clock line (host time over device time) is
continued. If both clocks show a longer pause, a new line is begun, because the error of the drift,
up to 6 ms per minute, would look like a step."""
MIN_STEP_US = 4000.0
"""Smallest difference, in µs, at which a step of the hub's clock is suspected. The device time
between two samples is compared with the time that follows from their numbers and the sample period.
Steps of 5 ms shall be found; 1 ms is left for the jitter of the hub."""
PERIOD_SAMPLES = 64
"""Time constant, in samples, of the low-pass filter that estimates the sample period."""
DECISION_NS = 200_000_000
"""Longest time, in ns, for which delays are collected after a suspected step of the hub's clock, to
decide whether the clock was set or the hub sampled late."""
MIN_DECISION_READS = 8
"""Number of reads of the link after a suspected step before `DECISION_NS` applies. The delays of
fewer reads may all be long."""
UNLIKELY_DELAY = 16.0
"""Ratio of a suspected step of the hub's clock to the mean delay above which one delay suffices to
decide about the step. The delay is compared with half of the step, and hardly any delay is 8 times
the mean."""
MAX_STEPS = 3
"""Number of steps of a hub's clock within `STEPS_NS` from which on the clock is not used, and
arrival times are used as stamps."""
STEPS_NS = 10_000_000_000
"""Length, in ns, of the time window in which steps of a hub's clock are counted."""
MAX_BAD_ANSWERS = 3
"""Number of successive answers to TIME (request for the hub's device time) that contradict the
samples or earlier answers, at which a problem is reported and the earlier answers are forgotten."""
CLOCK_SET = "the hub's clock was set: stamps follow its new time"
"""Problem that is reported after a step of the hub's clock."""
CLOCK_STANDS_STILL = "the hub's clock stands still: rows are stamped by their arrival"
"""Problem that is reported while the device times do not advance."""
CLOCK_KEEPS_JUMPING = (
    f"the hub's clock jumped {MAX_STEPS} times within {STEPS_NS / 1e9:g} s: "
    "rows are stamped by their arrival"
)
"""Problem that is reported while the hub's clock steps too often to be used."""
BAD_ANSWERS = "the hub's answers to TIME contradict its samples: they are not used"
"""Problem that is reported after `MAX_BAD_ANSWERS` answers in a row that cannot be true."""


class HubClock:
    """Converts the device times of one hub to host times.

    Attributes:
        resets: Number of restarts of the hub plus number of detected steps of a clock.
        in_doubt: Whether the stamps of the last `update` may be wrong.
        problems: Texts of problems, which the caller reports and removes.
        track: Sample numbers and clock values of the hub, which the module in C changes, too.
        line: The straight line from device times to host times.
    """

    def __init__(self, track: LinkTrack | None = None) -> None:
        self.track = track or LinkTrack()
        self.track.last_arrival_ns = self.track.last_stamp_ns = NEVER
        self.resets = self._n_bad_answers = 0
        self.in_doubt = self._is_still = False
        self.problems: set[str] = set()
        self.line = ClockLine(self.track)
        self._step_us = 0  # suspected step of the hub's clock; 0 if none is
        self._steps_ns: deque[int] = deque(maxlen=MAX_STEPS)  # arrival times of the newest steps
        # Last stamp before the newest step of the hub's clock was confirmed. The step may have made
        # it too late. Stamps never decrease, so new ones are in doubt until they exceed it.
        self._doubtful_stamp = NEVER
        self._restart()

    @property
    def is_steady(self) -> bool:
        """Whether the module in C may convert the next device times: the stamps are not in doubt,
        the sample period is known, and the newest sample came in order."""
        track = self.track
        is_newest = 1000 * (track.newest_us - track.first_us) == track.newest_ns
        is_period_known = track.reference_us == track.newest_us and track.period_us > 0
        return is_newest and is_period_known and not self.in_doubt

    @property
    def offset_ns(self) -> int:
        """Host time minus device time at the newest sample, in ns; 0 before the first sample."""
        track = self.track
        if track.newest_ns == NEVER:
            return 0
        since_origins = track.bounded_offset + track.drift * track.newest_ns
        return track.first_ns - 1000 * track.first_us + round(since_origins)

    def reset(self) -> None:
        """Discard the clock line (host time over device time) and its points, because the hub
        restarted; keep the drift."""
        self._count_step()
        self._restart()

    def forget_period(self) -> None:
        """Measure the sample period anew, because the hub was given another one."""
        self.track.reference = -1
        self.track.period_us = 0.0

    def shift(self, step_ns: int) -> None:
        """Move all stored host times by the step, in ns, by which the host's clock was set."""
        self.track.first_ns += step_ns
        self.track.last_arrival_ns += step_ns
        self.track.last_stamp_ns += step_ns

    def add_answer(self, sent_ns: int, device_us: int, arrival_ns: int) -> None:
        """Bound the offset (host time minus device time) by a question to the hub and its answer.

        Before the first sample, and while stamps are in doubt, the answer is not used.

        Args:
            sent_ns: Host time at which the hub was asked.
            device_us: Device time in the answer, in µs.
            arrival_ns: Host time at which the answer arrived.
        """
        if self.track.newest_ns == NEVER or self.in_doubt or sent_ns > arrival_ns:
            return
        device_ns = 1000.0 * (device_us - self.track.first_us)
        sent = sent_ns - self.track.first_ns
        is_good = self.line.add_round_trip(
            device_ns,
            sent,
            arrival_ns - self.track.first_ns,
        )
        self._n_bad_answers = 0 if is_good else self._n_bad_answers + 1
        if self._n_bad_answers >= MAX_BAD_ANSWERS:
            self.problems.add(BAD_ANSWERS)
            self.line.forget_round_trips()

    def update(
        self,
        device_us: Sequence[int],
        arrival_ns: int,
        numbers: Sequence[int],
        is_late: bool = False,
    ) -> list[int]:
        """Fit the line to samples that arrived together, and convert their device times.

        Stamps never decrease with increasing device time, and no stamp is later than the arrival.

        Args:
            device_us: Device times of the samples, in µs.
            arrival_ns: Host time at which the samples arrived.
            numbers: Numbers of the samples.
            is_late: Whether this host is too slow and reads the samples late.

        Returns:
            Stamp (host time) of each sample, in ns.
        """
        self.in_doubt = False
        times = [min(time_us, MAX_DEVICE_US) for time_us in device_us]
        stamps: list[int] = []
        start = 0
        for k, number in enumerate(numbers):
            step_us = self._find_step(number, times[k])
            # While the hub's clock stands still, `_find_step` keeps an earlier reference sample.
            self._is_still = step_us != 0 and self.track.reference != number
            if step_us and not self._is_still:
                # Samples before the step are converted as if there were none.
                stamps += self._convert(times[start:k], arrival_ns, is_late)
                start = k
                # If an earlier step is undecided, one decision is made about the sum of the two.
                step_us += self._step_us
                self._step_us = step_us if abs(step_us) > MIN_STEP_US else 0
                self._min_height = math.inf
                self._since_ns = arrival_ns
                self._n_reads = 0
        return stamps + self._convert(times[start:], arrival_ns, is_late)

    def _restart(self) -> None:
        """Discard the clock line (host time over device time) and all samples; keep the drift and
        the last stamp."""
        self.track.newest_ns = NEVER
        self.forget_period()
        self.line.restart()
        self._step_us = 0

    def _count_step(self, *problems: str) -> None:
        self.problems.update(problems)
        self.resets += 1
        self._steps_ns.append(self.track.last_arrival_ns)

    def _find_step(self, number: int, device_us: int) -> int:
        """Compare a device time with that of an earlier sample (reference) and the sample period.

        The sample then becomes the reference, and the estimate of the sample period is updated.

        Args:
            number: Number of the sample.
            device_us: Device time of the sample, in µs.

        Returns:
            Deviation of the device time, in µs, if it may be a step of the hub's clock; else 0.
        """
        track = self.track
        interval = device_us - track.reference_us
        n_periods = (number - track.reference) % COUNTER_RANGE
        is_step = False
        if track.reference >= 0:
            if not 0 < n_periods < COUNTER_RANGE // 2:
                return 0  # The sample came out of order, or is another frame of the same sample.
            period = track.period_us
            error = interval - n_periods * period
            is_step = abs(error) > MIN_STEP_US and (period > 0.0 or interval < 0)
            if period <= 0.0:
                track.period_us = max(0.0, interval / n_periods)
            elif not is_step:
                # Without the limit, a clock that stands still would shorten the period.
                bound = period / PERIOD_SAMPLES
                track.period_us += min(max(error, -bound), bound) / PERIOD_SAMPLES
        # While the clock stands still, the reference is kept, so that the deviation grows.
        if interval or track.reference < 0:
            track.reference = number
            track.reference_us = device_us
        return round(error) if is_step else 0

    def _decide(self, height: float, arrival_ns: int) -> None:
        """Decide whether the clock was set or the hub sampled late, if the delays show it by now.

        Args:
            height: Delay of the newest sample beyond the smallest one, in ns, if the hub's clock
                was not set (`ClockLine.compute_height`).
            arrival_ns: Host time at which the sample arrived.
        """
        self._n_reads += 1
        self._min_height = min(self._min_height, height)
        step_ns = 1000 * self._step_us
        # With the smallest delay, the height is 0 if the hub sampled late, and -step_ns if its
        # clock was set. Longer delays raise it, so a height below the middle of these two values
        # proves the lower one.
        is_low = self._min_height < -step_ns / 2
        is_long = abs(step_ns) > UNLIKELY_DELAY * self.track.jitter_ns
        is_old = arrival_ns - self._since_ns >= DECISION_NS and self._n_reads >= MIN_DECISION_READS
        if not (is_low or is_long or is_old):
            return
        self._step_us = 0
        if is_low != (step_ns > 0):
            self.track.period_us = 0.0  # The hub sampled late, maybe with another period.
            return
        # `first_us`, from which device times are counted, moves with the clock, so that the clock
        # line (host time over device time) stays valid. After a step forward, the newest device
        # time includes the step, which is subtracted. After a step back, it may be from before the
        # step, so it is kept.
        self.track.first_us += step_ns // 1000
        self.track.newest_ns -= max(0, step_ns)
        self._doubtful_stamp = self.track.last_stamp_ns
        self._count_step(CLOCK_SET)

    def _learn(self, newest_us: int, arrival_ns: int, is_late: bool) -> bool:
        """Fit the clock line (host time over device time) to the newest of some samples, and return
        whether it can be used.

        Args:
            newest_us: Largest device time of the samples, in µs.
            arrival_ns: Host time at which the samples arrived.
            is_late: Whether this host is too slow and reads the samples late.
        """
        track = self.track
        pause_ns = arrival_ns - track.last_arrival_ns
        device_pause_ns = 1000 * (newest_us - track.first_us) - track.newest_ns
        track.last_arrival_ns = arrival_ns
        if pause_ns < 0:
            # The host's clock was set back without being noticed, or simulated time was restarted.
            track.last_stamp_ns = NEVER
            self.reset()
        elif min(pause_ns, device_pause_ns) > MAX_PAUSE_NS and track.newest_ns != NEVER:
            self._restart()
        if track.newest_ns == NEVER:
            track.first_us = newest_us
            track.first_ns = arrival_ns

        problem = CLOCK_STANDS_STILL if self._is_still else ""
        if len(self._steps_ns) == MAX_STEPS and 0 <= arrival_ns - self._steps_ns[0] < STEPS_NS:
            problem = CLOCK_KEEPS_JUMPING
        if problem:
            self.problems.add(problem)
            self._step_us = 0
        arrival = arrival_ns - track.first_ns
        if self._step_us:
            self._decide(
                self.line.compute_height(1000 * (newest_us - track.first_us), arrival),
                arrival_ns,
            )
        # While the hub's clock stands still, or a step is undecided, delays are unknown.
        if not self._is_still and not self._step_us:
            device_ns = 1000 * (newest_us - track.first_us)
            if self.line.add(device_ns, arrival, is_late):
                self._count_step(CLOCK_SET)
        self.in_doubt |= bool(problem or self._step_us)
        return not problem

    def _convert(
        self,
        times: Sequence[int],
        arrival_ns: int,
        is_late: bool,
    ) -> list[int]:
        """Fit the line to samples without a step between them, and return their stamps.

        Args:
            times: Device times of samples that arrived together, in µs.
            arrival_ns: Host time at which they arrived.
            is_late: Whether this host is too slow and reads the samples late.
        """
        if not times:
            return []
        track = self.track
        # Of the samples that arrive together, only the newest can have the smallest delay.
        is_usable = self._learn(max(times), arrival_ns, is_late)
        stamps = []
        for time_us in times:
            device_ns = 1000 * (time_us - track.first_us)
            offset = round(track.bounded_offset + track.drift * device_ns)
            stamp = track.first_ns + device_ns + offset
            if not is_usable or not 0 <= arrival_ns - stamp <= MAX_DELAY_NS:
                stamp = arrival_ns
            if device_ns <= track.newest_ns and is_usable:
                # A sample that came out of order must not get a later stamp than the newest one.
                stamp = min(stamp, track.last_stamp_ns)
            else:
                # Stamps must not decrease, so a stamp is too late if an earlier one was.
                is_raised_much = track.last_stamp_ns - stamp > MAX_RISE_NS
                is_raised = stamp < min(self._doubtful_stamp, track.last_stamp_ns)
                self.in_doubt |= is_raised or is_raised_much
                track.newest_ns = max(device_ns, track.newest_ns)
                track.last_stamp_ns = stamp = max(stamp, track.last_stamp_ns)
            stamps.append(stamp)
        return stamps
