"""Fixtures: a DDS domain of its own for every test that runs ROS, kept to this host."""

from __future__ import annotations

import itertools
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
# Domains up to 101 leave the ports of the system alone; where two suites run at once they rarely meet.
_domains = itertools.cycle(range(1 + os.getpid() % 50, 100))


@pytest.fixture
def domain(monkeypatch: pytest.MonkeyPatch) -> int:
    """A DDS domain that no other test uses, in the environment of this process and its children."""
    number = next(_domains)
    monkeypatch.setenv("ROS_DOMAIN_ID", str(number))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    return number


@pytest.fixture
def ros(domain: int) -> Iterator[Ros]:
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
        """Until done() is true; fails the test after `seconds`."""
        until = time.monotonic() + seconds
        while not done():
            assert time.monotonic() < until, f"did not happen within {seconds} s: {done}"
            self._executor.spin_once(timeout_sec=0.1)

    def call(self, kind: type, service: str, request: object, seconds: float = 20.0) -> object:
        client = self.node.create_client(kind, service)
        self.wait(client.service_is_ready, seconds)
        future = client.call_async(request)
        self.wait(future.done, seconds)
        self.node.destroy_client(client)
        return future.result()
