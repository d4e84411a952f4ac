# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Recording and replaying in real processes."""

from __future__ import annotations

import contextlib
import os
import pty
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs rclpy: run this with ./cube test")

from bag_maker import START_NS, make_bag
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from test_files import all_differing_bits, differing_bits, stress

from conftest import ROOT, decoded
from cube_tensor_driver.bags.read import Bag
from cube_tensor_driver.bags.repair import repair
from cube_tensor_driver.bags.reprocess.job import ReprocessJob, reprocess
from cube_tensor_driver.bags.write import BagWriter
from cube_tensor_driver.cli.main import main
from cube_tensor_driver.config.package_data import find_package_data
from cube_tensor_driver.core.errors import BagError
from cube_tensor_driver.messages.types import FREQUENCIES_TYPE, INFO_TYPE, STRESS_TYPE
from cube_tensor_driver.msg import SkinFrequencies, SkinInfo, SkinStress
from cube_tensor_driver.processes.children import Children
from cube_tensor_driver.processes.skin_processes import Process, SimulatedHubs, list_skin_processes
from cube_tensor_driver.ros.commands.record import FLUSH_PERIOD_S, WRITE_PERIOD_S
from cube_tensor_driver.ros.messages import to_ns
from cube_tensor_driver.ros.qos import make_batch_profile
from cube_tensor_driver.simulation.inject import inject

SKIN = find_package_data() / "config" / "skin_demo.yaml"
LATCHED = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
MADE_ANEW = ("--exclude-topics", "/stress")
needs_ros2_bag = pytest.mark.skipif(
    find_spec("ros2bag") is None, reason="needs ros2 bag, which the wheels lack"
)


_started: list[subprocess.Popen] = []


@pytest.fixture(autouse=True)
def nothing_left() -> Iterator[None]:
    """A test that fails leaves no recorder behind, which others would hear."""
    yield
    while _started:
        process = _started.pop()
        if process.poll() is None:
            process.kill()
            process.wait()


