"""`./cube view`: serve a page that shows the running skin.

It is a process of its own, so that it does not slow down the nodes.
"""

from __future__ import annotations

import contextlib
import io
import logging
import math
import os
import queue
import secrets
import socket
import threading
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import rclpy
import viser
from diagnostic_msgs.msg import DiagnosticArray
from std_srvs.srv import Trigger

from ..core.errors import ConfigError
from ..core.latest_stress import STALE_S
from ..processes.stop_signals import stop_event
from ..ros.callbacks import CallbackErrors
from ..ros.compat import make_executor
from ..ros.session import start_ros
from ..ros.skin_subscriber import FollowedSkin, SkinSubscriber
from ..srv import Tare
from . import markup
from .bag_recorder import BagRecorder
from .charts import HISTORY_S
from .clients import ContactsClient, ReplayClient, ServiceCalls
from .gate import LOCAL_HOSTS, check_host, guarded_server
from .history import History, RowRate
from .markup import PageStatus
from .moment import Moment
from .page import Buttons, Page, ShownSkin, WaitingPage

ALL_ADDRESSES = ("0.0.0.0", "::")
"""Hosts that stand for all addresses of this machine, in IPv4 and IPv6."""

PICTURE_PERIOD_S = 0.05
"""Time, in seconds, from picture to picture."""

NUMBERS_PERIOD_S = 0.25
"""Time, in seconds, from one update of numbers and plots to the next. People cannot read faster."""

WAITING_NOTE_S = 2.0
"""Time, in seconds, without a skin, after which the terminal says that the page waits for one."""

NEVER_STALE_S = 1e9
"""Age, in seconds, above which a cube is stale while a replay is held: none is."""


