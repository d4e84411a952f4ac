"""The thread that reads all links of a skin.

It opens and reopens the links, decodes their bytes, and calls back once per wake-up. No link waits
for another: ports are read and TCP connections are made without blocking, and bytes that a link
    does
not accept wait in a bounded buffer of its own. `session.py` decides what is sent on a link.
"""

from __future__ import annotations

import contextlib
import logging
import os
import selectors
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

from ...core.errors import LinkError
from ..wire.protocol import Command, Frame, Request, encode
from .intake import read_links
from .link import Link, LinkConfig, LinkState
from .session import TICK_S, Session

MAX_WAIT_PERIODS = 0.2
"""Longest wait for the hubs that have not delivered yet, as a part of the sample period. Hubs
sample together, but their bytes arrive one after the other; after a short wait all come in one
callback."""
MAX_WAIT_S = 1e-3
"""Longest wait for the hubs that have not delivered yet, in s."""
WAIT_STEP_S = 2e-4
"""Period, in s, at which the reader checks for data while it waits for further hubs. Waking up for
each hub would cost more. Arrivals may be later than true by this time."""
MIN_SELECT_S = 5e-5
"""Duration of a wait for data, in s, below which the data were already there. Then this thread is
late and does not wait for more."""
DRAIN_S = 0.05
"""Time for which closing waits until the last requests have left the serial ports, in s."""
LOGGED_ERRORS = (1, 10, 100, 1000, 10_000)
"""Numbers of errors of a callback at which the error is logged. At 1 kHz all of them would fill the
log."""
CLOSE_S = 1.5
"""Time for which closing waits for the end of the thread, in s."""


class LinkRead(NamedTuple):
    """Result of one read of a link.

    Attributes:
        link: Index of the link.
        arrival_ns: Arrival of the bytes.
        result: The decoded frames, or the error by which the link is lost.
    """

    link: int
    arrival_ns: int
    result: list[Frame] | LinkError


class LinkFrames(NamedTuple):
    """Frames to deliver, which one read of a link completed.

    Attributes:
        link: Index of the link.
        arrival_ns: Arrival of the bytes.
        frames: The frames.
        asked_ns: Time of the question that a TIME among the frames answers; 0 if there is none.
    """

    link: int
    arrival_ns: int
    frames: list[Frame]
    asked_ns: int = 0


OnFrames = Callable[[list[LinkFrames]], None]
OnState = Callable[[int, LinkState, LinkError | None], None]

_log = logging.getLogger(__name__)