def cube(*arguments: object) -> subprocess.Popen:
    process = subprocess.Popen(
        [sys.executable, "-m", "cube_tensor_driver.cli", *map(str, arguments)],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    _started.append(process)
    return process


def ros2_bag(*arguments: object) -> subprocess.Popen:
    return subprocess.Popen(
        ["ros2", "bag", *map(str, arguments), "--disable-keyboard-controls"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def end(process: subprocess.Popen, number: int = signal.SIGINT) -> str:
    process.send_signal(number)
    return process.communicate(timeout=20)[1]


def grown(folder: Path, size: int) -> bool:
    """Whether the storage files of a folder hold so many bytes."""
    files = [path for path in folder.glob("**/*") if path.name.endswith((".mcap", ".db3"))]
    return sum(path.stat().st_size for path in files) > size


def frequency_stamps(bag: Path, copy: Path | None = None) -> list[int]:
    """What a bag holds of frequencies; of one that is being written, what a repaired copy of it
    does."""
    if copy is not None:
        shutil.rmtree(copy, ignore_errors=True)
        try:
            shutil.copytree(bag, copy)
            repair(copy)
        except (OSError, BagError):  # nothing there yet
            return []
        bag = copy
    with Bag(bag) as opened:
        if "/frequencies" not in opened.list_topics(FREQUENCIES_TYPE):
            return []
        return [
            int(stamp)
            for messages, _ in opened.read_frequencies("/frequencies")
            for stamp in messages.stamp_ns
        ]


@pytest.fixture(scope="module")
def bag_of_a_second(tmp_path_factory) -> Path:
    return make_bag(tmp_path_factory.mktemp("bags") / "bag", SKIN, messages=100)


@pytest.fixture
def own_signals() -> Iterator[None]:
    """A command that runs in this process leaves no signal handler behind."""
    numbers = signal.SIGINT, signal.SIGTERM, signal.SIGHUP
    handlers = [signal.getsignal(number) for number in numbers]
    yield
    for number, handler in zip(numbers, handlers, strict=True):
        signal.signal(number, handler)


@pytest.fixture
def running(ros, tmp_path):
    """A simulated skin of sixteen cubes, and a tester that listens."""
    with Children(tmp_path) as children:
        for process in list_skin_processes(SKIN, simulated=SimulatedHubs(tmp_path / "ports")):
            children.start(process)
        ros.children = children
        ros.heard = ros.listen(SkinStress, "stress", 1000)
        ros.wait(lambda: ros.heard)
        yield ros
        children.check()


@pytest.mark.alone
def test_recorded_is_published_and_reprocessed_is_live(running, tmp_path):
    """Nothing lost against what another subscriber hears; and the pipeline gives the nodes' own
    bits again.

    Also of a pad that was found stuck before the recording began, which the frequencies alone say
    half a second later.
    """
    path = tmp_path / "bag"
    inject(tmp_path / "ports", ["kind=stuck", "link=hub1", "cube=2", "pad=6", "seconds=60"])
    running.wait(lambda: running.heard[-1].left_out[-6:].count(1 << 6))
    heard = running.listen(SkinFrequencies, "frequencies", 1000)
    running.wait(lambda: heard)
    recorder, other = (
        cube("record", "-o", path),
        cube("record", "-o", tmp_path / "other", "--storage", "sqlite3"),
    )
    # The one that starts later has to have recorded for a while, too.
    running.wait(lambda: grown(path, 800_000) and grown(tmp_path / "other", 400_000))
    output = end(recorder)
    assert "/frequencies" in end(other) and other.returncode == 0
    assert recorder.returncode == 0 and "/frequencies" in output, output
    with Bag(path) as bag:
        assert {info.sender for info in bag.read_infos("/info")} == {"reconstruction"}
        assert all(cube.uid for cube in bag.read_infos("/info")[-1].cubes)
        recorded = [
            int(stamp)
            for messages, _ in bag.read_frequencies("/frequencies")
            for stamp in messages.stamp_ns
        ]
        latched = {one.topic for one in bag.connections if one.is_latched}
    assert "/info" in latched and "/frequencies" not in latched
    running.wait(lambda: to_ns(heard[-1].header.stamp) >= recorded[-1])
    stamps = [to_ns(message.header.stamp) for message in heard]
    first, last = stamps.index(recorded[0]), stamps.index(recorded[-1])
    assert recorded == stamps[first : last + 1] and len(recorded) > 50
    assert len(set(recorded) & set(frequency_stamps(tmp_path / "other"))) > 50
    reprocess(ReprocessJob(path, tmp_path / "out", "bag"))
    live, again = stress(path), stress(tmp_path / "out")
    common = live.keys() & again.keys()
    assert len(common) > 50
    assert all_differing_bits({k: live[k] for k in common}, {k: again[k] for k in common}) == 0
    assert all(again[k].left_out[again[k].cube == 10].all() for k in common)


@needs_ros2_bag
def test_ros2_bag_records_what_is_published(running, tmp_path):
    """As docs/bags.md says. The bag has the info from before, every scan, and gives the same bits
    again."""
    path = tmp_path / "bag"
    overrides = find_package_data() / "config" / "record_qos.yaml"
    options = ["--storage", "mcap", "-o", path, "--qos-profile-overrides-path", overrides]
    options += ["--topics", "/frequencies", "/stress", "/info"]
    heard = running.listen(SkinFrequencies, "frequencies", 1000)
    running.wait(lambda: heard)
    recorder = ros2_bag("record", *options)
    running.wait(lambda: len(running.node.get_subscriptions_info_by_topic("/frequencies")) == 3)
    begun = len(heard)
    running.wait(lambda: len(heard) > begun + 100)
    end(recorder)
    recorded = frequency_stamps(path)
    stamps = [to_ns(message.header.stamp) for message in heard]
    assert (
        recorded == stamps[stamps.index(recorded[0]) : stamps.index(recorded[-1]) + 1]
        and len(recorded) > 50
    )
    with Bag(path) as bag:
        assert {info.sender for info in bag.read_infos("/info")} == {"reconstruction"}
        assert all(cube.uid for cube in bag.read_infos("/info")[-1].cubes)
    reprocess(ReprocessJob(path, tmp_path / "out", "bag"))
    live, again = stress(path), stress(tmp_path / "out")
    common = live.keys() & again.keys()
    assert len(common) > 50
    assert all_differing_bits({k: live[k] for k in common}, {k: again[k] for k in common}) == 0


def test_killed_recordings_lose_less_than_a_second(running, tmp_path):
    """Killed while it writes, a recording is whole up to its end; and within a second it writes all
    that has come, even if nothing follows."""
    assert 2 * FLUSH_PERIOD_S + WRITE_PERIOD_S < 1.0
    heard = running.listen(SkinFrequencies, "frequencies", 1000)
    running.wait(lambda: heard)

    counts: list[int] = []

    def is_all_written() -> bool:
        counts.append(len(heard))
        # A look takes longer than the next message, so what has come is heard first.
        is_quiet = len(set(counts[-10:])) == 1
        newest_ns = to_ns(heard[-1].header.stamp)
        return is_quiet and frequency_stamps(path, tmp_path / "copy")[-1:] == [newest_ns]

    for is_followed in (True, False):
        path = tmp_path / f"killed{is_followed}"
        recorder = cube("record", "-o", path)
        running.wait(lambda path=path: grown(path, 400_000))
        if not is_followed:
            running.children.pause("simulator")
            running.wait(is_all_written)
            running.children.resume("simulator")
        recorder.kill()
        recorder.communicate(timeout=10)
        with pytest.raises(BagError, match="repair"):
            Bag(path)
        assert repair(path).messages > 0
        stamps = frequency_stamps(path)
        running.wait(lambda stamps=stamps: to_ns(heard[-1].header.stamp) >= stamps[-1])
        published = [to_ns(message.header.stamp) for message in heard]
        assert len(stamps) > 50
        assert stamps == published[published.index(stamps[0]) : published.index(stamps[-1]) + 1]


def test_the_duration_of_a_recording_begins_with_its_first_message(tmp_path, monkeypatch):
    from cube_tensor_driver.ros import session
    from cube_tensor_driver.ros.commands import record

    now = [100.0]
    recorder = SimpleNamespace(error=None, counts={"/stress": 0}, has_begun=True)
    recorder.find_topics = recorder.close = lambda: None

    def spin_once(timeout_sec: float) -> None:
        now[0] += timeout_sec
        recorder.counts["/stress"] += now[0] >= 103.0  # found late

    monkeypatch.setattr(record, "Recorder", lambda *_: recorder)
    for module in (record, session):
        monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: now[0]))
    bag = SimpleNamespace(folder=tmp_path, messages=1)
    node = SimpleNamespace(create_timer=lambda *_: None)
    its_node = session.NodeSession(node, SimpleNamespace(spin_once=spin_once))
    monkeypatch.setattr(record, "run_node_session", lambda _: contextlib.nullcontext(its_node))
    monkeypatch.setattr(record, "stop_event", threading.Event)
    monkeypatch.setattr(record, "BagWriter", lambda *_: bag)
    limits = {"storage": "mcap", "max_bytes": 0, "max_seconds": 0.0}
    record.record(tmp_path, [], duration=5.0, show=lambda *_: None, **limits)
    assert now[0] == pytest.approx(108.0, abs=2 * session.STEP_S)


class Publishers:
    """A node that meets one publisher of each topic, connected when the test says so."""

    def __init__(self) -> None:
        self.connected: dict[str, bool] = {}
        self.receive: dict[str, object] = {}
        self.now_ns = START_NS

    def get_clock(self) -> object:
        return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=self.now_ns))

    def get_publishers_info_by_topic(self, topic: str) -> list[object]:
        if topic not in self.connected:
            return []
        kinds = {"/stress": STRESS_TYPE, "/frequencies": FREQUENCIES_TYPE, "/info": INFO_TYPE}
        profile = LATCHED if topic == "/info" else QoSProfile(depth=10)
        return [SimpleNamespace(topic_type=kinds[topic], qos_profile=profile)]

    def create_subscription(self, kind, topic, receive, profile, raw) -> object:
        self.receive[topic] = receive
        return SimpleNamespace(get_publisher_count=lambda: int(self.connected[topic]))

    def destroy_subscription(self, subscription: object) -> None:
        pass


