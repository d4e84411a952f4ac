"""ROS clients of the page: calls of services, control of a replay, and contacts."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from rclpy.client import Client
from rclpy.node import Node
from scipy.spatial import cKDTree
from sensor_msgs.msg import PointCloud2

from ..core.arrays import Array
from ..core.latest_stress import STALE_S
from ..messages.contacts import decode_contacts, decode_traction
from ..msg import ReplayState, SkinContacts
from ..ros.callbacks import CallbackErrors
from ..srv import SteerReplay
from ..touch.surface import Contact, Surface
from .markup import NoteColour
from .moment import Found, SurfaceField

Say = Callable[[str, str, NoteColour], None]
"""Function that shows a note to the user: it takes the note's title, text and colour."""

MAX_ANSWER_S = 10.0
"""Maximum time, in seconds, from the call of a service to its answer.

After this time the call is cancelled and the user is told so.
"""

MAX_CONTACTS_AGE_S = 1.0
"""Time since their arrival, in seconds, after which contacts and traction are no longer shown.

Nothing arrives any more if the node `contacts` has ended or the skin sends nothing.
"""

INTERPOLATION_POINTS = 4
"""Number of nearest points of the topic `traction` from which the page interpolates each value."""


class _Call(NamedTuple):
    what: str
    future: Any
    asked_s: float


class ServiceCalls:
    """Calls services without waiting for their answers, and shows each result as a note."""

    def __init__(self, say: Say) -> None:
        self._say = say
        self._open: list[_Call] = []

    def ask(
        self,
        what: str,
        client: Client,
        request: Any,
    ) -> None:
        """Call a service; if no running node offers it, show a note instead.

        Args:
            what: Name of the action in the notes to the user, such as "tare".
            client: ROS client of the service.
            request: Request of the type that the service has.
        """
        if not client.service_is_ready():
            text = f"{what}: no node that can do it is running"
            self._say(f"{what} is not possible", text, "red")
            return
        self._open.append(_Call(what, client.call_async(request), time.monotonic()))

    def update(self) -> None:
        """Show a note for each call of a service that was answered or has timed out.

        A call times out after `MAX_ANSWER_S`. Later updates do not mention these calls again.
        """
        still_open = []
        for call in self._open:
            if call.future.done():
                self._report(call.what, call.future.result())
            elif time.monotonic() - call.asked_s > MAX_ANSWER_S:
                text = f"{call.what}: no answer within {MAX_ANSWER_S:g} s"
                self._say(f"{call.what} had no answer", text, "red")
                call.future.cancel()
            else:
                still_open.append(call)
        self._open = still_open

    def _report(self, what: str, answer: Any) -> None:
        if answer.success:
            self._say(f"{what} is done", f"{what} done: {answer.message}", "green")
        else:
            text = f"{what} refused, nothing was changed: {answer.message}"
            self._say(f"{what} was refused", text, "red")


class ReplayClient:
    """Follows a running `./cube replay`, and stops it or lets it jump to another time.

    Attributes:
        state: Latest state of the replay (position and length in s, whether it is paused); None if
            there is no replay or it has sent no state for `STALE_S`.
    """

    def __init__(
        self,
        node: Node,
        services: ServiceCalls,
        say: Say,
    ) -> None:
        self.state: ReplayState | None = None
        self._services = services
        self._say = say
        self._client = node.create_client(SteerReplay, "player/steer")
        node.create_subscription(ReplayState, "player/state", self._receive, 1)
        self._received_s = -np.inf
        self._wanted_position: float | None = None
        self._wanted_s = -np.inf
        self._jump: Any = None
        self._jump_asked_s = -np.inf

    @property
    def is_held(self) -> bool:
        """Whether there is a replay and it is paused."""
        return self.state is not None and self.state.paused

    @property
    def is_jumping(self) -> bool:
        """Whether the user has asked for a jump that the replay has not confirmed yet.

        Until then the position in `state` is not the one that the user has chosen.
        """
        is_wanted = self._wanted_position is not None or self._jump is not None
        return self.state is not None and is_wanted

    def toggle_hold(self) -> None:
        """Pause the replay if it runs, or let it continue if it is paused."""
        if self.state is None:
            return
        request = SteerReplay.Request(position=np.nan, paused=not self.state.paused)
        self._services.ask("replay", self._client, request)

    def jump_to(self, position: float) -> None:
        """Store a position, in s after the start of the bag, to which a later `update` jumps.

        A position that is stored before that replaces this one.
        """
        self._wanted_position = position
        self._wanted_s = time.monotonic()

    def update(self) -> bool:
        """Send the jump that `jump_to` stored, unless the answer to an earlier jump is missing.

        If no replay is known, the jump is kept, because on a busy machine the messages of a replay
        arrive late. After `MAX_ANSWER_S` it is dropped, and a note tells the user so.

        Returns:
            Whether a jump was sent in this call.
        """
        now_s = time.monotonic()
        self._finish_jump(now_s)
        if self._jump is not None or self._wanted_position is None:
            return False
        if self.state is None or not self._client.service_is_ready():
            if now_s > self._wanted_s + MAX_ANSWER_S:
                self._wanted_position = None
                self._say("No jump is possible", "jump: no replay is running", "red")
            return False

        # The slider may still have the length of the bag that was replayed before this one.
        position = min(self._wanted_position, self.state.length)
        request = SteerReplay.Request(position=position, paused=self.state.paused)
        self._wanted_position = None
        self._jump = self._client.call_async(request)
        self._jump_asked_s = now_s
        # Without this assignment, the slider would jump back to the old position until the next
        # state of the replay arrives.
        self.state.position = position
        return True

    def _finish_jump(self, now_s: float) -> None:
        """Forget the jump that was sent, if it was answered or is older than `MAX_ANSWER_S`.

        Args:
            now_s: Present time on the monotonic clock, in s.
        """
        if self._jump is None:
            return
        if self._jump.done():
            self._jump = None
        elif now_s > self._jump_asked_s + MAX_ANSWER_S:
            self._jump.cancel()
            self._jump = None
            text = f"jump: no answer within {MAX_ANSWER_S:g} s"
            self._say("The jump had no answer", text, "red")

    def forget_if_silent(self) -> None:
        """Set `state` to None if the replay has sent no state for `STALE_S` (1 s)."""
        if time.monotonic() - self._received_s > STALE_S:
            self.state = None

    def _receive(self, state: ReplayState) -> None:
        self.state, self._received_s = state, time.monotonic()


