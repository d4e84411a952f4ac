# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The straight line from the device time of one hub to host time, bounded by round trips.

    arrival = device time + offset + drift * device time + delay

Each sample is a point (device time, arrival). Its delay (buffers, USB polling, the scheduler) is
never negative, so the line that touches the points from below gives host time over device time, and
the height of a point above the line is its delay. Only the point of each second with the smallest
delay is kept. The line is the edge of the lower convex hull of these points at their mean device
time: of all lines below the points it has the smallest mean distance to them (Moon, Skelly,
Towsley, "Estimation and removal of clock skew from network delay measurements", INFOCOM 1999).

Arrival times alone cannot separate the smallest delay from the offset. A round trip, that is a
question for the hub's time and its answer, can, because the hub reads its clock between the two:
each round trip bounds the offset from both sides (F. Cristian, "Probabilistic clock
synchronization", Distributed Computing 3, 1989). All bounds hold at once. The centre between the
highest lower bound and the lowest upper bound is exact if both directions of the link have the same
delay, and is never wrong by more than half the distance of these bounds.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np

from ...core.arrays import Array
from ..track import LinkTrack

BUCKET_NS = 1_000_000_000
"""Length, in ns, of the time intervals (buckets) into which the samples of a hub are divided. Of
each bucket only the sample with the smallest delay between sampling and arrival is kept."""
MAX_BUCKETS = 120
"""Number of buckets (intervals of 1 s), together two minutes, whose samples of smallest delay are
kept. The clock line, that is host time as a linear function of device time, is fitted to them."""
MIN_BUCKETS_FOR_DRIFT = 5
"""Number of buckets (intervals of 1 s) that must be complete before the drift between hub and host
clock is estimated. In a shorter time, a change of the delay would look like drift."""
UNKNOWN_DRIFT = 1e-4
"""Largest assumed error of the relative drift between hub and host clock while the drift is not
estimated yet. Quartz crystals deviate by less than 100 parts per million."""
MAX_DRIFT = 1e-3
"""Largest credible relative drift between hub and host clock, to which the estimated drift is
limited. A larger value arises when the host pauses and reads many samples late."""
MAX_RISE_NS = 20e6
"""Largest credible change of the smallest delay of samples (arrival minus sampling), in ns; USB
adapters delay samples by up to 16 ms. The hub's or the host's clock counts as set if all delays of
`MIN_BUCKETS_HIGH` successive seconds exceed the smallest earlier delay by more, or if one delay is
smaller than it by more."""
MAX_FALL_NS = 4e6
"""Largest credible decrease, within 1 s, of the smallest delay (arrival minus sampling) of a hub's
samples, in ns. A larger one shows that the hub's or the host's clock was set, except in the first
second, in which the smallest delay is not known yet. Steps of 5 ms shall be found; 1 ms is left for
the error of the estimated delay."""
MIN_BUCKETS_HIGH = 2
"""Number of successive buckets (intervals of 1 s) in which the delays of all samples must exceed
the smallest delay by more than `MAX_RISE_NS` before the hub's or the host's clock counts as set.
In a single bucket this may come from a pause of the host."""
JITTER_POINTS = 64
"""Time constant, in reads of the link, of the low-pass filter that estimates the jitter.

The jitter is the mean delay (time from sampling to arrival) minus the smallest delay.
"""
MAX_ROUND_TRIPS = 64
"""Number of newest round trips (questions for the hub's time and their answers) that are kept. With
one per second they cover about one minute."""
MAX_COMMON_DELAY_NS = 1e9
"""Longest credible delay, in ns, that all samples of a hub have in common, for example in a buffer
of the hub. If an answer to the request TIME (for the hub's time) implies a longer one, the answer
contradicts the samples and is not used."""


class ClockRoundTrip(NamedTuple):
    """Bounds of the offset (host time minus device time) from one question for the hub's time.

    Attributes:
        device_ns: Device time in the answer, in ns since the first sample.
        low_ns: Lower bound, in ns: host time of the question minus device time in the answer.
        high_ns: Upper bound, in ns: host time of the answer minus device time in the answer.
    """

    device_ns: float
    low_ns: float
    high_ns: float


class ClockLine:
    """Straight line below the points (device time, arrival time) of the samples of one hub.

    It is fitted in bounded memory and, on average, constant time per point. All times are in ns
    since the first point.

    Attributes:
        drift: Relative drift, the slope of arrival minus device time over device time; positive if
            host time runs faster.
        offset: Arrival minus device time on the line at device time 0. It contains the smallest
            delay.
        bounded_offset: `offset` without the smallest delay, as far as round trips (questions for
            the hub's time and their answers) determine this delay.
        error_bound: Largest possible error of `bounded_offset`, in ns; None without round trips.
        jitter_ns: Mean height of the newest points above the line.
    """

    def __init__(self, track: LinkTrack | None = None) -> None:
        self._track = track or LinkTrack()
        self.restart()

    def restart(self) -> None:
        """Discard all samples and round trips; the drift is kept as a first guess.

        A round trip is a question for the hub's time and its answer.
        """
        self._track.offset = self._track.bounded_offset = 0.0
        self.error_bound: float | None = None
        self._track.bucket_end = BUCKET_NS
        self._track.bucket_height = self._previous_height = math.inf
        self._track.earliest_ns = self._track.earliest_delay = 0.0
        self._track.is_earliest_late = False
        self._points: deque[tuple[float, float]] = deque(maxlen=MAX_BUCKETS)
        self._round_trips: deque[ClockRoundTrip] = deque(maxlen=MAX_ROUND_TRIPS)
        self._trip_offset = math.inf
        self._fall = 0.0
        self._n_high = 0

    @property
    def recent_min_height(self) -> float:
        """Smallest delay, in ns, of the samples of this and the previous bucket of 1 s.

        It is counted from the clock line (host time over device time, through the samples of
        smallest delay); without a sample it is 0.
        """
        height = min(self._track.bucket_height, self._previous_height)
        return height if math.isfinite(height) else 0.0

    def height(self, device_ns: float, arrival_ns: float) -> float:
        """Return the delay of a sample (arrival minus sampling) minus the smallest delay, in ns.

        This is the height of the point (device time, arrival time) above the clock line.

        Args:
            device_ns: Device time of the sample, in ns since the first sample.
            arrival_ns: Host time of its arrival, in ns since the first sample.
        """
        return arrival_ns - device_ns - self._track.offset - self._track.drift * device_ns

    def add(self, device_ns: float, arrival_ns: int, is_late: bool = False) -> bool:
        """Add the point (device time, arrival time) of a sample to the clock line.

        The line states host time over device time for the smallest delay. If the point lies below
        the line, the line is lowered to it. After each bucket of 1 s the line is fitted anew.

        Args:
            device_ns: Device time of the sample, in ns since the first point.
            arrival_ns: Host time at which it arrived, in ns since the first point.
            is_late: Whether the host has read the sample too late, because it is too slow. A long
                delay then does not show that a clock was set.

        Returns:
            Whether the points show that the hub's or the host's clock was set.
        """
        track = self._track
        height = self.height(device_ns, arrival_ns)
        was_set = False
        if height < 0:
            was_set = self._lower(height)
            height = 0.0
        track.jitter_ns += (height - track.jitter_ns) / JITTER_POINTS
        if height < track.bucket_height:
            track.bucket_height = height
            track.earliest_ns = device_ns
            track.earliest_delay = arrival_ns - device_ns
            track.is_earliest_late = is_late
        if arrival_ns >= track.bucket_end:
            was_set = self._fit(arrival_ns) or was_set
        return was_set

    def add_round_trip(self, trip: ClockRoundTrip) -> bool:
        """Bound the offset (host minus hub time) by a question for the hub's time and its answer.

        Args:
            trip: Times of the question, of the answer and of the hub.

        Returns:
            Whether the answer is consistent with the samples; otherwise it is not used.
        """
        line = self._track.offset + self._track.drift * trip.device_ns
        if trip.low_ns > line + MAX_FALL_NS or trip.high_ns < line - MAX_COMMON_DELAY_NS:
            return False
        self._round_trips.append(trip)
        self._intersect_bounds()
        return True

    def discard_round_trips_after(self, arrival_ns: float) -> None:
        """Discard the round trips (question for the hub's time, answer) that ended after a time.

        Args:
            arrival_ns: This host time, in ns since the first sample.
        """
        trips = self._round_trips
        while trips:
            ended_ns = trips[-1].device_ns + trips[-1].high_ns
            if ended_ns <= arrival_ns:
                break
            trips.pop()
        self._intersect_bounds()

    def _lower(self, height: float) -> bool:
        """Lower the clock line (host time over device time) to a point below it.

        Args:
            height: Height of the point above the line, in ns; negative, because it is below.

        Returns:
            Whether this shows that the hub's or the host's clock was set.
        """
        # In the first second, the line falls because the smallest delay is not known yet. Only a
        # later fall shows that a clock was set.
        self._fall -= height if self._points else 0.0
        is_known = bool(self._points) or not self._track.is_earliest_late
        was_set = self._fall > MAX_FALL_NS or (-height > MAX_RISE_NS and is_known)
        if was_set:
            self._fall = 0.0
            self._points.clear()
        self._track.offset += height
        self._track.bucket_height = math.inf
        self._set_bounded_offset()
        return was_set

    def _fit(self, arrival_ns: int) -> bool:
        """Fit the clock line, host time over device time, to the samples of smallest delay.

        Each bucket (interval of 1 s) contributes one sample; the next one begins with this call.

        Args:
            arrival_ns: Host time, in ns since the first point, at which this bucket ends.

        Returns:
            Whether the last `MIN_BUCKETS_HIGH` buckets show that a clock was set before them.
        """
        was_set = False
        if not self._track.is_earliest_late:
            was_set = self._add_point()
        self._track.bucket_end = arrival_ns + BUCKET_NS
        self._fall = 0.0
        self._previous_height = self._track.bucket_height
        self._track.bucket_height = math.inf
        self._intersect_bounds()
        return was_set

    def _add_point(self) -> bool:
        """Fit the clock line (host time over device time) with the point of one more bucket of 1 s.

        The point is the sample with the smallest delay in this bucket.

        Returns:
            Whether the last `MIN_BUCKETS_HIGH` buckets show that a clock was set before them.
        """
        track = self._track
        device_ns = track.earliest_ns
        delay = track.earliest_delay
        height = delay - track.offset - track.drift * device_ns
        self._n_high = self._n_high + 1 if height > MAX_RISE_NS else 0
        was_set = self._n_high >= MIN_BUCKETS_HIGH
        if was_set:
            self._n_high = 0
            self._points.clear()
        self._points.append((device_ns, delay))

        devices_ns, delays = np.array(self._points).T
        if len(devices_ns) >= MIN_BUCKETS_FOR_DRIFT:
            slope = _find_slope_at_centre(devices_ns, delays)
            track.drift = min(max(slope, -MAX_DRIFT), MAX_DRIFT)
        # No point (device time, arrival) may lie below the line, because no delay is negative. If
        # the slope was limited to MAX_DRIFT, any point may be the lowest, so all are compared.
        offsets = delays - track.drift * devices_ns
        track.offset = float(offsets.min())
        return was_set

    def _estimate_drift_error(self) -> float:
        """Return the largest assumed error of the estimated relative drift between the clocks.

        It is the jitter of the delays divided by the time between the first and the last kept
        sample, and at most `UNKNOWN_DRIFT`.
        """
        if len(self._points) < MIN_BUCKETS_FOR_DRIFT:
            return UNKNOWN_DRIFT
        first, _ = self._points[0]
        last, _ = self._points[-1]
        if last <= first:
            return UNKNOWN_DRIFT
        return min(UNKNOWN_DRIFT, self._track.jitter_ns / (last - first))

    def _intersect_bounds(self) -> None:
        """Compute the offset (host minus device time) from all kept round trips, and its error.

        The offset is the centre between the highest lower and the lowest upper bound of the round
        trips, and the largest possible error half their distance. Both are stored. Without round
        trips, the offset is infinite (not bounded) and the error None.
        """
        self._trip_offset = math.inf
        self.error_bound = None
        low = -math.inf
        high = math.inf
        drift_error = self._estimate_drift_error()
        for trip in reversed(self._round_trips):
            drifted = self._track.drift * trip.device_ns
            # The bounds of the offset from older round trips (questions for the hub's time) are
            # wider, because the error of the drift has added up since then.
            age = abs(self._round_trips[-1].device_ns - trip.device_ns)
            tolerance = drift_error * age
            next_low = max(low, trip.low_ns - drifted - tolerance)
            next_high = min(high, trip.high_ns - drifted + tolerance)
            if next_low > next_high:
                # Bounds of the offset that do not overlap show that a clock was set between the
                # measurements, so the older ones are not used.
                break
            low = next_low
            high = next_high
            self._trip_offset = (low + high) / 2
            self.error_bound = (high - low) / 2
        self._set_bounded_offset()

    def _set_bounded_offset(self) -> None:
        """Set `bounded_offset` to the offset from round trips, but not above `offset`.

        With a larger offset, the delays of some samples would be negative.
        """
        self._track.bounded_offset = min(self._track.offset, self._trip_offset)


def _find_slope_at_centre(x: Array, y: Array) -> float:
    """Return the slope of the lower convex hull of points at their mean x; 0 if all x are equal.

    Args:
        x: First coordinates (K,) of the points.
        y: Second coordinates (K,) of the points.
    """
    is_left = x < x.mean()
    if not is_left.any():
        return 0.0
    # The edge of the lower hull is the segment from a point left of the centre (row) to one right
    # of it (column) that passes the centre lowest.
    left_x = x[is_left, np.newaxis]
    left_y = y[is_left, np.newaxis]
    right_x = x[~is_left]
    right_y = y[~is_left]
    slopes = (right_y - left_y) / (right_x - left_x)
    heights = left_y + slopes * (x.mean() - left_x)
    return float(slopes.flat[heights.argmin()])
