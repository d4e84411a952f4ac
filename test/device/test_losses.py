# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Whatever is lost shows in the report of its link, and device time decides between a gap, a repeat
and a restart."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from test_clock import EPOCH_NS

from conftest import sample_frame
from cube_tensor_driver.core.status import STAMP
from cube_tensor_driver.device import chain
from cube_tensor_driver.device.chain import LiveLinks
from cube_tensor_driver.device.clock.hub_clock import HubClock
from cube_tensor_driver.device.links.intake import NativeSamples
from cube_tensor_driver.device.links.link import LinkConfig, LinkState
from cube_tensor_driver.device.links.reader import LinkFrames
from cube_tensor_driver.device.scans.cube_table import CubeAddress
from cube_tensor_driver.device.scans.sequence import SampleAccount
from cube_tensor_driver.device.wire import native
from cube_tensor_driver.device.wire.decoder import PythonDecoder
from cube_tensor_driver.device.wire.protocol import Ack, Command, Hello, Sample, Stats, encode

PERIOD_US = 1000


def sample(number: int, device_us: int | None = None, first: int = 0, n_cubes: int = 1) -> Sample:
    device_us = PERIOD_US * number if device_us is None else device_us
    return sample_frame(number, device_us, n_cubes, first=first)


def hello(n_cubes: int) -> Hello:
    return Hello(1, 1, 2, PERIOD_US, np.arange(1, n_cubes + 1, dtype="<u8"))


class OneLink:
    """The chain behind one link, given frames by hand; its reader is not started."""

    def __init__(self, n_cubes: int = 1) -> None:
        self.rows: list[tuple[int, int]] = []
        cubes = [CubeAddress(f"c{index}", 0, index, None, 2) for index in range(n_cubes)]
        self.live = LiveLinks([LinkConfig("a", "/dev/none")], cubes, self._keep)
        self.lag_s = 0.0  # not that of this machine, which may be busy
        self.live._reader.take_lag_s = lambda: self.lag_s
        self.arrival_ns = EPOCH_NS
        self.give(hello(n_cubes))

    def _keep(self, rows) -> None:
        self.rows += zip(rows.sequence.tolist(), rows.status.tolist(), strict=True)

    def give(self, *frames, after_us: int = PERIOD_US, is_late: bool = False) -> None:
        self.arrival_ns += 1000 * after_us
        self.live.receive([LinkFrames(0, self.arrival_ns, list(frames), 0, is_late)])

    def report(self):
        (report,) = self.live.report()
        losses = [note for note in report.notes if "samples lost" in note]
        return report.values, losses

    def clock_problems(self) -> set[str]:
        return self.live._records[0].clock.problems

    def close(self) -> None:
        self.live.close()


@pytest.fixture
def link():
    made = OneLink()
    yield made
    made.close()


def test_a_link_that_loses_half_of_its_samples_says_how_many_and_where(link) -> None:
    """On the line, then in the hub, as its STATS tell; and nothing once it is over."""
    for number in range(0, 1000, 2):
        link.give(sample(number), after_us=2 * PERIOD_US)
    link.give(Stats(1000, 1000, 0))
    (note,) = link.report()[1]
    assert note.startswith("500 of 1000 samples lost or dropped since the last report: on the line")
    for number in range(1000, 1200, 2):
        link.give(sample(number), after_us=2 * PERIOD_US)
    link.give(Stats(1200, 1200, 100))
    values, (note,) = link.report()
    assert note.startswith("100 of 200 samples lost or dropped since the last report: in the hub")
    assert (values["taken"], values["lost_on_the_way"], values["dropped_in_hub"]) == (
        1200,
        500,
        100,
    )
    for number in range(1200, 1300):
        link.give(sample(number))
    link.give(Stats(1300, 1300, 100))
    assert link.report()[1] == []


def test_losses_that_turn_out_to_be_in_the_hub_are_told_when_its_stats_come(link) -> None:
    link.give(sample(0), sample(10))
    assert "on the line" in link.report()[1][0]
    link.give(Stats(11, 11, 9))
    values, (note,) = link.report()
    assert note == "9 of the samples lost before were dropped in the hub"
    assert (values["lost_on_the_way"], values["dropped_in_hub"]) == (0, 9)


