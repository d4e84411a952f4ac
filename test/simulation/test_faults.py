# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The fault injector does what it says; so does `./cube inject`."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cube_tensor_driver.config.yaml import parse_yaml, write_yaml
from cube_tensor_driver.core.errors import ConfigError
from cube_tensor_driver.device.scans.sequence import Arrival, SampleAccount
from cube_tensor_driver.device.wire.decoder import Decoder
from cube_tensor_driver.device.wire.protocol import Hello, Sample, Stats
from cube_tensor_driver.simulation.faults import FRAME_FAULTS, KINDS, Fault, parse_faults
from cube_tensor_driver.simulation.hub import SimulatedHub
from cube_tensor_driver.simulation.inject import inject
from cube_tensor_driver.simulation.injector import Injector, SimulatedLink
from workshop.torture.mix import CYCLE, schedule

PERIOD_US = 2000
VALUES = np.arange(1, 17, dtype="<u4").reshape(2, 8) * 1_000_000


@dataclass
class KeptLine:
    """A line that keeps what it is given."""

    port: Path = Path("/tmp/hub0")
    plugged: bool = True
    held_until_us: int = 0
    burst_until_us: int = 0
    sent: list = field(default_factory=list)

    def send(self, data, now_us):
        self.sent.append(data)
        return True

    def unplug(self):
        self.plugged = False

    def plug(self, port=None):
        self.plugged, self.port = True, port


class FaultyLink(SimulatedLink):
    """A link under faults."""

    def __init__(self, *faults):
        hub = SimulatedHub(uid=1, cube_uids=[10, 11], n_pads=8, period_us=PERIOD_US, started=True)
        super().__init__(name="hub0", hub=hub, line=KeptLine())
        self.injector = Injector([self], [Fault(**fault) for fault in faults], seed=3)

    def play(self, samples):
        """Samples through the injector into a decoder; returns the decoder and its frames."""
        decoder, frames = Decoder(), []
        for _ in range(samples):
            self.injector.step(self.hub.next_us)
            if self.hub.started:
                measured = self.injector.measure(self, VALUES, self.hub.next_us)
                data = self.injector.transmit(self, self.hub.sample(measured))
                self.line.send(data, self.hub.next_us)
            else:
                self.hub.next_us += PERIOD_US
            frames += decoder.feed(b"".join(self.line.sent))
            self.line.sent.clear()
        return decoder, [frame for frame in frames if isinstance(frame, Sample)]


@pytest.mark.parametrize("kind", FRAME_FAULTS)
def test_harmed_frames_are_delivered_or_missing_never_wrong(kind):
    link = FaultyLink({"kind": kind, "at": 0.01, "count": 20})
    decoder, samples = link.play(100)
    account = SampleAccount()
    arrivals = [account.classify(sample) for sample in samples]
    account.add_stats(Stats(10_000, link.hub.sequence, 0))
    counters = account.count_samples()
    assert counters["delivered"] + counters["duplicate"] == len(samples)
    assert counters["taken"] == 100 == counters["delivered"] + counters["lost_on_the_way"]
    for sample in samples:
        np.testing.assert_array_equal(sample.frequency, VALUES)
    lost, noise = (
        counters["lost_on_the_way"],
        decoder.counters.crc + decoder.counters.framing + decoder.counters.length,
    )
    expected = {
        "drop": (lost == 20, noise == 0),
        "flip": (lost == 20, noise >= 20),
        "insert": (0 < lost <= 20, noise > 0),
        "duplicate": (lost == 0, counters["duplicate"] == 20),
        "reorder": (lost == 0, arrivals.count(Arrival.LATE) == 10),
        "truncate": (lost == 20, noise == 20),
    }
    assert all(expected[kind]), (counters, noise)


