# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""State of one link that each of its samples changes: sample numbers, sample period, clock line.

The clock line is host time as a linear function of device time (the hub's clock). The module in C
(native/cube_track.c) handles usual samples and changes this state in place: samples with the next
number, all cubes of the hub, and a device time and a delay that fit the sample period and the line.
Python handles all others, for example those after lost samples or after a restart of the hub.
"""

from __future__ import annotations

from ctypes import Array, Structure, c_double, c_int64

MAX_DISORDER = 64
"""Number of newest samples of a hub whose numbers and times (hub's clock) are kept, to distinguish
late samples from repeated ones. An older sample counts as repeated, unless its number or time shows
that the hub has restarted."""
MAX_DEVICE_US = 1 << 51
"""Largest device time (time since power-up by a hub's clock), in µs, that is used: 71 years. Larger
ones, which only a faulty hub sends, are replaced by this one, so that differences of device times
in ns fit 64 bits."""
RESTART_US = 1_000_000
"""Smallest time, in µs of the hub's clock, by which a sample must be older than the newest one to
show that the hub has restarted. A sample that is older by less has only come out of order."""
NEVER = -(1 << 62)
"""Time, in ns, that is earlier than every device time (hub's clock) and every host time. The
time of a sample, such as the newest one, has this value as long as there is no such sample."""

_TYPES: dict[str, type[c_int64 | c_double | Array[Array[c_int64]]]] = {
    "int": c_int64,
    "bool": c_int64,
    "float": c_double,
    "list[list[int]]": c_int64 * 2 * MAX_DISORDER,
}
"""Annotation of a field of `LinkTrack` -> its type in C, which native/cube_track.h repeats."""


class LinkTrack(Structure):
    """Numbers and clock of the samples of one link, in memory that the module in C changes as well.

    Device time is the time of the hub's clock. The clock line is host time over device time. Unless
    stated otherwise, times in ns are counted from `first_us` (device) and `first_ns` (host).

    Attributes:
        is_native_allowed: Whether the module in C may count and stamp the next samples. The module
            clears this at a frame that it leaves to Python (for example after a lost sample), and
            Python sets it after handling the frame.
        n_native: Number of samples that the module in C has counted and stamped.
        n_cubes, n_pads: Shape of the samples that the module in C handles: all cubes of the hub.
        next: Number of the next sample, continued beyond 32 bits.
        newest_us: Device time of the newest sample, in µs.
        reference: Number (32 bits) of the sample from which device times are predicted; -1 if there
            is none.
        reference_us: Device time of the sample `reference`, in µs.
        first_us: Device time that is the origin of device times in ns.
        first_ns: Host time that is the origin of host times in ns.
        newest_ns: Newest device time, in ns; `NEVER` before the first sample.
        last_arrival_ns: Host time of the last arrival, in ns since the Unix epoch.
        last_stamp_ns: Last stamp (host time of sampling) that was given, in ns since the epoch.
        period_us: Estimated sample period, in µs; 0 if it is not known.
        offset: Arrival minus device time on the clock line at device time 0, in ns.
        bounded_offset: `offset` without the smallest delay, as far as this delay is known, in ns.
        drift: Slope of arrival minus device time over device time.
        jitter_ns: Mean height of the newest points above the clock line, in ns.
        bucket_end: Arrival time, in ns, at which the present second (bucket) ends.
        bucket_height: Smallest height above the line in this bucket, in ns; infinite if none.
        earliest_ns: Device time of the point with the height `bucket_height`, in ns.
        seen: Number and device time, in µs, of the newest samples; the place of number n is n % 64.
    """

    is_native_allowed: bool
    n_native: int
    n_cubes: int
    n_pads: int
    next: int
    newest_us: int
    reference: int
    reference_us: int
    first_us: int
    first_ns: int
    newest_ns: int
    last_arrival_ns: int
    last_stamp_ns: int
    period_us: float
    offset: float
    bounded_offset: float
    drift: float
    jitter_ns: float
    bucket_end: float
    bucket_height: float
    earliest_ns: float
    seen: list[list[int]]

    _fields_ = tuple((name, _TYPES[kind]) for name, kind in __annotations__.items())
