"""Conversion of one hub's device times to host times.

One straight line (`line.py`) converts them, bounded by round trips and restarted after a step.
`steps.py` finds the steps. A hub's clock that stands still or jumps again and again cannot be
converted; then the stamp of a row is its arrival.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

from .line import ClockLine, ClockRoundTrip
from .steps import SampleTiming, StepDecision

MAX_DELAY_NS = 60_000_000_000
"""Longest credible delay, in ns, between sampling and arrival. If the estimated sampling time is
older, the estimate is discarded and the arrival is the stamp."""
RESTART_US = 1_000_000
"""Step back of the device time, in µs, that shows that the hub restarted. If the step is smaller,
the sample is out of order."""
MIN_STILL_NS = 200_000_000
"""Time, in ns, after which a device time that does not change shows that the hub's clock stands
still."""
MIN_STILL_READS = 3
"""Number of reads without a change of the device time after which the hub's clock stands still. Two
reads may give frames of the same sample."""
MAX_STEPS = 3
"""Number of steps of a hub's clock within `STEPS_NS` after which the clock is not used."""
STEPS_NS = 10_000_000_000
"""Time, in ns, in which the steps of a hub's clock are counted."""
MAX_BAD_ANSWERS = 3
"""Number of successive answers to TIME that contradict the samples, after which it is reported."""
CLOCK_SET = "the hub's clock was set: stamps follow its new time"
CLOCK_STANDS_STILL = "the hub's clock stands still: rows are stamped by their arrival"
CLOCK_KEEPS_JUMPING = (
    f"the hub's clock jumped {MAX_STEPS} times within {STEPS_NS / 1e9:g} s: "
    "rows are stamped by their arrival"
)
BAD_ANSWERS = "the hub's answers to TIME contradict its samples: they are not used"
_NEVER = -(2**80)  # Before every time: device times are 64 bits of µs, here in ns.


