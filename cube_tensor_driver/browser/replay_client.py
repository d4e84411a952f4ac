"""A running replay of a bag, seen and controlled from the page."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from rclpy.node import Node
from rclpy.task import Future

from ..core.latest_stress import STALE_S
from ..msg import ReplayState
from ..srv import SteerReplay
from .markup import NoteColour
from .service_calls import WAIT_S, ServiceCalls


class ReplayClient:
    """state: where the replay is; None: there is none, or it has fallen silent."""

    def __init__(
        self, node: Node, services: ServiceCalls, say: Callable[[str, str, NoteColour], None]
    ) -> None:
        """say: told title, text and colour of what the user should know."""
        self.state: ReplayState | None = None
        self._services = services
        self._say = say
        self._client = node.create_client(SteerReplay, "player/steer")
        node.create_subscription(ReplayState, "player/state", self._receive, 1)
        self._received_at = -np.inf
        self._wanted: float | None = None
        self._wanted_at = -np.inf
        self._jump: Future | None = None
        self._jump_asked_at = -np.inf

    @property
    def held(self) -> bool:
        return self.state is not None and self.state.paused

    @property
    def jumping(self) -> bool:
        """A jump is wanted or under way: `state` is not where the user wants to be."""
        return self.state is not None and (self._wanted is not None or self._jump is not None)

    def toggle_hold(self) -> None:
        """Stop, or go on."""
        if self.state is None:
            return
        request = SteerReplay.Request(position=np.nan, paused=not self.state.paused)
        self._services.ask("replay", self._client, request)

    def jump_to(self, position: float) -> None:
        """Jump to `position`, s, with the next `update`; of several wishes the last one counts."""
        self._wanted = position
        self._wanted_at = time.monotonic()

    def update(self) -> bool:
        """Ask for the jump that is wanted, once the one before is done; True if it did.

        A replay that is silent, or not there yet, on a busy machine, is waited for.
        """
        now = time.monotonic()
        if self._jump is not None and self._jump.done():
            self._jump = None
        if self._jump is not None and now > self._jump_asked_at + WAIT_S:
            self._jump.cancel()
            self._jump = None
            self._say("The jump had no answer", f"jump: no answer within {WAIT_S:g} s", "red")
        if self._jump is not None or self._wanted is None:
            return False
        if self.state is None or not self._client.service_is_ready():
            if now > self._wanted_at + WAIT_S:
                self._wanted = None
                self._say("No jump is possible", "jump: no replay is running", "red")
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
            self.state = None

    def _receive(self, state: ReplayState) -> None:
        self.state, self._received_at = state, time.monotonic()
