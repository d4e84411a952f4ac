# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The node and the web server of `./cube view`, whose page shows the running skin.

They run in a process of their own, so that they do not slow down the driver and the other nodes.
"""

from __future__ import annotations

import contextlib
import io
import math
import queue
import secrets
import socket
import time
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import viser
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import Trigger

from ..core.arrays import Index
from ..core.defaults import CONTACT_PRESSURE
from ..core.latest_stress import STALE, STALE_S
from ..core.rows import StressRows
from ..messages.contacts import decode_contacts, decode_traction
from ..messages.skin_info import read_cube_calibrations, read_skin_elastomer
from ..msg import SkinContacts
from ..processes.stop_signals import stop_event
from ..ros.callbacks import CallbackErrors
from ..ros.messages import to_ns
from ..ros.session import describe_domain, run_node_session, spin_until
from ..ros.skin_subscriber import FollowedSkin, SkinSubscriber
from ..srv import Tare
from . import markup
from .charts import HISTORY_S
from .clients import BagRecorder, ReplayClient, ServiceCalls, ServiceClient
from .gate import LOCAL_HOSTS, Gate, make_secret_address
from .history import History
from .markup import PageStatus
from .page import (
    CLEAR_TARE,
    HOLD,
    JUMP,
    RECORD,
    STOP,
    TARE,
    Page,
    PageLayout,
    clear,
    show_waiting,
)
from .scan import Links, Scan, ScanSynchronizer
from .update import ShownSkin

ALL_ADDRESSES = ("", "0.0.0.0", "::")
"""Values of --host with which the server listens on all addresses of this machine: those of IPv4
and IPv6, of IPv4 alone, and of IPv6 alone."""

PICTURE_PERIOD_S = 0.1
"""Period, in seconds, at which picture, numbers and plots of all pages are updated together."""

MIN_PAUSE_SHARE = 2.0
"""Minimum pause after an update of the pages, divided by the processor time that the update took.

With a ratio of 2, the updates take at most a third of a core; those of a very large skin come less
often than once per `PICTURE_PERIOD_S`.
"""

WAITING_NOTE_S = 2.0
"""Time, in seconds after the start, at which the terminal prints that no skin is published yet."""

MAX_STEP_S = 0.02
"""Maximum time, in seconds, between two checks whether the pages are to be updated. A check also
follows each message from ROS."""

NEVER_STALE_S = 1e9
"""Maximum age, in seconds, of a cube's latest row (sample) while a replay of a bag is paused.