class ContactsClient:
    """Subscribes to the contacts and the traction that the node `contacts` publishes."""

    def __init__(self, node: Node, errors: CallbackErrors) -> None:
        node.create_subscription(SkinContacts, "contacts", errors.catch(self._receive_contacts), 2)
        node.create_subscription(PointCloud2, "traction", errors.catch(self._receive_traction), 2)
        self._contacts: list[Contact] = []
        self._cloud = np.empty((0, 6))
        self._contacts_s = self._cloud_s = -np.inf
        self._interpolation: _Interpolation | None = None

    def found(self, surface: Surface) -> Found:
        """Return the latest contacts, and pressure and shear interpolated to points of a surface.

        Contacts or a field that arrived more than `MAX_CONTACTS_AGE_S` ago, or never, are None.

        Args:
            surface: Points to which pressure and shear are interpolated.
        """
        oldest_s = time.monotonic() - MAX_CONTACTS_AGE_S
        contacts = self._contacts if self._contacts_s > oldest_s else None
        if self._cloud_s < oldest_s or not len(self._cloud):
            return Found(contacts)
        points = self._cloud[:, :3]
        # The points of a skin do not move, so the weights of the interpolation are computed once.
        if self._interpolation is None or not self._interpolation.fits(surface, points):
            self._interpolation = _Interpolation(surface, points)
        pressure, shear, sigma = self._interpolation.values(self._cloud[:, 3:]).T
        return Found(contacts, SurfaceField(pressure, shear, sigma))

    def _receive_contacts(self, message: SkinContacts) -> None:
        self._contacts, self._contacts_s = decode_contacts(message), time.monotonic()

    def _receive_traction(self, message: PointCloud2) -> None:
        cloud = decode_traction(message)
        has_position = np.isfinite(cloud[:, :3]).all(axis=1)
        self._cloud, self._cloud_s = cloud[has_position], time.monotonic()


class _Interpolation:
    """Interpolates from M points of the topic `traction` to all points of a surface.

    The weights are the inverse squared distances to the nearest `INTERPOLATION_POINTS` points
    (Shepard's method).
    """

    def __init__(self, surface: Surface, points: Array) -> None:
        self._surface, self._points = surface, points
        shape = len(surface.points), min(INTERPOLATION_POINTS, len(points))
        # `surface.points` lie in the plane of the cubes' centres, those of `traction` on the outer
        # surface of the skin, so the former are moved up by the depth of the cubes.
        up = surface.depth * surface.poses.rotation[surface.cube, :, 2]
        distance, nearest = cKDTree(points).query(surface.points + up, shape[1])
        self._nearest = nearest.reshape(shape)
        # The lower limit of the distance avoids a division by zero where two points coincide.
        weight = 1 / np.maximum(distance.reshape(shape), 1e-3 * surface.spacing) ** 2
        self._weight = weight / weight.sum(axis=1, keepdims=True)

    def fits(self, surface: Surface, points: Array) -> bool:
        """Return whether the weights were computed for this surface and these points.

        Args:
            surface: Surface to whose points values are interpolated.
            points: (M, 3) points of the topic `traction`, in m, in the parent frame of the skin.
        """
        return surface is self._surface and np.array_equal(points, self._points)

    def values(self, values: Array) -> Array:
        """Interpolate C quantities from the M points to the points of the surface.

        Args:
            values: Values (M, C) at the M points.

        Returns:
            Values (points of the surface, C); NaN where one of the nearest values is NaN.
        """
        return np.asarray(np.einsum("pk,pkc->pc", self._weight, values[self._nearest]))
