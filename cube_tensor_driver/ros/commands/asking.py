"""Services of running nodes: found, and asked from a command."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import Any

from rclpy.node import Node

from ...core.errors import CubeError

FIND_S = 5.0
"""How long nodes may take to be discovered."""
SETTLE_S = 0.3
"""For others to be found too, from the last one found on. rmw_fastrtps drops the answer to a
client that the server met less than 0.1 s before."""
ANSWER_S, AGAIN_S = 10.0, 3.0
"""How long an answer may take, and after how long the question is repeated."""
STEP_S = 0.05


def domain_text() -> str:
    """The DDS domain of this process, in words."""
    return f"DDS domain {os.environ.get('ROS_DOMAIN_ID') or 0}"


def spin(executor: Any, seconds: float, done: Callable[[], object] = lambda: False) -> bool:
    """Spin for so long, or until done. Returns whether it is done."""
    until = time.monotonic() + seconds
    while not done():
        left = until - time.monotonic()
        if left <= 0:
            return False
        executor.spin_once(timeout_sec=min(left, STEP_S))
    return True


def discover(executor: Any, found: Callable[[], object]) -> bool:
    """Spin until something is found, and a moment longer. Returns whether it is found."""
    if not spin(executor, FIND_S, found):
        return False
    spin(executor, SETTLE_S)
    return True


def discover_all(executor: Any, found: Callable[[], object]) -> bool:
    """Spin until something is found, and no more of it a moment later. Returns whether it is
    found."""
    until = time.monotonic() + FIND_S
    if not spin(executor, FIND_S, found):
        return False
    before = None
    while before != (now := found()) and time.monotonic() < until:
        before = now
        spin(executor, SETTLE_S)
    return True


def find_services(node: Node, executor: Any, kind: str, wanted: str = "") -> list[str]:
    """Full names of the services of a type, as in std_srvs/srv/Trigger, sorted, without
    those of the node itself; may be empty. wanted: one that is waited for, as long as any would be.
    """
    own = f"{node.get_fully_qualified_name()}/"

    def found() -> list[str]:
        services = node.get_service_names_and_types()
        return sorted(
            name for name, kinds in services if kind in kinds and not name.startswith(own)
        )

    if wanted:
        discover(executor, lambda: wanted in found())
    else:
        discover_all(executor, found)
    return found()


def ask(node: Node, executor: Any, kind: type, service: str, request: Any) -> Any:
    """The answer of a service. The request must do no harm if it comes twice.

    CubeError: no answer.
    """
    client = node.create_client(kind, service)
    try:
        if not discover(executor, client.service_is_ready):
            raise CubeError(f"{service}: nobody offers this service in {domain_text()}")
        futures: list[Any] = []
        until = time.monotonic() + ANSWER_S
        while time.monotonic() < until:
            futures.append(client.call_async(request))
            spin(executor, AGAIN_S, lambda: any(future.done() for future in futures))
            for future in futures:
                if future.done():
                    return future.result()
        raise CubeError(
            f"{service}: no answer within {ANSWER_S:g} s; is its node stopped, or very busy?"
        )
    finally:
        node.destroy_client(client)