def test_samples_dropped_in_the_hub_count_from_our_start_or_its_restart_on() -> None:
    """Its samples take two frames, each of which counts. Its STATS count whole samples."""
    account = SampleAccount()
    account.announce(80, 2)

    def places(*numbers: int, stats: Stats) -> tuple[int, int]:
        for number in numbers:
            for first in (0, 40):
                account.classify(sample(number, first=first, n_cubes=40))
        account.add_stats(stats)
        counters = account.count_samples()
        return counters["dropped_in_hub"], counters["lost_on_the_way"]

    assert places(500, stats=Stats(1000, 501, 100)) == (0, 0)
    assert places(506, stats=Stats(1100, 507, 103)) == (6, 4)
    assert places(stats=Stats(10, 0, 0)) == (6, 4)
    assert places(0, 5, stats=Stats(20, 6, 2)) == (10, 8)
    assert places(stats=Stats(30, 6, 50)) == (18, 0), "more than were ever missing"


def test_each_value_of_a_report_is_in_its_unit(link) -> None:
    link.give(Stats(12_500, 0, 0, 4900), sample(0))
    record = link.live._records[0]
    track = record.track
    track.first_ns, track.first_us, track.newest_ns = 7_000_000_000, 1_000_000, 0
    track.offset, track.bounded_offset = 504_000.0, 500_000.0
    track.drift, track.jitter_ns = 2.5e-5, 1500.0
    record.clock.resets, record.logger.left_out = 3, 4
    record.clock.line = SimpleNamespace(error_bound=8300.0)
    for counter, number in (("opened", 5), ("lost", 6), ("silences", 7)):
        setattr(link.live._reader.links[0], counter, number)
    values = link.report()[0]
    expected = {
        "clock offset s": 6.0005,
        "clock drift ppm": 25.0,
        "clock jitter us": 1.5,
        "clock delay us": 4.0,
        "clock error at most us": 8.3,
        "clock resets": 3,
        "log lines left out": 4,
        "opened": 5,
        "lost": 6,
        "silences": 7,
        "hub uptime s": 12.5,
        "hub supply mV": 4900,
    }
    assert {name: values[name] for name in expected} == expected


def test_a_host_that_is_too_slow_is_named(link) -> None:
    link.give(sample(0), sample(10))
    link.lag_s = 1.5
    assert "the host is too slow: it was 1.5 s behind" in link.report()[1][0]


def test_a_cable_unplugged_for_twenty_minutes_is_a_gap(link) -> None:
    """More than 2**20 samples at 1 kHz, with the hub powered. Its crystal is 50 ppm off."""
    for number in range(3000):
        link.give(sample(number))
    gap = 20 * 60 * 1000
    link.give(sample(3000 + gap), after_us=round(1000 * gap * (1 - 5e-5)))
    for number in range(3001 + gap, 6000 + gap):
        link.give(sample(number))
    assert not link.clock_problems()
    values, (note,) = link.report()
    assert (values["lost_on_the_way"], values["resets"], values["clock resets"]) == (gap, 0, 0)
    assert note.startswith(f"{gap} of {6000 + gap} samples")
    assert not any(status for _, status in link.rows)


def test_samples_repeated_late_are_repeats_and_nothing_else(link) -> None:
    """64 samples late or later, as a bridge does that sends its buffer again."""
    repeats = range(100, 4000, 105)
    for number in range(4000):
        link.give(sample(number))
        if number in repeats:
            link.give(sample(number - 100), after_us=0)
    values, losses = link.report()
    assert values["duplicate"] == len(repeats) == live_duplicates(link)
    assert (values["delivered"], values["resets"], values["clock resets"]) == (4000, 0, 0)
    assert losses == [] and values["lost_on_the_way"] == 0
    assert link.rows == [(number, 0) for number in range(4000)]


def live_duplicates(link: OneLink) -> int:
    return link.live.count_rows().duplicate


@pytest.mark.parametrize("told_by", [Ack(Command.START), Stats(1, 0, 0), LinkState.WAITING])
def test_a_restart_that_repeats_numbers_and_times_is_a_restart(link, told_by) -> None:
    """Soon after power-up the samples of the next run have the numbers and times of the last one.
    A hub samples after START only, its uptime begins again, or the link was away."""
    link.give(Stats(5, 0, 0))
    for number in range(200):
        link.give(sample(number))
    if isinstance(told_by, LinkState):
        link.live._on_state(0, told_by, None)
    else:
        link.give(told_by)
    for number in range(3):
        link.give(sample(number))
    values, _ = link.report()
    assert (values["resets"], values["duplicate"], values["delivered"]) == (1, 0, 203)


