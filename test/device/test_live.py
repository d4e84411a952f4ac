# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""open_links over real pseudo-terminals: simulated hubs at one end, rows at the other."""

from __future__ import annotations

import logging
import os
import select
import signal
import threading
import time
import tty
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from cube_tensor_driver.config.package_data import find_package_data
from cube_tensor_driver.config.skin import Skin, SkinCube, SkinLink, read_skin
from cube_tensor_driver.core.errors import ConfigError
from cube_tensor_driver.core.rows import FrequencyRows
from cube_tensor_driver.device import live
from cube_tensor_driver.device.chain import MAX_SCANS
from cube_tensor_driver.device.links import reader
from cube_tensor_driver.device.links.link import Link
from cube_tensor_driver.device.live import LinkSource, open_links
from cube_tensor_driver.simulation.hub import SimulatedHub

WAIT_S = 10.0  # ends a failing test; nothing is measured with it
PROMPT_S = 1.0  # closing, with a busy machine
BUSY_S = 0.3  # what a busy machine may add to a delay
N_PADS = 8
RATE = 200.0
UNMEASURED = 0


class RandomHub:
    """A simulated hub on a pseudo-terminal, played in a thread: each sample is random.

    sent: frequencies (cubes, pads), mHz, of each sample by its number.
    sampled_us: when it was sampled, µs since the hub was made.
    """

    def __init__(self, port: Path, number: int, uids: list[int]) -> None:
        self.hub = SimulatedHub(
            uid=100 + number, cube_uids=uids, n_pads=N_PADS, boot_us=1_000_003 * (number + 1)
        )
        self.sent: dict[int, np.ndarray] = {}
        self.sampled_us: dict[int, int] = {}
        self._random = np.random.default_rng(number)
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        port.symlink_to(os.ttyname(self._slave))
        self._stopping = False
        self._thread = threading.Thread(target=self._play)
        self._thread.start()

    def close(self) -> None:
        self._stopping = True
        self._thread.join()
        os.close(self._master)
        os.close(self._slave)

    def _play(self) -> None:
        begun_ns = time.monotonic_ns()
        second = 0
        while not self._stopping:
            ready, _, _ = select.select([self._master], [], [], 0.001)
            now_us = (time.monotonic_ns() - begun_ns) // 1000
            if ready:
                self._send(self.hub.receive(os.read(self._master, 4096), now_us))
            while self.hub.started and self.hub.next_us <= now_us:
                self._send(self._sample())
            if now_us // 200_000 > second:
                second = now_us // 200_000
                self._send(self.hub.make_hello() + self.hub.make_stats(now_us))

    def _sample(self) -> bytes:
        shape = len(self.hub.cube_uids), N_PADS
        frequency = self._random.integers(90_000_000, 110_000_000, shape, "<u4")
        frequency[self._random.random(shape) < 0.05] = UNMEASURED
        self.sent[self.hub.sequence] = frequency
        self.sampled_us[self.hub.sequence] = self.hub.next_us
        return self.hub.sample(frequency)

    def _send(self, data: bytes) -> None:
        os.write(self._master, data)


def make_skin(*cubes_of_links: int) -> Skin:
    """Links of so many cubes each, by link and index."""
    calibration = read_skin(find_package_data() / "config" / "cube.yaml").cubes[0].calibration
    assert calibration.layout.n_pads == N_PADS
    links = tuple(
        SkinLink(f"hub{number}", "/dev/none", 115200, None) for number in range(len(cubes_of_links))
    )
    cubes = tuple(
        SkinCube(f"cube{link}_{at}", f"hub{link}", at, None, (0, 0, 0), (0, 0, 0), calibration)
        for link, count in enumerate(cubes_of_links)
        for at in range(count)
    )
    return Skin("test", "world", RATE, links, cubes)


Play = Callable[[Skin], list[RandomHub]]


@pytest.fixture
def play(tmp_path: Path) -> Iterator[Play]:
    """Play the hubs of a skin, on ports in tmp_path, until the test is over."""
    hubs: list[RandomHub] = []

    def begin(skin: Skin) -> list[RandomHub]:
        for number, link in enumerate(skin.links):
            count = sum(cube.link == link.name for cube in skin.cubes)
            uids = list(range(1000 * number + 1, 1000 * number + 1 + count))
            hubs.append(RandomHub(tmp_path / link.name, number, uids))
        return hubs

    yield begin
    for hub in hubs:
        hub.close()


def notes(source: LinkSource) -> list[str]:
    """Problems of the first link since the last call."""
    return source.statistics()["links"]["hub0"]["notes"]


def wait_until(done: Callable[[], object], seconds: float) -> object:
    """What done() returns when it is true at last, or when the time is over."""
    until = time.monotonic() + seconds
    while not (found := done()) and time.monotonic() < until:
        time.sleep(0.01)
    return found


