# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The straight line from the device time of one hub to host time, bounded by round trips.

    arrival = device time + offset + drift * device time + delay

No delay is negative, so the line that touches the points (device time, arrival) from below gives
host time over device time: an edge of their lower convex hull (Moon, Skelly, Towsley, "Estimation
and removal of clock skew from network delay measurements", INFOCOM 1999).

Arrivals cannot separate the smallest delay from the offset. A round trip, that is a question for
the hub's time and its answer, can: the hub reads its clock between the two, which bounds the offset
from both sides (F. Cristian, "Probabilistic clock synchronization", Distributed Computing 3, 1989).
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from ..track import LinkTrack

BUCKET_NS = 1_000_000_000
"""Length, in ns, of the time intervals (buckets) of which each gives the clock line (host time over
device time) one point: the sample with the smallest delay."""
MAX_BUCKETS = 120
"""Maximum number of points to which the clock line (host time over device time) is fitted. They are
the points of the newest buckets: two minutes, with one point per second."""
MIN_BUCKETS_FOR_DRIFT = 5
"""Smallest number of points, one for each bucket of 1 s, from which the drift of the hub's clock is
estimated. Within fewer seconds, a change of the delay would look like drift."""
UNKNOWN_DRIFT = 1e-4
"""Assumed error of the drift (relative deviation of the clocks' rates) while the clock line (host
time over device time) has at most one point. Quartz crystals deviate by less than 100 ppm.

With n points, one per second, the assumed error is n times smaller: the longer the line, the better
its slope is known.
"""
MAX_DRIFT = 1e-3
"""Largest credible drift, to which the fitted drift is limited. A larger one is found when the host
pauses and reads many samples late."""
MAX_RISE_NS = 20e6
"""Largest credible rise, in ns, of the smallest delay in a bucket (1 s) above the clock line (host
time over device time). USB adapters delay samples by up to 16 ms. If the rises of two successive
buckets are larger, a clock was set, unless round trips show that only the samples are late; a
single larger rise may come from a pause of the host."""
MAX_FALL_NS = 4e6
"""Largest credible fall, in ns, of the smallest delay in a bucket (1 s) below the clock line (host
time over device time). A larger fall means that a clock was set. Steps of 5 ms shall be found."""
MAX_DELAY_NS = 60_000_000_000
"""Longest credible delay between sampling and arrival, in ns. If the clock line (host time over
device time) gives a longer one, the arrival time is used as the stamp."""
JITTER_POINTS = 64
"""Time constant of the low-pass filter that estimates the jitter, in reads of the link. The jitter
is the mean difference between a delay and the smallest delay. Each read adds the difference for its
newest sample, which is the height of the sample above the clock line (host time over device
time)."""


class ClockLine:
    """Straight line below the points (device time, arrival) of the samples of one hub.

    Its coefficients are attributes of the track: `drift`; `offset`, which includes the smallest
    delay; and `bounded_offset`, which excludes that delay as far as round trips tell it. All times
    are in ns since the first point.

    Attributes:
        error_bound: Largest possible error of `bounded_offset`, in ns; None without round trips.
    """

    def __init__(self, track: LinkTrack) -> None:
        self._track = track
        self._points: deque[tuple[float, float]] = deque(maxlen=MAX_BUCKETS)
        self.restart()

    def restart(self) -> None:
        """Discard all points and round trips; the drift is kept as a first guess."""
        self._track.offset = 0.0
        self._track.bucket_end = BUCKET_NS
        self._track.bucket_height = math.inf
        self._points.clear()
        self._fitted_offset = math.nan  # `offset` after the last fit; NaN before
        self._rose = False  # whether the last bucket's rise was above `MAX_RISE_NS`
        self.forget_round_trips()

    def forget_round_trips(self) -> None:
        """Discard the bounds from all round trips."""
        self.error_bound: float | None = None
        self._is_contradicted = False  # whether the last round trip contradicted earlier ones
        self._low, self._high = -math.inf, math.inf
        self._answered_ns = 0.0  # device time for which the bounds hold
        self._set_bounded_offset()

    def compute_height(self, device_ns: float, arrival_ns: float) -> float:
        """Return the height of a point above the line: its delay beyond the smallest, in ns.

        Args:
            device_ns: Device time of a sample.
            arrival_ns: Host time at which the sample arrived.
        """
        return arrival_ns - device_ns - self._track.offset - self._track.drift * device_ns

    def add(self, device_ns: float, arrival_ns: int, is_late: bool) -> bool:
        """Add a point: lower the line to it if it is below, and fit the line after each bucket.

        Args:
            device_ns: Device time of the sample.
            arrival_ns: Host time at which it arrived.
            is_late: Whether the host has read it late, so that its delay is not that of the link.

        Returns:
            Whether the points show that the hub's or the host's clock was set.
        """
        track = self._track
        height = self.compute_height(device_ns, arrival_ns)
        if height < 0:
            track.offset += height
            track.bucket_height = math.inf
            self._set_bounded_offset()
            height = 0.0
        track.jitter_ns += (height - track.jitter_ns) / JITTER_POINTS
        if height < track.bucket_height and not is_late:
            track.bucket_height = height
            track.earliest_ns = device_ns
        if arrival_ns < track.bucket_end:
            return False
        track.bucket_end = arrival_ns + BUCKET_NS
        height, track.bucket_height = track.bucket_height, math.inf
        # A bucket whose samples were all read late has no point.
        return math.isfinite(height) and self._add_bucket(height)

    def add_round_trip(
        self,
        device_ns: float,
        sent_ns: int,
        arrival_ns: int,
    ) -> bool:
        """Bound the offset at one device time by one round trip.

        Args:
            device_ns: Device time in the answer.
            sent_ns: Host time of the question.
            arrival_ns: Host time of the answer.

        Returns:
            Whether the answer agrees with the samples and earlier answers; else it is not used.
        """
        drift = self._track.drift
        elapsed = device_ns - self._answered_ns
        tolerance = abs(elapsed) * UNKNOWN_DRIFT / max(1, len(self._points))
        line = self._track.offset + drift * device_ns
        # The bounds from earlier answers are extrapolated with the drift to the device time of
        # this answer, and widened by the possible error of the drift.
        drifted = drift * elapsed
        low = max(
            sent_ns - device_ns,
            self._low + drifted - tolerance,
            line - MAX_DELAY_NS,
        )
        high = min(
            arrival_ns - device_ns,
            self._high + drifted + tolerance,
            line + MAX_FALL_NS,
        )
        self._is_contradicted = low > high
        if self._is_contradicted:
            return False
        self._low, self._high, self._answered_ns = low, high, device_ns
        self.error_bound = (high - low) / 2
        self._set_bounded_offset()
        return True

    def _add_bucket(self, height: float) -> bool:
        """Fit the line with one more point; return whether a clock was set.

        The point is the sample with the smallest delay in the last time interval (bucket).

        Args:
            height: Height of the point above the line: its delay beyond the smallest one, in ns.
        """
        track = self._track
        rise = track.offset + height - self._fitted_offset
        # Samples that are late for seconds rise, too, but the round trips still agree then.
        may_be_late = self.error_bound is not None and not self._is_contradicted
        is_too_high = self._rose and rise > MAX_RISE_NS and not may_be_late
        was_set = rise < -MAX_FALL_NS or is_too_high
        self._rose = rise > MAX_RISE_NS and not was_set
        if was_set:
            self._points.clear()
            self.forget_round_trips()
        if self._rose:
            # If all samples are late for half of the points, these would look like drift.
            return False
        line = track.offset + track.drift * track.earliest_ns
        self._points.append((track.earliest_ns, line + height))
        x, y = np.array(self._points).T  # device times; arrivals minus device times
        if len(x) >= MIN_BUCKETS_FOR_DRIFT:
            # The line joins the lowest points of the two halves, as seen along its previous slope.
            # Within a few buckets it converges to the edge of the hull.
            half = len(x) // 2
            heights = y - track.drift * x
            left = heights[:half].argmin()
            right = half + heights[half:].argmin()
            slope = (y[right] - y[left]) / max(1.0, x[right] - x[left])
            track.drift = min(max(float(slope), -MAX_DRIFT), MAX_DRIFT)
        track.offset = self._fitted_offset = float((y - track.drift * x).min())
        self._set_bounded_offset()
        return was_set

    def _set_bounded_offset(self) -> None:
        """Set `bounded_offset` to the centre of the bounds, but at most to `offset`, so that no
        delay is negative."""
        track = self._track
        centre = math.inf
        if self.error_bound is not None:
            centre = (self._low + self._high) / 2 - track.drift * self._answered_ns
        track.bounded_offset = min(track.offset, centre)
