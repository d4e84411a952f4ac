"""A simulated hub: answers requests, takes samples and logs them.

Like the protocol code, it has no input, output or clock; its caller passes bytes and the time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

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
from .prepared_frames import PreparedFrame
from .sample_log import SampleRun

FIRMWARE = 0x00010000
"""Firmware version that a simulated hub reports."""

PERIOD_LIMITS_US = (100, 10_000_000)
"""Shortest and longest sample period in µs that a simulated hub accepts."""

_BUFFER_SIZE = 5000
"""Free buffer that a simulated hub reports in STATS, in bytes."""

_UINT32_MASK = 0xFFFFFFFF
"""Counters on the wire have 32 bits; those in the log do not wrap."""


@dataclass
class SimulatedHub:
    """The device side of the protocol. Simulated times are in µs.

    Attributes:
        uid: Uid that it reports in HELLO.
        cube_uids: Uids of its cubes that it reports in HELLO.
        n_pads: Number of pads of each cube.
        boot_us: Value of its clock at simulated time 0.
        period_us: Sample period.
        started: Whether it takes samples.
        next_us: Simulated time of the next sample.
        sequence: Number of the next sample since the last restart; it does not wrap.
        dropped: Number of samples since the last restart for which the line had no room.
        decoder: Decoder of the incoming requests.
        boots: Number of restarts.
        drift_ppm: Excess rate of its clock in ppm; this and all below are set by faults.
        version: Protocol version of its frames.
        false_uid: Uid that it reports instead of its own.
        extra_pads: Number of pads that it reports in addition to `n_pads`.
        celsius: Temperature in 0.01 °C.
        pad_fault: Bits (cubes,) of the pads that it reports as failed; None for no pads.
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
    _ended_runs: list[SampleRun] = field(default_factory=list)
    _run: SampleRun | None = None  # the newest run, as it began; `_last` is its last sample
    _last: int = 0
    _expected: tuple[int, int, int] | None = None  # time, period and boot of its next sample
    _prepared: dict[int, tuple[Millihertz, PreparedFrame]] = field(default_factory=dict)

    def hello(self) -> bytes:
        """Return the HELLO frame."""
        uid = self.uid if self.false_uid is None else self.false_uid
        n_pads = self.n_pads + self.extra_pads
        uids = np.array(self.cube_uids, "<u8")
        return encode(
            Hello(uid, FIRMWARE, n_pads, self.period_us, uids),
            self.version,
        )

    def stats(self, now_us: int) -> bytes:
        """Return the STATS frame."""
        uptime_ms = self._positive_device_us(now_us) // 1000
        sequence = self.sequence & _UINT32_MASK
        dropped = self.dropped & _UINT32_MASK
        return encode(Stats(uptime_ms, sequence, dropped, _BUFFER_SIZE), self.version)

    def device_us(self, now_us: int) -> int:
        """Return the value of the hub's clock."""
        gained = round(1e-6 * self.drift_ppm * (now_us - self._drift_since_us))
        return self.boot_us + now_us + gained

    def _positive_device_us(self, now_us: int) -> int:
        """Return the value of the hub's clock as it is sent: without a sign."""
        return max(0, self.device_us(now_us))

    def set_clock(
        self,
        now_us: int,
        step_us: int = 0,
        drift_ppm: float | None = None,
    ) -> None:
        """Set the clock forward, or change its rate from now on."""
        # Time gained so far becomes part of the offset, so that only a step changes the clock.
        self.boot_us = self.device_us(now_us) - now_us + step_us
        self.drift_ppm = self.drift_ppm if drift_ppm is None else drift_ppm
        self._drift_since_us = now_us

    def off(self) -> None:
        """Switch the power off."""
        self.started = False

    def reset(self, now_us: int, sequence: int) -> None:
        """Restart: sampling stopped, clock at 0, numbers from `sequence` on."""
        self.off()
        self.boots += 1
        self.boot_us = -now_us
        self._drift_since_us = now_us
        self.sequence = sequence
        self.dropped = 0
        self.decoder = PythonDecoder()

    def receive(self, data: bytes, now_us: int) -> bytes:
        """Return the answers to bytes from the host."""
        frames = self.decoder.feed(data)
        requests = [frame for frame in frames if isinstance(frame, Request)]
        return b"".join(self._answer(request, now_us) for request in requests)

    def prepare(self, frequency: Millihertz) -> None:
        """Encode a SAMPLE in advance, except for number, time and checksum.

        Args:
            frequency: Frequencies (cubes, pads) in mHz. `sample` uses the frame for the same
                object.
        """
        sample = self._build_sample(0, 0, frequency)
        self._prepared[id(frequency)] = frequency, PreparedFrame(sample)

    def sample(self, frequency: Millihertz) -> bytes:
        """Take the sample of `next_us`.

        Args:
            frequency: Frequencies (cubes, pads) in mHz.

        Returns:
            The SAMPLE frame.
        """
        self._log_sample()
        sequence = self.sequence & _UINT32_MASK
        device_us = self._positive_device_us(self.next_us)
        self.sequence += 1
        self.next_us += self.period_us

        _, prepared = self._prepared.get(id(frequency), (None, None))
        # Prepared frames have no temperature and no reported faults.
        is_plain = self.celsius == TEMPERATURE_UNKNOWN and self.pad_fault is None
        if prepared is not None and is_plain and self.version == VERSION:
            return prepared.encode(sequence, device_us)
        sample = self._build_sample(
            sequence,
            device_us,
            frequency,
            self.celsius,
            self.pad_fault,
        )
        return encode(sample, self.version)

    @staticmethod
    def _build_sample(
        sequence: int,
        device_us: int,
        frequency: Millihertz,
        celsius: int = TEMPERATURE_UNKNOWN,
        pad_fault: PadMasks | None = None,
    ) -> Sample:
        n = len(frequency)
        if pad_fault is None:
            pad_fault = np.zeros(n, "<u4")
        temperature = np.full(n, celsius, "<i2")
        return Sample(sequence, 0, device_us, frequency, pad_fault, temperature)

    @property
    def runs(self) -> list[SampleRun]:
        """All samples that were taken, in the order of time."""
        if self._run is None:
            return []
        return [*self._ended_runs, replace(self._run, last=self._last)]

    def _log_sample(self) -> None:
        """Continue the run with the sample of `next_us`, or begin a new run."""
        # A run ends where samples were skipped, the period changed or the hub restarted.
        if (self.next_us, self.period_us, self.boots) != self._expected:
            self._ended_runs = self.runs
            self._run = SampleRun(
                first=self.sequence,
                last=self.sequence,
                start_us=self.next_us,
                period_us=self.period_us,
                boot=self.boots,
            )
        self._last = self.sequence
        self._expected = self.next_us + self.period_us, self.period_us, self.boots

    def skip(self, now_us: int) -> None:
        """Schedule the next sample after now; samples that are due are never taken.

        Samples fall on whole multiples of the period, so that hubs sample together.
        """
        self.next_us = (now_us // self.period_us + 1) * self.period_us

    def _answer(self, request: Request, now_us: int) -> bytes:
        """Carry out a request and return the answer."""
        result = Result.DONE
        argument = 0
        match request.request:
            case Command.HELLO:
                return encode(Ack(request.request), self.version) + self.hello()
            case Command.TIME:
                device_us = self._positive_device_us(now_us)
                return encode(Time(request.argument, device_us), self.version)
            case Command.START:
                # A second START must not shift the samples.
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