def first_rows(source: LinkSource, n_rows: int) -> list[FrequencyRows]:
    """Rows from a source until there are so many."""
    got: list[FrequencyRows] = []
    timer = threading.Timer(WAIT_S, source.close)  # ends the iteration if nothing comes
    timer.start()
    for rows in source:
        got.append(rows)
        if sum(map(len, got)) >= n_rows:
            break
    timer.cancel()
    return got


def close_within(source: LinkSource, limit_s: float) -> None:
    begun = time.monotonic()
    source.close()
    assert time.monotonic() - begun < limit_s


@pytest.mark.parametrize("has_descriptors", [True, False])
def test_all_that_the_hubs_sent_comes_out_bit_for_bit(
    play: Play, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, has_descriptors: bool
) -> None:
    """Also as on Windows, where no call waits for several ports."""
    monkeypatch.setattr(Link, "HAS_DESCRIPTORS", has_descriptors)
    skin = make_skin(3, 2)
    hubs = play(skin)
    with open_links(skin, port_directory=tmp_path) as source:
        assert source.skin is skin
        assert source.is_live is True
        got = first_rows(source, 500)
        statistics = source.statistics()
    cube, sequence, stamp_ns, frequency, temperature, pad_fault, status = (
        np.concatenate([getattr(rows, name) for rows in got])
        for name in (
            *("cube", "sequence", "stamp_ns", "frequency"),
            *("temperature", "pad_fault", "status"),
        )
    )
    assert len(cube) >= 500
    for number in range(5):
        link, at = (0, number) if number < 3 else (1, number - 3)
        rows = cube == number
        numbers = sequence[rows]
        np.testing.assert_array_equal(np.diff(numbers), 1)
        sent = np.array([hubs[link].sent[int(k)][at] for k in numbers])
        expected = (sent * 1e-3).astype(np.float32)
        expected[sent == UNMEASURED] = np.nan
        np.testing.assert_array_equal(frequency[rows], expected)
        assert np.diff(stamp_ns[rows]).min() >= 0
        sampled_ns = 1000 * np.array([hubs[link].sampled_us[int(k)] for k in numbers])
        assert np.ptp(stamp_ns[rows]) == pytest.approx(np.ptp(sampled_ns), abs=BUSY_S * 1e9)
    assert np.isnan(temperature).all()
    assert not pad_fault.any() and not status.any()
    assert abs(time.time_ns() - int(stamp_ns.max())) < WAIT_S * 1e9
    sizes = [len(rows) for rows in got]
    assert 5 in sizes, "a scan of both links, where nothing was held up"
    assert max(sizes) <= 5 * MAX_SCANS

    assert statistics["rows given"] == len(cube)
    assert statistics["rows dropped"] == 0
    assert statistics["rows unaccounted"] == 0
    assert statistics["rows of unknown cubes"] == 0
    links = statistics["links"]
    assert isinstance(links, dict)
    assert list(links) == ["hub0", "hub1"]
    for values in links.values():
        assert values["state"] in ("open", "silent")  # silent where a busy machine held up the hub
        assert values["lost_on_the_way"] == values["crc"] == values["resets"] == 0
        assert values["delivered"] >= 90  # on a busy machine one link is some samples ahead


def test_rate_is_asked_of_the_hubs(play: Play, tmp_path: Path) -> None:
    skin = make_skin(1)
    (hub,) = play(skin)
    with open_links(skin, rate=500.0, port=str(tmp_path / "hub0")) as source:
        first_rows(source, 50)
        assert hub.hub.period_us == 2000
    with open_links(replace(skin, rate=None), port_directory=str(tmp_path)) as source:
        first_rows(source, 5)
        assert hub.hub.period_us == 2000, "the hub's own"


def test_cubes_that_do_not_fit_are_counted_and_named(play: Play, tmp_path: Path) -> None:
    skin = make_skin(2)
    play(skin)
    less = replace(skin, cubes=skin.cubes[:1])
    with open_links(less, port_directory=tmp_path) as source:
        got = first_rows(source, 20)
        statistics = source.statistics()
    assert {int(cube) for rows in got for cube in rows.cube} == {0}
    assert statistics["rows of unknown cubes"] >= 20
    links = statistics["links"]
    assert isinstance(links, dict)
    note = "the hub's cube 1 (uid 0x2) not in the skin file: add it there"
    assert note in links["hub0"]["notes"]