def recorded(path: Path) -> list[tuple[str, bytes]]:
    with Bag(path) as bag:
        return [(entry.topic, entry.data) for entry in bag.read_entries()]


def test_recording_begins_when_all_topics_are_connected(tmp_path, monkeypatch):
    """Stress without its frequencies could not be computed again."""
    from cube_tensor_driver.ros.commands import record

    now = [50.0]
    monkeypatch.setattr(record, "time", SimpleNamespace(monotonic=lambda: now[0]), raising=True)
    node = Publishers()
    bag = BagWriter(tmp_path / "bag")
    recorder = record.Recorder(node, ["/stress", "/frequencies", "/info"], bag)
    node.connected = {"/stress": True, "/info": True, "/frequencies": False}
    for step in range(4):
        recorder.find_topics()
        now[0] += 0.5
        assert not recorder.has_begun
        node.receive["/stress"](b"early %d" % step)
        if step == 1:
            node.receive["/info"](b"latched")
    node.connected["/frequencies"] = True
    recorder.find_topics()
    assert recorder.has_begun and recorder.counts == {"/stress": 0, "/frequencies": 0, "/info": 1}
    node.receive["/frequencies"](b"one")
    node.receive["/stress"](b"two")
    assert recorder.received == 3 and not recorder.late
    recorder.close()
    assert recorded(tmp_path / "bag") == [
        ("/info", b"latched"),
        ("/frequencies", b"one"),
        ("/stress", b"two"),
    ]


