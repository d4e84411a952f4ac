"""A running replay of a bag, seen and controlled from the page."""

from __future__ import annotations

import time

import numpy as np
from rclpy.node import Node
from rclpy.task import Future

from cube_tensor_driver.msg import ReplayState
from cube_tensor_driver.srv import SteerReplay

from ..core.scene import STALE_S
from .service_calls import WAIT_S, ServiceCalls


class ReplayClient:
    """state: where the replay is; None: there is none, or it has fallen silent."""

    def __init__(self, node: Node, services: ServiceCalls) -> None:
        self.state: ReplayState | None = None
        self._services = services
        self._client = node.create_client(SteerReplay, "player/steer")
        node.create_subscription(ReplayState, "player/state", self._receive, 1)
        self._received_at = -np.inf
        self._wanted: float | None = None
        self._jump: Future | None = None
        self._jump_asked_at = -np.inf

    @property
    def held(self) -> bool:
        return self.state is not None and self.state.paused

    @property
    def jumping(self) -> bool:
        """A jump is wanted or under way: `state` is not where the user wants to be."""
        return self._wanted is not None or self._jump is not None

    def toggle_hold(self) -> None:
        """Stop, or go on."""
        if self.state is None:
            return
        request = SteerReplay.Request(position=np.nan, paused=not self.state.paused)
        self._services.ask("replay", self._client, request)

    def jump_to(self, position: float) -> None:
        """Jump to `position`, s, with the next `update`; of several wishes the last one counts."""
        self._wanted = position

    def update(self) -> bool:
        """Ask for the jump that is wanted, once the one before is done; True if it did."""
        now = time.monotonic()
        if self._jump is not None and (self._jump.done() or now > self._jump_asked_at + WAIT_S):
            self._jump = None
        if self._wanted is None or self._jump is not None or self.state is None:
            return False
        position = min(self._wanted, self.state.length)
        request = SteerReplay.Request(position=position, paused=self.state.paused)
        self._wanted = None
        self._jump = self._client.call_async(request)
        self._jump_asked_at = now
        self.state.position = position
        return True

    def forget_if_silent(self) -> None:
        """Nothing is known of a replay that has said nothing for a while."""
        if time.monotonic() - self._received_at > STALE_S:
            self.state = self._wanted = self._jump = None

    def _receive(self, state: ReplayState) -> None:
        self.state, self._received_at = state, time.monotonic()