def test_a_slow_consumer_loses_the_oldest_rows_and_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A scan comes every 1/64 s; 0.25 s are kept, which are 17 scans."""
    now_s = [0.0]
    monkeypatch.setattr(live, "QUEUE_S", 0.25)
    monkeypatch.setattr(live, "time", SimpleNamespace(monotonic=lambda: now_s[0]))
    with open_links(make_skin(2), port_directory=tmp_path) as source:
        for number in range(100):
            now_s[0] = number / 64
            rows = FrequencyRows.from_values(
                [0, 1], np.ones((2, N_PADS)), sequence=[number, number]
            )
            source._put(rows)
        assert next(iter(source)).sequence.tolist() == [83, 83]
        statistics = source.statistics()
    counts = [statistics[f"rows {name}"] for name in ("dropped", "given", "waiting")]
    assert counts == [2 * 83, 2, 2 * 16]


def test_a_port_that_a_simulator_will_make_is_no_news_while_it_is_missing(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Of a hub on a serial port it is."""

    def warned(skin: Skin, **where: Path) -> list[str]:
        caplog.clear()
        with open_links(skin, rate=RATE, **where) as source:
            wait_until(lambda: notes(source), WAIT_S)
        return [record.message for record in caplog.records if record.levelno >= logging.WARNING]

    assert warned(make_skin(1), port_directory=tmp_path) == []
    assert "/dev/none: No such file" in warned(make_skin(1))[0]


def test_close_ends_an_iteration_that_waits(tmp_path: Path) -> None:
    """There is no hub, so it waits."""
    source = open_links(make_skin(1), port_directory=tmp_path)
    got: list[FrequencyRows] = []
    waiting = threading.Thread(target=lambda: got.extend(source))
    waiting.start()
    found = wait_until(lambda: notes(source), WAIT_S)
    assert waiting.is_alive() and "plug the hub in" in found[0]
    assert source.statistics()["links"]["hub0"]["state"] == "waiting"
    close_within(source, PROMPT_S)
    waiting.join(PROMPT_S)
    assert not waiting.is_alive()
    assert got == []
    source.close()
    assert list(source) == []


def test_closing_stops_the_hubs_and_ends_the_thread(play: Play, tmp_path: Path) -> None:
    skin = make_skin(1)
    (hub,) = play(skin)
    with open_links(skin, port_directory=tmp_path) as source:
        first_rows(source, 5)
        assert hub.hub.started
        for _ in source:
            close_within(source, PROMPT_S)  # from within the loop, which ends
    assert "cube reader" not in {thread.name for thread in threading.enumerate()}
    assert wait_until(lambda: not hub.hub.started, PROMPT_S)
    links = source.statistics()["links"]
    assert isinstance(links, dict)
    assert links["hub0"]["state"] == "closed", "statistics can still be asked for"


@pytest.fixture
def ctrl_c() -> Iterator[None]:
    """SIGINT raises KeyboardInterrupt, as in a terminal. Workers of pytest-xdist ignore it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("ctrl_c")
def test_ctrl_c_works_while_waiting(tmp_path: Path) -> None:
    source = open_links(make_skin(1), port_directory=tmp_path)
    threading.Timer(0.2, os.kill, [os.getpid(), signal.SIGINT]).start()
    give_up = threading.Timer(WAIT_S, source.close)
    give_up.start()
    with pytest.raises(KeyboardInterrupt), source:
        for _ in source:
            pass
    assert give_up.is_alive()
    give_up.cancel()
    assert "cube reader" not in {thread.name for thread in threading.enumerate()}


def test_a_reader_that_fails_raises_its_error_in_the_iteration(
    play: Play, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    skin = make_skin(1)
    play(skin)
    broken = OSError("not foreseen")
    with open_links(skin, port_directory=tmp_path) as source:
        first_rows(source, 5)

        def fail(*arguments: object) -> None:
            raise broken

        monkeypatch.setattr(reader.Intake, "read", fail)
        begun = time.monotonic()
        with pytest.raises(OSError, match="not foreseen") as raised:
            for _ in source:
                pass
        assert raised.value is broken
        assert time.monotonic() - begun < PROMPT_S
        with pytest.raises(OSError, match="not foreseen"):
            next(iter(source))


def test_arguments_that_cannot_be_used_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"rate is -1, allowed: 0\.1 to 10000"):
        open_links(make_skin(1), rate=-1)
    with pytest.raises(ConfigError, match=r"rate is nan"):
        open_links(make_skin(1), rate=float("nan"))
    with pytest.raises(ConfigError, match=r"port is '/dev/x', but the skin test has 2 links"):
        open_links(make_skin(1, 1), port="/dev/x")
    with pytest.raises(ConfigError, match="port from 1 to 65535"):
        open_links(make_skin(1), port="socket://nowhere")
    with pytest.raises(ConfigError, match="a device path, a pattern"):
        open_links(make_skin(1), port=f"spy:///dev/null?file={tmp_path}/log")
    assert list(tmp_path.iterdir()) == []
