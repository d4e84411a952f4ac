"""Device time to host time: the line below all (device time, arrival) points.

Arrival is device time plus offset plus drift plus a delay, and delay only ever adds: buffers, USB
polling, the scheduler. So the line that touches the points from below is the clock, and what lies
above it is delay. Points are thinned to the earliest per bucket of one second; of their lower
convex hull the edge over the middle is the line below all points that is nearest to them in the
mean (Moon, Skelly, Towsley, "Estimation and removal of clock skew from network delay measurements",
INFOCOM 1999). The part of the delay that is always there cannot be told from the offset: stamps are
late by it.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from itertools import pairwise

BUCKET_NS = 1_000_000_000
WINDOW = 120
"""Buckets kept: two minutes."""
DRIFT_AFTER = 5
"""Buckets before drift is estimated: over less, delay looks like drift."""
MAX_DRIFT = 1e-3
"""No two clocks differ by more; a steeper line is a stall."""
STEP_NS = 20e6
"""Longer than a 16 ms USB burst: a line wrong by more is not delay, one of the clocks was set …"""
STEP_BUCKETS = 2
"""… provided it lasts so many buckets, where a stall would look the same at first."""
_NEVER = -(2**63)
RESTART_US = 1_000_000
"""Device time that falls back by more is a hub that restarted; less is a sample out of order."""


class ClockMap:
    """Maps one hub's clock to the host's. Bounded memory; amortised constant time per sample.

    Read-only: offset_ns, host minus device time at the newest sample, 0 before the first;
    drift_ppm, positive when host time runs faster than the hub's, 0 until known; jitter_ns, mean
    delay above the line (over the last 64 calls or so); resets, how often the map began anew.
    """

    _fresh: bool
    _first_us: int
    _first_ns: int
    _newest: int  # device time, ns since the first
    # The line: (arrival − device), both since the first, = offset + drift · device, all in ns.
    _offset: float
    _points: deque[tuple[float, float]]
    _earliest: tuple[float, float]  # of the bucket being filled
    _least: float  # how far that is above the line; inf: the bucket is empty
    _bucket_end: int
    _high: int  # buckets in a row that lie wholly above the line by more than STEP_NS

    def __init__(self) -> None:
        self.jitter_ns = 0.0
        self.resets = 0
        self._drift = 0.0
        self._last_stamp = self._last_arrival = _NEVER
        self._begin()

    def reset(self) -> None:
        """The hub restarted: fit anew. Drift is kept as a first guess; stamps still do not go
        backward."""
        self.resets += 1
        self._begin()

    @property
    def drift_ppm(self) -> float:
        return 1e6 * self._drift

    @property
    def offset_ns(self) -> int:
        if self._fresh:
            return 0
        return (
            self._first_ns
            - 1000 * self._first_us
            + round(self._offset + self._drift * self._newest)
        )

    def update(self, device_us: Sequence[int], arrival_ns: int) -> list[int]:
        """Host times, ns, of samples taken at device_us, µs, that arrived together at arrival_ns.

        Along device time stamps never go backward, and none is later than its arrival. Begins anew
        by itself when device time falls back by over 1 s or either clock was set; only a host clock
        set back makes stamps go backward.
        """
        for k in range(1, len(device_us)):
            if device_us[k] < device_us[k - 1] - RESTART_US:
                return self.update(device_us[:k], arrival_ns) + self.update(
                    device_us[k:], arrival_ns
                )
        return self._stamps(device_us, arrival_ns) if device_us else []

    def _stamps(self, times: Sequence[int], arrival_ns: int) -> list[int]:
        if arrival_ns < self._last_arrival:
            self._last_stamp = _NEVER
            self.reset()
        self._last_arrival = arrival_ns
        # Of samples that arrive together the newest waited least: it alone can touch the line.
        newest = max(times)
        if not self._fresh and 1000 * (newest - self._first_us + RESTART_US) < self._newest:
            self.reset()
        if self._fresh:
            self._fresh = False
            self._first_us, self._first_ns = newest, arrival_ns
            self._bucket_end = arrival_ns + BUCKET_NS
        self._take(1000.0 * (newest - self._first_us), arrival_ns)
        stamps = []
        for time in times:
            since = 1000 * (time - self._first_us)
            stamp = min(
                self._first_ns + since + round(self._offset + self._drift * since), arrival_ns
            )
            if since > self._newest:
                stamp = max(stamp, self._last_stamp)
                self._newest, self._last_stamp = since, stamp
            else:
                stamp = min(stamp, self._last_stamp)
            stamps.append(stamp)
        return stamps

    def _begin(self) -> None:
        self._fresh = True
        self._first_us = self._first_ns = self._bucket_end = self._high = 0
        self._newest = _NEVER
        self._offset = 0.0
        self._points = deque(maxlen=WINDOW)
        self._least = math.inf

    def _take(self, t: float, arrival_ns: int) -> None:
        """One point, t ns of device time since the first: lower the line to it, close the bucket
        when full."""
        delay = arrival_ns - self._first_ns - t
        above = delay - self._offset - self._drift * t
        if above < 0:
            if above < -STEP_NS:
                self.resets += 1
                self._points.clear()
            self._offset += above
            above, self._least = 0.0, math.inf
        self.jitter_ns += (above - self.jitter_ns) / 64
        if above < self._least:
            self._least, self._earliest = above, (t, delay)
        if arrival_ns >= self._bucket_end:
            self._bucket_end = arrival_ns + BUCKET_NS
            self._close_bucket(self._earliest)
            self._least = math.inf

    def _close_bucket(self, earliest: tuple[float, float]) -> None:
        self._high = self._high + 1 if self._above(earliest) > STEP_NS else 0
        if self._high >= STEP_BUCKETS:
            self._high = 0
            self.resets += 1
            self._points.clear()
        self._points.append(earliest)
        points = sorted(self._points)
        if len(points) >= DRIFT_AFTER:
            self._drift = min(max(_middle_slope(points), -MAX_DRIFT), MAX_DRIFT)
        self._offset = min(d - self._drift * t for t, d in points)

    def _above(self, point: tuple[float, float]) -> float:
        return point[1] - self._offset - self._drift * point[0]


def _middle_slope(points: list[tuple[float, float]]) -> float:
    """Slope of the lower convex hull's edge over the mean abscissa; points (x, y) sorted, at least
    two."""
    hull: list[tuple[float, float]] = []
    for x, y in points:
        while len(hull) > 1 and (hull[-1][0] - hull[-2][0]) * (y - hull[-2][1]) <= (
            x - hull[-2][0]
        ) * (hull[-1][1] - hull[-2][1]):
            hull.pop()
        hull.append((x, y))
    middle = sum(x for x, _ in points) / len(points)
    for (x0, y0), (x1, y1) in pairwise(hull):
        if x1 >= middle and x1 > x0:
            return (y1 - y0) / (x1 - x0)
    return 0.0
