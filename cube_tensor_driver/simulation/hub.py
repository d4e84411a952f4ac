"""A simulated hub: answers requests, takes samples and logs them. Like the protocol code it has no
I/O and no clock: its caller says what time it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

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
from .prepared_frames import PreparedFrame
from .sample_log import SampleRun

FIRMWARE = 0x00010000
PERIOD_LIMITS_US = (100, 10_000_000)


@dataclass
class SimulatedHub:
    """The device side of the protocol.

    uid, cube_uids, n_pads: what it says in HELLO
    boot_us: what its clock shows at simulated time 0
    period_us: sample period
    started: whether it takes samples
    next_us: simulated time of the next sample
    sequence: number of the next sample since the last restart, counted on beyond 2^32
    dropped: samples that found no room on the line since the last restart
    decoder: of the requests that come in
    boots: restarts so far

    Set by faults:

    drift_ppm: how much too fast its clock runs
    version: protocol version of its frames
    false_uid: what it says instead of its uid
    extra_pads: pads that it says it has beyond n_pads
    celsius: temperature in 0.01 °C
    pad_fault: (cubes,) bit p: it reports that pad p has failed; None: it reports none
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
    pad_fault: NDArray[np.uint32] | None = None
    _drift_since_us: int = 0
    _ended_runs: list[SampleRun] = field(default_factory=list)
    _run: SampleRun | None = None  # the newest, as it began; _last: its last sample
    _last: int = 0
    _expected: tuple[int, int, int] | None = None  # time, period and boot of its next sample
    _prepared: dict[int, tuple[NDArray[np.uint32], PreparedFrame]] = field(default_factory=dict)

    def hello(self) -> bytes:
        """Bytes of the HELLO frame."""
        uid = self.uid if self.false_uid is None else self.false_uid
        pads, uids = self.n_pads + self.extra_pads, np.array(self.cube_uids, "<u8")
        return encode(Hello(uid, FIRMWARE, pads, self.period_us, uids), self.version)

    def stats(self, now_us: int) -> bytes:
        """Bytes of the STATS frame at simulated time now_us."""
        uptime_ms = max(0, self.device_us(now_us)) // 1000
        frame = Stats(uptime_ms, self.sequence & 0xFFFFFFFF, self.dropped & 0xFFFFFFFF, 5000)
        return encode(frame, self.version)

    def device_us(self, now_us: int) -> int:
        """What the hub's clock shows at simulated time now_us."""
        return (
            self.boot_us + now_us + round(1e-6 * self.drift_ppm * (now_us - self._drift_since_us))
        )

    def set_clock(self, now_us: int, step_us: int = 0, drift_ppm: float | None = None) -> None:
        """Set the clock forward, or give it another rate from now on."""
        self.boot_us = self.device_us(now_us) - now_us + step_us
        self.drift_ppm = self.drift_ppm if drift_ppm is None else drift_ppm
        self._drift_since_us = now_us

    def off(self) -> None:
        """The power is gone."""
        self.started = False

    def reset(self, now_us: int, sequence: int) -> None:
        """Restart: stopped, clock at 0, counting from `sequence`."""
        self.off()
        self.boots += 1
        self.boot_us, self._drift_since_us = -now_us, now_us
        self.sequence, self.dropped = sequence, 0
        self.decoder = PythonDecoder()

    def receive(self, data: bytes, now_us: int) -> bytes:
        """What the hub answers to bytes that the host sends at simulated time now_us."""
        answers = [
            self._answer(frame, now_us)
            for frame in self.decoder.feed(data)
            if isinstance(frame, Request)
        ]
        return b"".join(answers)

    def prepare(self, frequency: NDArray[np.uint32]) -> None:
        """Encode now what will be the same in every SAMPLE of this very array of frequencies."""
        sample = self._sample(0, 0, frequency)
        self._prepared[id(frequency)] = frequency, PreparedFrame(sample)

    def sample(self, frequency: NDArray[np.uint32]) -> bytes:
        """Take the sample of next_us: bytes of its SAMPLE frame. frequency: (cubes, pads) in
        mHz."""
        self._log()
        sequence, device_us = self.sequence & 0xFFFFFFFF, max(0, self.device_us(self.next_us))
        self.sequence += 1
        self.next_us += self.period_us
        _, prepared = self._prepared.get(id(frequency), (None, None))
        is_plain = self.celsius == TEMPERATURE_UNKNOWN and self.pad_fault is None
        if prepared is not None and is_plain and self.version == VERSION:
            return prepared.encode(sequence, device_us)
        sample = self._sample(sequence, device_us, frequency, self.celsius, self.pad_fault)
        return encode(sample, self.version)

    @staticmethod
    def _sample(
        sequence: int,
        device_us: int,
        frequency: NDArray[np.uint32],
        celsius: int = TEMPERATURE_UNKNOWN,
        pad_fault: NDArray[np.uint32] | None = None,
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

    def _log(self) -> None:
        """The sample of next_us goes on with the run or begins a new one."""
        if (self.next_us, self.period_us, self.boots) != self._expected:
            self._ended_runs = self.runs
            self._run = SampleRun(
                self.sequence, self.sequence, self.next_us, self.period_us, self.boots
            )
        self._last = self.sequence
        self._expected = self.next_us + self.period_us, self.period_us, self.boots

    def skip(self, now_us: int) -> None:
        """Take the next sample after now_us; those before are never taken."""
        self._schedule(now_us)

    def _schedule(self, now_us: int) -> None:
        """Samples fall on whole multiples of the period, so that hubs sample together."""
        self.next_us = (now_us // self.period_us + 1) * self.period_us

    def _answer(self, request: Request, now_us: int) -> bytes:
        result, argument = Result.DONE, 0
        if request.request == Command.HELLO:
            return encode(Ack(request.request), self.version) + self.hello()
        if request.request == Command.START:
            if not self.started:
                self._schedule(now_us)
            self.started = True
        elif request.request == Command.STOP:
            self.started = False
        elif request.request == Command.SET_PERIOD:
            low, high = PERIOD_LIMITS_US
            if low <= request.argument <= high:
                self.period_us = request.argument
                self._schedule(now_us)
            else:
                result = Result.REFUSED
            argument = self.period_us
        elif request.request == Command.TIME:
            return encode(Time(request.argument, max(0, self.device_us(now_us))), self.version)
        elif request.request != Command.IDENTIFY:
            result = Result.UNKNOWN
        return encode(Ack(request.request, result, argument), self.version)
