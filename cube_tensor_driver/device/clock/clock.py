"""Device time to host time, for one hub.

The line below all points (device time, arrival) is the clock (`clock_line.py`). Arrival cannot tell
the smallest delay from the offset: stamps are late by it, unless the hub answers questions for its
time (`round_trips.py`), which bound the offset from both sides.

Where the host's clock was set shows at once (`host_clock.py`). Where a hub's clock was set, device
times no longer follow the numbers of the samples (`clock_step.py`). A hub's clock that stands still
or jumps again and again is no clock: arrival is the stamp (`hub_clock.py`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from .hub import HubClockWatch
from .line import FALL_NS, ClockLine
from .round_trips import RoundTrip, RoundTrips
from .step import LentSteps, StepWatch, Suspicion, Verdict

MAX_CONSTANT_NS = 1e9
"""No line delays all samples by more than this beyond its answers."""
CONTRARY = 3
"""So many answers in a row that contradict the samples are named."""
MAX_DELAY_NS = 60_000_000_000
"""No sample waits longer. A stamp further back is no time at all: arrival is taken."""
RESTART_US = 1_000_000
"""If device time falls back by more, the hub restarted; if by less, a sample is out of order."""
JUMPED = "the hub's clock was set: stamps follow its new time"
CONTRARY_ANSWERS = "the hub's answers to TIME contradict its samples: they are not used"
LENT_US, LENT_NS = 1 << 50, 1 << 62
"""Times beyond these, 35 and 146 years, are not lent: C could not add them."""
_NEVER = -(2**80)
"""Before every time: device times are 64 bits of µs, here in ns."""


class LentLine(NamedTuple):
    """What a `ClockMap` knows at the last sample, under its names and those of its line;
    stamp_offset: of the line that gives stamps."""

    first_us: int
    first_ns: int
    offset: float
    drift: float
    stamp_offset: float
    newest: int
    arrival: int
    stamp: int
    bucket_end: int
    jitter_ns: float
    least: float
    earliest: float
    delay: float


class ClockMap:
    """Maps one hub's clock to the host's. Bounded memory; amortised constant time per sample.

    resets: how often the map was fitted from the start, or the hub's clock was set
    in_doubt: whether the stamps of the last update may be wrong, because the hub's clock seems to
        have been set or is no clock
    problems: what is to be reported of the clock
    """

    # Times are in ns since the first point: device time from first_us, arrival from first_ns.

    def __init__(self) -> None:
        self.resets = 0
        self.in_doubt = False
        self.problems: set[str] = set()
        self._line = ClockLine()
        self._steps = StepWatch()
        self._watch = HubClockWatch()
        self._n_contrary = 0  # answers in a row that contradicted the samples
        self._last_stamp = self._last_arrival = _NEVER
        self._doubtful_stamp = _NEVER  # the last one that was in doubt when the clock was set
        self._begin()

    def _begin(self) -> None:
        self._first_us = self._first_ns = 0
        self._newest = _NEVER  # device time
        self._last_sound = 0  # arrival of the newest sample whose clock was not in doubt
        self._line.begin()
        self._steps.reset()
        self._suspicion: Suspicion | None = None
        self._trips = RoundTrips()

    def reset(self) -> None:
        """The hub restarted: fit from the start.

        Drift is kept as a first guess, and stamps still do not go backward.
        """
        self._count_reset()
        self._begin()

    def shift(self, step_ns: int) -> None:
        """The host's clock was set by step_ns: stamps go on in its new time."""
        self._first_ns += step_ns
        self._watch.shift(step_ns)
        if self._last_arrival != _NEVER:
            self._last_arrival += step_ns
        if self._last_stamp != _NEVER:
            self._last_stamp += step_ns
            self._doubtful_stamp += step_ns

    @property
    def drift_ppm(self) -> float:
        """Positive if host time runs faster than the hub's; 0 until known."""
        return 1e6 * self._line.drift

    @property
    def jitter_ns(self) -> float:
        """Mean delay above the line, over about the last 64 calls."""
        return self._line.jitter_ns

    @property
    def offset_ns(self) -> int:
        """Host time minus device time at the newest sample; 0 before the first."""
        if self._is_fresh:
            return 0
        at_first = self._first_ns - 1000 * self._first_us
        return at_first + round(self._stamp_offset + self._line.drift * self._newest)

    @property
    def delay_ns(self) -> float:
        """The smallest delay of samples, as round trips show it; 0 without them."""
        return max(0.0, self._line.offset - self._trips.offset_ns)

    @property
    def bound_ns(self) -> float | None:
        """How far stamps can be off while nothing is in doubt; None without round trips."""
        return self._trips.bound_ns if self._trips else None

    @property
    def round_trip_ns(self) -> float:
        """The shortest round trip of the last minute; 0 without."""
        return self._trips.least_ns

    @property
    def _is_fresh(self) -> bool:
        return self._newest == _NEVER

    @property
    def _stamp_offset(self) -> float:
        """Of the line that gives stamps: delays are no less than round trips say."""
        return min(self._line.offset, self._trips.offset_ns)

    def lend(self) -> tuple[LentSteps, LentLine] | None:
        """For `follower.py`; None: the clock is in doubt, or too little is known of it."""
        steps = self._steps.lend()
        is_doubtful = self.in_doubt or not self._watch.is_sound or self._suspicion is not None
        if steps is None or self._is_fresh or is_doubtful:
            return None
        line = self._line
        # Until the bucket has a point, none is known to be the earliest.
        earliest = line.earliest if math.isfinite(line.least) else (0.0, 0.0)
        lent = LentLine(
            self._first_us,
            self._first_ns,
            line.offset,
            line.drift,
            self._stamp_offset,
            self._newest,
            self._last_arrival,
            self._last_stamp,
            self._first_ns + line.bucket_end,
            line.jitter_ns,
            line.least,
            *earliest,
        )
        is_small = max(steps.device_us, abs(lent.first_us)) < LENT_US
        times_ns = lent.first_ns, lent.newest, lent.arrival, lent.stamp, lent.bucket_end
        is_small = is_small and max(map(abs, times_ns)) < LENT_NS
        # Stamps that were in doubt may hold back those after them.
        return (steps, lent) if is_small and lent.stamp >= self._doubtful_stamp else None

    def take_back(self, steps: LentSteps, lent: LentLine) -> None:
        """As if `update` had seen all samples until the one of `steps`."""
        self._steps.take_back(steps)
        self._watch.move(steps.device_us, lent.arrival)
        self._newest = lent.newest
        self._last_arrival = lent.arrival
        self._last_sound = lent.arrival - self._first_ns
        self._last_stamp = lent.stamp
        self._line.jitter_ns = lent.jitter_ns
        self._line.least, self._line.earliest = lent.least, (lent.earliest, lent.delay)

    def answer(self, sent_ns: int, device_us: int, arrival_ns: int) -> None:
        """The hub read device_us after a question was sent at sent_ns, and its answer arrived at
        arrival_ns.

        A round trip during which the host's clock was set must not be given.
        """
        if self._is_fresh or self.in_doubt or not sent_ns <= arrival_ns:
            return
        t = 1000.0 * (device_us - self._first_us)
        since_first = -self._first_ns - t
        trip = RoundTrip(t, sent_ns + since_first, arrival_ns + since_first)
        line = self._line.offset + self._line.drift * t
        if trip.low_ns > line + FALL_NS or trip.high_ns < line - MAX_CONSTANT_NS:
            self._n_contrary += 1
            if self._n_contrary >= CONTRARY:
                self.problems.add(CONTRARY_ANSWERS)
            return
        self._n_contrary = 0
        self._trips.add(trip)
        self._find_true_offset()

    def _find_true_offset(self) -> None:
        self._trips.find_offset(self._line.drift, self._line.drift_uncertainty)

    def update(
        self, device_us: Sequence[int], arrival_ns: int, numbers: Sequence[int] = ()
    ) -> list[int]:
        """Host times, ns, of samples taken at device_us, µs, that arrived together at arrival_ns.

        numbers: of the samples. Without them a step of the hub's clock shows later, and small steps
        back do not show.

        Along device time stamps never go backward, and none is later than its arrival. The map
        starts again when device time falls back by more than 1 s, and when either clock was set.
        Only a host clock that is set back makes stamps go backward.
        """
        if not device_us:
            return []
        self.in_doubt = False
        if len(device_us) == 1:  # as it mostly is
            step_us = self._steps.look(numbers[0], device_us[0]) if numbers else 0
            if step_us and not self._is_fresh:
                self._suspect(step_us, arrival_ns)
            return self._stamps(device_us, arrival_ns)
        stamps: list[int] = []
        start = 0
        for k, time_us in enumerate(device_us):
            step_us = self._steps.look(numbers[k], time_us) if numbers else 0
            if k > start and (step_us or time_us < device_us[k - 1] - RESTART_US):
                stamps += self._stamps(device_us[start:k], arrival_ns)
                start = k
            if step_us and not self._is_fresh:
                self._suspect(step_us, arrival_ns)
        return stamps + self._stamps(device_us[start:], arrival_ns)

    def _suspect(self, step_us: int, arrival_ns: int) -> None:
        """The clock seems to have been set by step_us, perhaps not for the first time."""
        before = self._suspicion
        since_ns, newest = arrival_ns, float(self._newest)
        if before is not None:
            since_ns, newest = before.since_ns, before.newest_ns
            step_us += before.step_us
        usual = self._line.usual
        self._suspicion = Suspicion(step_us, since_ns, newest, usual) if step_us else None

    def _judge(self, suspicion: Suspicion, newest_us: int, arrival_ns: int) -> None:
        """Decide whether the hub's clock was set, if that can be done now."""
        t = 1000.0 * (newest_us - self._first_us)
        height = self._line.height((t, arrival_ns - self._first_ns - t))
        verdict = suspicion.judge(t, height, arrival_ns, self.jitter_ns)
        if verdict is Verdict.OPEN:
            return
        self._suspicion = None
        if verdict is Verdict.NOT_SET:
            self._steps.forget_period()
            return
        # Device times without the step go on as before, and so does all that was learned of them.
        self._first_us += suspicion.step_us
        self._newest = min(self._newest, round(suspicion.newest_ns))
        self._doubtful_stamp = self._last_stamp
        self._trips.forget_since(self._last_sound)
        self._find_true_offset()
        self.problems.add(JUMPED)
        self._count_reset()

    def _stamps(self, times: Sequence[int], arrival_ns: int) -> list[int]:
        # Of samples that arrive together the newest waited least; only it can touch the line.
        is_believed = self._see(max(times), arrival_ns)
        offset, drift = self._stamp_offset, self._line.drift
        stamps = []
        for time_us in times:
            t = 1000 * (time_us - self._first_us)
            stamp = min(self._first_ns + t + round(offset + drift * t), arrival_ns)
            if not is_believed or stamp < arrival_ns - MAX_DELAY_NS:
                stamp = arrival_ns
            if t > self._newest or not is_believed:
                # Stamps that were in doubt may hold back those after them.
                if stamp < self._doubtful_stamp:
                    self.in_doubt = True
                stamp = max(stamp, self._last_stamp)
                self._newest = max(t, self._newest)
                self._last_stamp = stamp
            else:
                stamp = min(stamp, self._last_stamp)
            stamps.append(stamp)
        return stamps

    def _see(self, newest_us: int, arrival_ns: int) -> bool:
        """Learn from the newest of some samples. Whether the hub's clock is to be believed."""
        if arrival_ns < self._last_arrival:
            self._last_stamp = _NEVER
            self.reset()
        self._last_arrival = arrival_ns
        if self._watch.moves_again(newest_us, arrival_ns):
            self.reset()  # nobody knows how long it stood still
        problem = self._watch.look(newest_us, arrival_ns)
        if problem:
            self.problems.add(problem)
            self._suspicion = None
        elif self._suspicion is not None and not self._watch.is_still:
            self._judge(self._suspicion, newest_us, arrival_ns)
        if not self._is_fresh and 1000 * (newest_us - self._first_us + RESTART_US) < self._newest:
            self.reset()
        if self._is_fresh:
            self._first_us, self._first_ns = newest_us, arrival_ns
        if self._suspicion is None:
            self._add_point(1000.0 * (newest_us - self._first_us), arrival_ns)
            self._last_sound = arrival_ns - self._first_ns
        if problem or self._suspicion is not None:
            self.in_doubt = True
        return not problem

    def _add_point(self, t: float, arrival_ns: int) -> None:
        """Add a point at device time t to the line, and fit it when a bucket is full."""
        arrival = arrival_ns - self._first_ns
        was_set = self._line.add((t, arrival - t))
        if arrival >= self._line.bucket_end:
            was_set = self._line.close_bucket(arrival) or was_set
            self._find_true_offset()
        if was_set:
            self.problems.add(JUMPED)
            self._count_reset()

    def _count_reset(self) -> None:
        self.resets += 1
        self._watch.add_wrong(self._last_arrival)
