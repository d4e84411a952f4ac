"""Device time to host time: a line below all points (device time, arrival).

arrival = device time + offset + drift · device time + delay

The delay (buffers, USB polling, the scheduler) is never negative. So the line that touches the
points from below is the clock, and the height of a point above it is its delay. Of each second only
the earliest point is kept. The line is the edge of the lower convex hull of these points over their
mean device time: of all lines below the points it has the smallest mean distance to them (Moon,
Skelly, Towsley, "Estimation and removal of clock skew from network delay measurements", INFOCOM
1999). Arrival cannot tell the smallest delay from the offset: stamps are late by it, unless the hub
answers questions for its time (`round_trips.py`), which bound the offset from both sides.

Where the host's clock was set shows at once, without any points: it moves against the monotonic
clock. Where a hub's clock was set, device times no longer follow the numbers of the samples
(`clock_step.py`). A hub's clock that stands still or jumps again and again is no clock: arrival is
the stamp.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import NamedTuple

from .clock_step import LentSteps, StepWatch, Suspicion, Verdict
from .round_trips import RoundTrip, RoundTrips

BUCKET_NS = 1_000_000_000
"""Length of a bucket, of which the earliest point is kept."""
WINDOW = 120
"""Buckets kept: two minutes."""
DRIFT_AFTER = 5
"""Buckets before drift is estimated. Over a shorter time, delay looks like drift."""
FIRST_GUESS = 1e-4
"""Drift is 0 to within this as long as it is not known: crystals are that good."""
MAX_DRIFT = 1e-3
"""No two clocks differ by more. A steeper line comes from a stall."""
STEP_NS = 20e6
"""If all points lie further above the line, one of the clocks was set. USB bursts take 16 ms."""
FALL_NS = 4e6
"""If a point lies further below the line, one of the clocks was set: no delay is negative. A step
of 5 ms shows, with 1 ms for the line's own error."""
STEP_BUCKETS = 2
"""It must last for so many buckets, because a stall looks the same at first."""
MAX_CONSTANT_NS = 1e9
"""No line delays all samples by more than this beyond its answers."""
CONTRARY = 3
"""So many answers in a row that contradict the samples are named."""
MAX_DELAY_NS = 60_000_000_000
"""No sample waits longer. A stamp further back is no time at all: arrival is taken."""
RESTART_US = 1_000_000
"""If device time falls back by more, the hub restarted; if by less, a sample is out of order."""
FROZEN_NS = 200_000_000
FROZEN_CALLS = 3
"""A clock that has not moved for so long, and for so many calls, stands still."""
LIES, LIES_NS = 3, 10_000_000_000
"""A clock that was wrong so often within so long is not believed until that is over."""
MIN_SET_NS = 1_000_000
"""By less nobody sets a clock; and reading two clocks one after the other takes time."""
READ_NS, READS = 100_000, 3
"""Two clocks are compared if reading them took less; otherwise it is tried again so often."""
STANDS_STILL = "the hub's clock stands still: rows are stamped by their arrival"
JUMPED = "the hub's clock was set: stamps follow its new time"
CONTRARY_ANSWERS = "the hub's answers to TIME contradict its samples: they are not used"
LYING = (
    f"the hub's clock jumped {LIES} times within {LIES_NS / 1e9:g} s: "
    "rows are stamped by their arrival"
)
LENT_US, LENT_NS = 1 << 50, 1 << 62
"""Times beyond these, 35 and 146 years, are not lent: C could not add them."""
_NEVER = -(2**80)
"""Before every time: device times are 64 bits of µs, here in ns."""


