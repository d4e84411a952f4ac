"""The line below all points (device time, arrival) of one hub.

arrival = device time + offset + drift · device time + delay

The delay (buffers, USB polling, the scheduler) is never negative. So the line that touches the
points from below is the clock, and the height of a point above it is its delay. Of each second, a
bucket, only the earliest point is kept. The line is the edge of the lower convex hull of these
points over their mean device time: of all lines below the points it has the smallest mean distance
to them (Moon, Skelly, Towsley, "Estimation and removal of clock skew from network delay
measurements", INFOCOM 1999).
"""

from __future__ import annotations

import math
from collections import deque
from itertools import pairwise

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
SMOOTHING = 64
"""Points over which the jitter is averaged."""


class ClockLine:
    """Bounded memory; amortised constant time for each point.

    A point is (device time, arrival - device time), both in ns since the first point.

    offset, drift: the line is offset + drift · device time
    jitter_ns: mean height of the last points above it
    bucket_end: arrival at which the bucket that is being filled ends
    least, earliest: least height in this bucket, inf if it is empty; the point that has it
    """

    def __init__(self) -> None:
        self.drift = 0.0
        self.jitter_ns = 0.0
        self.begin()

    def begin(self) -> None:
        """Forget all points. Drift is kept as a first guess."""
        self.offset = 0.0
        self.bucket_end = BUCKET_NS
        self.least = self._last_least = math.inf
        self.earliest = (0.0, 0.0)
        self._points: deque[tuple[float, float]] = deque(maxlen=WINDOW)
        self._fallen = 0.0  # how far the line fell in this bucket
        self._n_high = 0  # buckets in a row with all points above the line by more than STEP_NS

    def __len__(self) -> int:
        """How many points are kept, one of each full bucket."""
        return len(self._points)

    @property
    def usual(self) -> float:
        """The least height of late, ns; 0 as long as nobody knows it."""
        least = min(self.least, self._last_least)
        return least if math.isfinite(least) else 0.0

    @property
    def drift_uncertainty(self) -> float:
        """How far the drift may be off."""
        if len(self._points) < DRIFT_AFTER:
            return FIRST_GUESS
        span = self._points[-1][0] - self._points[0][0]
        return min(FIRST_GUESS, self.jitter_ns / span) if span > 0 else FIRST_GUESS

    def height(self, point: tuple[float, float]) -> float:
        """Of a point above the line, ns."""
        t, delay = point
        return delay - self.offset - self.drift * t

    def add(self, point: tuple[float, float]) -> bool:
        """Lower the line to a point if need be. Whether one of the clocks was set before it."""
        height = self.height(point)
        was_set = False
        if height < 0:
            # Before the first bucket is full, the line falls because the least delay is not known.
            self._fallen -= height if self._points else 0.0
            was_set = self._fallen > FALL_NS or -height > STEP_NS
            if was_set:
                self._fallen = 0.0
                self._points.clear()
            self.offset += height
            height = 0.0
            self.least = math.inf
        self.jitter_ns += (height - self.jitter_ns) / SMOOTHING
        if height < self.least:
            self.least, self.earliest = height, point
        return was_set

    def close_bucket(self, arrival: int) -> bool:
        """Fit the line to the earliest points of all buckets, and begin a bucket. Whether one of
        the clocks was set some buckets ago."""
        self._n_high = self._n_high + 1 if self.height(self.earliest) > STEP_NS else 0
        was_set = self._n_high >= STEP_BUCKETS
        if was_set:
            self._n_high = 0
            self._points.clear()
        self._points.append(self.earliest)
        points = sorted(self._points)
        if len(points) >= DRIFT_AFTER:
            self.drift = min(max(_middle_slope(points), -MAX_DRIFT), MAX_DRIFT)
        self.offset = min(delay - self.drift * t for t, delay in points)
        self.bucket_end = arrival + BUCKET_NS
        self._fallen = 0.0
        self._last_least, self.least = self.least, math.inf
        return was_set


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
