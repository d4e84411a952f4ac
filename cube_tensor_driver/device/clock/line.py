"""The straight line from one hub's clock to the host's, bounded by round trips.

    arrival = device time + offset + drift * device time + delay

The delay of a sample (buffers, USB polling, the scheduler) is never negative, so the line that
touches the points (device time, arrival) from below is the clock, and the height of a point above
it is its delay. Only the earliest point of each second is kept. The line is the edge of the lower
convex hull of these points over their mean device time: of all lines below the points it has the
smallest mean distance to them (Moon, Skelly, Towsley, "Estimation and removal of clock skew from
network delay measurements", INFOCOM 1999).

Arrivals alone cannot separate the smallest delay from the offset. A question and its answer can,
because the hub read its clock between them: each round trip bounds the offset from both sides (F.
Cristian, "Probabilistic clock synchronization", Distributed Computing 3, 1989). All bounds hold at
once. The centre between the highest lower bound and the lowest upper bound is right if the line is
as slow in both directions, and never wrong by more than half their distance.
"""

from __future__ import annotations

import math
from collections import deque
from itertools import pairwise
from typing import NamedTuple

BUCKET_NS = 1_000_000_000
"""Length, in ns, of the intervals (buckets) of each of which the earliest point is kept."""
MAX_BUCKETS = 120
"""Number of buckets whose earliest point is kept; together they are two minutes."""
MIN_BUCKETS_FOR_DRIFT = 5
"""Number of buckets before the drift is estimated. Over a shorter time, a change of the delay
cannot be distinguished from drift."""
UNKNOWN_DRIFT = 1e-4
"""Bound of the relative drift of a hub's clock before it is estimated. Crystals are better than
that."""
MAX_DRIFT = 1e-3
"""Largest credible relative drift between two clocks. A steeper line comes from a pause of the
host."""
MAX_RISE_NS = 20e6
"""Height above the line, in ns. If all points of a bucket are higher, a clock was set. USB adapters
delay samples by up to 16 ms without that."""
MAX_FALL_NS = 4e6
"""Depth below the line, in ns. A point that is deeper shows that a clock was set, because no delay
is negative. Steps of 5 ms are found, with 1 ms for the error of the line itself."""
MIN_BUCKETS_HIGH = 2
"""Number of successive buckets above `MAX_RISE_NS` that show that a clock was set. A single one may
come from a pause of the host."""
JITTER_POINTS = 64
"""Number of points over which the jitter, the mean height above the line, is averaged."""
MAX_ROUND_TRIPS = 64
"""Number of round trips that are kept. With one per second they cover about one minute."""
MAX_COMMON_DELAY_NS = 1e9
"""Longest credible delay, in ns, that all samples have and the answers to TIME do not have. An
answer that requires a longer one contradicts the samples."""


class ClockRoundTrip(NamedTuple):
    """Bounds of the offset from one question for the hub's time.

    Attributes:
        device_ns: Device time in the answer.
        low_ns: Host time minus device time when the question was sent.
        high_ns: Host time minus device time when the answer came.
    """

    device_ns: float
    low_ns: float
    high_ns: float