def test_stats_complete_the_account_and_tell_drops_from_loss():
    account = SampleAccount()
    link = FaultyLink()
    _, samples = link.play(10)
    for sample in samples[:6]:
        account.classify(sample)
    account.add_stats(Stats(20, 10, 3))
    counters = account.count_samples()
    assert counters["taken"] == 10
    assert (counters["dropped_in_hub"], counters["lost_on_the_way"]) == (3, 1)
    assert account.classify(samples[7]) is Arrival.LATE
    counters = account.count_samples()
    assert counters["lost_on_the_way"] + counters["dropped_in_hub"] == 3


def test_faults_of_pads_and_hub_change_what_the_hub_says():
    link = FaultyLink(
        {"kind": "short", "at": 0.01, "seconds": 0.01, "cube": 1, "pad": 2},
        {"kind": "stuck", "at": 0.03, "seconds": 0.01, "cube": 0, "pad": 0},
        {"kind": "pads", "at": 0.05, "seconds": 0.01},
        {"kind": "version", "at": 0.07, "seconds": 0.01},
        {"kind": "temperature", "at": 0.09, "seconds": 0.002, "value": 10.0},
    )
    decoder, samples = link.play(60)
    by_time = {sample.device_us: sample for sample in samples}
    assert by_time[12_000].frequency[1, 2] == 0 and by_time[22_000].frequency[1, 2] == VALUES[1, 2]
    assert by_time[52_000].n_pads == 9 and by_time[62_000].n_pads == 8
    assert decoder.counters.version == 5 and decoder.other_version == 2
    warm = by_time[100_000]
    np.testing.assert_allclose(warm.frequency, VALUES * (1 + 10 * 50e-6), rtol=1e-6)
    assert warm.temperature[0] == 3500
    records = link.injector.records[:2]
    assert [(one.fault.kind, one.start_us, one.end_us) for one in records] == [
        ("short", 10_000, 20_000),
        ("stuck", 30_000, 40_000),
    ]


def test_restart_wrap_and_clock():
    link = FaultyLink(
        {"kind": "drift", "at": 0.01, "value": 100.0},
        {"kind": "step", "at": 0.02, "value": 1.5},
        {"kind": "wrap", "at": 0.03, "count": 2},
    )
    _, samples = link.play(12)
    times = [sample.device_us for sample in samples]
    assert times[5] - times[4] == 2000 and times[10] - times[9] == 2000 + 1_500_000
    link.hub.started, link.hub.next_us = (
        True,
        link.hub.next_us + (-link.hub.next_us % PERIOD_US),
    )
    link.play(5)
    link.hub.started = True
    _, samples = link.play(4)
    assert [sample.sequence for sample in samples] == [2**32 - 2, 2**32 - 1, 0, 1]
    assert [run.boot for run in link.hub.runs] == [0, 1]
    assert link.hub.runs[1].first == 2**32 - 2


def test_unplug_takes_the_power_and_rename_comes_back_elsewhere():
    link = FaultyLink({"kind": "rename", "at": 0.01, "seconds": 0.02})
    link.play(6)
    assert not link.line.plugged and not link.hub.started and link.hub.boots == 0
    link.play(12)
    assert link.line.plugged and link.hub.boots == 1 and link.line.port.name == "hub0_1"
    assert isinstance(Decoder().feed(link.hub.make_hello())[0], Hello)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{kind: explode}", ["explode", "drop"]),
        ("{kind: drop, count: -1}", ["count", "-1"]),
        ("{kind: drop, link: 3}", ["link", "3"]),
        ("{kind: drop, seconds: .nan}", ["seconds"]),
        ("{kind: drop, how: often}", ["how", "kind"]),
        ("drop", ["drop", "kind"]),
    ],
)
def test_a_fault_that_is_none_is_told(text, words):
    with pytest.raises(ConfigError) as error:
        Fault.parse(parse_yaml(text, "x"), "faults.yaml")
    for word in ["faults.yaml", *words]:
        assert word in str(error.value)


