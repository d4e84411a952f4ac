# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Detection of steps of the host's clock and of a hub's clock.

The host's clock is compared with the monotonic clock, which is never set. A hub numbers its samples
and takes one in each sample period, so its device times grow by one period with each number. If a
device time deviates from this, either the hub's clock was set, or the hub sampled late or early.
The delays (arrival minus device time) of the next samples distinguish the two: they change by the
step if the clock was set, and stay the same if the hub sampled late or early.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from ...core.rows import COUNTER_RANGE
from ..track import LinkTrack

MIN_STEP_US = 4000.0
"""Smallest deviation, in µs, of the device time (hub's clock) of a sample from the time expected
from its number and the sample period, at which a step of the hub's clock is suspected. Steps of
5 ms shall be found; 1 ms is left for the jitter of the hub."""
PERIOD_TOLERANCE = 1e-3
"""Largest assumed relative error of the estimated sample period. After lost samples, the threshold
`MIN_STEP_US` is increased by this fraction of the time between the received samples."""
PERIOD_SAMPLES = 64
"""Time constant, in samples, of the low-pass filter that estimates the sample period of a hub from
the device times (hub's clock) of its samples."""
DECISION_NS = 200_000_000
"""Time, in ns, for which delays of samples are collected after a suspected step of a hub's clock.

A delay is the time from the sampling to the arrival of a sample. If the hub only sampled late, the
smallest delay is the same as before; if its clock was set, the delay differs by the step. The
decision comes earlier if one of the two cases would make a delay negative or improbably long.
"""
MAX_DECISION_NS = 1_000_000_000
"""Time limit, in ns after a suspected step of the hub's clock, for deciding whether the clock was
set or the hub only sampled late. Until then the decision waits while the smallest delay of samples
(arrival minus sampling) is about as far from the value expected in the one case as in the other.
After it, the nearer value decides."""
MIN_DECISION_READS = 8
"""Number of reads after a suspected step of the hub's clock before the smallest delay decides. The
samples of a few reads may all be delayed."""
UNLIKELY_DELAY = 8.0
"""Smallest ratio of a step of the hub's clock to the mean delay of samples, at which a single delay
can decide whether the clock was set.

A delay is the time from the sampling to the arrival of a sample, minus the smallest such time.
Hardly any delay exceeds the mean by this factor, so the step cannot be confused with a delay.
"""
MIN_HOST_STEP_NS = 1_000_000
"""Smallest step of the host's clock, in ns, that is detected. The host's and the monotonic clock
are read one after the other, so that smaller differences of the two are not certain."""
MAX_READ_NS = 100_000
"""Longest time, in ns, that reading the host's clock and the monotonic clock may take. After a
longer time their difference is not used, because the thread was interrupted between them."""
MAX_READS = 3
"""Number of attempts to read the host's clock and the monotonic clock within `MAX_READ_NS`. If all
fail, no step of the host's clock is reported; the next comparison finds it."""


