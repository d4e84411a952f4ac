"""What the page asks of other nodes and hears from them: services, replays, contacts."""

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
"""Shows title, text and colour of a note to the user."""

MAX_ANSWER_S = 10.0
"""Time, in seconds, that a service may take to answer."""

MAX_CONTACTS_AGE_S = 1.0
"""Age, in seconds, above which contacts and traction are not shown any more: the node `contacts`
has ended, or the skin sends nothing."""

INTERPOLATION_POINTS = 4
"""Number of points of the topic `traction` between which the page interpolates."""


class _Call(NamedTuple):
    what: str
    future: Any
    asked_s: float


class ServiceCalls:
    """Calls services without waiting for the answers, and tells the user what became of them."""

    def __init__(self, say: Say) -> None:
        self._say = say
        self._open: list[_Call] = []

    def ask(
        self,
        what: str,
        client: Client,
        request: Any,
    ) -> None:
        """Call a service, unless nobody offers it.

        Args:
            what: Name of the action, for the notes to the user.
            client: Client of the service.
            request: The request.
        """
        if not client.service_is_ready():
            text = f"{what}: no node that can do it is running"
            self._say(f"{what} is not possible", text, "red")
            return
        self._open.append(_Call(what, client.call_async(request), time.monotonic()))

    def update(self) -> None:
        """Tell the user about calls that have been answered, or that took too long."""
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
    """Follows and steers a running `./cube replay`.

    Attributes:
        state: Where the replay is; None: there is none, or it has fallen silent.
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
        """Whether there is a replay and it is stopped."""
        return self.state is not None and self.state.paused

    @property
    def is_jumping(self) -> bool:
        """Whether a jump is wanted or under way, so that `state` is not where the user wants to
        be."""
        is_wanted = self._wanted_position is not None or self._jump is not None
        return self.state is not None and is_wanted

    def toggle_hold(self) -> None:
        """Stop the replay, or let it go on."""
        if self.state is None:
            return
        request = SteerReplay.Request(position=np.nan, paused=not self.state.paused)
        self._services.ask("replay", self._client, request)

    def jump_to(self, position: float) -> None:
        """Jump to a position, in seconds, with the next `update`; later wishes replace it."""
        self._wanted_position = position
        self._wanted_s = time.monotonic()

    def update(self) -> bool:
        """Ask for the jump that is wanted, once the jump before it is done.

        A replay that is silent, or not started yet, is waited for: on a busy machine its messages
        come late.

        Returns:
            Whether a jump was asked for now.
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

        # The page may know the length of a bag that was replayed before.
        position = min(self._wanted_position, self.state.length)
        request = SteerReplay.Request(position=position, paused=self.state.paused)
        self._wanted_position = None
        self._jump = self._client.call_async(request)
        self._jump_asked_s = now_s
        # The slider must not jump back until the replay has told its new position.
        self.state.position = position
        return True

    def _finish_jump(self, now_s: float) -> None:
        """Forget a jump that was answered, or whose answer is overdue."""
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
        """Forget a replay that has sent nothing for `STALE_S`."""
        if time.monotonic() - self._received_s > STALE_S:
            self.state = None

    def _receive(self, state: ReplayState) -> None:
        self.state, self._received_s = state, time.monotonic()


class ContactsClient:
    """Listens to what the node `contacts` finds, if it runs."""

    def __init__(self, node: Node, errors: CallbackErrors) -> None:
        node.create_subscription(SkinContacts, "contacts", errors.catch(self._receive_contacts), 2)
        node.create_subscription(PointCloud2, "traction", errors.catch(self._receive_traction), 2)
        self._contacts: list[Contact] = []
        self._cloud = np.empty((0, 6))
        self._contacts_s = self._cloud_s = -np.inf
        self._interpolation: _Interpolation | None = None

    def found(self, surface: Surface) -> Found:
        """Return contacts and the field on the points of a surface, where they are recent."""
        oldest_s = time.monotonic() - MAX_CONTACTS_AGE_S
        contacts = self._contacts if self._contacts_s > oldest_s else None
        if self._cloud_s < oldest_s or not len(self._cloud):
            return Found(contacts)
        points = self._cloud[:, :3]
        # The points of a skin do not move, so that the weights are computed once.
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
    """Interpolates from few points (M, 3) to all points of a surface.

    The weights are the inverse squared distances of the nearest points (Shepard's method).
    """

    def __init__(self, surface: Surface, points: Array) -> None:
        self._surface, self._points = surface, points
        shape = len(surface.points), min(INTERPOLATION_POINTS, len(points))
        # The points of the surface lie at the depth of the cubes, those of `traction` on the skin.
        up = surface.depth * surface.poses.rotation[surface.cube, :, 2]
        distance, nearest = cKDTree(points).query(surface.points + up, shape[1])
        self._nearest = nearest.reshape(shape)
        # The lower limit avoids a division by zero at a point itself.
        weight = 1 / np.maximum(distance.reshape(shape), 1e-3 * surface.spacing) ** 2
        self._weight = weight / weight.sum(axis=1, keepdims=True)

    def fits(self, surface: Surface, points: Array) -> bool:
        """Return whether it was made for this surface and these points."""
        return surface is self._surface and np.array_equal(points, self._points)

    def values(self, values: Array) -> Array:
        """Interpolate values (M, C); NaN where one of the nearest values is NaN.

        Returns:
            (points of the surface, C).
        """
        return np.asarray(np.einsum("pk,pkc->pc", self._weight, values[self._nearest]))
