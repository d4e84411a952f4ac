"""What demo, torture and bench share: a node that watches a skin in other processes."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSProfile

from ..config.output_files import write_json
from ..core.errors import CubeError
from ..processes.children import Children
from ..ros.session import STEP_S, node_session, spin_until
from ..simulation.sample_log import SampleLog


class Interrupted(CubeError):
    """The user has pressed Ctrl-C, or the process was asked to end."""


class Observer:
    """A node beside the processes that it observes; `observing` makes one.

    Attributes:
        node: The node.
    """

    def __init__(
        self,
        node: Node,
        executor: Any,
        children: Children,
        interrupted: threading.Event | None,
        on_step: Callable[[], None],
    ) -> None:
        """Args are those of `observing`, and the node with the executor that it is in."""
        self.node, self._executor = node, executor
        self._children, self._interrupted, self._on_step = children, interrupted, on_step
        self._checked_s = 0.0

    def listen(
        self, kind: type, topic: str, receive: Callable[[bytes], None], quality: QoSProfile
    ) -> None:
        """Call `receive` with each message of a topic, in its serialised form."""
        self.node.create_subscription(kind, topic, receive, quality, raw=True)

    def log_error(self, text: str) -> None:
        """Write an error to the log of the node."""
        logger: Any = self.node.get_logger()  # type: ignore[no-untyped-call]
        logger.error(text)

    def spin(self, seconds: float, done: Callable[[], bool] = lambda: False) -> None:
        """Receive messages for a time, or until `done()`.

        Raises:
            Interrupted: A signal asked to end.
            ChildError: A process has ended.
        """

        def check() -> None:
            # A signal sets an event only, so that it is handled at this place.
            if self._interrupted is not None and self._interrupted.is_set():
                raise Interrupted("interrupted")
            # Once per message would cost more than the message.
            if time.monotonic() - self._checked_s > STEP_S:
                self._checked_s = time.monotonic()
                self._children.check()
            self._on_step()

        spin_until(self._executor, done, seconds, on_step=check)


@contextmanager
def observing(
    name: str,
    children: Children,
    *,
    interrupted: threading.Event | None = None,
    on_step: Callable[[], None] = lambda: None,
) -> Iterator[Observer]:
    """Make a node for the length of a block.

    Args:
        name: Name of the node.
        children: The processes that it observes.
        interrupted: Event that ends `Observer.spin`; None: signals are left as they are.
        on_step: Called again and again while it spins.
    """
    with node_session(name) as (node, executor):
        yield Observer(node, executor, children, interrupted, on_step)


def end_simulator(children: Children, log: Path) -> SampleLog:
    """End the simulator and read its log.

    Raises:
        CubeError: It wrote none.
    """
    children.end(["simulator"])
    if not log.exists():
        raise CubeError(f"the simulator did not end as asked:\n{children.log('simulator')[-1500:]}")
    return SampleLog.read(log)


def report(result: dict[str, Any], json_path: Path | None) -> None:
    """Print figures, and write them to a file as well if one is named."""
    print(json.dumps(result, indent=2))
    if json_path is not None:
        write_json(json_path, result)
