# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Two machines: simulator and driver on one, reconstruction and a recorder on the other; the cable
between them is cut.

The machines are network namespaces joined by a veth cable; shared memory, which would reach from
one to the other, is off, as it is between real machines.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs rclpy: run this with ./cube test")

from cube_tensor_driver.bags.read import Bag
from cube_tensor_driver.config.package_data import find_package_data
from cube_tensor_driver.messages.types import STRESS_TYPE
from cube_tensor_driver.processes.children import format_ros_arguments
from cube_tensor_driver.processes.skin_processes import Process, SimulatedHubs, list_skin_processes
from cube_tensor_driver.simulation.sample_log import SampleLog

SKIN = find_package_data() / "config" / "skin_demo.yaml"
CUBES, RATE = 16, 100
QUEUE_S = 2.0
"""What queues hold: ros/node.py."""


class Hosts:
    """Two namespaces, `robot` and `desk`, and what runs in them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._names = {host: f"cube_{host}_{os.getpid()}" for host in ("robot", "desk")}
        self._running: dict[str, subprocess.Popen[bytes]] = {}
        for name in self._names.values():
            ip("netns", "add", name)
        robot, desk = self._names.values()
        ip(
            "link",
            "add",
            "cable",
            "netns",
            robot,
            "type",
            "veth",
            "peer",
            "name",
            "cable",
            "netns",
            desk,
        )
        for number, name in enumerate((robot, desk), 1):
            ip("-n", name, "link", "set", "lo", "up")
            ip("-n", name, "address", "add", f"10.231.77.{number}/24", "dev", "cable")
            ip("-n", name, "link", "set", "cable", "up")
        for name in (
            robot,
            desk,
        ):  # Fast DDS never takes up a network that was not there when it started
            wait(lambda name=name: "state UP" in ip("-n", name, "link", "show", "cable"))

    def cable(self, state: str) -> None:
        """up or down."""
        ip("-n", self._names["robot"], "link", "set", "cable", state)

    def start(self, host: str, process: Process) -> None:
        command = [
            "ip",
            "netns",
            "exec",
            self._names[host],
            sys.executable,
            "-u",
            "-m",
            process.module,
        ]
        command += [
            *process.arguments,
            *(["--ros-args", *format_ros_arguments(process.parameters)] if process.node else []),
        ]
        with (self.folder / f"{process.executable}.log").open("wb") as log:
            self._running[process.executable] = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )

    def end(self, *executables: str) -> None:
        for executable in executables:
            self._running[executable].send_signal(signal.SIGINT)
        for executable in executables:
            self._running.pop(executable).wait(10)

    def close(self) -> None:
        for process in self._running.values():
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        for log in self.folder.glob("*.log"):  # pytest shows them when the test fails
            print(f"{log.name}:\n{log.read_text(errors='replace')[-2000:]}")
        for name in self._names.values():
            subprocess.run(["ip", "netns", "del", name], check=False)


def ip(*arguments: str) -> str:
    return subprocess.run(["ip", *arguments], check=True, capture_output=True, text=True).stdout


@pytest.fixture
def hosts(domain: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Hosts]:
    if shutil.which("ip") is None:
        pytest.skip("needs the command ip (Debian: iproute2)")
    probe = f"cube_probe_{os.getpid()}"
    if subprocess.run(["ip", "netns", "add", probe], capture_output=True, check=False).returncode:
        pytest.skip("network namespaces are not permitted here: run as root")
    ip("netns", "del", probe)
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "SUBNET")
    monkeypatch.setenv("FASTDDS_BUILTIN_TRANSPORTS", "UDPv4")
    hosts = Hosts(tmp_path)
    try:
        yield hosts
    finally:
        hosts.close()


def wait(done: Callable[[], object], seconds: float = 60.0) -> None:
    until = time.monotonic() + seconds
    while not done():
        assert time.monotonic() < until, f"did not happen within {seconds} s"
        time.sleep(0.05)


def rows(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cube, sequence and time of arrival (ns) of all rows of `stress`."""
    with Bag(path) as bag:
        (topic,) = bag.list_topics(STRESS_TYPE)
        messages = [(message, time_ns) for time_ns, message in bag.read_decoded({topic})]
    cube, sequence = (
        np.concatenate([getattr(one, name) for one, _ in messages]) for name in ("cube", "sequence")
    )
    arrival = np.repeat(
        [time_ns for _, time_ns in messages], [len(one.cube) for one, _ in messages]
    )
    return cube, sequence.astype(np.int64), arrival


def lost_on_the_way(path: Path) -> int:
    """What the reconstruction said last of messages lost."""
    with Bag(path) as bag:
        arrays = [message for _, message in bag.read_decoded({"/diagnostics"})]
    said = [
        int(pair.value)
        for array in arrays
        for status in array.status
        for pair in status.values
        if pair.key == "messages lost on the way"
    ]
    return said[-1]


def sampled(log: SampleLog) -> dict[tuple[int, int], int]:
    """When each row was sampled, ns of the wall clock, by cube and sequence number."""
    return {
        (cube, int(number)): int(time_ns)
        for link, number, time_ns in zip(
            log.table.link, log.table.number, log.table.time_ns, strict=True
        )
        for cube in log.links[link].members
    }


def test_a_cut_cable_costs_what_queues_do_not_hold_and_that_is_counted(hosts, tmp_path):
    bag, log = tmp_path / "bag", tmp_path / "log.json"
    for process in list_skin_processes(
        SKIN, simulated=SimulatedHubs(tmp_path / "ports", sample_log=log, instants=16)
    ):
        hosts.start("desk" if process.executable == "reconstruction" else "robot", process)
    recording = ("record", "-o", str(bag), "--topics", "stress", "/diagnostics")
    hosts.start("desk", Process("recorder", "cube_tensor_driver.cli", False, arguments=recording))

    def size() -> int:
        return sum(file.stat().st_size for file in bag.rglob("*") if file.is_file())

    def flows() -> None:
        before = size()
        wait(lambda: size() > before + 200_000)  # some ten thousand bytes per scan and second

    flows()
    cuts = []
    for seconds in (1.0, 5.0):
        hosts.cable("down")
        begun = time.time_ns()
        time.sleep(seconds)  # what is tried: a cable that is out for so long
        hosts.cable("up")
        cuts.append((begun, time.time_ns()))
        flows()
    # what queues held came in one burst: the next diagnostics, a second later, say what they did
    # not
    flows()
    flows()
    hosts.end("simulator")
    wait(log.exists)
    hosts.end("recorder", "reconstruction", "driver")

    cube, sequence, arrival = rows(bag)
    came = set(zip(cube.tolist(), sequence.tolist(), strict=True))
    assert len(came) == len(cube)  # nothing twice
    times = sampled(SampleLog.read(log))
    first, last = min(times[one] for one in came), max(times[one] for one in came)
    gone = np.array(
        [time_ns for one, time_ns in times.items() if first < time_ns < last and one not in came]
    )
    down, up = cuts[1]
    back = arrival[arrival > up].min()
    assert back < up + 4e9  # tensors of new samples come soon: DDS repeats its heartbeat every 3 s
    # the short cut costs nothing; the long one what is older than the queues when DDS finds that
    # the cable is back
    slack = 0.5e9  # until DDS has sent again what it holds
    oldest_held = back - QUEUE_S * 1e9
    assert ((gone > down - slack) & (gone < oldest_held + slack)).all()
    assert 0 < len(gone) <= (oldest_held - down + slack) / 1e9 * RATE * CUBES
    # each message holds one to four scans
    counted = lost_on_the_way(bag)
    assert counted <= len(gone) / CUBES <= 4 * counted
