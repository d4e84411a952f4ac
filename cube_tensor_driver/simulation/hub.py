# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""A simulated hub: it answers requests of the host, takes samples and logs them.

Like the protocol code, this code reads no port and no clock: its caller passes bytes and the time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ..core.arrays import PadMasks
from ..device.wire.decoder import PythonDecoder
from ..device.wire.protocol import (
    TEMPERATURE_UNKNOWN,
    VERSION,
    Ack,
    Command,
    Hello,
    Request,
    Result,
    Sample,
    Stats,
    Time,
    encode,
)
from .cubes import Millihertz
from .sample_log import SampleRun

FIRMWARE = 0x00010000
"""Firmware version that a simulated hub reports in HELLO (message that describes the hub)."""

PERIOD_LIMITS_US = (100, 10_000_000)
"""Shortest and longest sample period in µs that a simulated hub accepts."""

_SUPPLY_MV = 5000
"""Supply voltage, in mV, that a simulated hub reports in STATS (frame with the hub's counters)."""

_UINT32_MASK = 0xFFFFFFFF
"""Mask of the lowest 32 bits of a counter. Counters in the frames (messages of a hub) have 32 bits
and wrap around; those of the simulation do not."""


@dataclass(kw_only=True)
class SimulatedHub:
    """A hub (device that samples the pads of some cubes and sends their frequencies to the host).

    It sends frames of bytes: HELLO with a description of the hub, SAMPLE with the frequencies of
    all pads, STATS with counters, and answers to requests. Simulated times are in µs.

    The attributes from `drift_ppm` on are changed by faults.

    Attributes:
        uid: Unique number of the hub, which HELLO contains.
        cube_uids: Unique numbers of its cubes, which HELLO contains.
        n_pads: Number of pads of each cube.
        boot_us: Value of the hub's clock at simulated time 0, in µs.
        period_us: Time between two samples in µs.
        started: Whether the hub takes samples.
        next_us: Simulated time of the next sample in µs.
        sequence: Number of the next sample since the last restart; it does not wrap at 2^32.
        dropped: Number of samples since the last restart for which the line had no room.
        decoder: Decoder of the incoming requests.
        boots: Number of restarts.
        drift_ppm: Excess rate of the hub's clock over simulated time, in ppm.
        version: Protocol version of the hub's frames.
        false_uid: Unique number that HELLO contains instead of `uid`; None: `uid`.
        extra_pads: Number of pads that HELLO contains in addition to `n_pads`.
        celsius: Temperature that the SAMPLE frames contain, in units of 0.01 °C.
        pad_fault: Bit masks (cubes,) of the pads that the hub reports as failed; None for no pads.
        runs: All samples taken so far, as runs (samples at equal intervals) in the order of time.
    """

    uid: int
    cube_uids: Sequence[int]
    n_pads: int
    boot_us: int = 0
    period_us: int = 10_000
    started: bool = False
    next_us: int = 0
    sequence: int = 0
    dropped: int = 0
    decoder: PythonDecoder = field(default_factory=PythonDecoder)
    boots: int = 0
    drift_ppm: float = 0.0
    version: int = VERSION
    false_uid: int | None = None
    extra_pads: int = 0
    celsius: int = TEMPERATURE_UNKNOWN
    pad_fault: PadMasks | None = None
    _drift_since_us: int = 0
    runs: list[SampleRun] = field(default_factory=list)

    def make_hello(self) -> bytes:
        """Return the HELLO frame, the description of the hub and its cubes."""
        uid = self.uid if self.false_uid is None else self.false_uid
        n_pads = self.n_pads + self.extra_pads
        uids = np.array(self.cube_uids, "<u8")
        return encode(
            Hello(
                uid,
                FIRMWARE,
                n_pads,
                self.period_us,
                uids,
            ),
            self.version,
        )

    def make_stats(self, now_us: int) -> bytes:
        """Return the STATS frame, the hub's counters, at simulated time `now_us`."""
        uptime_ms = self._compute_positive_device_us(now_us) // 1000
        sequence = self.sequence & _UINT32_MASK
        dropped = self.dropped & _UINT32_MASK
        return encode(Stats(uptime_ms, sequence, dropped, _SUPPLY_MV), self.version)

    def read_device_us(self, now_us: int) -> int:
        """Return the value of the hub's clock in µs at simulated time `now_us`."""
        gained = round(1e-6 * self.drift_ppm * (now_us - self._drift_since_us))
        return self.boot_us + now_us + gained

    def _compute_positive_device_us(self, now_us: int) -> int:
        """Return the value of the hub's clock in µs, or 0 if that is negative.

        A clock that the fault `step` has set back can be negative, but times in frames have no
        sign.
        """
        return max(0, self.read_device_us(now_us))

    def set_clock(
        self,
        now_us: int,
        step_us: int = 0,
        drift_ppm: float | None = None,
    ) -> None:
        """Set the clock of the hub forward, or change its rate relative to simulated time.

        Args:
            now_us: Simulated time in µs.
            step_us: Time in µs by which the clock is set forward.
            drift_ppm: New excess rate of the clock in ppm; None: the rate does not change.
        """
        # The time that the clock has gained so far by its rate becomes part of its offset. So a new
        # rate does not change the clock's present value.
        self.boot_us = self.read_device_us(now_us) - now_us + step_us
        self.drift_ppm = self.drift_ppm if drift_ppm is None else drift_ppm
        self._drift_since_us = now_us

    def reset(self, now_us: int, sequence: int) -> None:
        """Restart the hub: it stops sampling, and its clock starts again at 0.

        Args:
            now_us: Simulated time in µs.
            sequence: Number of the next sample.
        """
        self.started = False
        self.boots += 1
        self.boot_us = -now_us
        self._drift_since_us = now_us
        self.sequence = sequence
        self.dropped = 0
        self.decoder = PythonDecoder()

    def receive(self, data: bytes, now_us: int) -> bytes:
        """Carry out the requests of the host.

        Args:
            data: Bytes from the host, which may end within a request.
            now_us: Simulated time in µs.

        Returns:
            Frames with the answers, empty if there are none.
        """
        frames = self.decoder.feed(data)
        requests = [frame for frame in frames if isinstance(frame, Request)]
        return b"".join(self._answer(request, now_us) for request in requests)

    def is_due(self, now_us: int) -> bool:
        """Return whether the hub takes samples and the next one is due at the time `now_us`."""
        return self.started and self.next_us <= now_us

    def sample(self, frequency: Millihertz) -> bytes:
        """Take the sample that is due at `next_us`, log it and schedule the next one.

        Args:
            frequency: Frequencies (cubes, pads) in mHz.

        Returns:
            The SAMPLE frame (message with one sample of all pads).
        """
        # A run of the log ends when samples are skipped or get other numbers, the period changes,
        # or the hub restarts.
        begin = SampleRun(
            self.sequence,
            self.sequence,
            self.next_us,
            self.period_us,
            self.boots,
        )
        if self.runs and self.runs[-1].is_followed_by(begin):
            self.runs[-1].last = self.sequence
        else:
            self.runs.append(begin)
        sequence = self.sequence & _UINT32_MASK
        device_us = self._compute_positive_device_us(self.next_us)
        self.sequence += 1
        self.next_us += self.period_us

        n = len(frequency)
        pad_fault = np.zeros(n, "<u4") if self.pad_fault is None else self.pad_fault
        temperature = np.full(n, self.celsius, "<i2")
        sample = Sample(
            sequence,
            0,
            device_us,
            frequency,
            pad_fault,
            temperature,
        )
        return encode(sample, self.version)

    def skip(self, now_us: int) -> None:
        """Schedule the next sample after simulated time `now_us`; earlier samples are left out.

        Simulated times of samples are whole multiples of the period, so that all hubs of a skin
        sample at the same times.
        """
        self.next_us = (now_us // self.period_us + 1) * self.period_us

    def _answer(self, request: Request, now_us: int) -> bytes:
        """Carry out a request of the host and return the frames of the answer."""
        result = Result.DONE
        argument = 0
        match request.request:
            case Command.HELLO:
                ack = encode(Ack(request.request), self.version)
                return ack + self.make_hello()
            case Command.TIME:
                device_us = self._compute_positive_device_us(now_us)
                return encode(Time(request.argument, device_us), self.version)
            case Command.START:
                # If the hub takes samples already, another START request must not change the times
                # at which it takes them.
                if not self.started:
                    self.skip(now_us)
                self.started = True
            case Command.STOP:
                self.started = False
            case Command.SET_PERIOD:
                low, high = PERIOD_LIMITS_US
                if low <= request.argument <= high:
                    self.period_us = request.argument
                    self.skip(now_us)
                else:
                    result = Result.REFUSED
                argument = self.period_us  # the period that holds now
            case Command.IDENTIFY:
                pass
            case _:
                result = Result.UNKNOWN
        return encode(Ack(request.request, result, argument), self.version)
