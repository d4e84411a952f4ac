# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""What the page controls: services of the nodes, a replay, and the recording of a bag."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
from rclpy.node import Node

from ..core.latest_stress import STALE_S
from ..msg import ReplayState
from ..processes.children import end_with_parent
from ..srv import SteerReplay
from .markup import NoteColour
from .page import JUMP

Say = Callable[[str, str, NoteColour], None]
"""Function that shows a note to the user: its arguments are the result of an action in a few words,
further text about it, and the colour of the note."""

MAX_ANSWER_S = 10.0
"""Maximum time, in seconds, from the call of a service to its answer.

After this time the call is cancelled and the user is told so.
"""

MAX_END_S = 10.0
"""Maximum time, in seconds, from SIGINT until the process that records must have finished its file.

A process that takes longer is killed.
"""


class ServiceResponse(Protocol):
    """What the responses of all services that the page calls have."""

    success: bool
    message: str


class ServiceFuture(Protocol):
    """The methods of rclpy's `Future` that are used here; its `result` is None until it is done."""

    def result(self) -> ServiceResponse | None: ...
    def cancel(self) -> None: ...


class ServiceClient(Protocol):
    """The methods of rclpy's `Client` that are used here. `Client` itself has type arguments since
    ROS 2 Kilted, and none before."""

    def service_is_ready(self) -> bool: ...
    def call_async(self, request: object) -> ServiceFuture: ...


class _Call(NamedTuple):
    what: str
    future: ServiceFuture
    asked_s: float
    notes_success: bool


class ServiceCalls:
    """Calls services without waiting for their answers, and shows each result as a note."""

    def __init__(self, say: Say) -> None:
        self._say = say
        self._open: list[_Call] = []

    def ask(
        self,
        what: str,
        client: ServiceClient,
        request: object,
        notes_success: bool = True,
    ) -> None:
        """Call a service; if no running node offers it, show a note instead.

        Args:
            what: Name of the action in the notes to the user, such as "tare".
            client: ROS client of the service.
            request: Request of the type that the service has.
            notes_success: Whether a note is shown if the service did what was requested.
        """
        if not client.service_is_ready():
            self._say(
                f"{what} not possible",
                "no node that can do it is running",
                "red",
            )
            return
        future = client.call_async(request)
        self._open.append(_Call(what, future, time.monotonic(), notes_success))

    def is_waiting_for(self, what: str) -> bool:
        """Return whether a call with this name has neither been answered nor timed out."""
        return any(call.what == what for call in self._open)

    def update(self) -> None:
        """Show a note for each call of a service that was answered or has timed out.

        A call times out after `MAX_ANSWER_S`. Later updates do not mention these calls again.
        """
        still_open = []
        for call in self._open:
            answer = call.future.result()
            if answer is not None:
                if not answer.success:
                    text = f"nothing was changed: {answer.message}"
                    self._say(f"{call.what} refused", text, "red")
                elif call.notes_success:
                    self._say(f"{call.what} done", answer.message, "green")
            elif time.monotonic() - call.asked_s > MAX_ANSWER_S:
                self._say(
                    f"{call.what} failed",
                    f"no answer within {MAX_ANSWER_S:g} s",
                    "red",
                )
                call.future.cancel()
            else:
                still_open.append(call)
        self._open = still_open


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
        self._client: ServiceClient = node.create_client(SteerReplay, "player/steer")
        node.create_subscription(
            ReplayState,
            "player/state",
            self._receive,
            1,
        )
        self._received_s = -np.inf
        self._wanted_position: float | None = None
        self._wanted_s = -np.inf

    @property
    def is_held(self) -> bool:
        """Whether there is a replay and it is paused."""
        return self.state is not None and self.state.paused

    @property
    def is_jumping(self) -> bool:
        """Whether the user has asked for a jump that the replay has not confirmed yet.

        Until then the position in `state` is not the one that the user has chosen.
        """
        is_wanted = self._wanted_position is not None or self._services.is_waiting_for(JUMP)
        return self.state is not None and is_wanted

    def toggle_hold(self) -> None:
        """Pause the replay if it runs, or let it continue if it is paused."""
        if self.state is None:
            return
        request = SteerReplay.Request(position=np.nan, paused=not self.state.paused)
        # The page shows whether the replay is paused, so an action that succeeds needs no note.
        self._services.ask(
            "replay",
            self._client,
            request,
            notes_success=False,
        )

    def jump_to(self, position: float) -> None:
        """Store a position, in s after the start of the bag, to which a later `update` jumps.

        If another position is stored before that update, it replaces this one.
        """
        self._wanted_position = position
        self._wanted_s = time.monotonic()

    def update(self) -> bool:
        """Process the answers of services, then send the jump that `jump_to` stored, if any.

        The jump waits until an earlier jump has been answered, and until the state of a replay has
        arrived, which takes long on a busy machine. If no replay appears within `MAX_ANSWER_S`, the
        jump is dropped, and a note tells the user so.

        Returns:
            Whether a jump was sent in this call.
        """
        self._services.update()
        if self._wanted_position is None or self._services.is_waiting_for(JUMP):
            return False
        if self.state is None or not self._client.service_is_ready():
            if time.monotonic() > self._wanted_s + MAX_ANSWER_S:
                self._wanted_position = None
                self._say("jump not possible", "no replay is running", "red")
            return False

        # The slider may still have the length of the bag that was replayed before this one.
        position = min(self._wanted_position, self.state.length)
        request = SteerReplay.Request(position=position, paused=self.state.paused)
        self._wanted_position = None
        # The page shows the new position, so a jump that succeeds needs no note.
        self._services.ask(
            JUMP,
            self._client,
            request,
            notes_success=False,
        )
        # Without this assignment, the slider would jump back to the old position until the next
        # state of the replay arrives.
        self.state.position = position
        return True

    def forget_if_silent(self) -> None:
        """Set `state` to None if the replay has sent no state for `STALE_S` (1 s)."""
        if time.monotonic() - self._received_s > STALE_S:
            self.state = None

    def _receive(self, state: ReplayState) -> None:
        self.state, self._received_s = state, time.monotonic()