def test_a_topic_that_comes_late_is_named(tmp_path, monkeypatch, capsys):
    from cube_tensor_driver.cli.record import RecordingStatus
    from cube_tensor_driver.ros.commands import record

    now = [50.0]
    monkeypatch.setattr(record, "time", SimpleNamespace(monotonic=lambda: now[0]), raising=True)
    node = Publishers()
    recorder = record.Recorder(node, ["/stress", "/frequencies"], BagWriter(tmp_path / "bag"))
    node.connected = {"/frequencies": True}
    while not recorder.has_begun:
        recorder.find_topics()
        node.receive["/frequencies"](b"early")
        now[0] += 0.25
    assert now[0] - 50 == pytest.approx(record.MAX_CONNECT_S, abs=0.5)
    node.receive["/frequencies"](b"kept")
    now[0] += 2.0
    node.connected["/stress"] = True
    recorder.find_topics()
    assert recorder.late == {"/stress": pytest.approx(2.25)}
    recorder.close()
    assert recorded(tmp_path / "bag") == [("/frequencies", b"early"), ("/frequencies", b"kept")]
    RecordingStatus(tmp_path / "bag").print_summary(recorder)
    assert "/stress came 2.2 s later than the other topics" in capsys.readouterr().err


def test_a_recording_that_ends_early_keeps_what_came(tmp_path):
    from cube_tensor_driver.ros.commands import record

    node = Publishers()
    recorder = record.Recorder(node, ["/stress", "/frequencies"], BagWriter(tmp_path / "bag"))
    node.connected = {"/stress": True}
    recorder.find_topics()
    node.receive["/stress"](b"early")
    recorder.close()
    assert recorded(tmp_path / "bag") == [("/stress", b"early")]


