# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Hubs that are wrong in one way each, as firmware is, by the rules that they break; written from
docs/protocol.md, not from the rules of the check."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
from hub_in_memory import HubInMemory
from test_protocol import wire

from cube_tensor_driver.device.wire.decoder import Decoder
from cube_tensor_driver.device.wire.protocol import (
    Ack,
    Command,
    Frame,
    Hello,
    Request,
    Result,
    Sample,
    Stats,
    Time,
    encode,
)

Changed = Iterable[Frame | bytes]
FAULTY: dict[str, type[HubInMemory]] = {}
"""Rules that the check finds broken, and what is wrong -> hub."""


def faulty(what: str) -> Callable[[type[HubInMemory]], type[HubInMemory]]:
    def enter(kind: type[HubInMemory]) -> type[HubInMemory]:
        assert what not in FAULTY
        FAULTY[what] = kind
        return kind

    return enter


def sends(what: str, change: Callable[[HubInMemory, Frame], Changed]) -> None:
    """A hub whose frames are changed one by one on their way out."""

    def on_the_line(self: HubInMemory, data: bytes) -> bytes:
        out = b""
        for frame in Decoder().feed(data):
            for one in change(self, frame):
                out += one if isinstance(one, bytes) else encode(one)
        return out

    faulty(what)(type("SendsWrong", (HubInMemory,), {"on_the_line": on_the_line}))


def answers(what: str, change: Callable[[HubInMemory, Request, int, bytes], bytes]) -> None:
    """A hub that does something else at a request; `bytes` is the right answer."""

    def _answer(self: HubInMemory, request: Request, now_us: int) -> bytes:
        right = HubInMemory._answer(self, request, now_us)
        return change(self, request, now_us, right)

    faulty(what)(type("AnswersWrong", (HubInMemory,), {"_answer": _answer}))


def of(kind: type, change: Callable[..., Changed]) -> Callable[[HubInMemory, Frame], Changed]:
    return lambda hub, frame: change(hub, frame) if isinstance(frame, kind) else [frame]


def values(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[HubInMemory, Frame], Changed]:
    """Other frequencies."""
    return of(Sample, lambda hub, one: [rows(one, frequency=change(one.frequency).astype("<u4"))])


def rows(sample: Sample, **changes: object) -> Sample:
    names = ("sequence", "first_cube", "device_us", "frequency", "pad_fault", "temperature")
    return Sample(**{name: getattr(sample, name) for name in names} | changes)


def cubes(sample: Sample, begin: int, end: int, late_us: int = 0) -> Sample:
    return rows(
        sample,
        first_cube=begin,
        device_us=sample.device_us + late_us,
        frequency=sample.frequency[begin:end],
        pad_fault=sample.pad_fault[begin:end],
        temperature=sample.temperature[begin:end],
    )


def every(n: int) -> Callable[[HubInMemory], bool]:
    """True at every n-th call for a hub."""

    def is_due(hub: HubInMemory) -> bool:
        hub.calls = getattr(hub, "calls", 0) + 1
        return hub.calls % n == 0

    return is_due