class HubClock:
    """Converts the device times of one hub, in bounded memory and constant time per sample.

    Attributes:
        resets: Number of times the line was restarted or the hub's clock was set.
        in_doubt: Whether the stamps of the last update may be wrong, because the hub's clock may
            have been set or cannot be used.
        problems: Texts to report.
    """

    # Device times count from _first_us and arrivals from _first_ns, in ns, because a float rounds
    # absolute times to 256 ns. When a clock was set, its origin moves by the step.

    def __init__(self) -> None:
        self.resets = 0
        self.in_doubt = False
        self.problems: set[str] = set()
        self._line = ClockLine()
        self._timing = SampleTiming()
        self._last_us = -1  # device time of the last read
        self._moved_ns = 0
        self._n_still = 0
        self._steps_ns: deque[int] = deque(maxlen=MAX_STEPS)
        self._n_bad_answers = 0
        self._last_arrival = _NEVER
        self._last_stamp = _NEVER
        self._doubtful_stamp = _NEVER  # the last stamp in doubt before the latest step
        self._restart()

    @property
    def drift_ppm(self) -> float:
        """Drift, positive if host time runs faster than the hub's; 0 until it is known."""
        return 1e6 * self._line.drift

    @property
    def jitter_ns(self) -> float:
        """Mean delay beyond the smallest delay, over about the last 64 reads."""
        return self._line.jitter_ns

    @property
    def offset_ns(self) -> int:
        """Host time minus device time at the newest sample; 0 before the first."""
        if self._is_fresh:
            return 0
        at_first = self._first_ns - 1000 * self._first_us
        return at_first + round(self._line.bounded_offset + self._line.drift * self._newest)

    @property
    def delay_ns(self) -> float:
        """Smallest delay of samples, from round trips; 0 without them."""
        return self._line.offset - self._line.bounded_offset

    @property
    def bound_ns(self) -> float | None:
        """Largest error of stamps that are not in doubt; None without round trips."""
        return self._line.error_bound

    def reset(self) -> None:
        """Restart the line, because the hub restarted.

        The drift is kept as a first guess, and stamps still do not go back.
        """
        self._count_reset()
        self._restart()

    def shift(self, step_ns: int) -> None:
        """Continue in the new time after the host's clock was set by `step_ns`."""
        self._first_ns += step_ns
        self._moved_ns += step_ns
        self._steps_ns = deque((at + step_ns for at in self._steps_ns), MAX_STEPS)
        if self._last_arrival != _NEVER:
            self._last_arrival += step_ns
        if self._last_stamp != _NEVER:
            self._last_stamp += step_ns
            self._doubtful_stamp += step_ns

    def add_answer(self, sent_ns: int, device_us: int, arrival_ns: int) -> None:
        """Bound the offset by a round trip during which the host's clock was not set.

        Args:
            sent_ns: Time at which the question was sent.
            device_us: Device time of the answer.
            arrival_ns: Arrival of the answer.
        """
        if self._is_fresh or self.in_doubt or not sent_ns <= arrival_ns:
            return
        device_ns = 1000.0 * (device_us - self._first_us)
        since_first = -self._first_ns - device_ns
        trip = ClockRoundTrip(device_ns, sent_ns + since_first, arrival_ns + since_first)
        if self._line.add_round_trip(trip):
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
    ) -> list[int]:
        """Learn from samples that arrived together, and convert their device times.

        Along device time stamps never go back, unless the host's clock does, and none is later than
        its arrival.

        Args:
            device_us: Device times of the samples, in µs.
            arrival_ns: Arrival of the samples.
            numbers: Numbers of the samples. Without them a step of the hub's clock is found later,
                and small steps back are not found.

        Returns:
            Host time of each sample, in ns.
        """
        self.in_doubt = False
        stamps: list[int] = []
        start = 0
        for k, number in enumerate(numbers):
            step_us = self._timing.find_step(number, device_us[k])
            if not step_us:
                continue
            # The samples before a step are converted by the clock before it.
            if k > start:
                stamps += self._convert(device_us[start:k], arrival_ns)
                start = k
            if self._newest != _NEVER:
                self._begin_decision(step_us, arrival_ns)
        remaining = device_us[start:] if start else device_us
        return stamps + self._convert(remaining, arrival_ns)

    @property
    def _is_fresh(self) -> bool:
        """Whether there was no sample since the restart."""
        return self._newest == _NEVER

    def _restart(self) -> None:
        """Forget all samples but the drift and the last stamp."""
        self._first_us = self._first_ns = 0
        self._newest = _NEVER  # device time of the newest sample
        self._line.restart()
        self._timing.restart()
        self._decision: StepDecision | None = None

    def _count_reset(self) -> None:
        """Count a restart of the line or a step of the hub's clock."""
        self.resets += 1
        self._steps_ns.append(self._last_arrival)

    def _convert(self, times: Sequence[int], arrival_ns: int) -> list[int]:
        """Learn from the newest of some samples and convert the device times of all."""
        if not times:
            return []
        # Of samples that arrive together the newest waited least; only it can touch the line.
        is_usable = self._learn(max(times), arrival_ns)
        offset, drift = self._line.bounded_offset, self._line.drift
        stamps = []
        for time_us in times:
            device_ns = 1000 * (time_us - self._first_us)
            stamp = self._first_ns + device_ns + round(offset + drift * device_ns)
            if not is_usable or not 0 <= arrival_ns - stamp <= MAX_DELAY_NS:
                stamp = arrival_ns
            # Along device time stamps do not go back, not even behind those that were in doubt.
            if device_ns <= self._newest and is_usable:
                stamp = min(stamp, self._last_stamp)
            else:
                self._newest = max(device_ns, self._newest)
                if stamp < self._last_stamp:
                    self.in_doubt |= stamp < self._doubtful_stamp
                    stamp = self._last_stamp
                self._last_stamp = stamp
            stamps.append(stamp)
        return stamps

    def _learn(self, newest_us: int, arrival_ns: int) -> bool:
        """Learn from the newest of some samples; return whether the hub's clock can be used."""
        goes_back = arrival_ns < self._last_arrival
        self._last_arrival = arrival_ns
        if goes_back:
            # Only a clock of the host that was set unnoticed, or a simulated time, does that.
            self._last_stamp = _NEVER
            self.reset()

        problem = self._find_problem(newest_us, arrival_ns)
        if problem:
            self.problems.add(problem)
            self._decision = None
        elif self._decision is not None and not self._n_still:
            self._decide(self._decision, newest_us, arrival_ns)

        device_ns = 1000 * (newest_us - self._first_us)
        if device_ns + 1000 * RESTART_US < self._newest:
            self.reset()
        if self._newest == _NEVER:
            self._first_us, self._first_ns = newest_us, arrival_ns
            device_ns = 0

        # While it is open whether the clock was set, the delays of samples are unknown.
        arrival = arrival_ns - self._first_ns
        if self._decision is None and self._line.add(device_ns, arrival):
            self.problems.add(CLOCK_SET)
            self._count_reset()
        if problem or self._decision is not None:
            self.in_doubt = True
        return not problem

    def _find_problem(self, device_us: int, arrival_ns: int) -> str:
        """Return why the hub's clock cannot be used now; empty if it can."""
        if device_us == self._last_us:
            self._n_still += 1
            if self._stands_still(arrival_ns):
                return CLOCK_STANDS_STILL
        else:
            if self._n_still and self._stands_still(arrival_ns):
                self.reset()  # It is unknown how long the clock stood still.
            self._last_us, self._moved_ns, self._n_still = device_us, arrival_ns, 0
        steps_ns = self._steps_ns
        if steps_ns and arrival_ns - steps_ns[0] > STEPS_NS:
            steps_ns.popleft()
        return CLOCK_KEEPS_JUMPING if len(steps_ns) == MAX_STEPS else ""

    def _stands_still(self, arrival_ns: int) -> bool:
        """Return whether the device time has not changed for too long."""
        still_ns = arrival_ns - self._moved_ns
        return self._n_still >= MIN_STILL_READS and still_ns > MIN_STILL_NS

    def _begin_decision(self, step_us: int, arrival_ns: int) -> None:
        """Begin to decide whether the hub's clock was set, or add a step to the decision."""
        newest_ns = self._newest
        before_ns = self._last_arrival - self._first_ns
        since_ns = arrival_ns - self._first_ns
        if self._decision is not None:
            step_us += self._decision.step_us
            newest_ns = self._decision.newest_ns
            before_ns = self._decision.before_ns
            since_ns = self._decision.since_ns
        if not step_us:
            self._decision = None  # The second step has undone the first.
            return
        self._decision = StepDecision(
            step_us=step_us,
            newest_ns=newest_ns,
            before_ns=before_ns,
            since_ns=since_ns,
            usual_delay_ns=self._line.recent_min_height,
        )

    def _decide(self, decision: StepDecision, newest_us: int, arrival_ns: int) -> None:
        """Decide whether the hub's clock was set, if that can be done now."""
        device_ns = 1000 * (newest_us - self._first_us)
        arrival = arrival_ns - self._first_ns
        delay = self._line.height(device_ns, arrival)
        was_set = decision.was_set(device_ns, delay, arrival, self._line.jitter_ns)
        if was_set is None:
            return
        self._decision = None
        if not was_set:
            self._timing.forget_period()
            return
        # Device times without the step continue as before, and so does all that was learned.
        self._first_us += decision.step_us
        self._newest = min(self._newest, decision.newest_ns)
        self._doubtful_stamp = self._last_stamp
        self._line.discard_round_trips_after(decision.before_ns)
        self.problems.add(CLOCK_SET)
        self._count_reset()