class Viewer:
    """The node and the pages of all browsers.

    All of it runs in the thread that calls `spin`. Buttons are pressed in threads of viser, and
    what they ask for waits in a queue.
    """

    def __init__(
        self,
        host: str,
        port: int,
        depth: float,
        recordings: Path,
    ) -> None:
        """Start the server and the node; arguments as of `run_view`."""
        self._host = host
        # Whoever can open a local address is a user of this machine already.
        self._token = "" if host in LOCAL_HOSTS else secrets.token_urlsafe(16)
        self._server = _serve(host, port, self._token)
        self._depth = depth
        self._node = rclpy.create_node("view")
        self._callback_errors = CallbackErrors(self._node)
        self._subscriber = SkinSubscriber(self._node, self._show_skin)
        self._node.create_subscription(
            DiagnosticArray,
            "/diagnostics",
            self._callback_errors.catch(self._receive_diagnostics),
            10,
        )
        self._tare = self._node.create_client(Tare, "reconstruction/tare")
        self._clear_tare = self._node.create_client(Trigger, "reconstruction/clear_tare")
        self._status = PageStatus()
        self._services = ServiceCalls(self._status.say)
        self._replay = ReplayClient(self._node, self._services, self._status.say)
        self._contacts = ContactsClient(self._node, self._callback_errors)
        self._recorder = BagRecorder(recordings)
        self._links: dict[str, str] = {}
        self._actions: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._followed: FollowedSkin | None = None
        self._shown: ShownSkin | None = None
        self._rows = RowRate(0, time.monotonic())
        self._pages: dict[int, Page | WaitingPage] = {}
        # viser calls these in threads of its own.
        put = self._actions.put
        self._server.on_client_connect(lambda client: put(lambda: self._open_page(client)))
        self._server.on_client_disconnect(
            lambda client: put(lambda: self._forget_page(client.client_id))
        )
        self._executor = make_executor()
        self._executor.add_node(self._node)

    @property
    def url(self) -> str:
        """Address of the page, with the token where one is needed."""
        host = socket.gethostname() if self._host in ALL_ADDRESSES else self._host
        name = f"[{host}]" if ":" in host else host
        query = f"/?token={self._token}" if self._token else ""
        return f"http://{name}:{self._server.get_port()}{query}"

    def spin(self, stop: threading.Event) -> None:
        """Serve until `stop` is set."""
        next_picture_s = next_numbers_s = time.monotonic()
        waiting_note_s = next_picture_s + WAITING_NOTE_S
        while not stop.is_set():
            # The executor returns earlier when a message comes.
            wait_s = min(next_picture_s - time.monotonic(), PICTURE_PERIOD_S)
            self._executor.spin_once(timeout_sec=max(0.0, wait_s))
            while not self._actions.empty():
                self._callback_errors.catch(self._actions.get())()
            now_s = time.monotonic()
            if now_s < next_picture_s:
                continue

            # Pictures that were missed, while the computer slept for example, are left out.
            next_picture_s = max(next_picture_s + PICTURE_PERIOD_S, now_s)
            with_numbers = now_s >= next_numbers_s
            if with_numbers:
                next_numbers_s = now_s + NUMBERS_PERIOD_S
            if self._followed is not None and self._shown is not None:
                self._callback_errors.catch(self._update)(self._followed, self._shown, with_numbers)
            elif now_s >= waiting_note_s:
                waiting_note_s = math.inf
                print(markup.waiting(_domain()), flush=True)

    def close(self) -> None:
        """End a recording, the node and the server."""
        self._recorder.end()
        self._executor.remove_node(self._node)
        self._node.destroy_node()  # type: ignore[no-untyped-call]
        # viser prints that it has stopped.
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()

    def _show_skin(self, skin: FollowedSkin) -> None:
        """Make the pages of a skin that has appeared, or has taken the place of another one."""
        names = [cube.name for cube in skin.info.cubes]
        history = History(len(names), round(HISTORY_S / PICTURE_PERIOD_S))
        self._shown = ShownSkin(skin.info.name, names, skin.poses, self._depth, history)
        self._followed = skin
        self._rows = RowRate(len(names), time.monotonic())
        for page in self._pages.values():
            page.close()
        self._pages.clear()
        for client in self._server.get_clients().values():
            self._open_page(client)

    def _open_page(self, client: viser.ClientHandle) -> None:
        """Make the page of a browser, unless it has one or has gone already."""
        # The browser may be gone by the time its event is handled.
        if client.client_id in self._pages or client.client_id not in self._server.get_clients():
            return
        if self._shown is None:
            self._pages[client.client_id] = WaitingPage(client, markup.waiting(_domain()))
            return
        page = Page(client, self._shown, self._buttons())
        page.show_replay(self._replay.state)
        self._pages[client.client_id] = page

    def _forget_page(self, client_id: int) -> None:
        self._pages.pop(client_id, None)

    def _buttons(self) -> Buttons:
        def tare() -> None:
            self._services.ask("tare", self._tare, Tare.Request())

        def clear_tare() -> None:
            self._services.ask("undo tare", self._clear_tare, Trigger.Request())

        put = self._actions.put
        return Buttons(
            tare=lambda: put(tare),
            clear_tare=lambda: put(clear_tare),
            record=lambda: put(self._toggle_recording),
            hold=lambda: put(self._replay.toggle_hold),
            jump=lambda position: put(lambda: self._replay.jump_to(position)),
        )

    def _update(
        self,
        followed: FollowedSkin,
        shown: ShownSkin,
        with_numbers: bool,
    ) -> None:
        """Show one picture, and with `with_numbers` the numbers and plots beside it."""
        # After a jump the plots would connect two different times.
        if self._replay.update():
            shown.history.clear()
        is_held = self._replay.is_held
        now = self._subscriber.now()
        health = followed.newest.health(now, NEVER_STALE_S if is_held else STALE_S)
        if not is_held:
            shown.history.add(now, followed.newest.usable_values(health), followed.newest.residual)
        if with_numbers:
            self._update_status()
            self._rows.update(time.monotonic(), followed.newest.count)
        # Without a browser there is nobody to draw for.
        if not self._pages:
            return
        moment = Moment.of(
            followed.newest, health, shown.surface, self._contacts.found(shown.surface)
        )
        connected = self._server.get_clients()
        for client_id, page in self._pages.items():
            if isinstance(page, Page) and client_id in connected:
                if with_numbers and not self._replay.is_jumping:
                    page.show_replay(self._replay.state)
                page.show(moment, self._rows.rate, self._status, with_numbers)

    def _update_status(self) -> None:
        status = self._status
        self._services.update()
        code = self._recorder.ended_by_itself()
        if code is not None:
            status.say("The recording ended", f"recording ended by itself with code {code}", "red")
        status.recording = self._recorder.recording
        status.links = list(self._links.values())
        self._replay.forget_if_silent()

    def _toggle_recording(self) -> None:
        if self._recorder.recording:
            self._recorder.end()
            self._status.say("Recorded", f"recorded to {self._recorder.path}", "green")
            return
        try:
            self._recorder.start()
        except ConfigError as error:
            self._status.say("The recording did not start", str(error), "red")
            return
        self._status.say("Recording", f"recording to {self._recorder.path}")

    def _receive_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            # Names of diagnostics are "NODE: link NAME".
            if ": link " in status.name:
                name = status.name.rpartition(": ")[2]
                self._links[status.name] = f"{name}: {status.message}"


def _domain() -> str:
    return os.environ.get("ROS_DOMAIN_ID") or "0"


def _serve(host: str, port: int, token: str) -> viser.ViserServer:
    """Start viser.

    Raises:
        ConfigError: The host is no address of this machine, or the port cannot be had.
    """
    check_host(host)
    # A refused request is no error of the server.
    logging.getLogger("websockets").setLevel(logging.ERROR)
    # viser warns when a browser leaves while its picture is made, which is no fault.
    warnings.filterwarnings("ignore", "Queued a .* on a closed connection")
    try:
        # viser prints a banner with an address without the token.
        with contextlib.redirect_stdout(io.StringIO()), guarded_server(token):
            return viser.ViserServer(host, port, label="cube_tensor_driver", verbose=False)
    except OSError as error:
        raise ConfigError(f"--port {port}: {error.strerror}; take another one") from None


def run_view(
    host: str,
    port: int,
    depth: float,
    recordings: Path,
) -> int:
    """Serve the page until Ctrl-C; returns the exit code.

    Args:
        host: Address at which the page is served.
        port: TCP port of the page.
        depth: Depth of the centres of the cubes below the surface, in metres.
        recordings: Folder for bags that are recorded from the page.

    Raises:
        ConfigError: Host or port cannot be had.
    """
    stop = stop_event()
    start_ros()
    try:
        with contextlib.closing(Viewer(host, port, depth, recordings)) as viewer:
            print(f"{viewer.url}  (Ctrl-C ends it)", flush=True)
            viewer.spin(stop)
    finally:
        rclpy.try_shutdown()
    return 0