# Frequencies.
sends("S6: frequencies in Hz", values(lambda f: f // 1000))
sends("S6: frequencies in 0.01 Hz", values(lambda f: f // 10_000))
sends("S6: big-endian frequencies", values(lambda f: (f // 1000).byteswap() & 0xFFFF))
sends("S6: not measured is 0xFFFFFFFF", values(lambda f: np.where(f[0] == f[0, 0], 2**32 - 1, f)))
sends(
    "S6: one pad not measured is 0xFFFFFFFF",
    values(lambda f: np.where(np.arange(f.shape[1]) == 2, 2**32 - 1, f)),
)
sends("S6: periods in ns", values(lambda f: 10**12 // f.astype(np.int64)))

# Cubes and pads of samples.
sends("S5: the last cube is never sent", of(Sample, lambda hub, one: [cubes(one, 0, 2)]))
sends("S5: the first cube is never sent", of(Sample, lambda hub, one: [cubes(one, 1, 3)]))
sends("S5: one cube of each sample", of(Sample, lambda hub, one: [cubes(one, 0, 1)]))
sends("S5: samples without cubes", of(Sample, lambda hub, one: [cubes(one, 0, 0)]))
sends(
    "S5: samples without pads",
    of(Sample, lambda hub, one: [rows(one, frequency=one.frequency[:, :0])]),
)
sends(
    "S5: fewer pads than HELLO says",
    of(Sample, lambda hub, one: [rows(one, frequency=one.frequency[:, :4])]),
)
sends("S5: cubes counted from 1", of(Sample, lambda hub, one: [rows(one, first_cube=1)]))
sends(
    "H4: a cube is missing now and then",
    of(Sample, lambda hub, one: [cubes(one, 0, 2 if one.sequence % 20 == 7 else 3)]),
)
for bits in (1 << 8, 1 << 31, 0xFFFFFFFF):
    sends(
        f"S5: faults of pads that do not exist: {bits:#x}",
        of(Sample, lambda hub, one, b=bits: [rows(one, pad_fault=one.pad_fault | np.uint32(b))]),
    )
sends(
    "S5: overlapping frames of a sample",
    of(Sample, lambda hub, one: [cubes(one, 0, 2), cubes(one, 1, 3)]),
)
sends(
    "S4: half samples, not counted",
    of(
        Sample,
        lambda hub, one: [cubes(one, 0, 2), *([cubes(one, 2, 3)] if one.sequence % 10 else [])],
    ),
)
sends(
    "S3: frames of a sample at two times",
    of(Sample, lambda hub, one: [cubes(one, 0, 2), cubes(one, 2, 3, 40)]),
)
sends(
    "S3: frames of a sample split anywhere",
    of(
        Sample,
        lambda hub, one: [
            cubes(one, 0, 1 + one.sequence % 2),
            cubes(one, 1 + one.sequence % 2, 3),
        ],
    ),
)
sends(
    "L5 H4 S2 S3 S4 S7 R3 R7: the second frame has the next number",
    of(
        Sample,
        lambda hub, one: [
            rows(cubes(one, 0, 2), sequence=2 * one.sequence),
            rows(cubes(one, 2, 3), sequence=2 * one.sequence + 1),
        ],
    ),
)

# Numbers.
sends(
    "L5 S4 S7 R3 R7: numbers in steps of two",
    of(Sample, lambda hub, one: [rows(one, sequence=2 * one.sequence)]),
)
sends(
    "S1 S4 S7: numbers of 6 bits",
    of(Sample, lambda hub, one: [rows(one, sequence=one.sequence % 64)]),
)
sends("S1: each sample twice", of(Sample, lambda hub, one: [one, one]))
sends("S1: one sample twice", of(Sample, lambda hub, one: [one] * (1 + (one.sequence == 100))))
sends(
    "S4: one of 50 samples is lost in silence",
    of(Sample, lambda hub, one: [one] * (one.sequence % 50 != 9)),
)


def swapped(hub: HubInMemory, frame: Frame) -> Changed:
    if not isinstance(frame, Sample):
        return [frame]
    held = getattr(hub, "held", None)
    if held is not None:
        hub.held = None
        return [frame, held]
    if frame.sequence % 40 == 5:
        hub.held = frame
        return []
    return [frame]


sends("S1: two samples exchanged", swapped)


@faulty("S1: numbers from 0 at each START")
class CountsFromStart(HubInMemory):
    def _answer(self, request, now_us):
        if request.request == Command.START and not self.started:
            self.sequence = 0
        return super()._answer(request, now_us)


@faulty("L5: numbers back to 0 after reopening")
class CountsFromOpening(HubInMemory):
    def host_left(self):
        self.sequence = 0


@faulty("L5: numbers and dropped back to 0 after reopening")
class CountersFromOpening(HubInMemory):
    def host_left(self):
        self.sequence = self.dropped = 0


@faulty("R8: restarts when the port is opened, and starts by itself")
class RestartsStarted(HubInMemory):
    def host_came(self, now_us):
        self.reset(now_us, 0)
        self.started = True
        self.skip(now_us)


@faulty("L5: restarts when a TCP connection is made")
class RestartsAtTcp(HubInMemory):
    only_tcp = True

    def host_came(self, now_us):
        self.reset(now_us, 0)


@faulty("L5: starts by itself when the port is opened")
class StartsAtOpening(HubInMemory):
    def host_came(self, now_us):
        if not self.started:
            self.skip(now_us)
        self.started = True


@faulty("L5: another period after reopening")
class PeriodOfOpening(HubInMemory):
    def host_came(self, now_us):
        self.period_us = 10_000


@faulty("H2: another uid after reopening")
class UidOfOpening(HubInMemory):
    def host_came(self, now_us):
        self.uid += 1


@faulty("L5: stops when the port is closed")
class StopsAtClosing(HubInMemory):
    def host_left(self):
        self.started = False


@faulty("R8: starts by itself after power-up")
class StartsByItself(HubInMemory):
    def make_hello(self):
        if not self.sequence:
            self.started = True
        return super().make_hello()


# Device time.
def device_time(change: Callable[[int], float]) -> Callable[[HubInMemory, Frame], Changed]:
    return of(Sample, lambda hub, one: [rows(one, device_us=int(change(one.device_us)))])


sends("L5 S2 R3 R7 T3: device time in ms", device_time(lambda us: us // 1000))
sends("S2 R3 R7 T3: device time in ns", device_time(lambda us: us * 1000))
sends("S2 T3: device time of 22 bits", device_time(lambda us: us % (1 << 22)))
sends(
    "S2: device time back by 30 ms once",
    of(
        Sample,
        lambda hub, one: [rows(one, device_us=one.device_us - 90_000 * (one.sequence == 60))],
    ),
)
sends(
    "S2 R3 R7: device time of every second sample",
    of(Sample, lambda hub, one: [rows(one, device_us=one.device_us - 40_000 * (one.sequence % 2))]),
)
sends("S2 R3 R7 T3: device time that stands still", device_time(lambda us: 5_000_000))
sends("S2 T3: device time 3000 ppm fast", device_time(lambda us: us * 1.003))
sends("T3: device time ahead by 2 s", device_time(lambda us: us + 2_000_000))
sends(
    "S2 R3 R7 T3: device time of ticks of 100 ms", device_time(lambda us: us // 100_000 * 100_000)
)


@faulty("S2 T3: device time from START on")
class ClockOfStart(HubInMemory):
    since_us = 0

    def receive(self, data, now_us):
        if encode(Request(Command.START, 0xFF0D0A40)) in data:
            self.since_us = now_us
        return super().receive(data, now_us)

    def on_the_line(self, data):
        frames = Decoder().feed(data)
        return b"".join(
            encode(rows(one, device_us=one.device_us - self.since_us))
            if isinstance(one, Sample)
            else encode(one)
            for one in frames
        )


# TIME.
for what, change in {
    "T3: TIME early by 30 ms": lambda us: us - 30_000,
    "T3: TIME late by 30 ms": lambda us: us + 30_000,
    "T1 T3: TIME in ms": lambda us: us // 1000,
    "T1 T3: TIME stands still": lambda us: 3_000_000,
    "T3: TIME in steps of 50 ms": lambda us: us // 50_000 * 50_000,
    "T3: TIME of another clock": lambda us: us + 10**8,
}.items():
    sends(
        what,
        of(Time, lambda hub, one, c=change: [replace(one, device_us=max(0, c(one.device_us)))]),
    )


@faulty("T1: TIME in steps of 100 ms until the port is closed")
class TimeInSteps(HubInMemory):
    step_us = 100_000

    def _answer(self, request, now_us):
        # T3 looks at it after that.
        if request.request == Command.TIME:
            now_us = -(-now_us // self.step_us) * self.step_us
        return super()._answer(request, now_us)

    def host_left(self):
        self.step_us = 1


sends("T2: TIME and ACK", of(Time, lambda hub, one: [one, Ack(Command.TIME)]))
sends("T2: ACK and TIME", of(Time, lambda hub, one: [Ack(Command.TIME), one]))
sends("T2: TIME twice", of(Time, lambda hub, one: [one, one]))
sends(
    "T2: TIME with 16 bits of its number",
    of(Time, lambda hub, one: [replace(one, number=one.number & 0xFFFF)]),
)
sends("T2: TIME only while started", of(Time, lambda hub, one: [one] * hub.started))
sends("T2: TIME only while stopped", of(Time, lambda hub, one: [one] * (not hub.started)))
answers(
    "T4: TIME is unknown and answered done",
    lambda hub, ask, now, right: encode(Ack(6)) if ask.request == Command.TIME else right,
)

# The period.
PERIOD = Command.SET_PERIOD


def period_0(what: str, change: Callable[[HubInMemory, bytes], bytes]) -> None:
    def answer(hub, ask, now, right):
        return change(hub, right) if ask.request == PERIOD and not ask.argument else right

    answers(what, answer)


def stopped(hub: HubInMemory, answer: bytes) -> bytes:
    hub.started = False
    return answer


def with_period(hub: HubInMemory, period_us: int, answer: bytes) -> bytes:
    hub.period_us = period_us
    return answer


period_0("R4: period 0 is answered done", lambda hub, right: encode(Ack(PERIOD, 0, 0)))
period_0("R4 R7: period 0 stops the samples", stopped)
period_0(
    "R4: period 0 is refused with 0", lambda hub, right: encode(Ack(PERIOD, Result.REFUSED, 0))
)
period_0(
    "R4: period 0 is an unknown request", lambda hub, right: encode(Ack(PERIOD, Result.UNKNOWN, 0))
)
period_0(
    "R4: period 0 is refused and sets another", lambda hub, right: with_period(hub, 100_000, right)
)
period_0(
    "R3 R4: period 0 is done with the old period, and HELLO says another",
    lambda hub, right: with_period(hub, 20_000, encode(Ack(PERIOD, 0, 10_000))),
)
answers(
    "R3 R6 R7: the period is in ms",
    lambda hub, ask, now, right: (
        with_period(hub, ask.argument * 10, right)
        if ask.request == PERIOD and ask.argument
        else right
    ),
)
answers(
    "R3: the ACK of a period says 0",
    lambda hub, ask, now, right: (
        encode(Ack(PERIOD, 0, 0)) if ask.request == PERIOD and ask.argument else right
    ),
)
answers(
    "S2 R4 R7: a new period stops the samples",
    lambda hub, ask, now, right: stopped(hub, right) if ask.request == PERIOD else right,
)
answers(
    "R3: STOP forgets the period",
    lambda hub, ask, now, right: (
        with_period(hub, 10_000, right) if ask.request == Command.STOP else right
    ),
)


@faulty("R3 R6: a period 3 % too long")
class LongPeriod(HubInMemory):
    def take(self, room):
        data = super().take(room)
        self.next_us += self.period_us * 3 // 100
        return data


sends("R3: HELLO with an old period", of(Hello, lambda hub, one: [replace(one, period_us=10_000)]))
sends("R3 R4: HELLO without a period", of(Hello, lambda hub, one: [replace(one, period_us=0)]))

# HELLO.


def other_uids(change: Callable[[HubInMemory, np.ndarray], np.ndarray]):
    return of(Hello, lambda hub, one: [replace(one, cube_uids=change(hub, one.cube_uids))])


third = every(3)
sends("H2: uids change between HELLOs", other_uids(lambda hub, uids: uids + np.uint64(third(hub))))
sends(
    "H2: the order of uids changes", other_uids(lambda hub, uids: uids[:: -1 if third(hub) else 1])
)
sends(
    "S5: the number of cubes in HELLO changes",
    other_uids(lambda hub, uids: uids[: 2 if third(hub) else 3]),
)
sends("H2: two cubes with one uid", other_uids(lambda hub, uids: uids[[0, 1, 0]]))
sends(
    "H2: the hub's uid changes",
    of(Hello, lambda hub, one: [replace(one, hub_uid=one.hub_uid + third(hub))]),
)
sends(
    "S5: the pads of HELLO change",
    of(Hello, lambda hub, one: [replace(one, n_pads=one.n_pads + third(hub))]),
)
sends("S5: HELLO says a cube less", other_uids(lambda hub, uids: uids[:2]))
sends("S5: HELLO says a cube more", other_uids(lambda hub, uids: np.append(uids, np.uint64(99))))
sends("F4: HELLO with flags", of(Hello, lambda hub, one: [replace(one, flags=4)]))


def hello_first(hub, ask, now, right):
    return hub.make_hello() + encode(Ack(1)) if ask.request == Command.HELLO else right


answers("H1: HELLO before its ACK", hello_first)
answers(
    "H1: no HELLO when asked",
    lambda hub, ask, now, right: encode(Ack(1)) if ask.request == 1 else right,
)
answers(
    "L5: HELLO stops the samples",
    lambda hub, ask, now, right: stopped(hub, right) if ask.request == 1 else right,
)


class Seconds(HubInMemory):
    n = 0

    def once_a_second(self, now_us):
        self.n += 1
        return self.at(now_us)


@faulty("H1: HELLO every two seconds")
class SlowHello(Seconds):
    def at(self, now_us):
        return (self.make_hello() if self.n % 2 else b"") + self.make_stats(now_us)


@faulty("H1: HELLO twice a second")
class FastHello(Seconds):
    def at(self, now_us):
        return 2 * self.make_hello() + self.make_stats(now_us)


@faulty("H1: no HELLO while started")
class HelloStopped(Seconds):
    def at(self, now_us):
        return (b"" if self.started else self.make_hello()) + self.make_stats(now_us)


@faulty("H1: no HELLO after power-up")
class NoFirstHello(HubInMemory):
    has_begun = False

    def on_the_line(self, data):
        # The first bytes of all are the HELLO of power-up.
        is_first, self.has_begun = not self.has_begun, True
        return b"" if is_first else data


@faulty("L5 S8: STATS every two seconds")
class SlowStats(Seconds):
    def at(self, now_us):
        return self.make_hello() + (self.make_stats(now_us) if self.n % 2 else b"")


@faulty("S8: no STATS while stopped")
class StatsStarted(Seconds):
    def at(self, now_us):
        return self.make_hello() + (self.make_stats(now_us) if self.started else b"")


# STATS.
sends(
    "S4 S7: samples taken is the last number",
    of(Stats, lambda hub, one: [replace(one, taken=max(0, one.taken - 1))]),
)
sends(
    "S7: samples taken is one ahead",
    of(Stats, lambda hub, one: [replace(one, taken=one.taken + 1)]),
)
sends(
    "S2: uptime in s", of(Stats, lambda hub, one: [replace(one, uptime_ms=one.uptime_ms // 1000)])
)
sends(
    "L5 S2: uptime in µs",
    of(Stats, lambda hub, one: [replace(one, uptime_ms=one.uptime_ms * 1000)]),
)
sends("S2: uptime stands still", of(Stats, lambda hub, one: [replace(one, uptime_ms=1000)]))
sends("S4: dropped stays 0", of(Stats, lambda hub, one: [replace(one, dropped=0)]))
sends(
    "S4: dropped counts cubes", of(Stats, lambda hub, one: [replace(one, dropped=3 * one.dropped)])
)
sends(
    "S4: dropped counts what was sent",
    of(Stats, lambda hub, one: [replace(one, dropped=one.taken)]),
)


@faulty("S4: dropped is cleared by each STATS")
class ClearsDropped(HubInMemory):
    def make_stats(self, now_us):
        frame = super().make_stats(now_us)
        self.dropped = 0
        return frame


@faulty("S4 S7: samples taken counts from START")
class TakenFromStart(HubInMemory):
    since = 0

    def receive(self, data, now_us):
        if encode(Request(Command.START)) in data:
            self.since = self.sequence
        return super().receive(data, now_us)

    def make_stats(self, now_us):
        (one,) = Decoder().feed(super().make_stats(now_us))
        return encode(replace(one, taken=one.taken - self.since))


# Requests.
answers(
    "R1: IDENTIFY is not answered", lambda hub, ask, now, right: b"" if ask.request == 5 else right
)
answers(
    "R1: IDENTIFY is answered twice",
    lambda hub, ask, now, right: 2 * right if ask.request == 5 else right,
)
answers(
    "R2: IDENTIFY is unknown",
    lambda hub, ask, now, right: encode(Ack(5, 1)) if ask.request == 5 else right,
)
answers(
    "R2: an unknown request is done",
    lambda hub, ask, now, right: encode(Ack(ask.request)) if ask.request > 6 else right,
)
answers(
    "F2 F3 R1: an unknown request is not answered",
    lambda hub, ask, now, right: b"" if ask.request > 6 else right,
)
answers(
    "R2: ACKs repeat the argument",
    lambda hub, ask, now, right: (
        encode(Ack(ask.request, 0, ask.argument)) if ask.request in (2, 3, 5) else right
    ),
)
answers(
    "R6: a second STOP is refused",
    lambda hub, ask, now, right: encode(Ack(3, 2)) if ask.request == 3 and ask.argument else right,
)
answers(
    "L5 R1: STOP is answered and not done",
    lambda hub, ask, now, right: started(hub, right, ask.request == 3),
)
answers(
    "R1: START is answered and not done",
    lambda hub, ask, now, right: stopped(hub, right) if ask.request == 2 else right,
)


def started(hub: HubInMemory, answer: bytes, is_started: bool) -> bytes:
    hub.started |= is_started and hub.sequence > 0
    return answer


@faulty("R1: START needs the argument 0")
class StartOfZero(HubInMemory):
    def _answer(self, request, now_us):
        if request.request == Command.START and request.argument:
            return encode(Ack(Command.START, Result.REFUSED))
        return super()._answer(request, now_us)


@faulty("R6: a second START moves the samples")
class StartsAnew(HubInMemory):
    def _answer(self, request, now_us):
        answer = super()._answer(request, now_us)
        if request.request == Command.START:
            self.next_us = now_us + self.period_us
        return answer


@faulty("R7: a new period counts from the next START on")
class LatePeriod(HubInMemory):
    asked_us = 10_000

    def make_hello(self):
        (one,) = Decoder().feed(super().make_hello())
        return encode(replace(one, period_us=self.asked_us))

    def _answer(self, request, now_us):
        if request.request == Command.START:
            self.period_us = self.asked_us
        if request.request == PERIOD and request.argument:
            self.asked_us = request.argument
            if not self.started:
                self.period_us = request.argument
            return encode(Ack(PERIOD, 0, request.argument))
        return super()._answer(request, now_us)


@faulty("R1: one request of a packet is carried out")
class OneRequest(HubInMemory):
    def receive(self, data, now_us):
        frames = [frame for frame in Decoder().feed(data) if isinstance(frame, Request)]
        return super().receive(encode(frames[-1]) if frames else data, now_us)


@faulty("R1: requests of a packet in reverse order")
class Reversed(HubInMemory):
    def receive(self, data, now_us):
        frames = [frame for frame in Decoder().feed(data) if isinstance(frame, Request)]
        return super().receive(b"".join(map(encode, frames[::-1])) or data, now_us)


@faulty("R1: a sample comes behind the ACK of STOP")
class LateStop(HubInMemory):
    def receive(self, data, now_us):
        was_started = self.started
        answer = super().receive(data, now_us)
        if was_started and not self.started:
            answer += self.take(True)
        return answer


@faulty("F3 F5 H2 S1 S4 S7 T2: echoes what it hears")
class Echo(HubInMemory):
    def receive(self, data, now_us):
        return data + super().receive(data, now_us)


@faulty("L1: deaf after XOFF")
class Deaf(HubInMemory):
    deaf = False

    def receive(self, data, now_us):
        self.deaf = data[:1] == b"\x13" or (self.deaf and data[:1] != b"\x11")
        return b"" if self.deaf else super().receive(data, now_us)


@faulty("F2: answers requests of version 2")
class Version2(HubInMemory):
    def receive(self, data, now_us):
        also = encode(Ack(233, 1)) if encode(Request(233), version=2) in data else b""
        return also + super().receive(data, now_us)


@faulty("F2: noise makes it deaf")
class LostByNoise(HubInMemory):
    def receive(self, data, now_us):
        return b"" if len(data) > 256 else super().receive(data, now_us)


@faulty("F3: answers ACKs")
class AnswersAcks(HubInMemory):
    def receive(self, data, now_us):
        acks = [frame for frame in Decoder().feed(data) if isinstance(frame, Ack)]
        return b"".join(map(encode, acks)) + super().receive(data, now_us)


# Frames.
sends("L2: says nothing", lambda hub, one: [])
sends("F1: no zero before a frame", lambda hub, one: [encode(one)[1:]])
sends(
    "F5 S4: every 100th frame is damaged",
    lambda hub, one: [encode(one)[:-3] + b"\x55\x55\0" if hundredth(hub) else one],
)
hundredth = every(100)
sends("F5: a line of text at times", of(Stats, lambda hub, one: [b"\0hello\0", one]))
sends("F5: requests instead of frames at times", of(Stats, lambda hub, one: [one, Request(1)]))
sends("F5 S8: frames of version 2", of(Stats, lambda hub, one: [encode(one, version=2)]))
sends(
    "F4: spare bytes",
    of(Sample, lambda hub, one: [wire(one.raw[:21] + b"\0\7\0" + one.raw[24:-4])]),
)


# A host that does not read.
@faulty("S9: waits while the host does not read")
class Waits(HubInMemory):
    def take(self, room):
        if room:
            return super().take(room)
        self.next_us += self.period_us
        return b""


@faulty("S9: stands still while the host does not read")
class StandsStill(Waits):
    is_full = False

    def take(self, room):
        self.is_full = not room
        return super().take(room)

    def once_a_second(self, now_us):
        return b"" if self.is_full else super().once_a_second(now_us)


@faulty("S4: drops in silence")
class SilentDrops(HubInMemory):
    def take(self, room):
        data = super().take(room)
        self.dropped = 0
        return data


@faulty("S9: cuts frames that find no room")
class Cuts(HubInMemory):
    def take(self, room):
        if not room and self.dropped % 10 == 0:
            self.dropped += 1
            return super().take(True)[:30]
        return super().take(room)


@faulty("S4: does not number samples without room")
class NotNumbered(HubInMemory):
    def take(self, room):
        if room:
            return super().take(room)
        self.next_us += self.period_us
        self.dropped += 1
        return b""


@faulty("S9: stops after a full buffer")
class StopsWhenFull(HubInMemory):
    def take(self, room):
        self.started = self.started and room
        return super().take(room)