class ClockLine:
    """The clock line of one hub, fitted in bounded memory and amortised constant time per point.

    All times are in ns since the first point.

    Attributes:
        drift: Slope of the line; positive if host time runs faster.
        offset: Arrival minus device time of the line below all points, at device time 0.
        bounded_offset: The same without the smallest delay, as far as round trips bound it.
        error_bound: Largest possible error of `bounded_offset`; None without round trips.
        jitter_ns: Mean height of the newest points above the line.
    """

    def __init__(self) -> None:
        self.drift = 0.0
        self.jitter_ns = 0.0
        self.restart()

    def restart(self) -> None:
        """Discard all points and round trips. The drift is kept as a first guess."""
        self.offset = self.bounded_offset = 0.0
        self.error_bound: float | None = None
        self._bucket_end = BUCKET_NS
        self._bucket_height = self._previous_height = math.inf
        self._earliest = (0.0, 0.0)
        self._points: deque[tuple[float, float]] = deque(maxlen=MAX_BUCKETS)
        self._round_trips: deque[ClockRoundTrip] = deque(maxlen=MAX_ROUND_TRIPS)
        self._trip_offset = math.inf
        self._fall = 0.0
        self._n_high = 0

    def __len__(self) -> int:
        """Return the number of points kept, one for each full bucket."""
        return len(self._points)

    @property
    def recent_min_height(self) -> float:
        """Smallest height of a point in this and the previous bucket; 0 if there is no point."""
        height = min(self._bucket_height, self._previous_height)
        return height if math.isfinite(height) else 0.0

    def height(self, device_ns: float, arrival_ns: float) -> float:
        """Return the height of a point above the line, which is its delay."""
        return arrival_ns - device_ns - self.offset - self.drift * device_ns

    def add(self, device_ns: float, arrival_ns: int) -> bool:
        """Add a point: lower the line if the point is below it, and fit it after each bucket.

        Returns:
            Whether the point shows that one of the clocks was set.
        """
        height = self.height(device_ns, arrival_ns)
        was_set = False
        if height < 0:
            was_set = self._lower(height)
            height = 0.0
        self.jitter_ns += (height - self.jitter_ns) / JITTER_POINTS
        if height < self._bucket_height:
            self._bucket_height = height
            self._earliest = (device_ns, arrival_ns - device_ns)
        if arrival_ns >= self._bucket_end:
            was_set = self._fit(arrival_ns) or was_set
        return was_set

    def add_round_trip(self, trip: ClockRoundTrip) -> bool:
        """Bound the offset by a round trip.

        Returns:
            Whether the answer is consistent with the samples; otherwise it is not used.
        """
        line = self.offset + self.drift * trip.device_ns
        if trip.low_ns > line + MAX_FALL_NS or trip.high_ns < line - MAX_COMMON_DELAY_NS:
            return False
        self._round_trips.append(trip)
        self._intersect_bounds()
        return True

    def discard_round_trips_after(self, arrival_ns: float) -> None:
        """Discard the round trips whose answer came after `arrival_ns`."""
        trips = self._round_trips
        while trips and trips[-1].device_ns + trips[-1].high_ns > arrival_ns:
            trips.pop()
        self._intersect_bounds()

    def _lower(self, height: float) -> bool:
        """Lower the line to a point at a negative height; return whether a clock was set."""
        # In the first bucket the line falls because the smallest delay is not known yet.
        self._fall -= height if self._points else 0.0
        was_set = self._fall > MAX_FALL_NS or -height > MAX_RISE_NS
        if was_set:
            self._fall = 0.0
            self._points.clear()
        self.offset += height
        self._bucket_height = math.inf
        self._set_bounded_offset()
        return was_set

    def _fit(self, arrival_ns: int) -> bool:
        """Fit the line to the earliest points of all buckets, and begin the next bucket.

        Returns:
            Whether a clock was set some buckets ago.
        """
        device_ns, delay = self._earliest
        height = delay - self.offset - self.drift * device_ns
        self._n_high = self._n_high + 1 if height > MAX_RISE_NS else 0
        was_set = self._n_high >= MIN_BUCKETS_HIGH
        if was_set:
            self._n_high = 0
            self._points.clear()
        self._points.append(self._earliest)

        points = sorted(self._points)
        if len(points) >= MIN_BUCKETS_FOR_DRIFT:
            slope = _slope_at_centre(points)
            self.drift = min(max(slope, -MAX_DRIFT), MAX_DRIFT)
        # The line must not lie above any point, not even where the slope was limited.
        self.offset = min(delay - self.drift * device_ns for device_ns, delay in points)
        self._bucket_end = arrival_ns + BUCKET_NS
        self._fall = 0.0
        self._previous_height, self._bucket_height = self._bucket_height, math.inf
        self._intersect_bounds()
        return was_set

    def _drift_error(self) -> float:
        """Return the largest error that the estimated drift may have."""
        if len(self._points) < MIN_BUCKETS_FOR_DRIFT:
            return UNKNOWN_DRIFT
        first, _ = self._points[0]
        last, _ = self._points[-1]
        if last <= first:
            return UNKNOWN_DRIFT
        return min(UNKNOWN_DRIFT, self.jitter_ns / (last - first))

    def _intersect_bounds(self) -> None:
        """Find the offset within the bounds of all recent round trips, and its largest error."""
        self._trip_offset, self.error_bound = math.inf, None
        low, high = -math.inf, math.inf
        drift_error = self._drift_error()
        for trip in reversed(self._round_trips):
            drifted = self.drift * trip.device_ns
            # The error of the drift widens the bounds of round trips that are long ago.
            age = abs(self._round_trips[-1].device_ns - trip.device_ns)
            tolerance = drift_error * age
            next_low = max(low, trip.low_ns - drifted - tolerance)
            next_high = min(high, trip.high_ns - drifted + tolerance)
            if next_low > next_high:
                break  # A clock was set between the round trips: the earlier ones are invalid.
            low, high = next_low, next_high
            self._trip_offset = (low + high) / 2
            self.error_bound = (high - low) / 2
        self._set_bounded_offset()

    def _set_bounded_offset(self) -> None:
        """Use the offset of the round trips, unless a delay would then be negative."""
        self.bounded_offset = min(self.offset, self._trip_offset)


def _slope_at_centre(points: list[tuple[float, float]]) -> float:
    """Return the slope of the lower convex hull at the mean x of at least two sorted points."""
    hull: list[tuple[float, float]] = []
    for x, y in points:
        while len(hull) > 1:
            (x0, y0), (x1, y1) = hull[-2:]
            turns_left = (x1 - x0) * (y - y0) > (x - x0) * (y1 - y0)
            if turns_left:
                break  # The last point lies below the line to the new one.
            hull.pop()
        hull.append((x, y))
    centre = sum(x for x, _ in points) / len(points)
    for (x0, y0), (x1, y1) in pairwise(hull):
        if x1 >= centre and x1 > x0:
            return (y1 - y0) / (x1 - x0)
    return 0.0
