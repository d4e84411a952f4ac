# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The check of a hub: a sound hub passes, and a faulty one fails exactly the rules it breaks."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from faulty_hubs import FAULTY, cubes, rows
from hub_in_memory import HubInMemory, MemoryWire

from conftest import ROOT
from cube_tensor_driver.core.errors import CubeError, LinkError
from cube_tensor_driver.device.wire.decoder import Decoder
from cube_tensor_driver.device.wire.protocol import Ack, Command, encode
from cube_tensor_hub.check import Checked, check, sort_rules
from cube_tensor_hub.rule import Outcome

UIDS = (0xA1, 0xA2, 0xA3)


def checked(hub: HubInMemory, **wire: object) -> Checked:
    return check(MemoryWire(hub, **wire))


class SplitsSamples(HubInMemory):
    """Two frames for each sample: two cubes, then the others."""

    def sample(self, frequency):
        (sample,) = Decoder().feed(super().sample(frequency))
        return encode(cubes(sample, 0, 2)) + encode(cubes(sample, 2, 3))


class NoTime(HubInMemory):
    def _answer(self, request, now_us):
        if request.request == Command.TIME:
            return encode(Ack(Command.TIME, 1))
        return super()._answer(request, now_us)


WRONG_SETTINGS: dict[str, dict[str, object]] = {
    "H3": {"n_pads": 33},
    "S2": {"drift_ppm": 5000.0},
    "S5": {"extra_pads": 1},
}
"""Rule that a hub with these settings breaks."""


def made(kind: type[HubInMemory], settings: dict[str, object]) -> HubInMemory:
    return kind(**{"uid": 0xAB, "cube_uids": UIDS, "n_pads": 8} | settings)


@pytest.mark.parametrize(("what", "kind"), FAULTY.items(), ids=list(FAULTY))
def test_a_faulty_hub_fails_exactly_the_rules_that_it_breaks(what, kind):
    rules, _ = what.split(": ", 1)
    result = checked(made(kind, {}), is_tcp=hasattr(kind, "only_tcp"))
    assert result.list_failed() == rules.split(), result.to_dict()


@pytest.mark.parametrize(("number", "settings"), WRONG_SETTINGS.items())
def test_a_hub_with_wrong_settings_fails_exactly_one_rule(number, settings):
    assert checked(made(HubInMemory, settings)).list_failed() == [number]


@pytest.mark.parametrize("greeting", [b"\xff\xfb\x01", b"\x15\x03\x01"], ids=["Telnet", "TLS"])
def test_a_bridge_that_speaks_something_else_fails_l3(greeting):
    result = checked(made(HubInMemory, {}), is_tcp=True, greeting=greeting)
    assert result.list_failed() == ["L3"]


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
    def make_hello(self):
        (hello,) = Decoder().feed(super().make_hello())
        is_new = getattr(self, "has_said", 0) < 2
        self.has_said = getattr(self, "has_said", 0) + 1
        return encode(replace(hello, cube_uids=hello.cube_uids[:0]) if is_new else hello)


class MeasuresAlways(HubInMemory):
    """The window of the first sample began before START."""

    def sample(self, frequency):
        (sample,) = Decoder().feed(super().sample(frequency))
        return encode(rows(sample, device_us=sample.device_us - 450))


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
    assert not result.list_failed(), result.to_dict()


def test_a_sound_hub_passes_on_a_slow_line():
    result = check(SlowWire(made(HubInMemory, {})))
    assert not result.list_failed(), result.to_dict()


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
    """It breaks that rule alone. Rules that are never tried say why."""
    sound = [checked(made(kind, {})) for kind in (HubInMemory, SplitsSamples, NoTime)]
    sound.append(checked(made(HubInMemory, {}), is_tcp=True))
    tried = {
        number
        for result in sound
        for number, verdict in result.results.items()
        if verdict.outcome is Outcome.PASSED
    }
    alone = {what[:2] for what in FAULTY if what[2] == ":"}
    assert tried == alone | {*WRONG_SETTINGS, "L3"}
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
    assert result.list_failed() == ["H1"] and wire.now() < 5


def test_a_hub_that_floods_is_an_error():
    class Floods(HubInMemory):
        def on_the_line(self, data):
            return 4000 * data

    with pytest.raises(CubeError, match="more than a hub can be asked for"):
        checked(made(Floods, {}))
