"""`./cube view`: serves a page that shows the running skin.

It is a process of its own, so that it slows nothing else down.
"""

from __future__ import annotations

import contextlib
import io
import logging
import math
import os
import queue
import secrets
import signal
import socket
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
from ..ros.compat import make_executor
from ..ros.guard import CallbackGuard
from ..ros.session import start_ros
from ..ros.skin_subscriber import FollowedSkin, SkinSubscriber
from ..srv import Tare
from . import markup
from .bag_recorder import BagRecorder
from .charts import HISTORY_S
from .contacts_client import ContactsClient
from .gate import HOSTS, check_host, guarded_server
from .history import History, RowRate
from .markup import PageStatus
from .moment import Moment
from .page import Buttons, Page, ShownSkin, WaitingPage
from .replay_client import ReplayClient
from .service_calls import ServiceCalls

WILDCARDS = ("0.0.0.0", "::")
"""All addresses of this machine."""
PICTURES_HZ, NUMBERS_HZ = 20.0, 4.0
SAY_WAITING_S = 2.0
"""Without a skin, until the terminal says that the page waits for one."""
NEVER_STALE_S = 1e9
"""For cubes while a replay is held."""


class Viewer:
    """The node and the page.

    All of it runs in the thread that calls `spin`, except that buttons are pressed in viser's
    threads: what they ask for waits in a queue.
    """

    def __init__(self, host: str, port: int, depth: float, recordings: Path) -> None:
        """host, port: where the page is served, TCP. depth: from the cubes' centres to the surface,
        m. recordings: the folder for bags."""
        self._host = host
        self._token = "" if host in HOSTS else secrets.token_urlsafe(16)
        self._server = _serve(host, port, self._token)
        self._depth = depth
        self._node = rclpy.create_node("view")
        self._guard = CallbackGuard(self._node)
        self._subscriber = SkinSubscriber(self._node, self._show_skin)
        self._node.create_subscription(
            DiagnosticArray, "/diagnostics", self._guard.wrap(self._receive_diagnostics), 10
        )
        self._tare = self._node.create_client(Tare, "reconstruction/tare")
        self._clear_tare = self._node.create_client(Trigger, "reconstruction/clear_tare")
        self._status = PageStatus()
        self._services = ServiceCalls(self._status.say)
        self._replay = ReplayClient(self._node, self._services, self._status.say)
        self._contacts = ContactsClient(self._node, self._guard)
        self._recorder = BagRecorder(recordings)
        self._links: dict[str, str] = {}
        self._pressed: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._followed: FollowedSkin | None = None
        self._shown: ShownSkin | None = None
        self._rows = RowRate(0, time.monotonic())
        self._pages: dict[int, Page | WaitingPage] = {}
        put = self._pressed.put
        self._server.on_client_connect(lambda client: put(lambda: self._open_page(client)))
        self._server.on_client_disconnect(
            lambda client: put(lambda: self._forget_page(client.client_id))
        )
        self._executor = make_executor()
        self._executor.add_node(self._node)

    @property
    def url(self) -> str:
        """What to open in a browser; with the token, where one is needed."""
        host = socket.gethostname() if self._host in WILDCARDS else self._host
        name = f"[{host}]" if ":" in host else host
        query = f"/?token={self._token}" if self._token else ""
        return f"http://{name}:{self._server.get_port()}{query}"

    def spin(self, stopping: Callable[[], bool]) -> None:
        """Serve until `stopping` is true."""
        next_picture = next_numbers = time.monotonic()
        say_waiting_at = next_picture + SAY_WAITING_S
        while not stopping():
            wait = min(next_picture - time.monotonic(), 1 / PICTURES_HZ)
            self._executor.spin_once(timeout_sec=max(0.0, wait))
            while not self._pressed.empty():
                self._guard.wrap(self._pressed.get())()
            now = time.monotonic()
            if now < next_picture:
                continue
            # After a pause of the computer, pictures that were missed are not made up for.
            next_picture = max(next_picture + 1 / PICTURES_HZ, now)
            with_numbers = now >= next_numbers
            if with_numbers:
                next_numbers = now + 1 / NUMBERS_HZ
            if self._followed is not None and self._shown is not None:
                self._guard.wrap(self._update)(self._followed, self._shown, with_numbers)
            elif now >= say_waiting_at:
                say_waiting_at = math.inf
                print(markup.waiting(_domain()), flush=True)

    def close(self) -> None:
        self._recorder.end()
        self._executor.remove_node(self._node)
        self._node.destroy_node()
        with contextlib.redirect_stdout(io.StringIO()):  # viser prints that it has stopped
            self._server.stop()

    def _show_skin(self, skin: FollowedSkin) -> None:
        """There is a skin, or another one: make its pages."""
        names = [cube.name for cube in skin.info.cubes]
        history = History(len(names), round(HISTORY_S * PICTURES_HZ))
        self._shown = ShownSkin(skin.info.name, names, skin.poses, self._depth, history)
        self._followed = skin
        self._rows = RowRate(len(names), time.monotonic())
        for page in self._pages.values():
            page.close()
        self._pages.clear()
        for client in self._server.get_clients().values():
            self._open_page(client)

    def _open_page(self, client: viser.ClientHandle) -> None:
        """The page of a browser that has come; safe to call again."""
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

        put = self._pressed.put
        return Buttons(
            tare=lambda: put(tare),
            clear_tare=lambda: put(clear_tare),
            record=lambda: put(self._toggle_recording),
            hold=lambda: put(self._replay.toggle_hold),
            jump=lambda position: put(lambda: self._replay.jump_to(position)),
        )

    def _update(self, followed: FollowedSkin, shown: ShownSkin, with_numbers: bool) -> None:
        """One picture; with_numbers: and what stands beside it."""
        if self._replay.update():
            shown.history.clear()
        held = self._replay.held
        now = self._subscriber.now()
        health = followed.newest.health(now, NEVER_STALE_S if held else STALE_S)
        if not held:
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
        here = self._server.get_clients()
        for client_id, page in self._pages.items():
            if isinstance(page, Page) and client_id in here:
                if with_numbers and not self._replay.jumping:
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
            if ": link " in status.name:
                name = status.name.rpartition(": ")[2]
                self._links[status.name] = f"{name}: {status.message}"


