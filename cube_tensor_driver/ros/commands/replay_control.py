"""Control of a player over ROS: a topic with its state, and a service to pause, resume and jump."""

from __future__ import annotations

import math

from rclpy.node import Node

from ...core.errors import BagError
from ...msg import ReplayState
from ...srv import SteerReplay
from .player import Player

STATE_S = 0.1


class ReplayControl:
    """`~/state` and `~/steer` of the node for a player; made in the thread that spins the node."""

    def __init__(self, node: Node, player: Player) -> None:
        self._player = player
        self._state = node.create_publisher(ReplayState, "~/state", 1)
        node.create_service(SteerReplay, "~/steer", self._steer)
        node.create_timer(STATE_S, self._publish_state)

    def _publish_state(self) -> None:
        player = self._player
        self._state.publish(
            ReplayState(position=player.position, length=player.length, paused=player.paused)
        )

    def _steer(
        self, request: SteerReplay.Request, answer: SteerReplay.Response
    ) -> SteerReplay.Response:
        player = self._player
        try:
            if math.isnan(request.position):
                player.pause(request.paused)
            else:
                player.jump(request.position, request.paused)
        except BagError as error:
            answer.message = str(error)
            return answer
        answer.success, answer.message = True, "holds" if request.paused else "goes on"
        return answer
