"""./cube view: a page on this machine that shows a running skin. A process of its own: it slows
nothing else."""

from __future__ import annotations

import contextlib
import io
import logging
import queue
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import rclpy
import viser
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.signals import SignalHandlerOptions
from std_srvs.srv import Trigger

from cube_tensor_driver.msg import ReplayState
from cube_tensor_driver.srv import SteerReplay, Tare

from ..core.defaults import SURFACE_DEPTH
from ..core.errors import ConfigError
from ..processes.children import LEASH
from ..ros.node import make_executor
from ..ros.skin_subscriber import STALE_S, SkinSubscriber
from .history import History
from .markup import Facts
from .page import Buttons, Page

HOST = "127.0.0.1"
PORT = 8080
PICTURES_HZ, NUMBERS_HZ = 20.0, 4.0
HISTORY_S = 10.0
WAIT_S = 10.0
"""How long a service may take to answer before the page says that it does not."""
HELD_S = 1e9
"""After which cubes are stale while a replay holds."""


class Browser:
    """The node and the page; `spin` until `stopping`."""

    def __init__(self, port: int, depth: float) -> None:
        logging.getLogger("websockets").setLevel(logging.ERROR)
        try:
            with contextlib.redirect_stdout(io.StringIO()):  # viser prints a banner of its own
                self._server = viser.ViserServer(
                    HOST, port, label="cube_tensor_driver", verbose=False
                )
        except OSError as error:
            raise ConfigError(f"--port {port}: {error.strerror}; take another one") from None
        self.url = f"http://{HOST}:{self._server.get_port()}"
        self._depth = depth
        self._node = rclpy.create_node("view")
        self._subscriber = SkinSubscriber(self._node, self._new_skin)
        self._page: Page | None = None
        self._facts = Facts()
        self._links: dict[str, str] = {}
        self._node.create_subscription(DiagnosticArray, "/diagnostics", self._take_diagnostics, 10)
        self._tare = self._node.create_client(Tare, "reconstruction/tare")
        self._clear = self._node.create_client(Trigger, "reconstruction/clear_tare")
        self._steer = self._node.create_client(SteerReplay, "player/steer")
        self._node.create_subscription(ReplayState, "player/state", self._take_replay, 1)
        self._replay: ReplayState | None = None
        self._replay_at = -np.inf
        self._jump: float | None = None
        self._steered: Any = None
        self._jumped = 0.0
        self._wishes: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._answers: list[tuple[str, Any, float]] = []
        self._recorder: subprocess.Popen[bytes] | None = None
        self._executor = make_executor()
        self._executor.add_node(self._node)

    def spin(self, stopping: Callable[[], bool]) -> None:
        picture = numbers = time.monotonic()
        while not stopping():
            self._executor.spin_once(timeout_sec=max(0.0, min(picture - time.monotonic(), 0.05)))
            now = time.monotonic()
            while not self._wishes.empty():
                self._wishes.get()()
            if now < picture:
                continue
            # After a pause of the machine the pictures that were missed are not made up for.
            picture = max(picture + 1 / PICTURES_HZ, now)
            self._draw(now >= numbers)
            if now >= numbers:
                numbers = now + 1 / NUMBERS_HZ

    def close(self) -> None:
        self._end_recording()
        self._executor.remove_node(self._node)
        self._node.destroy_node()
        self._server.stop()

    def _new_skin(self) -> None:
        info = self._subscriber.info
        if self._page is not None:
            self._page.close()
        wish = self._wishes.put
        buttons = Buttons(
            tare=lambda: wish(lambda: self._ask("tare", self._tare, Tare.Request())),
            clear_tare=lambda: wish(
                lambda: self._ask("clear tare", self._clear, Trigger.Request())
            ),
            record=lambda: wish(self._record),
            hold=lambda: wish(self._hold),
            jump=lambda position: wish(lambda: setattr(self, "_jump", position)),
        )
        names = [cube.name for cube in info.cubes]
        self._page = Page(
            self._server, info.name, names, self._subscriber.places, self._depth, buttons
        )
        self._history = History(len(names), round(HISTORY_S * PICTURES_HZ))
        self._page.steer(self._replay)
        self._count, self._counted_at = np.zeros(len(names), np.int64), time.monotonic()
        self._rate = np.full(len(names), np.nan)

    def _draw(self, numbers: bool) -> None:
        page = self._page
        if page is None:
            return
        self._make_jump()
        newest = self._subscriber.newest
        held = self._replay is not None and self._replay.paused
        health = self._subscriber.health(HELD_S if held else STALE_S)
        if not page.paused and not held:
            self._history.add(self._subscriber.now(), newest)
        # Without a browser there is nobody to draw for.
        if not self._server.get_clients():
            return
        if not page.paused:
            page.draw(newest, health)
        if numbers:
            now = time.monotonic()
            if now - self._counted_at > 1.0:
                self._rate = (newest.count - self._count) / (now - self._counted_at)
                self._count, self._counted_at = newest.count.copy(), now
            self._look_at_answers(now)
            if now - self._replay_at > STALE_S:
                self._replay = self._steered = self._jump = None
            if self._jump is None and self._steered is None:
                page.steer(self._replay)
            self._facts.links = list(self._links.values())
            page.write(newest, health, self._rate, self._history, self._facts)

    def _ask(self, what: str, client: Any, request: Any) -> None:
        if not client.service_is_ready():
            self._facts.action = f"{what}: no reconstruction node that can is running"
            return
        self._facts.action = f"{what}: asked …"
        self._answers.append((what, client.call_async(request), time.monotonic()))

    def _take_replay(self, message: ReplayState) -> None:
        self._replay, self._replay_at = message, time.monotonic()

    def _hold(self) -> None:
        if self._replay is not None:
            request = SteerReplay.Request(position=np.nan, paused=not self._replay.paused)
            self._ask("replay", self._steer, request)

    def _make_jump(self) -> None:
        """The last place that the slider was drawn to, once the place before it has been
        reached."""
        now = time.monotonic()
        if self._steered is not None and (self._steered.done() or now > self._jumped + WAIT_S):
            self._steered = None
        if self._jump is None or self._steered is not None or self._replay is None:
            return
        request = SteerReplay.Request(
            position=min(self._jump, self._replay.length), paused=self._replay.paused
        )
        self._jump, self._steered, self._jumped = None, self._steer.call_async(request), now
        self._replay.position = request.position
        self._history.clear()

    def _look_at_answers(self, now: float) -> None:
        waiting = []
        for what, future, since in self._answers:
            if future.done():
                answer = future.result()
                sign = "done" if answer.success else "refused"
                self._facts.action = f"{what} {sign}: {answer.message}"
            elif now - since > WAIT_S:
                self._facts.action = f"{what}: no answer within {WAIT_S:g} s"
                future.cancel()
            else:
                waiting.append((what, future, since))
        self._answers = waiting
        if self._recorder is not None and self._recorder.poll() is not None:
            self._facts.action = f"recording ended by itself with code {self._recorder.returncode}"
            self._recorder, self._facts.recording = None, False

    def _record(self) -> None:
        """Start a recording in the folder that we run in, or end it."""
        if self._recorder is not None:
            self._end_recording()
            return
        name = time.strftime("skin_%Y%m%d_%H%M%S")
        command = [*LEASH, sys.executable, "-m", "cube_tensor_driver.cli", "record", "-o", name]
        self._recorder = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, start_new_session=True
        )
        self._facts.recording, self._facts.action = True, f"recording to {name}"

    def _end_recording(self) -> None:
        if self._recorder is None:
            return
        self._recorder.send_signal(signal.SIGINT)
        try:
            self._recorder.wait(WAIT_S)
        except subprocess.TimeoutExpired:
            self._recorder.kill()
            self._recorder.wait()
        self._recorder, self._facts.recording, self._facts.action = None, False, "recording ended"

    def _take_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if ": link " in status.name:
                self._links[status.name] = f"{status.name.rpartition(': ')[2]}: {status.message}"


def run_view(port: int = PORT, depth: float = SURFACE_DEPTH) -> int:
    """Serve until Ctrl-C; returns the exit code. ConfigError: the port cannot be had."""
    stopping = False

    def stop(*_: object) -> None:
        nonlocal stopping
        stopping = True

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, stop)
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    try:
        with contextlib.closing(Browser(port, depth)) as browser:
            print(f"{browser.url}  (Ctrl-C ends it)", flush=True)
            browser.spin(lambda: stopping)
    finally:
        rclpy.try_shutdown()
    return 0
