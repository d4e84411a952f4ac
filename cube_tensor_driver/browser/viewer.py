"""The node and the web server of `./cube view`, whose page shows the running skin.

They run in a process of their own, so that they do not slow down the driver and the other nodes.
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
"""Values of --host with which the server listens on all addresses of this machine (IPv4, IPv6)."""

PICTURE_PERIOD_S = 0.05
"""Period, in seconds, at which the pages get a new picture of the skin."""

NUMBERS_PERIOD_S = 0.25
"""Period, in seconds, at which numbers and plots change; people cannot read numbers faster."""

WAITING_NOTE_S = 2.0
"""Time, in seconds after the start, at which the terminal prints that no skin is published yet."""

NEVER_STALE_S = 1e9
"""Maximum age, in seconds, of a cube's latest row while a replay is paused.

A paused replay publishes nothing. The limit is so high that no cube is shown as stale then.
"""


class Viewer:
    """The ROS node of `./cube view`, its web server, and the pages of all browsers.

    Everything runs in the thread that calls `spin`. viser calls the functions of buttons in threads
    of its own; these only put an action into a queue, from which `spin` takes it.
    """

    def __init__(
        self,
        host: str,
        port: int,
        depth: float,
        recordings: Path,
    ) -> None:
        """Start the web server and the ROS node.

        Args:
            host: Name or IP address on which the server listens.
            port: TCP port of the page; if it is in use, the next free one is taken.
            depth: Distance from the centres of the cubes to the surface of the skin, in metres.
            recordings: Folder for the bags that are recorded from the page.
        """
        self._host = host
        # An address that only this machine can reach needs no token: whoever can open it is a user
        # of this machine.
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
        self._links: dict[str, tuple[str, int]] = {}
        self._actions: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._followed: FollowedSkin | None = None
        self._shown: ShownSkin | None = None
        self._rows = RowRate(0, time.monotonic())
        self._pages: dict[int, Page | WaitingPage] = {}
        # viser calls both functions in threads of its own, so they only put actions into the queue.
        put = self._actions.put
        self._server.on_client_connect(lambda client: put(lambda: self._open_page(client)))
        self._server.on_client_disconnect(
            lambda client: put(lambda: self._forget_page(client.client_id))
        )
        self._executor = make_executor()
        self._executor.add_node(self._node)

    @property
    def url(self) -> str:
        """URL of the page; it contains the token if browsers of other machines may open it."""
        host = socket.gethostname() if self._host in ALL_ADDRESSES else self._host
        name = f"[{host}]" if ":" in host else host
        query = f"/?token={self._token}" if self._token else ""
        return f"http://{name}:{self._server.get_port()}{query}"

    def spin(self, stop: threading.Event) -> None:
        """Receive messages, execute actions of users and update the pages until `stop` is set."""
        next_picture_s = next_numbers_s = time.monotonic()
        waiting_note_s = next_picture_s + WAITING_NOTE_S
        while not stop.is_set():
            # `spin_once` waits until the next picture is due, or returns earlier after a message.
            wait_s = min(next_picture_s - time.monotonic(), PICTURE_PERIOD_S)
            self._executor.spin_once(timeout_sec=max(0.0, wait_s))
            while not self._actions.empty():
                self._callback_errors.catch(self._actions.get())()
            now_s = time.monotonic()
            if now_s < next_picture_s:
                continue

            # Pictures that are overdue, for example after the computer slept, are skipped.
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
        """End a recording that runs, destroy the node and stop the server."""
        self._recorder.end()
        self._executor.remove_node(self._node)
        self._node.destroy_node()  # type: ignore[no-untyped-call]
        # viser prints a message when it stops, which is discarded.
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()

    def _show_skin(self, skin: FollowedSkin) -> None:
        """Open new pages in all browsers for a skin that has appeared or has replaced another.

        Args:
            skin: The state of the new skin, as received on its topics.
        """
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
        """Open a page in a browser, unless it has one already or is no longer connected.

        Args:
            client: The browser.
        """
        # The event waited in the queue, and the browser may have disconnected in that time.
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
        """Update the pages of all browsers.

        Args:
            followed: The skin, with its latest rows.
            shown: The skin, as the pages show it.
            with_numbers: Whether to update numbers and plots as well as the 3-D view.
        """
        # After a jump of the replay, the plots would connect values of two different times.
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
        # Without a page, computing the field and the contacts would be useless work.
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
            # The driver names the diagnostics of a link (connection to a hub) "NODE: link NAME".
            if ": link " in status.name:
                name = status.name.rpartition(": ")[2]
                self._links[status.name] = f"{name}: {status.message}", status.level[0]


def _domain() -> str:
    return os.environ.get("ROS_DOMAIN_ID") or "0"


def _serve(host: str, port: int, token: str) -> viser.ViserServer:
    """Start the web server of viser.

    Args:
        host: Name or IP address on which it listens.
        port: TCP port; if it is in use, viser takes the next free one.
        token: Text that browsers must send; empty: none is needed.

    Raises:
        ConfigError: This machine does not have the address, or the port cannot be opened.
    """
    check_host(host)
    # websockets logs each refused request as an error, but refusing is intended here.
    logging.getLogger("websockets").setLevel(logging.ERROR)
    # viser warns if a browser disconnects while its picture is made, which is no fault.
    warnings.filterwarnings("ignore", "Queued a .* on a closed connection")
    try:
        # viser prints the address of the page without the token, which would not work.
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
    """Serve the page until Ctrl-C.

    Args:
        host: Name or IP address on which the server listens.
        port: TCP port of the page; if it is in use, the next free one is taken.
        depth: Distance from the centres of the cubes to the surface of the skin, in metres.
        recordings: Folder for the bags that are recorded from the page.

    Returns:
        The exit code, 0.

    Raises:
        ConfigError: This machine does not have the address, or the port cannot be opened.
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