def test_a_hub_that_announces_fewer_cubes_is_counted_right() -> None:
    """80 cubes take two frames, 50 take one: nothing is missing where the second was."""
    link = OneLink(80)
    try:
        for number in range(10):
            link.give(sample(number, first=0, n_cubes=40), sample(number, first=40, n_cubes=40))
        link.give(Stats(10, 10, 0), hello(50))
        for number in range(10, 20):
            link.give(sample(number, n_cubes=50))
        link.give(Stats(20, 20, 0))
        values, losses = link.report()
        assert losses == [] and values["lost_on_the_way"] == values["resets"] == 0
        assert values["taken"] == values["delivered"] == 2 * 10 + 10
        for number in range(20, 30):
            link.give(sample(number, first=0, n_cubes=40), sample(number, first=40, n_cubes=10))
        link.give(Stats(30, 30, 0), hello(40))
        link.give(sample(30, n_cubes=40), Stats(31, 31, 0))
        values, losses = link.report()
        assert losses == [] and values["taken"] == values["delivered"] == 30 + 2 * 10 + 1
        assert values["hub changes"] == 3
        assert link.live.count_rows().unaccounted == 0
    finally:
        link.close()


def test_frames_of_cubes_that_the_hub_does_not_have_are_not_remembered() -> None:
    account = SampleAccount()
    account.announce(8, 2)
    for first in range(20_000):
        account.classify(sample(0, first=first))
    account.add_stats(Stats(10, 1, 0))
    assert len(account._trackers) == 8
    counters = account.count_samples()
    assert (counters["delivered"], counters["lost_on_the_way"]) == (20_000, 0)


def test_a_host_that_falls_behind_does_not_blame_the_hubs_clock() -> None:
    """A backlog of 80 ms from the start on for 4 s, then one that comes and goes."""
    random = np.random.default_rng(3)
    number = np.arange(30_000)
    behind_ms = np.where(number > 4000, np.maximum(0, 80 * np.sin(number / 1200)), 80)
    late_ms = behind_ms + random.exponential(0.2, len(number))
    arrival_ns = np.maximum.accumulate(1_000_000 * (number + late_ms))
    is_late = arrival_ns > 1_000_000 * (number + 2)
    clock = HubClock()
    for k, arrived_ns, late in zip(number.tolist(), arrival_ns, is_late.tolist(), strict=True):
        (stamp_ns,) = clock.update([PERIOD_US * k], EPOCH_NS + int(arrived_ns), [k], late)
        assert k < 5000 or abs(stamp_ns - EPOCH_NS - 1_000_000 * k) < 500_000
    assert clock.problems == set() and clock.resets == 0


def test_the_doubt_after_a_step_waits_for_reads_in_time(link) -> None:
    """A hub samples 30 ms late once, while the host falls behind by as much."""
    number = np.arange(1500)
    device_us = PERIOD_US * number + np.where(number >= 1000, 30_000, 0)
    late_us = np.where((number >= 990) & (number < 1300), 30_000, 0)
    arrival_us = np.maximum.accumulate(device_us + late_us)
    after_us = np.diff(arrival_us, prepend=0)
    for k in number.tolist():
        is_late = bool(arrival_us[k] > device_us[k])
        link.give(sample(k, int(device_us[k])), after_us=int(after_us[k]), is_late=is_late)
    values, _ = link.report()
    assert values["clock resets"] == 0
    assert {status for number, status in link.rows if number < 1000 or number > 1400} == {0}
    assert {status for _, status in link.rows} <= {0, STAMP}


class SimpleAccount(SampleAccount):
    """Account of samples that are given as usual ones although some before them are lost."""

    def __init__(self, host: SlowHost) -> None:
        super().__init__()
        self._host = host

    @property
    def missing(self) -> int:
        return self._host.lost