class BagRecorder:
    """Runs `./cube record` as a child process, at most one at a time, each into a new folder.

    Attributes:
        path: Folder of the bag that was begun last; before the first one, the folder for all bags.
    """

    def __init__(self, folder: Path, say: Say) -> None:
        """Prepare to record.

        Args:
            folder: Parent folder of all bags, which is made if it does not exist.
            say: Function that shows notes to the user.
        """
        self._folder = folder
        self._say = say
        self.path = folder
        self._process: subprocess.Popen[bytes] | None = None

    def toggle(self) -> None:
        """End the recording that runs, or start to record into a new folder.

        The name of the folder contains the local time.
        """
        if self._process is not None:
            self.end()
            self._say("recorded", f"{self.path}", "green")
            return
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            text = f"{self._folder}: {error.strerror}; name another folder with --recordings"
            self._say("recording not possible", text, "red")
            return
        self.path = self._folder / time.strftime("skin_%Y%m%d_%H%M%S")
        record = ["-m", "cube_tensor_driver.cli", "record", "-o", str(self.path)]
        self._process = subprocess.Popen(
            [*end_with_parent(), sys.executable, *record],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            # Ctrl-C in the terminal reaches every process of its session. In a session of its own,
            # the recorder does not get it and can finish its file when `end` asks for that.
            start_new_session=True,
        )
        self._say("recording", f"{self.path}", "blue")

    def end(self) -> None:
        """Ask the recorder to finish its bag, and wait up to `MAX_END_S` for it.

        Without a recording nothing happens.
        """
        if self._process is None:
            return
        self._process.send_signal(signal.SIGINT)
        try:
            self._process.wait(MAX_END_S)
        except subprocess.TimeoutExpired:
            # ./cube bag repair can make the unfinished bag readable.
            self._process.kill()
            self._process.wait()
        self._process = None

    def is_recording(self) -> bool:
        """Return whether a bag is being recorded; show a note if the recorder ended by itself."""
        if self._process is not None and self._process.poll() is not None:
            text = f"the recorder ended by itself with code {self._process.returncode}"
            self._say("recording failed", text, "red")
            self._process = None
        return self._process is not None
