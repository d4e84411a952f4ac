# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Fixtures: a DDS domain of its own for every test that runs ROS, kept to this host."""

from __future__ import annotations

import contextlib
import fcntl
import functools
import itertools
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

# On every processor there is a worker, or a node: threads of a matrix product only get in the way.
# The library reads this when numpy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import pytest
from hypothesis import HealthCheck, settings

from cube_tensor_driver.core.rows import FrequencyRows
from cube_tensor_driver.device.wire.protocol import Sample

# Hypothesis measures the time of an example by the wall clock, which also counts the time in which
# a busy machine runs other processes.
settings.register_profile("busy", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("busy")

# A shell that starts us in the background has SIGINT ignored, in all that we start too.
signal.signal(signal.SIGINT, signal.default_int_handler)

ROOT = Path(__file__).resolve().parents[1]
# Tests share cases with those of other folders.
sys.path += [str(folder) for folder in (ROOT / "test").iterdir() if folder.is_dir()]
# Domains up to 101 leave the ports of the system alone.
_domains = itertools.cycle(range(1, 101))


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests that run alone do so one after the other, and one worker runs all tests that share a
    fixture of their module, which is then set up once."""
    for item in items:
        if is_alone(item):
            item.add_marker(pytest.mark.xdist_group("alone"))
        elif (shared := _shared_fixtures(item)) and not item.get_closest_marker("xdist_group"):
            # Without brackets, after which xdist would find no group.
            name = " ".join([item.path.stem, *filter(None, shared)])
            item.add_marker(pytest.mark.xdist_group(name))


def _shared_fixtures(item: pytest.Item) -> list[str]:
    """Values of the parametrised fixtures of its module that a test uses, "" for each other one."""
    parameters = item.callspec.params if hasattr(item, "callspec") else {}
    fixtures = item._fixtureinfo.name2fixturedefs
    shared = [name for name, known in fixtures.items() if known[-1].scope == "module"]
    return sorted({str(parameters.get(name, "")) for name in shared})


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> object:
    """Beside a test that is marked `alone` one processor has no other test."""
    if not hasattr(item.config, "workerinput"):
        return (yield)
    turns = _turns(item.config)
    turns.take(is_alone(item))
    try:
        return (yield)
    finally:
        if not (is_alone(item) and nextitem is not None and is_alone(nextitem)):
            turns.give()


def is_alone(item: pytest.Item) -> bool:
    return item.get_closest_marker("alone") is not None


class _Turns:
    """The turns of a worker to run tests.

    For a test it holds its own byte of a file; for one that runs alone also those of all other
    workers but as many as there are other processors. Who wants a byte holds its door until the
    byte is his: so nobody overtakes whoever waits for the byte of another.
    """

    def __init__(self, number: int, count: int, run: str) -> None:
        """number, count: of this worker and of all; run: what names this run of the suite."""
        others = [one for one in range(count) if one != number]
        self._count = count
        self._mine = number
        self._paused = others[len(os.sched_getaffinity(0)) - 1 :]
        # It stays open, or its locks would go.
        self._file = (Path(tempfile.gettempdir()) / f"cube_tensor_turns_{run}").open("w")
        self._held: set[int] = set()

    def take(self, alone: bool) -> None:
        for byte in {self._mine, *(self._paused if alone else ())} - self._held:
            self._held.add(byte)
            door = self._count + byte
            fcntl.lockf(self._file, fcntl.LOCK_EX, 1, door)
            fcntl.lockf(self._file, fcntl.LOCK_EX, 1, byte)
            fcntl.lockf(self._file, fcntl.LOCK_UN, 1, door)

    def give(self) -> None:
        fcntl.lockf(self._file, fcntl.LOCK_UN)
        self._held.clear()


@functools.cache
def _turns(config: pytest.Config) -> _Turns:
    worker = config.workerinput
    number = int(worker["workerid"].removeprefix("gw"))
    return _Turns(number, worker["workercount"], worker["testrunuid"])


@pytest.fixture
def effort(request: pytest.FixtureRequest) -> int:
    """How long a test marked `campaign` tries: in the suite once, under -m campaign 20 times."""
    return 20 if request.config.option.markexpr == "campaign" else 1


@pytest.fixture
def one_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """`./cube reprocess` without worker processes, each of which takes half a second to start."""
    name = "cube_tensor_driver.bags.reprocess.all_bags.start_workers"
    monkeypatch.setattr(name, lambda *_: ThreadPoolExecutor(1))


@contextlib.contextmanager
def free_domain() -> Iterator[int]:
    """A DDS domain that no other test uses, of no other suite either, in the environment of this
    process and below."""
    for number in itertools.islice(_domains, 100):
        with (Path(tempfile.gettempdir()) / f"cube_tensor_domain_{number}").open("w") as mine:
            try:
                fcntl.flock(mine, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                continue
            with pytest.MonkeyPatch.context() as patch:
                patch.setenv("ROS_DOMAIN_ID", str(number))
                patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
                yield number
            return
    pytest.fail("all 100 domains are in use: end the other suites")


@pytest.fixture
def domain() -> Iterator[int]:
    """`free_domain` for one test."""
    with free_domain() as number:
        yield number


def end(process: subprocess.Popen) -> None:
    """Asked first: a process that is killed leaves its own children behind."""
    process.terminate()
    try:
        process.wait(10)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


@contextlib.contextmanager
def observer_node(domain: int) -> Iterator[Ros]:
    """A node in this process to look at the others with."""
    rclpy = pytest.importorskip("rclpy")
    from rclpy.signals import SignalHandlerOptions

    rclpy.init(domain_id=domain, signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("tester")
    try:
        yield Ros(node)
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


@pytest.fixture
def ros(domain: int) -> Iterator[Ros]:
    """`observer_node` for one test."""
    with observer_node(domain) as node:
        yield node


def open_files() -> int:
    """How many files this process has open."""
    return sum(1 for _ in Path("/proc/self/fd").iterdir())


@pytest.fixture
def deaf() -> Iterator[str]:
    """A TCP port where connecting neither succeeds nor fails, as of a host that is switched off:
    its queue is full."""
    with (
        socket.create_server(("127.0.0.1", 0), backlog=0) as server,
        contextlib.ExitStack() as stack,
    ):
        for _ in range(4):
            waiting = stack.enter_context(socket.socket())
            waiting.setblocking(False)
            waiting.connect_ex(server.getsockname())
        yield f"socket://127.0.0.1:{server.getsockname()[1]}"


def decoded(message: object) -> object:
    """`Decoded` rows of a SkinFrequencies or SkinStress as rclpy gives it."""
    from rclpy.serialization import serialize_message

    from cube_tensor_driver.messages import codec

    name = "frequency" if hasattr(message, "frequency") else "stress"
    return getattr(codec, f"{name}_codec").decode(serialize_message(message))


def encoded(rows: object, frame_id: bytes) -> bytes:
    """A message of frequencies or stress whose stamp is that of its earliest row."""
    from cube_tensor_driver.messages import codec

    name = "frequency" if hasattr(rows, "frequency") else "stress"
    stamps = rows.stamp_ns.min(keepdims=True)
    return getattr(codec, f"{name}_codec").encode(rows, stamps, frame_id)[0]


class Ros:
    """Subscriptions whose messages are kept, and waiting for what should happen."""

    def __init__(self, node: object) -> None:
        from rclpy.executors import SingleThreadedExecutor

        self.node = node
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(node)

    def listen(self, kind: type, topic: str, quality: object = 1000) -> list:
        """All messages of a topic from now on, in a list that grows while `wait` waits."""
        messages: list = []
        self.node.create_subscription(kind, topic, messages.append, quality)
        return messages

    def wait(self, done: Callable[[], object], seconds: float = 20.0) -> None:
        """Until done() is true; fails the test after `seconds`, or that times the number of
        processes that want each processor."""
        begun = time.monotonic()
        while not done():
            crowd = os.getloadavg()[0] / len(os.sched_getaffinity(0))
            limit = seconds * max(1.0, crowd)
            assert time.monotonic() - begun < limit, f"did not happen within {limit:.0f} s: {done}"
            self._executor.spin_once(timeout_sec=0.1)

    def call(
        self, kind: type, service: str, request: object, wait: Callable | None = None
    ) -> object:
        """A service's answer. rmw_fastrtps drops the answer to a client that the server met less
        than 0.1 s before (on a full machine it can take longer): after 5 s without one the request
        is sent again."""
        wait = wait or self.wait
        client = self.node.create_client(kind, service)
        wait(client.service_is_ready)
        futures: list = []
        again = 0.0

        def answered() -> bool:
            nonlocal again
            if time.monotonic() > again:
                again = time.monotonic() + 5.0
                futures.append(client.call_async(request))
            return any(future.done() for future in futures)

        wait(answered)
        self.node.destroy_client(client)
        return next(future.result() for future in futures if future.done())


def samples(cube, frequency, pad_fault=0, temperature=None) -> FrequencyRows:
    """Rows without a time."""
    known = np.nan if temperature is None else temperature
    fault = 0 if pad_fault is None else pad_fault
    return FrequencyRows.from_values(cube, frequency, pad_fault=fault, temperature=known)


def stamped(cube, frequency, pad_fault, stamp_ns, temperature=None) -> FrequencyRows:
    """Rows with a time."""
    known = np.nan if temperature is None else temperature
    return FrequencyRows.from_values(
        cube, frequency, pad_fault=pad_fault, stamp_ns=stamp_ns, temperature=known
    )


def sample_frame(
    number: int, device_us: int = 0, n_cubes: int = 1, n_pads: int = 2, first: int = 0
) -> Sample:
    """A sample whose pads all have 1 mHz."""
    frequency = np.ones((n_cubes, n_pads), "<u4")
    no_fault, temperature = np.zeros(n_cubes, "<u4"), np.zeros(n_cubes, "<i2")
    return Sample(number, first, device_us, frequency, no_fault, temperature)


def check(health, rows: FrequencyRows) -> tuple[np.ndarray, np.ndarray]:
    """Masks and status of rows, which update the health."""
    stress = health.pipeline.process(rows, watch=health)
    return stress.left_out, stress.status