class HostClockWatch:
    """Detects steps of the host's clock by comparing it with the monotonic clock.

    Args:
        clock_ns: Clock that is checked, in ns.
        steady_ns: Clock that is never set, in ns.
    """

    def __init__(
        self,
        clock_ns: Callable[[], int],
        steady_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._clock_ns = clock_ns
        self._steady_ns = steady_ns
        self._offset: int | None = None

    def look(self) -> tuple[int, int]:
        """Read the host's clock and compare it with the monotonic clock.

        Returns:
            Time of the host's clock, and the step by which it was set since the last call (0 if it
            was not set), both in ns.
        """
        for _ in range(MAX_READS):
            before = self._steady_ns()
            now = self._clock_ns()
            if self._steady_ns() - before < MAX_READ_NS:
                break
        else:
            # The thread was interrupted between the two clocks in every attempt, so they cannot be
            # compared now; the next call finds the step.
            return now, 0
        offset = now - before
        step = 0 if self._offset is None else offset - self._offset
        if self._offset is not None and abs(step) < MIN_HOST_STEP_NS:
            return now, 0
        self._offset = offset
        return now, step


def find_step(track: LinkTrack, number: int, device_us: int) -> int:
    """Compare the device time (hub's clock) of a sample with the time expected from its number.

    The expected time grows by the estimated sample period with each number.

    Args:
        track: Sample period and reference sample of the link, which are updated.
        number: Number of the sample, 32 bits, which wraps to 0.
        device_us: Device time of the sample, in µs.

    Returns:
        Device time minus expected device time, in µs, if the difference is large enough for a step
        of the hub's clock; else 0.
    """
    if track.reference < 0:
        track.reference = number
        track.reference_us = device_us
        return 0
    # A number that is not ahead of the reference belongs to a sample that came out of order or to
    # another frame of the same sample, which cannot be checked.
    n_periods = (number - track.reference) % COUNTER_RANGE
    if not 0 < n_periods < COUNTER_RANGE // 2:
        return 0
    interval = device_us - track.reference_us
    period = track.period_us
    error = interval - n_periods * period
    is_step = False
    if period <= 0.0:
        track.period_us = interval / n_periods
    elif abs(error) > MIN_STEP_US + PERIOD_TOLERANCE * n_periods * period:
        is_step = True
    else:
        # The change of the period per sample is limited. Otherwise a clock that stands still would
        # look like an ever shorter period.
        bound = period / PERIOD_SAMPLES
        if abs(error) > bound:
            error = math.copysign(bound, error)
        track.period_us = period + error / PERIOD_SAMPLES
    # The reference sample is kept while the hub's clock stands still, so that the deviation from
    # the expected time grows until it counts as a step.
    if interval or is_step or period <= 0.0:
        track.reference = number
        track.reference_us = device_us
    return round(error) if is_step else 0


@dataclass
class StepDecision:
    """Decides from the delays of samples whether a hub's clock was set or the hub sampled late.

    If the hub sampled late or early, the delays (arrival minus device time) of the next samples are
    as before. If its clock was set, they seem to be shorter by the step. All times but `step_us`
    are in ns, relative to the origins of the hub's clock line.

    Attributes:
        step_us: Device time of the first sample after the step minus the device time expected from
            its number, in µs.
        newest_ns: Device time of the newest sample before the step.
        before_ns: Arrival time of the newest sample before the step.
        since_ns: Arrival time of the first sample after the step.
        usual_delay_ns: Smallest delay of the samples just before the step, above the clock line.
        min_delay_ns: Smallest delay of the samples since the step, above the clock line.
        n_reads: Number of reads of the link since the step.
    """

    step_us: int
    newest_ns: int
    before_ns: int
    since_ns: int
    usual_delay_ns: float
    min_delay_ns: float = field(default=math.inf, init=False)
    n_reads: int = field(default=0, init=False)

    def was_set(
        self,
        device_ns: int,
        delay_ns: float,
        arrival_ns: int,
        mean_delay_ns: float,
    ) -> bool | None:
        """Decide whether the hub's clock was set, after one more sample.

        Args:
            device_ns: Device time of the sample, in ns.
            delay_ns: Delay of the sample, in ns, computed as if the clock had not been set.
            arrival_ns: Host time at which the sample arrived, in ns.
            mean_delay_ns: Mean delay of many samples above the smallest one, in ns.

        Returns:
            Whether the clock was set; None if more samples are needed.
        """
        step_ns = 1000 * self.step_us
        if step_ns < 0 and device_ns < self.newest_ns:
            # Device times never decrease unless the hub's clock is set back.
            return True
        self.n_reads += 1
        self.min_delay_ns = min(self.min_delay_ns, delay_ns)
        # The shift is the decrease of the delay divided by the step: 0 if the hub sampled late or
        # early, 1 if its clock was set.
        reference_ns = self.usual_delay_ns
        if step_ns > 0:
            # Even if the clock was not set, the delay may become smaller than before the step, down
            # to that of the clock line, which is 0 here.
            reference_ns = 0.0
        shift = (reference_ns - delay_ns) / step_ns
        max_shift = (reference_ns - self.min_delay_ns) / step_ns
        if (step_ns > 0) == (max_shift > 0.5):
            # After the opposite decision, the delay of a sample would be negative.
            return step_ns > 0

        if abs(step_ns) > UNLIKELY_DELAY * mean_delay_ns:
            # The step is longer than almost any delay, so the change of a single delay decides.
            if abs(shift) < 0.25:
                return False
            if abs(shift - 1) < 0.25:
                return True

        age_ns = arrival_ns - self.since_ns
        shift = (self.usual_delay_ns - self.min_delay_ns) / step_ns
        is_unclear = abs(shift - 0.5) < 0.25 and age_ns < MAX_DECISION_NS
        if age_ns < DECISION_NS or self.n_reads < MIN_DECISION_READS or is_unclear:
            return None
        return shift > 0.5
