"""Detection of steps of the host's clock and of a hub's clock.

The host's clock is compared with the monotonic clock, which is never set. A hub numbers its samples
and takes one in each period, so its device times follow the numbers. Where they do not, either the
hub's clock was set, or the hub sampled late or early. The delays of the next samples distinguish
the two: in the first case they differ from those before by the step, in the second they do not.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from ..scans.sequence import MAX_DISORDER, MAX_GAP

MIN_STEP_US = 4000.0
"""Smallest deviation of a device time from the sample period, in µs, that counts as a step of the
hub's clock. Steps of 5 ms are found, with 1 ms for the jitter of the hub."""
PERIOD_TOLERANCE = 1e-3
"""Relative error of the estimated sample period. Over a gap of lost samples, `MIN_STEP_US` is
increased by this part of the gap."""
PERIOD_SAMPLES = 64
"""Number of samples over which the sample period of a hub is averaged."""
DECISION_NS = 200_000_000
"""Time after a step, in ns, in which only samples decide whose delay leaves no doubt. After it, the
smallest delay decides whether the clock was set."""
MAX_DECISION_NS = 1_000_000_000
"""Longest time after a step, in ns, without a decision, while the smallest delay fits both
explanations equally well."""
MIN_DECISION_READS = 8
"""Number of reads after a step before the smallest delay decides, because one sample may wait
long."""
UNLIKELY_DELAY = 8.0
"""Ratio of a delay to the mean delay above which hardly any sample waits."""
MIN_HOST_STEP_NS = 1_000_000
"""Smallest step of the host's clock, in ns, that is detected. Reading it and the monotonic clock
one after the other takes time."""
MAX_READ_NS = 100_000
"""Longest time, in ns, that reading both clocks of the host may take for a valid comparison."""
MAX_READS = 3
"""Number of attempts to read both clocks of the host within `MAX_READ_NS`."""
_WRAP = 1 << 32
_NO_NUMBER = -2  # With -1, number 0 would be the next one.


