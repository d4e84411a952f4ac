"""What demo, torture and bench share: a node that watches a skin in other processes, what these
processes use, and where figures go."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psutil
from rclpy.node import Node
from rclpy.qos import QoSProfile

from ..config.output_files import write_json
from ..core.errors import CubeError
from ..processes.children import Children
from ..ros.session import node_session, on_stop_signal
from ..simulation.sample_log import SampleLog

STEP_S = 0.05
"""How often a loop that spins looks whether it is done, interrupted, or a process has ended."""


class Interrupted(CubeError):
    """Ctrl-C, or asked to end."""


def interruption() -> threading.Event:
    """Set by Ctrl-C, SIGTERM or the end of the terminal from now on."""
    event = threading.Event()
    on_stop_signal(event.set)
    return event


class Observer:
    """A node beside the processes that it observes; `observing` makes one."""

    def __init__(
        self,
        node: Node,
        executor: Any,
        children: Children,
        interrupted: threading.Event | None,
        on_step: Callable[[], None],
    ) -> None:
        self.node, self._executor = node, executor
        self._children, self._interrupted, self._on_step = children, interrupted, on_step
        self._looked = 0.0

    def listen(
        self, kind: type, topic: str, receive: Callable[[bytes], None], quality: QoSProfile
    ) -> None:
        """Have each message of a topic, as it is serialised."""
        self.node.create_subscription(kind, topic, receive, quality, raw=True)

    def spin(self, seconds: float, done: Callable[[], bool] = lambda: False) -> None:
        """Receive messages for so long, or until done. Interrupted: by a signal. ChildError: a
        process ended."""
        until = time.monotonic() + seconds
        while not done() and (left := until - time.monotonic()) > 0:
            if self._interrupted is not None and self._interrupted.is_set():
                raise Interrupted("interrupted")
            self._executor.spin_once(timeout_sec=min(left, STEP_S))
            if time.monotonic() - self._looked > STEP_S:
                self._looked = time.monotonic()
                self._children.check()
            self._on_step()


@contextmanager
def observing(
    name: str,
    children: Children,
    *,
    interrupted: threading.Event | None = None,
    on_step: Callable[[], None] = lambda: None,
) -> Iterator[Observer]:
    """A node of this name, for the length of a block.

    interrupted: ends `Observer.spin`; None leaves signals as they are
    on_step: called again and again while it spins
    """
    with node_session(name) as (node, executor):
        yield Observer(node, executor, children, interrupted, on_step)


class Usage:
    """What processes use of the machine; processor time is counted from the start."""

    def __init__(self, children: Children, names: Iterable[str]) -> None:
        self._processes = {name: psutil.Process(children.pid(name)) for name in names}
        self._start_s = time.monotonic()
        self._cpu_s = self._cpu()

    def cpu_percent(self) -> dict[str, float]:
        """Of one core, by process, since the start."""
        seconds = time.monotonic() - self._start_s
        return {
            name: 100 * (now - self._cpu_s[name]) / seconds for name, now in self._cpu().items()
        }

    def memory_mb(self) -> dict[str, float]:
        """Resident, by process."""
        return {
            name: process.memory_info().rss / 2**20 for name, process in self._processes.items()
        }

    def threads(self) -> dict[str, int]:
        return {name: process.num_threads() for name, process in self._processes.items()}

    def _cpu(self) -> dict[str, float]:
        times = {name: process.cpu_times() for name, process in self._processes.items()}
        return {name: float(time.user + time.system) for name, time in times.items()}


def end_simulator(children: Children, log: Path) -> SampleLog:
    """End the simulator and read its log. CubeError: it wrote none."""
    children.end(["simulator"])
    if not log.exists():
        raise CubeError(f"the simulator did not end as asked:\n{children.log('simulator')[-1500:]}")
    return SampleLog.read(log)


def report(result: dict[str, Any], json_path: Path | None) -> None:
    """Print figures, and write them to a file as well if one is named."""
    print(json.dumps(result, indent=2))
    if json_path is not None:
        write_json(json_path, result)