def _domain() -> str:
    return os.environ.get("ROS_DOMAIN_ID") or "0"


def _serve(host: str, port: int, token: str) -> viser.ViserServer:
    """ConfigError: the host is no address of this machine, or the port is in use."""
    check_host(host)
    logging.getLogger("websockets").setLevel(logging.ERROR)
    # A browser may leave while its picture is made.
    warnings.filterwarnings("ignore", "Queued a .* on a closed connection")
    try:
        # viser prints a banner
        with contextlib.redirect_stdout(io.StringIO()), guarded_server(token):
            return viser.ViserServer(host, port, label="cube_tensor_driver", verbose=False)
    except OSError as error:
        raise ConfigError(f"--port {port}: {error.strerror}; take another one") from None


def run_view(host: str, port: int, depth: float, recordings: Path) -> int:
    """Serve the page until Ctrl-C; returns the exit code.

    host, port: where the page is served, TCP. depth: from the cubes' centres to the surface, m.
    recordings: the folder for bags. Raises ConfigError if host or port cannot be had.
    """
    stopping = False

    def stop(*_: object) -> None:
        nonlocal stopping
        stopping = True

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, stop)
    start_ros()
    try:
        with contextlib.closing(Viewer(host, port, depth, recordings)) as viewer:
            print(f"{viewer.url}  (Ctrl-C ends it)", flush=True)
            viewer.spin(lambda: stopping)
    finally:
        rclpy.try_shutdown()
    return 0