def test_messages_that_a_slow_disk_does_not_take_are_counted(tmp_path, monkeypatch):
    from cube_tensor_driver.ros.commands import record

    monkeypatch.setattr(record, "MAX_WAITING_BYTES", 9)
    node = Publishers()
    recorder = record.Recorder(node, ["/stress", "/frequencies"], BagWriter(tmp_path / "bag"))
    node.connected = {"/stress": True}
    recorder.find_topics()  # nothing is written before both topics are connected
    for data in (b"12345", b"6789", b"too much", b"more"):
        node.receive["/stress"](data)
    assert (recorder.received, recorder.dropped, recorder.counts) == (4, 2, {"/stress": 4})
    recorder.close()
    assert recorded(tmp_path / "bag") == [("/stress", b"12345"), ("/stress", b"6789")]


def test_record_says_what_is_wrong(domain, tmp_path):
    (tmp_path / "there").mkdir()
    recorder = cube("record", "-o", tmp_path / "there")
    _, errors = recorder.communicate(timeout=30)
    assert recorder.returncode == 1 and "is there already" in errors and "Traceback" not in errors
    recorder = cube("record", "-o", tmp_path / "bag", "--topics", "nothing", "--duration", "0.5")
    _, errors = recorder.communicate(timeout=30)
    assert recorder.returncode == 1 and "Traceback" not in errors
    assert f"nobody offers /nothing in DDS domain {domain}; start the skin" in errors
    assert not (tmp_path / "bag").exists()
    recorder = cube("record", "-o", tmp_path / "bag", "--topics", "bad topic!")
    _, errors = recorder.communicate(timeout=30)
    assert recorder.returncode == 1 and errors.count("\n") == 1
    assert "topic 'bad topic!', allowed: letters" in errors
    assert not (tmp_path / "bag").exists()


@pytest.mark.parametrize("number", ["abc", "500", "-1"])
@pytest.mark.parametrize("words", ["record -o {}", "view", "replay {}", "demo --headless"])
def test_a_domain_that_is_none_is_one_line(
    bag_of_a_second, own_signals, monkeypatch, capsys, words, number
):
    monkeypatch.setenv("ROS_DOMAIN_ID", number)
    there, new = bag_of_a_second, bag_of_a_second.with_name("new")
    command = words.format(there if words.startswith("replay") else new).split()
    assert main(command) == 1
    assert capsys.readouterr().err == (
        f"cube: ROS_DOMAIN_ID is {number!r}, allowed: 0 to 232; set it or unset it\n"
    )
    assert not new.exists()