class HostClockWatch:
    """Sees at once when the host's clock was set.

    clock_ns: the clock that is watched; steady_ns: one that nobody sets.
    """

    def __init__(
        self,
        clock_ns: Callable[[], int],
        steady_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._clock_ns, self._steady_ns = clock_ns, steady_ns
        self._offset: int | None = None

    def look(self) -> tuple[int, int]:
        """The time, and by how much the clock was set since the last call, ns; mostly 0."""
        for _ in range(READS):
            before = self._steady_ns()
            now = self._clock_ns()
            if self._steady_ns() - before < READ_NS:
                break
        else:
            return now, 0
        offset = now - before
        step = 0 if self._offset is None else offset - self._offset
        if self._offset is not None and abs(step) < MIN_SET_NS:
            return now, 0
        self._offset = offset
        return now, step


class LentLine(NamedTuple):
    """What a `ClockMap` knows at the last sample, under its names; stamp_offset: of the line that
    gives stamps."""

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

    jitter_ns: mean delay above the line, over about the last 64 calls.
    resets: how often the map was fitted from the start, or the hub's clock was set.
    in_doubt: whether the stamps of the last update may be wrong, because the hub's clock seems to
    have been set or is no clock.
    """

    # Times are in ns since the first point; a point is (device time, arrival - device time).
    # The line: arrival - device time = offset + drift * device time.
    _is_fresh: bool
    _first_us: int
    _first_ns: int
    _newest: int  # device time
    _offset: float
    _points: deque[tuple[float, float]]
    _earliest: tuple[float, float]  # point of the bucket being filled
    _least: float  # its height above the line; inf: the bucket is empty
    _bucket_end: int
    _fallen: float  # how far the line fell in the bucket being filled
    _n_high: int  # buckets in a row with all points above the line by more than STEP_NS
    _last_least: float  # least height in the last full bucket
    _suspicion: Suspicion | None
    _trips: RoundTrips
    _true_offset: float  # as the round trips say; inf: there are none
    _bound: float  # how far it can be off

    def __init__(self) -> None:
        self.jitter_ns = 0.0
        self.resets = 0
        self.in_doubt = False
        self._drift = 0.0
        self._steps = StepWatch()
        self._n_contrary = 0  # answers in a row that contradicted the samples
        self._last_stamp = self._last_arrival = _NEVER
        self._doubtful_stamp = _NEVER  # the last one that was in doubt when the clock was set
        self.problems: set[str] = set()
        self._is_doubtful = False  # whether `_find_problem` has to look
        self._last_us = -1  # device time of the last call
        self._moved_ns = 0  # when that came first
        self._calls_still = 0  # since then
        self._wrong_ns: deque[int] = deque(maxlen=LIES)  # arrivals where the map began anew
        self._begin()

    def reset(self) -> None:
        """The hub restarted: fit from the start.

        Drift is kept as a first guess, and stamps still do not go backward.
        """
        self._count_reset()
        self._begin()

    def shift(self, step_ns: int) -> None:
        """The host's clock was set by step_ns: stamps go on in its new time."""
        self._first_ns += step_ns
        self._bucket_end += step_ns
        self._moved_ns += step_ns
        if self._last_arrival != _NEVER:
            self._last_arrival += step_ns
        if self._last_stamp != _NEVER:
            self._last_stamp += step_ns
            self._doubtful_stamp += step_ns
        self._wrong_ns = deque((at + step_ns for at in self._wrong_ns), LIES)

    @property
    def drift_ppm(self) -> float:
        """Positive if host time runs faster than the hub's; 0 until known."""
        return 1e6 * self._drift

    @property
    def offset_ns(self) -> int:
        """Host time minus device time at the newest sample; 0 before the first."""
        if self._is_fresh:
            return 0
        at_first = self._first_ns - 1000 * self._first_us
        offset = min(self._offset, self._true_offset)
        return at_first + round(offset + self._drift * self._newest)

    @property
    def delay_ns(self) -> float:
        """The smallest delay of samples, as round trips show it; 0 without them."""
        return max(0.0, self._offset - self._true_offset)

    @property
    def bound_ns(self) -> float | None:
        """How far stamps can be off while nothing is in doubt; None without round trips."""
        return self._bound if self._trips else None

    @property
    def round_trip_ns(self) -> float:
        """The shortest round trip of the last minute; 0 without."""
        return self._trips.least_ns

    def lend(self) -> tuple[LentSteps, LentLine] | None:
        """For `follower.py`; None: the clock is in doubt, or too little is known of it."""
        steps = self._steps.lend()
        is_doubtful = self.in_doubt or self._is_doubtful or self._suspicion is not None
        if steps is None or self._is_fresh or is_doubtful:
            return None
        # Until the bucket has a point, none is known to be the earliest.
        earliest = self._earliest if math.isfinite(self._least) else (0.0, 0.0)
        line = LentLine(
            self._first_us,
            self._first_ns,
            self._offset,
            self._drift,
            min(self._offset, self._true_offset),
            self._newest,
            self._last_arrival,
            self._last_stamp,
            self._bucket_end,
            self.jitter_ns,
            self._least,
            *earliest,
        )
        is_small = max(steps.device_us, abs(line.first_us)) < LENT_US
        times_ns = line.first_ns, line.newest, line.arrival, line.stamp, line.bucket_end
        is_small = is_small and max(map(abs, times_ns)) < LENT_NS
        # Stamps that were in doubt may hold back those after them.
        return (steps, line) if is_small and line.stamp >= self._doubtful_stamp else None

    def take_back(self, steps: LentSteps, line: LentLine) -> None:
        """As if `update` had seen all samples until the one of `steps`."""
        self._steps.take_back(steps)
        self._last_us = steps.device_us
        self._newest = line.newest
        self._last_arrival = self._moved_ns = line.arrival
        self._last_sound = line.arrival - self._first_ns
        self._last_stamp = line.stamp
        self.jitter_ns = line.jitter_ns
        self._least, self._earliest = line.least, (line.earliest, line.delay)

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
        line = self._offset + self._drift * t
        if trip.low_ns > line + FALL_NS or trip.high_ns < line - MAX_CONSTANT_NS:
            self._n_contrary += 1
            if self._n_contrary >= CONTRARY:
                self.problems.add(CONTRARY_ANSWERS)
            return
        self._n_contrary = 0
        self._trips.add(trip)
        self._find_true_offset()

    def _find_true_offset(self) -> None:
        if not self._trips:
            self._true_offset, self._bound = math.inf, 0.0
            return
        uncertainty = FIRST_GUESS
        if len(self._points) >= DRIFT_AFTER:
            span = self._points[-1][0] - self._points[0][0]
            uncertainty = min(uncertainty, self.jitter_ns / span) if span > 0 else uncertainty
        self._true_offset, self._bound = self._trips.offset(self._drift, uncertainty)

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
        least = min(self._least, self._last_least)
        usual = least if math.isfinite(least) else 0.0
        self._suspicion = Suspicion(step_us, since_ns, newest, usual) if step_us else None

    def _judge(self, newest_us: int, arrival_ns: int, problem: str) -> None:
        """Decide about the suspicion, if that can be done now."""
        suspicion = self._suspicion
        if problem:
            self._suspicion = None
        # A clock that stands still would seem to be set again and again.
        if suspicion is None or self._calls_still or problem:
            return
        t = 1000.0 * (newest_us - self._first_us)
        height = self._height((t, arrival_ns - self._first_ns - t))
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
        if arrival_ns < self._last_arrival:
            self._last_stamp = _NEVER
            self.reset()
        self._last_arrival = arrival_ns
        # Of samples that arrive together the newest waited least; only it can touch the line.
        newest = max(times)
        problem = ""
        if newest != self._last_us and not self._is_doubtful:
            self._last_us, self._moved_ns = newest, arrival_ns
        else:
            problem = self._find_problem(newest, arrival_ns)
        if self._suspicion is not None:
            self._judge(newest, arrival_ns, problem)
        if not self._is_fresh and 1000 * (newest - self._first_us + RESTART_US) < self._newest:
            self.reset()
        if self._is_fresh:
            self._is_fresh = False
            self._first_us, self._first_ns = newest, arrival_ns
            self._bucket_end = arrival_ns + BUCKET_NS
        if self._suspicion is None:
            self._add_point(1000.0 * (newest - self._first_us), arrival_ns)
            self._last_sound = arrival_ns - self._first_ns
        if problem or self._suspicion is not None:
            self.in_doubt = True
        offset = self._offset if self._offset < self._true_offset else self._true_offset
        stamps = []
        for time_us in times:
            t = 1000 * (time_us - self._first_us)
            stamp = self._first_ns + t + round(offset + self._drift * t)
            stamp = min(stamp, arrival_ns)
            if problem or stamp < arrival_ns - MAX_DELAY_NS:
                stamp = arrival_ns
            if t > self._newest or problem:
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

    def _find_problem(self, newest_us: int, arrival_ns: int) -> str:
        """Why device times are not to be believed now; empty if they are."""
        problem = ""
        if newest_us != self._last_us:
            if self._is_still(arrival_ns):
                self.reset()  # nobody knows how long it stood still
            self._last_us, self._moved_ns, self._calls_still = newest_us, arrival_ns, 0
        else:
            self._calls_still += 1
            if self._is_still(arrival_ns):
                problem = STANDS_STILL
        wrong = self._wrong_ns
        if wrong and arrival_ns - wrong[0] > LIES_NS:
            wrong.popleft()
        if len(wrong) == LIES and not problem:
            problem = LYING
        if problem:
            self.problems.add(problem)
        self._is_doubtful = self._calls_still > 0 or len(wrong) == LIES
        return problem

    def _is_still(self, arrival_ns: int) -> bool:
        return self._calls_still >= FROZEN_CALLS and arrival_ns - self._moved_ns > FROZEN_NS

    def _count_reset(self) -> None:
        self.resets += 1
        self._wrong_ns.append(self._last_arrival)
        self._is_doubtful = True

    def _begin(self) -> None:
        self._is_fresh = True
        self._first_us = self._first_ns = self._bucket_end = self._n_high = 0
        self._newest = _NEVER
        self._offset = 0.0
        self._points = deque(maxlen=WINDOW)
        self._least = self._last_least = math.inf
        self._fallen = 0.0
        self._steps.reset()
        self._suspicion = None
        self._trips = RoundTrips()
        self._true_offset, self._bound = math.inf, 0.0
        self._last_sound = 0  # arrival of the newest sample whose clock was not in doubt

    def _add_point(self, t: float, arrival_ns: int) -> None:
        """Lower the line to a point at device time t if need be, and close the bucket when it is
        full."""
        delay = arrival_ns - self._first_ns - t
        height = delay - self._offset - self._drift * t
        if height < 0:
            # Before the first bucket is full, the line falls because the least delay is not known.
            self._fallen -= height if self._points else 0.0
            if self._fallen > FALL_NS or -height > STEP_NS:
                self._fallen = 0.0
                self.problems.add(JUMPED)
                self._count_reset()
                self._points.clear()
            self._offset += height
            height = 0.0
            self._least = math.inf
        self.jitter_ns += (height - self.jitter_ns) / 64
        if height < self._least:
            self._least = height
            self._earliest = t, delay
        if arrival_ns >= self._bucket_end:
            self._bucket_end = arrival_ns + BUCKET_NS
            self._fallen = 0.0
            self._last_least = self._least
            self._close_bucket(self._earliest)
            self._least = math.inf

    def _close_bucket(self, earliest: tuple[float, float]) -> None:
        self._n_high = self._n_high + 1 if self._height(earliest) > STEP_NS else 0
        if self._n_high >= STEP_BUCKETS:
            self._n_high = 0
            self.problems.add(JUMPED)
            self._count_reset()
            self._points.clear()
        self._points.append(earliest)
        points = sorted(self._points)
        if len(points) >= DRIFT_AFTER:
            self._drift = min(max(_middle_slope(points), -MAX_DRIFT), MAX_DRIFT)
        self._offset = min(d - self._drift * t for t, d in points)
        self._find_true_offset()

    def _height(self, point: tuple[float, float]) -> float:
        """Of a point above the line."""
        t, delay = point
        return delay - self._offset - self._drift * t


def _middle_slope(points: list[tuple[float, float]]) -> float:
    """Slope of the edge of the lower convex hull over the mean x.

    points: (x, y), at least two, sorted.
    """
    hull: list[tuple[float, float]] = []
    for x, y in points:
        while len(hull) > 1:
            (x0, y0), (x1, y1) = hull[-2:]
            if (x1 - x0) * (y - y0) > (x - x0) * (y1 - y0):
                break  # the last point lies below the line to the new one
            hull.pop()
        hull.append((x, y))
    middle = sum(x for x, _ in points) / len(points)
    for (x0, y0), (x1, y1) in pairwise(hull):
        if x1 >= middle and x1 > x0:
            return (y1 - y0) / (x1 - x0)
    return 0.0
