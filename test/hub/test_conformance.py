# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The check of a hub: a sound hub passes, and a hub that breaks one rule fails exactly that one."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from faulty_hubs import FAULTY
from hub_in_memory import HubInMemory, MemoryWire
from test_protocol import wire

from conftest import ROOT
from cube_tensor_driver.core.errors import CubeError, LinkError
from cube_tensor_driver.device.wire.decoder import Decoder
from cube_tensor_driver.device.wire.protocol import Ack, Command, Request, Sample, Time, encode
from cube_tensor_hub.check import Checked, check, sort_rules
from cube_tensor_hub.rule import Outcome

UIDS = (0xA1, 0xA2, 0xA3)


def checked(hub: HubInMemory, **wire: object) -> Checked:
    return check(MemoryWire(hub, **wire))


def reframed(change: Callable) -> Callable[[HubInMemory, bytes], bytes]:
    """on_the_line of a hub whose frames are changed one by one."""

    def on_the_line(self: HubInMemory, data: bytes) -> bytes:
        frames = Decoder().feed(data)
        return b"".join(encode(one) for frame in frames for one in change(self, frame))

    return on_the_line


class DeafByXoff(HubInMemory):
    """By one between frames only, so that no other rule is touched."""

    deaf = False

    def receive(self, data, now_us):
        self.deaf = data[:1] == b"\x13" or (self.deaf and data[:1] != b"\x11")
        return b"" if self.deaf else super().receive(data, now_us)


class Silent(HubInMemory):
    def on_the_line(self, data):
        return b""


class StopsWithTheHost(HubInMemory):
    def host_left(self):
        self.started = False


class NoOpeningZero(HubInMemory):
    def on_the_line(self, data):
        return data.replace(b"\0\0", b"\0")


class AnswersOtherVersions(HubInMemory):
    def receive(self, data, now_us):
        also = encode(Ack(233, 1)) if encode(Request(233), version=2) in data else b""
        return also + super().receive(data, now_us)


class LostByNoise(HubInMemory):
    def receive(self, data, now_us):
        return b"" if len(data) > 256 else super().receive(data, now_us)


class AnswersAcks(HubInMemory):
    def receive(self, data, now_us):
        acks = [frame for frame in Decoder().feed(data) if isinstance(frame, Ack)]
        return b"".join(map(encode, acks)) + super().receive(data, now_us)


class SendsFlags(HubInMemory):
    on_the_line = reframed(
        lambda self, frame: [replace(frame, flags=1) if hasattr(frame, "flags") else frame]
    )


class SendsSpare(HubInMemory):
    def sample(self, frequency):
        (sample,) = Decoder().feed(super().sample(frequency))
        raw = bytearray(sample.raw[:-4])
        raw[21:24] = b"\0\7\0"
        return wire(bytes(raw))


class SendsNoise(HubInMemory):
    def once_a_second(self, now_us):
        return super().once_a_second(now_us) + b"\0debug: all is well\0"


class NoHelloByItself(HubInMemory):
    def once_a_second(self, now_us):
        return self.stats(now_us)


class NoHelloWhenAsked(HubInMemory):
    def receive(self, data, now_us):
        frames = Decoder().feed(super().receive(data, now_us))
        return b"".join(encode(frame) for frame in frames if not hasattr(frame, "flags"))


class LosesACube(HubInMemory):
    def sample(self, frequency):
        return super().sample(frequency[: 2 if self.sequence > 100 else 3])


class CountsAnew(HubInMemory):
    def receive(self, data, now_us):
        if encode(Request(Command.START)) in data and not self.started:
            self.sequence = 0
        return super().receive(data, now_us)


class CountsTwice(HubInMemory):
    has_repeated = False

    def sample(self, frequency):
        if self.sequence == 100 and not self.has_repeated:
            self.sequence, self.has_repeated = 99, True
        return super().sample(frequency)


class ClockGoesBack(HubInMemory):
    on_the_line = reframed(
        lambda self, frame: [
            part(frame, 0, 3, -30_000)
            if isinstance(frame, Sample) and frame.sequence == 700
            else frame
        ]
    )


def part(sample: Sample, start: int, end: int, late_us: int = 0) -> Sample:
    """Some cubes of a sample, at another device time."""
    return Sample(
        sample.sequence,
        start,
        sample.device_us + late_us,
        sample.frequency[start:end],
        sample.pad_fault[start:end],
        sample.temperature[start:end],
    )


class SplitsSamples(HubInMemory):
    """Two frames for each sample: two cubes, then the others."""

    late_us = 0
    moves = False

    def sample(self, frequency):
        (sample,) = Decoder().feed(super().sample(frequency))
        at = 1 if self.moves and sample.sequence % 2 else 2
        return encode(part(sample, 0, at)) + encode(part(sample, at, 3, self.late_us))