class SlowHost:
    """A host in simulated time, with two links of a cube each at 1 kHz.

    Every callback costs 0.5 ms, and every scan that it delivers `scan_ms`; what the links send
    meanwhile waits for the next callback, up to `BUFFER` samples of each, as in the kernel.
    """

    BUFFER = 20

    def __init__(self, monkeypatch, scan_ms: float, as_usual: bool) -> None:
        self.now_s, self.scan_ms, self.as_usual = 0.0, scan_ms, as_usual
        self.done = self.lost = 0
        self.ages_s: list[float] = []
        self.numbers: list[int] = []
        cubes = [CubeAddress(f"c{link}", link, 0, None, 2) for link in (0, 1)]
        configs = [LinkConfig(f"l{link}", "/dev/none") for link in (0, 1)]
        self.live = LiveLinks(configs, cubes, self._take)
        self.live._reader = SimpleNamespace(behind_s=0.0)
        if as_usual:
            self.live._records[0].account = SimpleAccount(self)
        monkeypatch.setattr(chain.time, "monotonic", lambda: self.now_s)
        for link in (0, 1):
            one = Hello(link + 1, 1, 2, PERIOD_US, np.array([link + 1], "<u8"))
            self.live.receive([LinkFrames(link, 0, [one])])

    def _take(self, rows) -> None:
        self.now_s += 1e-3 * self.scan_ms * len(rows) / 2
        self.ages_s += (self.now_s - 1e-9 * rows.stamp_ns).tolist()
        self.numbers += rows.sequence[::2].tolist()

    def run(self, n_scans: int) -> None:
        in_time_s = self.now_s
        while self.done < n_scans:
            due = min(n_scans, int(1e3 * self.now_s))
            waiting = range(self.done, min(due, self.done + self.BUFFER))
            if not waiting:
                self.now_s = 1e-3 * (self.done + 1)
                in_time_s = self.now_s
                continue
            self.live._reader.behind_s = self.now_s - in_time_s
            self.done = due
            self.lost += due - waiting.stop
            self.now_s += 0.5e-3
            self._give([sample(number, 1000 * number + 1) for number in waiting])
        assert self.live.count_rows().unaccounted == 0

    def _give(self, samples: list[Sample]) -> None:
        stamps_ns = [1000 * one.device_us for one in samples]
        if not self.as_usual:
            arrival_ns = stamps_ns[-1]
            self.live.receive([LinkFrames(i, arrival_ns, samples, 0, True) for i in (0, 1)])
            return
        decoded = [PythonDecoder().feed(encode(one))[0].raw for one in samples]
        links = [link for link in (0, 1) for _ in samples]
        self.live.receive([], NativeSamples(links, 2 * decoded, 2 * stamps_ns))


@pytest.mark.parametrize("as_usual", [True, False])
@pytest.mark.parametrize(("scan_ms", "share"), [(0.8, 1.0), (1.1, 0.82), (2.0, 0.47)])
def test_a_host_that_is_too_slow_loses_what_exceeds_its_capacity(
    monkeypatch, as_usual, scan_ms, share
) -> None:
    """A host needs 4 * scan_ms + 0.5 ms for 4 scans, so at 1 kHz it can deliver the given share.

    Delivered scans are whole and late by a few periods. In the first half second samples are lost.
    """
    if as_usual and native.wire is None:
        pytest.skip("was not compiled")
    host = SlowHost(monkeypatch, scan_ms, as_usual)
    host.run(4000)
    counts = host.live.count_rows()
    assert counts.delivered + counts.overload == 2 * (4000 - host.lost)
    assert host.lost < 500, "only until it is certain that the host is too slow"
    assert counts.delivered / 8000 == pytest.approx(share, abs=0.1 * share)
    assert (counts.overload > 0) == (share < 1)
    assert host.numbers == sorted(set(host.numbers)), "scans have rows of both links"
    assert np.percentile(host.ages_s[len(host.ages_s) // 2 :], 99) < 20e-3


def test_a_short_pause_of_the_host_loses_nothing(monkeypatch) -> None:
    host = SlowHost(monkeypatch, 0.5, False)
    host.run(100)
    host.now_s += 0.4
    host.run(2000)
    counts = host.live.count_rows()
    assert counts.overload == 0 and counts.delivered == 2 * (2000 - host.lost)


def test_a_host_that_is_always_behind_but_loses_nothing_drops_nothing(monkeypatch) -> None:
    """As where other processes take most of the machine: it reads seldom, but then all."""
    host = SlowHost(monkeypatch, 0.9, False)
    host.BUFFER = 1000
    host.now_s = 0.2
    host.run(3000)
    counts = host.live.count_rows()
    assert (counts.overload, counts.delivered) == (0, 6000)
    assert host.live._reader.behind_s > 1.0
