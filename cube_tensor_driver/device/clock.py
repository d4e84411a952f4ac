"""Device time to host time: a line below all points (device time, arrival).

arrival = device time + offset + drift · device time + delay

The delay (buffers, USB polling, the scheduler) is never negative. So the line that touches the
points from below is the clock, and the height of a point above it is its delay. Of each second only
the earliest point is kept. The line is the edge of the lower convex hull of these points over their
mean device time: of all lines below the points it has the smallest mean distance to them (Moon,
Skelly, Towsley, "Estimation and removal of clock skew from network delay measurements", INFOCOM
1999). The smallest delay cannot be told from the offset: stamps are late by it.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from itertools import pairwise

BUCKET_NS = 1_000_000_000
"""Length of a bucket, of which the earliest point is kept."""
WINDOW = 120
"""Buckets kept: two minutes."""
DRIFT_AFTER = 5
"""Buckets before drift is estimated. Over a shorter time, delay looks like drift."""
MAX_DRIFT = 1e-3
"""No two clocks differ by more. A steeper line comes from a stall."""
STEP_NS = 20e6
"""If all points lie further above the line, one of the clocks was set. USB bursts take 16 ms."""
STEP_BUCKETS = 2
"""It must last for so many buckets, because a stall looks the same at first."""
MAX_DELAY_NS = 60_000_000_000
"""No sample waits longer. A stamp further back is no time at all: arrival is taken."""
RESTART_US = 1_000_000
"""If device time falls back by more, the hub restarted; if by less, a sample is out of order."""
_NEVER = -(2**63)


class ClockMap:
    """Maps one hub's clock to the host's. Bounded memory; amortised constant time per sample.

    jitter_ns: mean delay above the line, over about the last 64 calls.
    resets: how often the map was fitted from the start.
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
    _n_high: int  # buckets in a row with all points above the line by more than STEP_NS

    def __init__(self) -> None:
        self.jitter_ns = 0.0
        self.resets = 0
        self._drift = 0.0
        self._last_stamp = self._last_arrival = _NEVER
        self._begin()

    def reset(self) -> None:
        """The hub restarted: fit from the start.

        Drift is kept as a first guess, and stamps still do not go backward.
        """
        self.resets += 1
        self._begin()

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
        return at_first + round(self._offset + self._drift * self._newest)

    def update(self, device_us: Sequence[int], arrival_ns: int) -> list[int]:
        """Host times, ns, of samples taken at device_us, µs, that arrived together at arrival_ns.

        Along device time stamps never go backward, and none is later than its arrival. The map
        starts again when device time falls back by more than 1 s, and when either clock was set.
        Only a host clock that is set back makes stamps go backward.
        """
        if not device_us:
            return []
        stamps: list[int] = []
        start = 0
        for k in range(1, len(device_us)):
            if device_us[k] < device_us[k - 1] - RESTART_US:
                stamps += self._stamps(device_us[start:k], arrival_ns)
                start = k
        return stamps + self._stamps(device_us[start:], arrival_ns)

    def _stamps(self, times: Sequence[int], arrival_ns: int) -> list[int]:
        if arrival_ns < self._last_arrival:
            self._last_stamp = _NEVER
            self.reset()
        self._last_arrival = arrival_ns
        # Of samples that arrive together the newest waited least; only it can touch the line.
        newest = max(times)
        if not self._is_fresh and 1000 * (newest - self._first_us + RESTART_US) < self._newest:
            self.reset()
        if self._is_fresh:
            self._is_fresh = False
            self._first_us, self._first_ns = newest, arrival_ns
            self._bucket_end = arrival_ns + BUCKET_NS
        self._add_point(1000.0 * (newest - self._first_us), arrival_ns)
        stamps = []
        for time_us in times:
            t = 1000 * (time_us - self._first_us)
            stamp = self._first_ns + t + round(self._offset + self._drift * t)
            stamp = min(stamp, arrival_ns)
            if stamp < arrival_ns - MAX_DELAY_NS:
                stamp = arrival_ns
            if t > self._newest:
                stamp = max(stamp, self._last_stamp)
                self._newest = t
                self._last_stamp = stamp
            else:
                stamp = min(stamp, self._last_stamp)
            stamps.append(stamp)
        return stamps

    def _begin(self) -> None:
        self._is_fresh = True
        self._first_us = self._first_ns = self._bucket_end = self._n_high = 0
        self._newest = _NEVER
        self._offset = 0.0
        self._points = deque(maxlen=WINDOW)
        self._least = math.inf

    def _add_point(self, t: float, arrival_ns: int) -> None:
        """Lower the line to a point at device time t if need be, and close the bucket when it is
        full."""
        point = t, arrival_ns - self._first_ns - t
        height = self._height(point)
        if height < 0:
            if height < -STEP_NS:
                self.resets += 1
                self._points.clear()
            self._offset += height
            height = 0.0
            self._least = math.inf
        self.jitter_ns += (height - self.jitter_ns) / 64
        if height < self._least:
            self._least = height
            self._earliest = point
        if arrival_ns >= self._bucket_end:
            self._bucket_end = arrival_ns + BUCKET_NS
            self._close_bucket(self._earliest)
            self._least = math.inf

    def _close_bucket(self, earliest: tuple[float, float]) -> None:
        self._n_high = self._n_high + 1 if self._height(earliest) > STEP_NS else 0
        if self._n_high >= STEP_BUCKETS:
            self._n_high = 0
            self.resets += 1
            self._points.clear()
        self._points.append(earliest)
        points = sorted(self._points)
        if len(points) >= DRIFT_AFTER:
            self._drift = min(max(_middle_slope(points), -MAX_DRIFT), MAX_DRIFT)
        self._offset = min(d - self._drift * t for t, d in points)

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