class HostClockWatch:
    """Detects steps of the host's clock.

    Args:
        clock_ns: The clock that is watched.
        steady_ns: A clock that is never set.
    """

    def __init__(
        self,
        clock_ns: Callable[[], int],
        steady_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._clock_ns, self._steady_ns = clock_ns, steady_ns
        self._offset: int | None = None

    def look(self) -> tuple[int, int]:
        """Return the host's time, and by how much it was set since the last call, both in ns."""
        for _ in range(MAX_READS):
            before = self._steady_ns()
            now = self._clock_ns()
            if self._steady_ns() - before < MAX_READ_NS:
                break
        else:
            return now, 0  # The thread was interrupted each time, so nothing can be compared.
        offset = now - before
        step = 0 if self._offset is None else offset - self._offset
        if self._offset is not None and abs(step) < MIN_HOST_STEP_NS:
            return now, 0
        self._offset = offset
        return now, step


class SampleTiming:
    """Compares the device times of one hub's samples with their numbers."""

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Forget all samples, because the hub restarted."""
        self._number = self._reference = _NO_NUMBER
        self._reference_us = 0
        self._period_us = 0.0

    def forget_period(self) -> None:
        """Discard the estimated sample period; the next sample gives a new one."""
        self._period_us = 0.0

    def find_step(self, number: int, device_us: int) -> int:
        """Return the deviation of a sample from the period, in µs; 0 if there is no step."""
        if number != self._number + 1 and not self._is_ahead(number, device_us):
            return 0
        self._number = number
        # The reference is the newest sample before this one whose device time had changed.
        n_periods = (number - self._reference) % _WRAP
        interval = device_us - self._reference_us
        period = self._period_us
        error = interval - n_periods * period
        is_step = False
        if period <= 0.0:
            self._period_us = interval / n_periods
        elif abs(error) > MIN_STEP_US + PERIOD_TOLERANCE * n_periods * period:
            is_step = True
        else:
            # Bounded, because a clock that stands still must not pass for a shorter period.
            bound = period / PERIOD_SAMPLES
            if error > bound:
                error = bound
            elif error < -bound:
                error = -bound
            self._period_us = period + error / PERIOD_SAMPLES
        # While the clock stands still, the deviation adds up from the last sample before.
        if interval or is_step or period <= 0.0:
            self._reference, self._reference_us = number, device_us
        return round(error) if is_step else 0

    def _is_ahead(self, number: int, device_us: int) -> bool:
        """Return whether a number follows the newest one, with a credible gap.

        A number that neither does nor belongs to a late sample comes from a hub that restarted:
        then all samples before are forgotten.
        """
        advance = (number - self._number + _WRAP // 2) % _WRAP - _WRAP // 2
        is_known = self._number != _NO_NUMBER
        if is_known and 0 < advance <= MAX_GAP:
            return True
        # The newest sample may have another frame.
        is_late = is_known and -MAX_DISORDER <= advance <= 0
        if not is_late:
            self.restart()
            self._number = self._reference = number
            self._reference_us = device_us
        return False


class StepDecision:
    """Decides whether a hub's clock was set or the hub sampled late, from the delays that follow.

    If the hub sampled late or early, samples wait as long as before. If its clock was set, their
    delay seems to be shorter by the step.

    Attributes:
        step_us: Step of the device times against the numbers of the samples, in µs.
        newest_ns: Device time of the newest sample before the step.
        before_ns: Arrival of the newest sample before the step.
        since_ns: Arrival of the first sample after the step.
    """

    def __init__(
        self,
        *,
        step_us: int,
        newest_ns: int,
        before_ns: int,
        since_ns: int,
        usual_delay_ns: float,
    ) -> None:
        self.step_us = step_us
        self.newest_ns = newest_ns
        self.before_ns = before_ns
        self.since_ns = since_ns
        self._usual_delay_ns = usual_delay_ns
        self._min_delay_ns = math.inf
        self._n_reads = 0

    def was_set(
        self,
        device_ns: int,
        delay_ns: float,
        arrival_ns: int,
        mean_delay_ns: float,
    ) -> bool | None:
        """Decide after one more sample.

        Args:
            device_ns: Device time of the sample.
            delay_ns: Delay of the sample, computed as if the clock had not been set.
            arrival_ns: Arrival of the sample.
            mean_delay_ns: Mean delay of many samples.

        Returns:
            Whether the clock was set; None if more samples are needed.
        """
        step_ns = 1000 * self.step_us
        if step_ns < 0 and device_ns < self.newest_ns:
            return True  # A clock does not go back by itself.
        self._n_reads += 1
        self._min_delay_ns = min(self._min_delay_ns, delay_ns)
        # A shift is 0 if the sample waited as before, and 1 if the clock was set. Before a step
        # forward, the shortest possible delay counts, because the next sample may wait less.
        reference_ns = self._usual_delay_ns if step_ns < 0 else 0.0
        shift = (reference_ns - delay_ns) / step_ns
        max_shift = (reference_ns - self._min_delay_ns) / step_ns
        if (step_ns > 0) == (max_shift > 0.5):
            return step_ns > 0  # With the other explanation, the delay would be negative.

        if abs(step_ns) > UNLIKELY_DELAY * mean_delay_ns:
            # With the other explanation, the delay would equal the step by chance.
            if abs(shift) < 0.25:
                return False
            if abs(shift - 1) < 0.25:
                return True

        age_ns = arrival_ns - self.since_ns
        shift = (self._usual_delay_ns - self._min_delay_ns) / step_ns
        is_unclear = abs(shift - 0.5) < 0.25 and age_ns < MAX_DECISION_NS
        if age_ns < DECISION_NS or self._n_reads < MIN_DECISION_READS or is_unclear:
            return None
        return shift > 0.5