def test_a_node_in_a_domain_that_is_none_ends_with_one_line(domain, monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", "abc")
    command = [sys.executable, "-m", "cube_tensor_driver.ros.nodes.driver"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=30, check=False)
    assert done.returncode == os.EX_CONFIG
    assert done.stderr == (
        "cube_tensor_driver: ROS_DOMAIN_ID is 'abc', allowed: 0 to 232; set it or unset it\n"
    )


def reconstruction(children: Children, config: Path) -> None:
    children.start(
        Process(
            "reconstruction",
            "cube_tensor_driver.ros.nodes.reconstruction",
            parameters={"config": str(config), "use_sim_time": True},
        )
    )


def stuck(k: int) -> np.ndarray:
    """A pad of cube 5 that was found stuck before the recording began, until message 60."""
    return np.where(np.arange(16) == 5, 1 << 3, 0) * (k < 60)


@pytest.mark.parametrize(
    ("config", "command"),
    [
        ("skin", "replay"),
        ("bag", "replay"),
        pytest.param("bag", "ros2 bag play", marks=needs_ros2_bag),
    ],
)
def test_replayed_frequencies_give_the_recorded_stress(ros, tmp_path, config, command):
    """To the bit, stamps included, also the second time round after the jump back.

    With the bag as configuration also where the skin was tared in the middle, and a pad known to be
    bad.
    """
    made = {"left_out": stuck, "tare": (90, 1.001)} if config == "bag" else {}
    path = make_bag(tmp_path / "bag", SKIN, 150, **made)
    batches = ros.listen(SkinStress, "stress", make_batch_profile(None))
    infos = ros.listen(SkinInfo, "info", LATCHED)
    clock = ros.listen(
        Clock, "/clock", QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)
    )
    with Children(tmp_path) as children:
        reconstruction(children, path if config == "bag" else SKIN)
        ros.wait(lambda: len(infos) == 1)
        options = (path, "--clock", "--loop", "--rate", "2")
        player = (
            cube("replay", *options)
            if command == "replay"
            else ros2_bag("play", *options, *MADE_ANEW)
        )

        def twice_round() -> bool:
            """Two beginnings and a jump back seen; how much of the first round is heard is up to
            discovery."""
            begun = [message for message in batches if to_ns(message.header.stamp) == START_NS]
            now = [to_ns(message.clock) for message in clock]
            return len(begun) >= 2 and len(infos) > 1 and min(np.diff(now), default=0) < 0

        ros.wait(twice_round)
        assert "Traceback" not in end(player)
        assert player.returncode == 0
        children.check()
    recorded = stress(path)
    for message in batches:
        rows = decoded(message).rows
        assert differing_bits(rows, recorded[to_ns(message.header.stamp)]) == 0
    now = [to_ns(message.clock) for message in clock]
    assert min(np.diff(now)) < -1_000_000_000  # the jump back
    assert all(START_NS <= one <= START_NS + 1_500_000_000 for one in now)


def test_replay_starts_late_pauses_steps_and_quits(ros, tmp_path):
    """Keys through a terminal of its own."""
    path = make_bag(tmp_path / "bag", SKIN, 300)
    raw = ros.listen(SkinFrequencies, "frequencies", make_batch_profile(None))
    infos = ros.listen(SkinInfo, "info", LATCHED)
    near, far = pty.openpty()
    player = subprocess.Popen(
        [sys.executable, "-m", "cube_tensor_driver.cli", "replay", str(path), "--start", "1"],
        cwd=ROOT,
        stdin=far,
        stdout=far,
        stderr=far,
    )
    os.close(far)
    os.set_blocking(near, False)
    try:
        ros.wait(lambda: len(raw) > 10 and infos)
        # The player may know of the subscription a little before the subscriber knows of the
        # player, whose first messages are lost then.
        first = int(raw[0].sequence[0])
        assert 100 <= first < 200 and len(infos) == 1
        assert [int(one.sequence[0]) for one in raw[:10]] == list(range(first, first + 10))
        os.write(near, b" ")
        held: list[int] = []

        def still() -> bool:
            held.append(len(raw))
            return len(held) > 8 and len(set(held[-8:])) == 1  # for 0.7 s

        ros.wait(still)
        before = len(raw)
        os.write(near, b"s")
        ros.wait(lambda: len(raw) > before)
        ros.wait(still)
        assert len(raw) == before + 1
        os.write(near, b"q")
        assert player.wait(timeout=10) == 0
    finally:
        player.kill()
        player.wait()
        os.close(near)


def test_types_of_the_bag_are_offered_as_they_were(ros, tmp_path):
    path = make_bag(tmp_path / "bag", SKIN, 50)
    player = cube("replay", path, "--stress")
    ros.wait(
        lambda: (
            {name for name, _ in ros.node.get_topic_names_and_types()}
            >= {"/stress", "/info", "/force"}
        )
    )
    offered = ros.node.get_publishers_info_by_topic("/info")[0]
    assert offered.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
    assert ros.node.get_publishers_info_by_topic("/frequencies")[0].topic_type == FREQUENCIES_TYPE
    assert player.communicate(timeout=20) and player.returncode == 0