@settings(max_examples=200)
@given(
    st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
        lambda child: (
            st.lists(child, max_size=3)
            | st.dictionaries(
                st.sampled_from(
                    ["kind", "at", "link", "seconds", "count", "cube", "pad", "value", "x"]
                ),
                child | st.sampled_from(sorted(KINDS)),
                max_size=4,
            )
        ),
    )
)
def test_any_data_is_faults_or_our_error(data):
    try:
        faults = parse_faults(data, "x")
        Injector([FaultyLink()], faults)
    except ConfigError:
        return
    assert all(fault.kind in KINDS for fault in faults)


def test_the_wrong_link_cube_or_pad():
    for fault in (
        {"kind": "drop", "link": "hub9"},
        {"kind": "open", "cube": 2},
        {"kind": "short", "pad": 8},
    ):
        with pytest.raises(ConfigError, match="allowed"):
            FaultyLink(fault)


def test_inject_speaks_to_the_pipe_or_says_that_nobody_listens(tmp_path):
    with pytest.raises(ConfigError, match="No such file"):
        inject(tmp_path, ["kind=drop"])
    os.mkfifo(tmp_path / ".faults")
    with pytest.raises(ConfigError, match="no simulator reads it"):
        inject(tmp_path, ["kind=drop"])
    reader = os.open(tmp_path / ".faults", os.O_RDONLY | os.O_NONBLOCK)
    write_yaml(tmp_path / ".hubs", {"hub0": {"cubes": 8, "pads": 8}})
    for words in (["kind=unplug", "link=hub7"], ["kind=open", "cube=8"], ["kind=short", "pad=8"]):
        with pytest.raises(ConfigError, match=r"fault .*: .*allowed: "):
            inject(tmp_path, words)
    said = inject(tmp_path, ["kind=unplug", "link=hub0", "seconds=2"])
    assert said == "hub0: cut the port and the power for 2 s"
    assert parse_yaml(os.read(reader, 1000), "pipe") == {
        "kind": "unplug",
        "link": "hub0",
        "seconds": 2,
    }
    said = inject(tmp_path, ["kind=stuck", "cube=3", "pad=5", "seconds=10"])
    assert said == "hub0: repeat the reading of pad 5 of cube 3 for 10 s"
    os.close(reader)


def test_a_long_torture_has_every_fault_and_action_and_the_same_seed_the_same_mix():
    mix = list(schedule(120.0, 5))
    assert {event["kind"] for _, event in mix if "kind" in event} == set(KINDS)
    assert {event["action"] for _, event in mix if "action" in event} == {
        event["action"] for event in CYCLE.values() if "action" in event
    }
    assert mix == list(schedule(120.0, 5)) != list(schedule(120.0, 6))
    assert [at for at, _ in mix] == sorted(at for at, _ in mix)


def test_the_load_stays_while_it_is_held():
    link = FaultyLink(
        {"kind": "hold", "at": 0.01, "seconds": 0.02}, {"kind": "hold", "at": 0.02, "seconds": 0.02}
    )
    loads = []
    for now_us in range(0, 50_000, PERIOD_US):
        link.injector.step(now_us)
        loads.append(link.find_load_time_us(now_us))
    expected = np.arange(0, 50_000, PERIOD_US)
    expected[(expected >= 10_000) & (expected < 20_000)] = 10_000
    expected[(expected >= 20_000) & (expected < 40_000)] = 20_000
    assert loads == expected.tolist()


def test_a_hub_reports_pads_and_a_sample_that_was_harmed_is_noted():
    link = FaultyLink(
        {"kind": "report", "at": 0.01, "seconds": 0.01, "cube": 1, "pad": 2},
        {"kind": "drop", "at": 0.03, "count": 2},
    )
    _, samples = link.play(30)
    reported = [sample.sequence for sample in samples if sample.pad_fault.tolist() == [0, 1 << 2]]
    assert reported == list(range(5, 10))
    assert link.damaged == [(0, 15), (0, 16)]
