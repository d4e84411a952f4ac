"""Whether a hub's clock was set, from the numbers of its samples and their arrival.

A hub counts its samples and takes one each period, so its device times follow the numbers. Where
they stop to, the clock was set there, or the hub sampled late or early. Their arrival tells which:
samples wait as long as before, or by the step longer or shorter. Until that is clear the step is a
suspicion, and stamps are in doubt.
"""

from __future__ import annotations

import math
from enum import Enum
from typing import NamedTuple

from ..scans.sequence import MAX_GAP, MEMORY

STEP_US = 4000.0
"""A smaller deviation is no step. Steps of 5 ms show, with 1 ms for the hub's own jitter."""
SLACK = 1e-3
"""Of the time since the last sample: the period is known no better."""
QUIET_US = 2.0
"""A smaller deviation is rounding."""
MEMORY_US = 50_000.0
"""Deviations add up over so long: a clock that stands still deviates by one period at a time."""
SMOOTHING = 64
"""Samples over which the period is averaged."""
DECIDE_NS = 200_000_000
"""Until then a sample may come that leaves no doubt. After that the smallest delay decides."""
PATIENCE_NS = 1_000_000_000
"""If that is in the middle, more samples are awaited for so long."""
FEWEST = 8
"""Reads that a decision needs at least: one may have waited for long."""
UNUSUAL = 8.0
"""Times the mean delay: hardly any sample waits so long."""
_WRAP = 1 << 32


class LentSteps(NamedTuple):
    """What a `StepWatch` knows of the last sample: its number and device time; the period; when the
    next is due, if that is known; by how much samples lag behind the period."""

    sequence: int
    device_us: int
    period_us: float
    due_us: float
    lag_us: float
    is_due: bool


class StepWatch:
    """Compares the device times of samples with their numbers."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget the samples before: the hub restarted."""
        self._number = self._next = -1
        self._device_us = 0
        self._due_us = 0.0
        self.forget_period()

    def forget_period(self) -> None:
        """Take the sample period from the next two samples."""
        self._period_us = 0.0
        self._lag_us = 0.0
        self._next = -1

    def lend(self) -> LentSteps | None:
        """For `follower.py`; None: the next sample tells nothing."""
        if self._number < 0 or self._period_us <= 0.0:
            return None
        is_due = self._next == self._number + 1
        return LentSteps(
            self._number, self._device_us, self._period_us, self._due_us, self._lag_us, is_due
        )

    def take_back(self, lent: LentSteps) -> None:
        """As if `look` had seen all samples until the one of `lent`."""
        self._number, self._device_us, self._period_us, self._due_us, self._lag_us, is_due = lent
        self._next = self._number + 1 if is_due else -1

    def look(self, number: int, device_us: int) -> int:
        """By how much the clock seems to have been set before this sample, µs; mostly 0."""
        # A sample that comes when it should is the common case, and it is quick.
        if number == self._next and -QUIET_US < device_us - self._due_us < QUIET_US:
            self._number, self._next = number, number + 1
            self._device_us, self._due_us = device_us, device_us + self._period_us
            return 0
        step = self._compare(number, device_us)
        self._next = -1
        if self._number == number and self._period_us and abs(self._lag_us) < QUIET_US:
            self._next, self._due_us, self._lag_us = number + 1, device_us + self._period_us, 0.0
        return step

    def _compare(self, number: int, device_us: int) -> int:
        last, self._number = self._number, number
        ahead = (number - last + _WRAP // 2) % _WRAP - _WRAP // 2
        if (
            -MEMORY <= ahead <= 0 <= last
        ):  # another frame of the last sample, or one that comes late
            self._number = last
            return 0
        if last < 0 or not 0 < ahead <= MAX_GAP:
            self.reset()
            self._number, self._device_us = number, device_us
            return 0
        interval = device_us - self._device_us
        self._device_us = device_us
        period = self._period_us
        if period <= 0.0:
            self._period_us = interval / ahead
            return 0
        error = interval - ahead * period
        self._lag_us = error + self._lag_us * max(0.0, 1 - ahead * period / MEMORY_US)
        if abs(self._lag_us) > STEP_US + SLACK * ahead * period:
            step, self._lag_us = round(self._lag_us), 0.0
            return step
        # Bounded, because a clock that stands still must not pass for a shorter period.
        bound = period / SMOOTHING
        self._period_us += min(max(error, -bound), bound) / SMOOTHING
        return 0


class Verdict(Enum):
    """What became of a suspicion. OPEN: more samples are needed."""

    OPEN = "open"
    SET = "set"
    NOT_SET = "not set"


class Suspicion:
    """That a hub's clock was set, while its samples come.

    step_us: by how much
    since_ns: arrival of the first sample behind the step
    newest_ns: device time of the newest sample before it
    """

    def __init__(self, step_us: int, since_ns: int, newest_ns: float, usual_ns: float) -> None:
        """usual_ns: the smallest delay of the samples before."""
        self.step_us = step_us
        self.since_ns = since_ns
        self.newest_ns = newest_ns
        self._usual_ns = usual_ns
        self._least_ns = math.inf
        self._calls = 0

    def judge(
        self, device_ns: float, delay_ns: float, arrival_ns: int, mean_delay_ns: float
    ) -> Verdict:
        """The verdict after one more sample.

        delay_ns: of the sample, as if the clock had not been set; mean_delay_ns: of many.
        """
        step_ns = 1000.0 * self.step_us
        self._least_ns = min(self._least_ns, delay_ns)
        self._calls += 1
        if device_ns < self.newest_ns and step_ns < 0:
            return Verdict.SET  # a clock that nobody sets does not go back
        if step_ns > 0:
            if self._least_ns < -step_ns / 2:
                return Verdict.SET  # otherwise it had come before it was taken
            if delay_ns < step_ns / 4 and step_ns > UNUSUAL * mean_delay_ns:
                return Verdict.NOT_SET  # otherwise it had waited for just that long
        else:
            waited = delay_ns - self._usual_ns
            if waited < -step_ns / 2:
                return Verdict.NOT_SET  # otherwise it had not waited
            if abs(waited + step_ns) < -step_ns / 4 and -step_ns > UNUSUAL * mean_delay_ns:
                return Verdict.SET  # otherwise it had waited for just that long
        age_ns = arrival_ns - self.since_ns
        change = self._least_ns - self._usual_ns
        is_unclear = abs(change + step_ns / 2) < abs(step_ns) / 4 and age_ns < PATIENCE_NS
        if age_ns < DECIDE_NS or self._calls < FEWEST or is_unclear:
            return Verdict.OPEN
        return Verdict.SET if abs(change + step_ns) < abs(change) else Verdict.NOT_SET
