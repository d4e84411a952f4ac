"""A simulated hub: answers requests, takes samples, keeps its book. No I/O and no clock, as on the wire so here."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..device.protocol import TEMPERATURE_UNKNOWN, Ack, Command, Decoder, Hello, Request, Result, Sample, Stats, encode

FIRMWARE = 0x00010000
PERIOD_LIMITS_US = (100, 10_000_000)


@dataclass
class Run:
    """Samples first … last (from power-up) were taken at start_us, start_us + period_us, … of simulated time."""

    first: int
    last: int
    start_us: int
    period_us: int


@dataclass
class SimulatedHub:
    """The device side of the protocol.

    boot_us: what the hub's clock shows at simulated time 0; period_us: sample period; next_us: simulated time of the
    next sample; runs: the book of what was sampled; dropped: samples taken that found no room on the line.
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
    runs: list[Run] = field(default_factory=list)
    decoder: Decoder = field(default_factory=Decoder)

    def hello(self) -> bytes:
        """Bytes of the HELLO frame."""
        return encode(Hello(self.uid, FIRMWARE, self.n_pads, self.period_us, np.array(self.cube_uids, "<u8")))

    def stats(self, uptime_ms: int) -> bytes:
        """Bytes of the STATS frame."""
        return encode(Stats(uptime_ms, self.sequence & 0xFFFFFFFF, self.dropped & 0xFFFFFFFF, 5000))

    def receive(self, data: bytes, now_us: int) -> bytes:
        """What the hub answers to bytes that the host sends at simulated time now_us."""
        answers = [self._answer(frame, now_us) for frame in self.decoder.feed(data) if isinstance(frame, Request)]
        return b"".join(answers)

    def sample(self, frequency: NDArray[np.uint32]) -> bytes:
        """Take the sample of next_us: bytes of its SAMPLE frame. frequency: (cubes, pads) in mHz."""
        run = self.runs[-1] if self.runs else None
        if (
            run
            and run.period_us == self.period_us
            and self.next_us == run.start_us + (run.last + 1 - run.first) * run.period_us
        ):
            run.last = self.sequence
        else:
            self.runs.append(Run(self.sequence, self.sequence, self.next_us, self.period_us))
        n = len(frequency)
        unknown = np.full(n, TEMPERATURE_UNKNOWN, "<i2")
        device_us = self.boot_us + self.next_us
        frame = Sample(self.sequence & 0xFFFFFFFF, 0, device_us, frequency, np.zeros(n, "<u4"), unknown)
        self.sequence += 1
        self.next_us += self.period_us
        return encode(frame)

    def _schedule(self, now_us: int) -> None:
        """Samples fall on whole multiples of the period, so that hubs sample together."""
        self.next_us = (now_us // self.period_us + 1) * self.period_us

    def _answer(self, request: Request, now_us: int) -> bytes:
        result, argument = Result.DONE, 0
        if request.request == Command.HELLO:
            return encode(Ack(request.request)) + self.hello()
        if request.request == Command.START:
            self.started = True
            self._schedule(now_us)
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
        elif request.request != Command.IDENTIFY:
            result = Result.UNKNOWN
        return encode(Ack(request.request, result, argument))