class SplitsAtTwoTimes(SplitsSamples):
    late_us = 40


class SplitsAnywhere(SplitsSamples):
    moves = True


class DropsInSecret(HubInMemory):
    def take(self, room):
        frames = super().take(room)
        self.dropped = 0
        return frames


class InHertz(HubInMemory):
    def sample(self, frequency):
        return super().sample(frequency // 1000)


class CountsOneMore(HubInMemory):
    def stats(self, now_us):
        self.sequence += 1
        try:
            return super().stats(now_us)
        finally:
            self.sequence -= 1


class NoStatsWhileStopped(HubInMemory):
    def once_a_second(self, now_us):
        return super().once_a_second(now_us) if self.started else self.hello()


class Waits(HubInMemory):
    def take(self, room):
        if room:
            return super().take(room)
        self.next_us += self.period_us
        return b""


class StandsStill(Waits):
    is_full = False

    def take(self, room):
        self.is_full = not room
        return super().take(room)

    def once_a_second(self, now_us):
        return b"" if self.is_full else super().once_a_second(now_us)


class CutsFrames(HubInMemory):
    def take(self, room):
        if not room and self.dropped % 10 == 0:
            self.dropped += 1
            return super().take(True)[:30]
        return super().take(room)


class AnswersTwice(HubInMemory):
    def _answer(self, request, now_us):
        answer = super()._answer(request, now_us)
        return 2 * answer if request.request == Command.IDENTIFY else answer


class NeverStarts(HubInMemory):
    def receive(self, data, now_us):
        answer = super().receive(data, now_us)
        self.started = False
        return answer


class RepeatsArguments(HubInMemory):
    def _answer(self, request, now_us):
        if request.request == Command.STOP and not self.started:
            return encode(Ack(Command.STOP, 0, request.argument))
        return super()._answer(request, now_us)


class HelloWithAnOldPeriod(HubInMemory):
    on_the_line = reframed(
        lambda self, frame: [replace(frame, period_us=10_000) if hasattr(frame, "flags") else frame]
    )


class RefusesAndChanges(HubInMemory):
    def _answer(self, request, now_us):
        answer = super()._answer(request, now_us)
        if request.request == Command.SET_PERIOD and not request.argument:
            self.period_us = 100_000
        return answer


class StartsAnew(HubInMemory):
    def _answer(self, request, now_us):
        if request.request == Command.START:
            self.started = True
            self.next_us = now_us + self.period_us
            return encode(Ack(Command.START))
        return super()._answer(request, now_us)


class PeriodFromNextStart(HubInMemory):
    """asked_us: what it says; period_us: what it does."""

    asked_us = 10_000

    def hello(self):
        (hello,) = Decoder().feed(super().hello())
        return encode(replace(hello, period_us=self.asked_us))

    def _answer(self, request, now_us):
        if request.request == Command.SET_PERIOD and request.argument:
            self.asked_us = request.argument
            if not self.started:
                self.period_us = request.argument
            return encode(Ack(Command.SET_PERIOD, 0, request.argument))
        return super()._answer(request, now_us)


class StartsByItself(HubInMemory):
    def hello(self):
        if not self.sequence:
            self.started = True
        return super().hello()


class TimeInSteps(HubInMemory):
    """Until the port is closed; T3 looks at it after that."""

    step_us = 100_000
    on_the_line = reframed(
        lambda self, frame: [
            replace(frame, device_us=-(-frame.device_us // self.step_us) * self.step_us)
            if isinstance(frame, Time)
            else frame
        ]
    )

    def host_left(self):
        self.step_us = 1


class TimeWithoutNumber(HubInMemory):
    on_the_line = reframed(
        lambda self, frame: [replace(frame, number=0) if isinstance(frame, Time) else frame]
    )


class TimeOfAnotherClock(HubInMemory):
    on_the_line = reframed(
        lambda self, frame: [
            replace(frame, device_us=frame.device_us + 10**8) if isinstance(frame, Time) else frame
        ]
    )


class NoTime(HubInMemory):
    result = 1

    def _answer(self, request, now_us):
        if request.request == Command.TIME:
            return encode(Ack(Command.TIME, self.result))
        return super()._answer(request, now_us)


class SaysTimeIsDone(NoTime):
    result = 0


BROKEN: list[tuple[str, type[HubInMemory], dict[str, object]]] = [
    ("L1", DeafByXoff, {}),
    ("L2", Silent, {}),
    ("L5", StopsWithTheHost, {}),
    ("F1", NoOpeningZero, {}),
    ("F2", AnswersOtherVersions, {}),
    ("F2", LostByNoise, {}),
    ("F3", AnswersAcks, {}),
    ("F4", SendsFlags, {}),
    ("F4", SendsSpare, {}),
    ("F5", SendsNoise, {}),
    ("H1", NoHelloByItself, {}),
    ("H1", NoHelloWhenAsked, {}),
    ("H2", HubInMemory, {"cube_uids": (1, 2, 1)}),
    ("H3", HubInMemory, {"n_pads": 33}),
    ("H4", LosesACube, {}),
    ("S1", CountsAnew, {}),
    ("S1", CountsTwice, {}),
    ("S2", HubInMemory, {"drift_ppm": 5000.0}),
    ("S2", ClockGoesBack, {}),
    ("S3", SplitsAtTwoTimes, {}),
    ("S3", SplitsAnywhere, {}),
    ("S4", DropsInSecret, {}),
    ("S5", HubInMemory, {"extra_pads": 1}),
    ("S6", InHertz, {}),
    ("S7", CountsOneMore, {}),
    ("S8", NoStatsWhileStopped, {}),
    ("S9", Waits, {}),
    ("S9", StandsStill, {}),
    ("S9", CutsFrames, {}),
    ("R1", AnswersTwice, {}),
    ("R1", NeverStarts, {}),
    ("R2", RepeatsArguments, {}),
    ("R3", HelloWithAnOldPeriod, {}),
    ("R4", RefusesAndChanges, {}),
    ("R6", StartsAnew, {}),
    ("R7", PeriodFromNextStart, {}),
    ("R8", StartsByItself, {}),
    ("T1", TimeInSteps, {}),
    ("T2", TimeWithoutNumber, {}),
    ("T3", TimeOfAnotherClock, {}),
    ("T4", SaysTimeIsDone, {}),
]


def made(kind: type[HubInMemory], settings: dict[str, object]) -> HubInMemory:
    return kind(**{"uid": 0xAB, "cube_uids": UIDS, "n_pads": 8} | settings)


@pytest.mark.parametrize(
    ("number", "kind", "settings"),
    BROKEN,
    ids=[f"{number} {kind.__name__}" for number, kind, _ in BROKEN],
)
def test_a_hub_that_breaks_one_rule_fails_exactly_that_one(number, kind, settings):
    result = checked(made(kind, settings))
    assert result.failed() == [number], result.to_dict()


@pytest.mark.parametrize("greeting", [b"\xff\xfb\x01", b"\x15\x03\x01"], ids=["Telnet", "TLS"])
def test_a_bridge_that_speaks_something_else_fails_l3(greeting):
    result = checked(made(HubInMemory, {}), is_tcp=True, greeting=greeting)
    assert result.failed() == ["L3"]


@pytest.mark.parametrize(("what", "kind"), FAULTY.items(), ids=list(FAULTY))
def test_a_faulty_hub_is_found(what, kind):
    """All of them, with no exception but that for a hub which floods."""
    assert checked(made(kind, {}), is_tcp=hasattr(kind, "only_tcp")).failed()


class Restarts(HubInMemory):
    """A serial port that restarts the board when it is opened, as L2 allows."""

    def host_came(self, now_us):
        self.reset(now_us, 0)


class CannotDoFast(HubInMemory):
    def _answer(self, request, now_us):
        if request.request == Command.SET_PERIOD and request.argument < 20_000:
            return encode(Ack(Command.SET_PERIOD, 2, self.period_us))
        return super()._answer(request, now_us)


class AsManyCubesAsFit(CannotDoFast):
    """As many cubes of 8 pads as fit a frame."""


class Rounds(HubInMemory):
    """Every period, also 0, to a multiple of 8 ms."""

    def _answer(self, request, now_us):
        if request.request == Command.SET_PERIOD:
            request = replace(request, argument=max(8_000, request.argument // 8_000 * 8_000))
        return super()._answer(request, now_us)


class Sleeps(HubInMemory):
    """Takes no samples while nobody reads, as an emulator on a busy machine, but sends STATS."""

    def take(self, room):
        if room or self.sequence % 2:
            return super().take(room)
        self.next_us += 1_100_000
        self.sequence += 1
        self.dropped += 1
        return b""


class BrokenPads(HubInMemory):
    """One pad is not measured, one reported as faulty, one cube silent, the others noisy."""

    def sample(self, frequency):
        random = np.random.default_rng(self.sequence)
        frequency = random.integers(50_000_000, 90_000_000, frequency.shape).astype("<u4")
        frequency[0, 0] = 0
        frequency[-1] = 0
        frequency[1, 1] = 20 + self.sequence % 3 * 4_000_000_000 // 3
        self.pad_fault = np.array([0, 1 << (self.n_pads - 1), 0], "<u4")
        return super().sample(frequency)


class FindsCubesLater(HubInMemory):
    def hello(self):
        (hello,) = Decoder().feed(super().hello())
        is_new = getattr(self, "has_said", 0) < 2
        self.has_said = getattr(self, "has_said", 0) + 1
        return encode(replace(hello, cube_uids=hello.cube_uids[:0]) if is_new else hello)


class MeasuresAlways(HubInMemory):
    """The window of the first sample began before START."""

    on_the_line = reframed(
        lambda self, frame: [
            part(frame, 0, frame.n_cubes, -450) if isinstance(frame, Sample) else frame
        ]
    )


class SlowWire(MemoryWire):
    """Everything takes 20 ms more to the host, and 20 ms to the hub."""

    def send(self, data):
        self.ignore(0.02)
        super().send(data)
        self.ignore(0.02)

    def listen(self, seconds):
        data = super().listen(seconds)
        self.ignore(0.02)
        return data


@pytest.mark.parametrize("is_tcp", [False, True])
@pytest.mark.parametrize(
    ("kind", "settings"),
    [
        (HubInMemory, {}),
        (HubInMemory, {"sequence": 2**32 - 50}),
        (HubInMemory, {"boot_us": 10**9, "period_us": 777}),
        (HubInMemory, {"boot_us": 2**32 * 1000 - 10**7, "dropped": 2**32 - 3}),
        (HubInMemory, {"cube_uids": (), "n_pads": 8}),
        (HubInMemory, {"cube_uids": (0,) * 5, "n_pads": 1}),
        (HubInMemory, {"cube_uids": range(1, 65), "n_pads": 8}),
        (HubInMemory, {"n_pads": 32}),
        (AsManyCubesAsFit, {"cube_uids": range(1, 1725)}),
        (SplitsSamples, {}),
        (NoTime, {}),
        (Restarts, {}),
        (CannotDoFast, {"period_us": 33_000}),
        (Rounds, {}),
        (Sleeps, {}),
        (BrokenPads, {}),
        (BrokenPads, {"n_pads": 32}),
        (FindsCubesLater, {}),
        (MeasuresAlways, {}),
    ],
)
def test_a_sound_hub_passes(kind, settings, is_tcp):
    if is_tcp and kind is Restarts:
        pytest.skip("with TCP it may not restart")
    result = checked(made(kind, settings), is_tcp=is_tcp)
    assert not result.failed(), result.to_dict()


def test_a_sound_hub_passes_on_a_slow_line():
    result = check(SlowWire(made(HubInMemory, {})))
    assert not result.failed(), result.to_dict()


class BusyHost(MemoryWire):
    """Reads late and little at once, so that what it left unread comes in a later step."""

    def listen(self, seconds: float) -> bytes:
        data = super().listen(seconds)
        self._out[:0] = data[200:]
        self.ignore(0.005)
        return data[:200]


def test_samples_of_the_faster_period_are_not_due_while_the_port_is_closed():
    result = check(BusyHost(made(HubInMemory, {})))
    assert result.results["L5"].outcome is Outcome.PASSED, result.to_dict()


def test_every_rule_that_can_fail_has_its_broken_hub():
    """Those that are never tried say why."""
    sound = [checked(made(kind, {})) for kind in (HubInMemory, SplitsSamples, NoTime)]
    sound.append(checked(made(HubInMemory, {}), is_tcp=True))
    tried = {
        number
        for result in sound
        for number, verdict in result.results.items()
        if verdict.outcome is Outcome.PASSED
    }
    assert tried == {number for number, _, _ in BROKEN} | {"L3"}
    for verdict in sound[0].results.values():
        assert verdict.text


def test_rules_are_those_of_the_page_in_its_words():
    page = (ROOT / "docs/protocol.md").read_text(encoding="utf-8")
    found = re.findall(r"^- \*\*([A-Z]\d)\*\* (.*(?:\n  .*)*)", page, re.MULTILINE)
    of_page = {number: " ".join(text.split()) for number, text in found}
    assert [one.number for one in sort_rules()] == list(of_page)
    for one in sort_rules():
        assert one.says in of_page[one.number], one.number
        assert f"### {one.section}\n" in page


def test_a_line_that_is_lost_is_an_error_with_the_step():
    class Lost(MemoryWire):
        def listen(self, seconds):
            if self.now() > 8:
                raise LinkError("gone", "lost")
            return super().listen(seconds)

    with pytest.raises(LinkError, match="lost in the step 'start'"):
        check(Lost(made(HubInMemory, {})))


def test_bytes_that_are_no_frames_end_the_check_soon():
    class Noise(MemoryWire):
        def listen(self, seconds):
            return super().listen(seconds).replace(b"\0", b"\1")

    wire = Noise(made(HubInMemory, {}))
    result = check(wire)
    assert result.failed() == ["H1"] and wire.now() < 5


def test_a_hub_that_floods_is_an_error():
    class Floods(HubInMemory):
        def on_the_line(self, data):
            return 4000 * data

    with pytest.raises(CubeError, match="more than a hub can be asked for"):
        checked(made(Floods, {}))