class Reader:
    """Reads all links in one thread.

    Both callbacks run in the reader's thread and must return soon. If one raises, the error is
    logged and the reader goes on.

    Args:
        links: Place and identity of the hub of each link.
        on_frames: Called once per wake-up with a list of `LinkFrames`, in order of arrival per
            link.
        on_state: Called with the index of a link, its state and the error that is the reason, when
            one of them changes.
        clock_ns: The clock of arrivals. It is read after the bytes, so that no arrival is earlier
            than true.
        period_us: Sample period to set on every hub, in µs; None leaves the hub's own.
        on_end: Called last of all in the reader's thread, however it ends.

    Attributes:
        links: The links.
        failure: Error that ended the thread; None while it runs and after `close`.
        callback_errors: Number of times a callback raised.

    Raises:
        LinkError: `bad_port`: a port can never be opened.
    """

    def __init__(
        self,
        links: Sequence[LinkConfig],
        on_frames: OnFrames,
        on_state: OnState,
        clock_ns: Callable[[], int] = time.time_ns,
        period_us: int | None = None,
        on_end: Callable[[], None] = lambda: None,
    ) -> None:
        self.links = [Link(config) for config in links]
        self.callback_errors = 0
        self.failure: Exception | None = None
        self._sessions = [
            Session(link, period_us, clock_ns, partial(self._call, on_state, i))
            for i, link in enumerate(self.links)
        ]
        self._selector = selectors.DefaultSelector()
        self._on_frames = on_frames
        self._on_end = on_end
        self._clock_ns = clock_ns
        self._requests: deque[tuple[int, Request]] = deque()
        self._stopping = False
        self._thread: threading.Thread | None = None
        self._wake_lock = threading.Lock()
        self._wake_write = -1

    def start(self) -> None:
        """Start the thread.

        Raises:
            LinkError: `closed`: the reader was started before; it runs once.
        """
        if self._thread is not None:
            raise LinkError("a reader starts once: make a new Reader", "closed")
        wake_read, self._wake_write = os.pipe()
        os.set_blocking(wake_read, False)
        os.set_blocking(self._wake_write, False)
        self._thread = threading.Thread(
            target=self._run, args=(wake_read,), name="cube reader", daemon=True
        )
        self._thread.start()

    def send(self, link: int, request: Request) -> None:
        """Send a request; callable from any thread.

        START, STOP and SET_PERIOD are remembered and sent again after each reopening, so they may
        be given while the link is not open.

        Raises:
            LinkError: `closed`: another request was given while the link is not open.
        """
        target = self.links[link]
        remembered = request.request in (Command.START, Command.STOP, Command.SET_PERIOD)
        if not remembered and not target.is_open:
            raise LinkError(
                f"link {target.config.name!r} is {target.state.value}: wait until it opens",
                "closed",
            )
        self._requests.append((link, request))
        self._wake()

    def forget_questions(self) -> None:
        """Ignore the answers to all requests TIME sent until now; callable from `on_frames`."""
        for session in self._sessions:
            session.asked_ns = None

    def close(self) -> None:
        """Stop the hubs, close all links and end the thread within `CLOSE_S`; idempotent."""
        self._stopping = True
        self._wake()
        thread = self._thread
        if thread is not None and thread is not threading.current_thread():
            thread.join(CLOSE_S)
            if thread.is_alive():
                _log.error(
                    "the reader did not end within %.1f s: a port hangs in the kernel", CLOSE_S
                )

    def _wake(self) -> None:
        """Wake up the reader's thread."""
        # Without the lock, a late call could write to a file descriptor that was closed and reused.
        with self._wake_lock:
            if self._wake_write >= 0:
                with contextlib.suppress(BlockingIOError):
                    os.write(self._wake_write, b"\0")

    def _run(self, wake_read: int) -> None:
        """Run the thread until the end."""
        try:
            self._selector.register(wake_read, selectors.EVENT_READ, None)
            self._loop(wake_read)
        except Exception as error:  # noqa: BLE001  (a thread that ends unseen would look like silent hubs)
            self.failure = error
            _log.exception("the thread that reads the links has ended")
        finally:
            try:
                self._close_all(wake_read)
            finally:
                self._on_end()

    def _loop(self, wake_read: int) -> None:
        """Wait for data and handle them until `close` is called."""
        tick_at = 0.0
        while not self._stopping:
            now = time.monotonic()
            ready = self._selector.select(max(0.0, tick_at - now))
            awake_at = time.monotonic()
            reads = self._read_ready(ready, wake_read)
            if reads and awake_at - now > MIN_SELECT_S:
                while time.monotonic() - awake_at < self._waiting_time(reads):
                    time.sleep(WAIT_STEP_S)
                    reads += self._read_ready(self._selector.select(0), wake_read)
            received, failed = self._handle_reads(reads)
            if received:
                self._call(self._on_frames, received)
            # Links are closed only now, because delivering the frames of a link marks it as live.
            for i, error in failed.items():
                self._drop(i, error)
            if self._requests:
                self._send_requests()
            now = time.monotonic()
            if now >= tick_at:
                tick_at = now + TICK_S
                for i in range(len(self.links)):
                    self._check_timers(i, now)

    def _read_ready(
        self,
        ready: list[tuple[selectors.SelectorKey, int]],
        wake_read: int,
    ) -> list[LinkRead]:
        """Read and decode all links that are ready, and send the bytes that wait."""
        reads: list[LinkRead] = []
        readable: list[int] = []
        for key, events in ready:
            if key.data is None:
                os.read(wake_read, 4096)
                continue
            if events & selectors.EVENT_WRITE:
                try:
                    self.links[key.data].flush()
                    self._watch(key.data)
                except LinkError as error:
                    reads.append(LinkRead(key.data, 0, error))
                    continue
            if events & selectors.EVENT_READ:
                readable.append(key.data)
        if readable:
            links = [self.links[i] for i in readable]
            arrival_ns, results = read_links(links, self._clock_ns)
            for i, result in zip(readable, results, strict=True):
                if result is not None:
                    reads.append(LinkRead(i, arrival_ns, result))
        return reads

    def _handle_reads(
        self,
        reads: list[LinkRead],
    ) -> tuple[list[LinkFrames], dict[int, LinkError]]:
        """Handle all reads of a wake-up.

        They are handled together, because after each wait Python's code and data have left the
        caches of the processor.

        Returns:
            The frames to deliver, and the reason to close a link by its index.
        """
        received: list[LinkFrames] = []
        failed: dict[int, LinkError] = {}
        now = time.monotonic()
        for i, arrival_ns, result in reads:
            if i in failed:
                continue
            if isinstance(result, LinkError):
                failed[i] = result
                continue
            frames: list[Frame] = []
            session = self._sessions[i]
            session.last_byte = now
            asked_ns = session.asked_ns or 0
            try:
                for frame in result:
                    if session.take(frame):
                        frames.append(frame)
                if session.link.unsent:
                    self._watch(i)
            except LinkError as error:
                failed[i] = error
            if frames:
                received.append(LinkFrames(i, arrival_ns, frames, asked_ns))
        return received, failed

    def _waiting_time(self, reads: list[LinkRead]) -> float:
        """Return how long to wait, in s, for links that should deliver but have not yet."""
        delivered = {read.link for read in reads if isinstance(read.result, list) and read.result}
        if not delivered or len(delivered) == len(self.links):
            return 0.0
        periods_us = [
            session.actual_us
            for i, session in enumerate(self._sessions)
            if i not in delivered and session.is_delivering
        ]
        if not periods_us:
            return 0.0
        # The fastest of the other hubs would deliver its next sample first.
        period_s = 1e-6 * min(periods_us)
        return min(MAX_WAIT_PERIODS * period_s, MAX_WAIT_S)

    def _send_requests(self) -> None:
        """Send the requests of other threads."""
        while self._requests:
            i, request = self._requests.popleft()
            try:
                self._sessions[i].send(request)
                self._watch(i)
            except LinkError as error:
                self._drop(i, error)

    def _check_timers(self, i: int, now: float) -> None:
        """Check the timers of one link, and open it if it is time."""
        session = self._sessions[i]
        try:
            if session.link.is_open:
                session.check_timers(now)
            elif session.open(now):
                self._selector.register(session.link, selectors.EVENT_READ, i)
                session.begin()
            self._watch(i)
        except LinkError as error:
            self._drop(i, error)

    def _drop(self, i: int, error: LinkError) -> None:
        """Close one link because of an error; it is opened again later."""
        link = self.links[i]
        if link.is_open:
            link.lost += 1
            self._selector.unregister(link)
        self._sessions[i].close(error)

    def _watch(self, i: int) -> None:
        """Make the selector wake up for writing while bytes wait to be sent, and only then."""
        link = self.links[i]
        if not link.is_open:
            return
        events = selectors.EVENT_READ | (selectors.EVENT_WRITE if link.unsent else 0)
        if self._selector.get_key(link).events != events:
            self._selector.modify(link, events, i)

    def _call(self, callback: Callable[..., None], *arguments: object) -> None:
        """Call back; log and count an error."""
        try:
            callback(*arguments)
        except Exception:  # noqa: BLE001  (whatever a callback raises, the links go on)
            self.callback_errors += 1
            if self.callback_errors in LOGGED_ERRORS:
                _log.exception("callback failed (%d so far); reading goes on", self.callback_errors)

    def _close_all(self, wake_read: int) -> None:
        """Stop all hubs, wait until the requests have left, and close all links."""
        for link in self.links:
            if link.is_open:
                with contextlib.suppress(LinkError):
                    link.write(encode(Request(Command.STOP)))
        until = time.monotonic() + DRAIN_S
        while time.monotonic() < until:
            if not any(link.is_draining() for link in self.links):
                break
            time.sleep(0.002)
        for session in self._sessions:
            session.link.close()
            session.set_state(LinkState.CLOSED)
        self._selector.close()
        with self._wake_lock:
            os.close(wake_read)
            os.close(self._wake_write)
            self._wake_write = -1