A paused replay publishes nothing. The limit is so high that only cubes that never had a row are
shown as stale then.
"""


class Viewer:
    """The web server of `./cube view`, the pages of all browsers, and what they receive from ROS.

    Everything runs in the thread that spins the node and calls `step`. viser calls the functions of
    buttons in threads of its own; these only put an action into a queue, which `step` empties.
    """

    def __init__(
        self,
        node: Node,
        host: str,
        port: int,
        recordings: Path,
    ) -> None:
        """Start the web server and subscribe to the topics of the skin.

        Args:
            node: Node of this process.
            host: Name or IP address on which the server listens.
            port: TCP port of the page; if it is in use, the next free one is taken.
            recordings: Folder for the bags that are recorded from the page.

        Raises:
            ConfigError: This machine does not have the address, or the port cannot be opened.
        """
        self._host = host
        # An address that only this machine can reach needs no token: whoever can open it is a user
        # of this machine.
        self._token = "" if host in LOCAL_HOSTS else secrets.token_urlsafe(16)
        address = make_secret_address()
        # viser prints its secret address. The text is discarded, because browsers must use the
        # address of the gate.
        with contextlib.redirect_stdout(io.StringIO()):
            self._server = viser.ViserServer(
                address,
                0,
                label="cube_tensor_driver",
                verbose=False,
            )
        inner = address, self._server.get_port()
        self._gate = Gate(host, port, self._token, inner)
        # viser warns if a browser disconnects while its picture is made, which is no fault.
        warnings.filterwarnings("ignore", "Queued a .* on a closed connection")
        self._callback_errors = CallbackErrors(node)
        self._subscriber = SkinSubscriber(
            node,
            self._show_skin,
            self._receive_stress,
        )
        for kind, topic, receive in (
            (DiagnosticArray, "/diagnostics", self._receive_diagnostics),
            (SkinContacts, "contacts", self._receive_contacts),
            (PointCloud2, "traction", self._receive_traction),
        ):
            receive_safely = self._callback_errors.catch(receive)
            node.create_subscription(
                kind,
                topic,
                receive_safely,
                10,
            )
        self._status = PageStatus()
        self._services = ServiceCalls(self._status.say)
        self._replay = ReplayClient(node, self._services, self._status.say)
        self._recorder = BagRecorder(recordings, self._status.say)
        ask = self._services.ask
        tare: ServiceClient = node.create_client(Tare, "reconstruction/tare")
        clear_tare: ServiceClient = node.create_client(Trigger, "reconstruction/clear_tare")
        # What is done for each action of a user; the arguments are those of `Act`.
        self._commands: dict[str, Callable[..., None]] = {
            TARE: partial(ask, "tare", tare, Tare.Request()),
            CLEAR_TARE: partial(
                ask,
                "undo tare",
                clear_tare,
                Trigger.Request(),
            ),
            HOLD: self._replay.toggle_hold,
            JUMP: lambda take_position: self._replay.jump_to(take_position()),
            RECORD: self._recorder.toggle,
            STOP: self._recorder.toggle,
        }
        self._links: dict[str, tuple[str, int]] = {}
        self._actions: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._shown: ShownSkin | None = None
        self._scans = ScanSynchronizer(0)
        self._history = History(1)
        self._pages: dict[int, Page] = {}
        self._layouts: dict[int, PageLayout] = {}
        # viser calls both functions in threads of its own, so they only put actions into the queue.
        put = self._actions.put
        self._server.on_client_connect(lambda client: put(lambda: self._open_page(client)))
        self._server.on_client_disconnect(
            lambda client: put(lambda: self._forget_page(client.client_id))
        )
        self._next_picture_s = time.monotonic()
        self._waiting_note_s = self._next_picture_s + WAITING_NOTE_S

    @property
    def url(self) -> str:
        """URL of the page; it contains the token if browsers of other machines may open it."""
        host = socket.gethostname() if self._host in ALL_ADDRESSES else self._host
        name = f"[{host}]" if ":" in host else host
        query = f"/?token={self._token}" if self._token else ""
        return f"http://{name}:{self._gate.port}{query}"

    def step(self) -> None:
        """Execute the actions of users, and update the pages if a picture is due."""
        while not self._actions.empty():
            self._callback_errors.catch(self._actions.get())()
        now_s = time.monotonic()
        if self._shown is not None and now_s >= self._next_picture_s:
            start_s = time.thread_time()
            self._callback_errors.catch(self._update)(self._shown)
            pause_s = MIN_PAUSE_SHARE * (time.thread_time() - start_s)
            # Pictures whose times have passed, for example while the computer slept, are skipped.
            self._next_picture_s = max(
                self._next_picture_s + PICTURE_PERIOD_S,
                time.monotonic() + pause_s,
            )
        elif self._shown is None and now_s >= self._waiting_note_s:
            self._waiting_note_s = math.inf
            print(markup.describe_waiting(describe_domain()), flush=True)

    def close(self) -> None:
        """End a recording that runs, and stop the server."""
        self._recorder.end()
        # viser prints a message when it stops, which is discarded.
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()
        self._gate.close()

    def _show_skin(self, skin: FollowedSkin) -> None:
        """Open new pages in all browsers for a skin that has appeared or has replaced another.

        Args:
            skin: The state of the new skin, as received on its topics.
        """
        names = [cube.name for cube in skin.info.cubes]
        calibrations = read_cube_calibrations(skin.info)
        self._shown = ShownSkin(
            skin.info.name,
            names,
            skin.poses,
            calibrations,
            read_skin_elastomer(skin.info),
        )
        self._scans = ScanSynchronizer(len(names))
        self._history = History(round(HISTORY_S / PICTURE_PERIOD_S))
        self._pages.clear()
        for client in self._server.get_clients().values():
            clear(client)
            self._open_page(client)

    def _open_page(self, client: viser.ClientHandle) -> None:
        """Open a page in a browser, unless it has one already or is no longer connected.

        Args:
            client: The browser.
        """
        # The event waited in the queue, and the browser may have disconnected in that time.
        has_page = client.client_id in self._pages
        if has_page or client.client_id not in self._server.get_clients():
            return
        # The size is read before panels are added, because they make the picture narrower.
        size = client.camera.image_width, client.camera.image_height
        layout = self._layouts.setdefault(client.client_id, PageLayout(*size))
        if self._shown is None:
            show_waiting(
                client,
                layout,
                markup.describe_waiting(describe_domain()),
            )
            return

        def act(action: str, *arguments: object) -> None:
            # A browser may send any text, and unknown ones do nothing.
            if action in self._commands:
                self._actions.put(partial(self._commands[action], *arguments))

        page = Page(client, layout, self._shown, act)
        page.replay.show(self._replay.state)
        self._pages[client.client_id] = page

    def _forget_page(self, client_id: int) -> None:
        self._pages.pop(client_id, None)
        self._layouts.pop(client_id, None)

    def _update(self, skin: ShownSkin) -> None:
        """Show the newest scan (the values of all cubes at one instant) in all browsers."""
        if self._replay.update():
            # After a jump of the replay, the plots would connect values of two different times.
            self._history.clear()
        self._replay.forget_if_silent()
        self._status.recording = self._recorder.is_recording()

        scans = self._scans
        has_advanced = scans.advance()
        stale_s = NEVER_STALE_S if self._replay.is_held else STALE_S
        health = scans.latest.compute_health(self._subscriber.now(), stale_s)
        if has_advanced:
            values = scans.latest.select_usable_values(health)
            self._history.add(
                1e-9 * scans.stamp_ns,
                values,
                scans.latest.residual,
            )
        # Without a page, computing the field and the contacts would be useless work.
        if not self._pages:
            return
        scan = make_scan(
            skin,
            scans,
            health,
            tuple(self._links.values()),
        )
        connected = self._server.get_clients()
        for client_id, page in self._pages.items():
            if client_id in connected:
                if not self._replay.is_jumping:
                    page.replay.show(self._replay.state)
                page.show(scan, self._history, self._status)

    def _receive_stress(self, stamp_ns: int, rows: StressRows) -> None:
        self._scans.add_rows(stamp_ns, rows, self._subscriber.now())

    def _receive_contacts(self, message: SkinContacts) -> None:
        self._scans.add_contacts(to_ns(message.header.stamp), decode_contacts(message))

    def _receive_traction(self, message: PointCloud2) -> None:
        cloud = decode_traction(message)
        has_position = np.isfinite(cloud[:, :3]).all(axis=1)
        self._scans.add_cloud(to_ns(message.header.stamp), cloud[has_position])

    def _receive_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            # The driver names the diagnostics of a link (connection to a hub) "NODE: link NAME".
            if ": link " in status.name:
                name = status.name.rpartition(": ")[2]
                self._links[status.name] = f"{name}: {status.message}", status.level[0]


def make_scan(
    skin: ShownSkin,
    scans: ScanSynchronizer,
    health: Index,
    links: Links,
) -> Scan:
    """Return everything that the pages show of the present instant.

    If the node `contacts` does not run, contacts are found by interpolation between the cubes.

    Args:
        skin: The skin.
        scans: Latest row (sample) of each cube, and what the node `contacts` found in these rows.
        health: (N,) health of the cubes at this instant.
        links: Line of text and level of the diagnostics of each link (connection to a hub).
    """
    latest = scans.latest
    values = latest.select_usable_values(health)
    contacts = scans.contacts
    if contacts is None:
        contacts = skin.surface.find_contacts(values, CONTACT_PRESSURE)
    return Scan(
        values=values,
        residual=latest.residual.copy(),
        health=health,
        status=latest.status.copy(),
        rate=np.where(health == STALE, 0.0, scans.sample_rate.hertz),
        field=skin.field.compute(values, scans.cloud),
        contacts=contacts,
        links=links,
    )


def run_view(
    host: str,
    port: int,
    recordings: Path,
) -> int:
    """Serve the page until Ctrl-C.

    Args:
        host: Name or IP address on which the server listens.
        port: TCP port of the page; if it is in use, the next free one is taken.
        recordings: Folder for the bags that are recorded from the page.

    Returns:
        The exit code, 0.

    Raises:
        ConfigError: This machine does not have the address, or the port cannot be opened.
    """
    stop = stop_event()
    with (
        run_node_session("view") as (node, executor),
        contextlib.closing(Viewer(node, host, port, recordings)) as viewer,
    ):
        print(f"{viewer.url}  (Ctrl-C ends it)", flush=True)
        spin_until(
            executor,
            stop.is_set,
            step_s=MAX_STEP_S,
            on_step=viewer.step,
        )
    return 0
