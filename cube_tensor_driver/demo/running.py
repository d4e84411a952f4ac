# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""A ROS node that receives messages of nodes in child processes and checks that they still run.

`./cube demo`, torture and bench use it.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from rclpy.executors import Executor
from rclpy.node import Node
from rclpy.qos import QoSProfile

from ..core.errors import CubeError
from ..processes.children import Children
from ..ros.session import STEP_S, run_node_session, spin_until
from ..simulation.sample_log import SampleLog


class Interrupted(CubeError):
    """The user has pressed Ctrl-C, or another signal asked the process to end."""


@dataclass
class Observer:
    """A ROS node that receives what the nodes in child processes publish; see `observe_skin`.

    Attributes:
        node: The ROS node.
        executor: The executor that contains the node.
        children: The processes that are observed.
        interrupted: Event that lets `spin` raise Interrupted; None: no such event.
        on_step: Function that `spin` calls repeatedly while it receives messages.
        checked_s: Monotonic time, in s, at which `spin` checked the processes last.
    """

    node: Node
    executor: Executor
    children: Children
    interrupted: threading.Event | None
    on_step: Callable[[], None]
    checked_s: float = 0.0

    def listen(
        self,
        kind: type,
        topic: str,
        receive: Callable[[bytes], None],
        quality: QoSProfile,
    ) -> None:
        """Subscribe to a topic.

        Args:
            kind: Type of the messages.
            topic: Name of the topic.
            receive: Function that is called with each message in its serialised form (CDR).
            quality: Quality of service of the subscription.
        """
        self.node.create_subscription(
            kind,
            topic,
            receive,
            quality,
            raw=True,
        )

    def log_error(self, text: str) -> None:
        """Write an error message to the log of the ROS node."""
        self.node.get_logger().error(text)  # type: ignore[no-untyped-call]

    def spin(
        self,
        seconds: float,
        done: Callable[[], bool] = lambda: False,
    ) -> None:
        """Receive messages for a time, or until a condition is met.

        Args:
            seconds: Maximum time, in s.
            done: Condition that ends the function earlier when it returns true.

        Raises:
            Interrupted: The event `interrupted` was set, by Ctrl-C for example.
            ChildError: One of the observed processes has ended.
        """

        def check() -> None:
            # The signal handler only sets the event; the exception is raised here, between two
            # messages.
            if self.interrupted is not None and self.interrupted.is_set():
                raise Interrupted("interrupted")
            # Checking the processes after each message would take longer than the message.
            now_s = time.monotonic()
            if now_s - self.checked_s > STEP_S:
                self.checked_s = now_s
                self.children.check()
            self.on_step()

        spin_until(
            self.executor,
            done,
            seconds,
            on_step=check,
        )


@contextmanager
def observe_skin(
    name: str,
    children: Children,
    *,
    interrupted: threading.Event | None = None,
    on_step: Callable[[], None] = lambda: None,
) -> Iterator[Observer]:
    """Make an observer inside a `with` block, and destroy its node at the end of the block.

    Args:
        name: Name of the ROS node.
        children: The processes that it observes.
        interrupted: Event that lets `Observer.spin` raise Interrupted; None: no such event.
        on_step: Function that `Observer.spin` calls repeatedly while it receives messages.
    """
    with run_node_session(name) as (node, executor):
        yield Observer(
            node,
            executor,
            children,
            interrupted,
            on_step,
        )


def end_simulator(children: Children, log: Path) -> SampleLog:
    """End the process of the simulator and read the log that it writes at its end.

    Args:
        children: The processes, of which one is named "simulator".
        log: Path of the log.

    Raises:
        CubeError: The simulator ended without writing its log.
    """
    children.end(["simulator"])
    if not log.exists():
        raise CubeError(f"the simulator did not end as asked:\n{children.end_of_log('simulator')}")
    return SampleLog.read(log)
