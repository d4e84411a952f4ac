# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Conversion of one hub's device times to host times.

Host time is a straight line over device time (`line.py`). Round trips (a question for the hub's
time and its answer) bound the error of the line, and it is restarted after a step of the hub's
clock, which `steps.py` finds. Device times of a clock that stands still or jumps again and again
cannot be converted; then the stamp (host time) of a row is its arrival time.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import replace

from ..track import MAX_DEVICE_US, NEVER, RESTART_US, LinkTrack
from .line import ClockLine, ClockRoundTrip
from .steps import MAX_DECISION_NS, StepDecision, find_step

MAX_DELAY_NS = 60_000_000_000
"""Longest credible delay, in ns, between the sampling of a sample and its arrival. If the estimated
time of sampling is further before the arrival, the arrival time is the stamp of the sample."""
MAX_PAUSE_NS = 60_000_000_000
"""Longest pause, in ns, between two reads of a hub's samples after which the clock line (host time
over device time) is still used. A pause is longer only if it is so by both the hub's and the host's
clock. Then the error of the drift, up to 6 ms per minute, would look like a step of the hub's
clock. So the line is begun anew, and only its drift is kept."""
MIN_STILL_NS = 200_000_000
"""Time, in ns, for which the device times (hub's clock) of samples must stay the same before the
hub's clock counts as standing still. `MIN_STILL_READS` must be reached, too."""
MIN_STILL_READS = 3
"""Number of successive reads with an unchanged device time (hub's clock) before this clock counts
as standing still. One is not enough, because two reads may give two frames of one sample."""
MAX_STEPS = 3
"""Number of steps of a hub's clock within `STEPS_NS` (10 s) from which on its times are not used.
Then the arrival times at the host are the stamps of the samples."""
STEPS_NS = 10_000_000_000
"""Length, in ns, of the time window in which the steps of a hub's clock are counted. Older steps do
not count, so that the clock is used again after some time without steps."""
MAX_BAD_ANSWERS = 3
"""Number of successive answers to the request TIME (for the hub's time) that must contradict the
device times of the hub's samples before the contradiction is reported as a problem."""
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
    """Converts the device times of one hub to host times (stamps).

    It needs bounded memory and constant time per sample.

    Attributes:
        resets: Number of restarts of the hub plus number of detected steps of a clock.
        in_doubt: Whether the stamps of the last `update` may be wrong, because the hub's clock may
            have been set or cannot be used.
        problems: Texts of problems, which the caller reports and removes.
        track: Sample numbers and clock values of the hub, which the module in C changes, too.
        line: The straight line from device times to host times.
    """

    # Times are stored relative to track.first_us (device) and track.first_ns (host), because a
    # float would round absolute times to 256 ns.

    def __init__(self, track: LinkTrack | None = None) -> None:
        self.track = track or LinkTrack()
        self.resets = 0
        self.in_doubt = False
        self.problems: set[str] = set()
        self.line = ClockLine(self.track)
        self._is_late = False  # whether the samples of the last update were read late
        self._last_us = -1  # newest device time, in µs, in the last read
        self._moved_ns = 0  # arrival time at which _last_us changed last
        self._n_still = 0  # number of reads since _last_us changed
        self._steps_ns: deque[int] = deque(maxlen=MAX_STEPS)
        self._n_bad_answers = 0
        self.track.last_arrival_ns = NEVER
        self.track.last_stamp_ns = NEVER
        # Last stamp that was given while a step of the hub's clock was only suspected, if the step
        # was confirmed later. The stamp was computed without the step and may be too late.
        self._doubtful_stamp = NEVER
        self._restart()

    @property
    def is_steady(self) -> bool:
        """Whether the hub's clock runs regularly, so that the module in C may convert its times.

        The sample period must be known up to the newest sample, and no step of the clock suspected.
        """
        track = self.track
        is_newest = 1000 * (track.newest_us - track.first_us) == track.newest_ns
        in_step = is_newest and track.reference_us == track.newest_us and track.period_us > 0
        is_suspected = self.in_doubt or self._decision is not None or self._n_still > 0
        return in_step and not is_suspected and len(self._steps_ns) < MAX_STEPS

    @property
    def offset_ns(self) -> int:
        """Host time minus hub's time at the newest sample, in ns; 0 before the first sample."""
        if self._is_fresh:
            return 0
        track = self.track
        between_origins = track.first_ns - 1000 * track.first_us
        since_origins = track.bounded_offset + track.drift * track.newest_ns
        return between_origins + round(since_origins)

    def reset(self) -> None:
        """Discard the line (host time over device time) and its samples, because the hub restarted.

        The drift is kept as a first guess. Later stamps are still not earlier than the last one.
        """
        self._count_reset()
        self._restart()

    def shift(self, step_ns: int) -> None:
        """Move all stored host times by the step by which the host's clock was set.

        Args:
            step_ns: New time minus old time of the host's clock, in ns.
        """
        self.track.first_ns += step_ns
        self._moved_ns += step_ns
        self._steps_ns = deque((at + step_ns for at in self._steps_ns), MAX_STEPS)
        if self.track.last_arrival_ns != NEVER:
            self.track.last_arrival_ns += step_ns
        if self.track.last_stamp_ns != NEVER:
            self.track.last_stamp_ns += step_ns
            self._doubtful_stamp += step_ns

    def add_answer(self, sent_ns: int, device_us: int, arrival_ns: int) -> None:
        """Bound the offset (host time minus device time) by one question and its answer.

        The host's clock must not have been set between the two. Without samples, or while stamps
        are in doubt, the answer is not used.

        Args:
            sent_ns: Host time at which the hub was asked for its time, in ns.
            device_us: Device time in the answer, in µs.
            arrival_ns: Host time at which the answer arrived, in ns.
        """
        if self._is_fresh or self.in_doubt or not sent_ns <= arrival_ns:
            return
        device_ns = 1000.0 * (device_us - self.track.first_us)
        since_first = -self.track.first_ns - device_ns
        trip = ClockRoundTrip(device_ns, sent_ns + since_first, arrival_ns + since_first)
        if self.line.add_round_trip(trip):
            self._n_bad_answers = 0
            return
        self._n_bad_answers += 1
        if self._n_bad_answers >= MAX_BAD_ANSWERS:
            self.problems.add(BAD_ANSWERS)

    def update(
        self,
        device_us: Sequence[int],
        arrival_ns: int,
        numbers: Sequence[int] = (),
        is_late: bool = False,
    ) -> list[int]:
        """Convert the device times of samples that arrived together to host times (stamps).

        The clock line (host time over device time) is first fitted to the samples. Stamps never
        decrease with increasing device time, unless the host's clock was set back, and no stamp is
        later than the arrival.

        Args:
            device_us: Device times of the samples, in µs.
            arrival_ns: Host time at which the samples arrived, in ns.
            numbers: Numbers of the samples. Without numbers, a step of the hub's clock is found
                later, and small steps back are not found.
            is_late: Whether this host reads the samples late, because it is too slow. Then their
                delays are not used to find steps of a clock.

        Returns:
            Stamp (host time) of each sample, in ns.
        """
        self.in_doubt = False
        self._is_late = is_late
        device_us = [min(time_us, MAX_DEVICE_US) for time_us in device_us]
        stamps: list[int] = []
        start = 0
        for k, number in enumerate(numbers):
            step_us = find_step(self.track, number, device_us[k])
            if not step_us:
                continue
            # Samples before a step of the hub's clock are converted by the line before the step.
            stamps += self._convert(device_us[start:k], arrival_ns)
            start = k
            if not self._is_fresh:
                self._begin_decision(step_us, arrival_ns)
        return stamps + self._convert(device_us[start:], arrival_ns)

    @property
    def _is_fresh(self) -> bool:
        """Whether no sample has come since the start or the last restart of the hub."""
        return self.track.newest_ns == NEVER

    def _restart(self) -> None:
        """Discard the clock line and all samples; keep the drift and the last stamp (host time)."""
        self.track.first_us = self.track.first_ns = 0
        self.track.newest_ns = NEVER
        self.track.reference = -1
        self.track.period_us = 0.0
        self.line.restart()
        self._decision: StepDecision | None = None

    def _count_reset(self) -> None:
        """Count a restart of the hub or a step of a clock.

        The time of the event is kept, to find a clock that is set again and again.
        """
        self.resets += 1
        self._steps_ns.append(self.track.last_arrival_ns)

    def _convert(self, times: Sequence[int], arrival_ns: int) -> list[int]:
        """Fit the clock line to the newest of some samples, and convert the device times of all.

        The clock line states host time as a linear function of device time (the hub's clock).

        Args:
            times: Device times of samples that arrived together, in µs.
            arrival_ns: Host time at which they arrived, in ns.

        Returns:
            Stamp (host time) of each sample, in ns.
        """
        if not times:
            return []
        track = self.track
        # The clock line is determined by the smallest delays. Of samples that arrive together, only
        # the newest one can have the smallest delay.
        is_usable = self._learn(max(times), arrival_ns)
        offset = track.bounded_offset
        drift = track.drift
        stamps = []
        for time_us in times:
            device_ns = 1000 * (time_us - track.first_us)
            stamp = track.first_ns + device_ns + round(offset + drift * device_ns)
            if not is_usable or not 0 <= arrival_ns - stamp <= MAX_DELAY_NS:
                stamp = arrival_ns
            # Stamps must be in the order of the device times, so a sample that came out of order
            # must not get a later stamp than the newest one.
            if device_ns <= track.newest_ns and is_usable:
                stamp = min(stamp, track.last_stamp_ns)
            else:
                track.newest_ns = max(device_ns, track.newest_ns)
                if stamp < track.last_stamp_ns:
                    self.in_doubt |= stamp < self._doubtful_stamp
                    stamp = track.last_stamp_ns
                track.last_stamp_ns = stamp
            stamps.append(stamp)
        return stamps

    def _learn(self, newest_us: int, arrival_ns: int) -> bool:
        """Fit the clock line to a new sample, and look for steps of the hub's clock.

        The clock line states host time as a linear function of device time (the hub's clock).

        Args:
            newest_us: Device time of the sample, in µs; the newest one of those that arrived
                together.
            arrival_ns: Host time at which it arrived, in ns.

        Returns:
            Whether device times of this hub can be converted now.
        """
        track = self.track
        goes_back = arrival_ns < track.last_arrival_ns
        pause_ns = min(
            arrival_ns - track.last_arrival_ns,
            1000 * (newest_us - track.first_us) - track.newest_ns,
        )
        track.last_arrival_ns = arrival_ns
        if goes_back:
            # Host time went back without a reported step of the host's clock: the step was missed,
            # or a simulated time was restarted.
            track.last_stamp_ns = NEVER
            self.reset()
        elif pause_ns > MAX_PAUSE_NS and not self._is_fresh:
            self._restart()

        problem = self._find_problem(newest_us, arrival_ns)
        if problem:
            self.problems.add(problem)
            self._decision = None
        elif self._decision is not None and not self._n_still:
            self._decide(self._decision, newest_us, arrival_ns)

        device_ns = 1000 * (newest_us - track.first_us)
        if device_ns + 1000 * RESTART_US < track.newest_ns:
            self.reset()
        if track.newest_ns == NEVER:
            track.first_us = newest_us
            track.first_ns = arrival_ns
            device_ns = 0

        # The line is not fitted while a step of the hub's clock is undecided, because the delay of
        # a sample (arrival minus sampling) is unknown then.
        arrival = arrival_ns - track.first_ns
        if self._decision is None and self.line.add(device_ns, arrival, self._is_late):
            self.problems.add(CLOCK_SET)
            self._count_reset()
        if problem or self._decision is not None:
            self.in_doubt = True
        return not problem

    def _find_problem(self, device_us: int, arrival_ns: int) -> str:
        """Return the text of the problem for which device times cannot be converted; empty if none.

        Args:
            device_us: Device time of the newest sample, in µs.
            arrival_ns: Host time at which it arrived, in ns.
        """
        is_same = device_us == self._last_us
        self._n_still += is_same
        is_long = self._n_still >= MIN_STILL_READS
        stood_still = is_long and arrival_ns - self._moved_ns > MIN_STILL_NS
        if is_same and stood_still:
            return CLOCK_STANDS_STILL
        if not is_same:
            if stood_still:
                # The clock runs again, but it is unknown for how long it stood still.
                self.reset()
            self._last_us = device_us
            self._moved_ns = arrival_ns
            self._n_still = 0
        steps_ns = self._steps_ns
        if steps_ns and arrival_ns - steps_ns[0] > STEPS_NS:
            steps_ns.popleft()
        return CLOCK_KEEPS_JUMPING if len(steps_ns) == MAX_STEPS else ""

    def _begin_decision(self, step_us: int, arrival_ns: int) -> None:
        """Begin to decide whether the hub's clock was set, or the hub sampled late or early.

        If a decision about an earlier step is pending, the two steps are decided as one.

        Args:
            step_us: Device time of the sample minus the time expected from the sample period, in
                µs.
            arrival_ns: Host time at which the sample after the step arrived, in ns.
        """
        track = self.track
        if self._decision is None:
            self._decision = StepDecision(
                step_us,
                newest_ns=track.newest_ns,
                before_ns=track.last_arrival_ns - track.first_ns,
                since_ns=arrival_ns - track.first_ns,
                usual_delay_ns=self.line.recent_min_height,
            )
            return
        step_us += self._decision.step_us
        # If the two steps of the hub's clock cancel each other, there is nothing to decide.
        self._decision = replace(self._decision, step_us=step_us) if step_us else None

    def _decide(self, decision: StepDecision, newest_us: int, arrival_ns: int) -> None:
        """Decide whether the hub's clock was set or the hub sampled late, if that is possible now.

        Args:
            decision: The pending decision.
            newest_us: Device time of the newest sample, in µs.
            arrival_ns: Host time at which it arrived, in ns.
        """
        device_ns = 1000 * (newest_us - self.track.first_us)
        arrival = arrival_ns - self.track.first_ns
        if not self._is_late:
            delay = self.line.height(device_ns, arrival)
            was_set = decision.was_set(device_ns, delay, arrival, self.track.jitter_ns)
        else:
            # The delays of samples that this host reads too late do not show whether the hub's
            # clock was set. After the time limit the clock counts as not set; if it was set, the
            # check of later delays finds the step.
            is_in_time = arrival - decision.since_ns <= MAX_DECISION_NS
            was_set = None if is_in_time else False
        if was_set is None:
            return
        self._decision = None
        if not was_set:
            self.track.period_us = 0.0
            return
        # The origin of device times is moved by the step, so that times relative to it continue
        # without a step and the clock line stays valid.
        self.track.first_us += decision.step_us
        self.track.newest_ns = min(self.track.newest_ns, decision.newest_ns)
        self._doubtful_stamp = self.track.last_stamp_ns
        self.line.discard_round_trips_after(decision.before_ns)
        self.problems.add(CLOCK_SET)
        self._count_reset()
