"""The one thread that reads all links: opens and reopens them, decodes, and calls back once per
wake-up.

Each link is brought up the same way after every opening: ask for HELLO; on HELLO send what the hub
should do (period, start or stop). A hub that restarts behind an open port falls silent, and its
next HELLO brings it up again. No link waits for another: ports are read without blocking, a TCP
connection is made without blocking, and what one link does not take stays in its own bounded
buffer.
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

from ..core.errors import LinkError
from .link import Link, LinkConfig, LinkState
from .protocol import Ack, Command, Frame, Hello, Request, Result, Sample, encode

TICK_S = 0.02
"""How often timers are looked at: silence, back-off, connections under way."""
SILENT_S = 0.2
HELLO_S = 1.0
"""A hub that does not answer is asked again at this interval."""
REOPEN_S = 5.0
"""A link without a single byte for so long is opened anew; hubs say HELLO every second."""
LOOK_S = 0.25
"""How often a waiting link looks whether its port has come back."""
GATHER = 0.2, 1e-3
"""Hubs sample together, but their bytes come one by one. Who comes first waits so long for the
others, as a share of
the sample period and in s at most: one message for all instead of several."""
GATHER_STEP_S = 2e-4
"""They are looked for at this interval, instead of a wake-up for each; arrival may look later by
that."""
NO_WAIT_S = 5e-5
"""A wait for data shorter than this was none."""
DRAIN_S = 0.05
"""How long closing waits for the last requests to leave the serial ports."""
CLOSE_S = 1.5

Taken = list[tuple[int, int, bytes | LinkError]]
"""Link index, arrival in ns, and what one read of this link gave."""
Arrivals = list[tuple[int, int, list[Frame]]]
"""Link index, arrival in ns, and the frames that one read of this link completed; one or several of
each link."""
OnFrames = Callable[[Arrivals], None]
OnState = Callable[[int, LinkState, LinkError | None], None]

_log = logging.getLogger(__name__)


class _Session:
    """What the reader remembers of one link between wake-ups; times are time.monotonic()
    seconds."""

    def __init__(self, period_us: int | None) -> None:
        self.period_us = period_us  # to ask for, None leaves the hub's own
        self.started = True  # whether samples are asked for
        self.actual_us = period_us or 0  # what the hub says
        self.greeted = False  # HELLO seen since the port was opened
        self.opened_at = self.last_byte = self.last_sample = 0.0
        self.retry_at = self.look_at = self.hello_at = 0.0
        self.fingerprint: tuple[object, ...] = ()
        self.watching_writes = False

    def silent_after(self) -> float:
        return max(3e-6 * self.actual_us, SILENT_S) - TICK_S


class Reader:
    """Reads all links in one thread.

    on_frames: called once per wake-up with `Arrivals`, in order of arrival per link. on_state:
    called with (link index, LinkState, LinkError or None) when a link's state, or why it waits,
    changes. Both run in the reader's thread and must return soon; an exception in them is logged
    and the reader goes on. clock_ns: the clock of arrival times, read after the bytes, so that
    arrival is never earlier than true. period_us: sample period to set on every hub, None leaves
    the hub's own.

    failure: what ended the thread though nobody asked it to end, None while all is well.
    """

    def __init__(
        self,
        links: Sequence[LinkConfig],
        on_frames: OnFrames,
        on_state: OnState,
        clock_ns: Callable[[], int] = time.time_ns,
        period_us: int | None = None,
    ) -> None:
        """LinkError `bad_port`: a port that can never be opened."""
        self.links = [Link(config) for config in links]
        self.callback_errors = 0
        self.failure: Exception | None = None
        self._sessions = [_Session(period_us) for _ in links]
        self._on_frames, self._on_state, self._clock_ns = on_frames, on_state, clock_ns
        self._requests: deque[tuple[int, Request]] = deque()
        self._stopping = False
        self._thread: threading.Thread | None = None
        self._wake_lock = threading.Lock()
        self._wake_write = -1

    def start(self) -> None:
        """Begin. A reader runs once; make a new one to start again. LinkError `closed`
        otherwise."""
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
        """Send a request, from any thread. Start, stop and set period are remembered and sent again
        after each reopening; so they may be given while the link is down. LinkError `closed`: any
        other request then."""
        target = self.links[link]
        remembered = request.request in (Command.START, Command.STOP, Command.SET_PERIOD)
        if not remembered and not target.is_open:
            raise LinkError(
                f"link {target.config.name!r} is {target.state.value}: wait until it opens",
                "closed",
            )
        self._requests.append((link, request))
        self._wake()

    def close(self) -> None:
        """Stop the hubs, close all links, end the thread; within CLOSE_S, also in the middle of a
        reconnect."""
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
        # The lock keeps a late send from writing to a number that the closed pipe has given back.
        with self._wake_lock:
            if self._wake_write >= 0:
                with contextlib.suppress(BlockingIOError):
                    os.write(self._wake_write, b"\0")

    def _run(self, wake_read: int) -> None:
        selector = selectors.DefaultSelector()
        try:
            selector.register(wake_read, selectors.EVENT_READ, None)
            tick_at = 0.0
            while not self._stopping:
                now = time.monotonic()
                ready = selector.select(max(0.0, tick_at - now))
                begun = time.monotonic()
                taken = self._take(selector, ready, wake_read)
                # Where data waited for us we are late already.
                waited = begun - now > NO_WAIT_S
                while taken and waited and time.monotonic() - begun < self._gathering(taken):
                    time.sleep(GATHER_STEP_S)
                    taken += self._take(selector, selector.select(0), wake_read)
                batch, failed = self._decode(selector, taken)
                if batch:
                    self._call(self._on_frames, batch)
                # Later than what came before: else it would seem to deliver still.
                for i, error in failed.items():
                    self._drop(selector, i, error)
                if self._requests:
                    self._send_requests(selector)
                now = time.monotonic()
                if now >= tick_at:
                    tick_at = now + TICK_S
                    for i in range(len(self.links)):
                        self._tick(selector, i, now)
        except Exception as error:  # noqa: BLE001  (a thread that ends unseen would look like silent hubs)
            self.failure = error
            _log.exception("the thread that reads the links has ended")
        finally:
            self._shut(selector, wake_read)

    def _take(
        self,
        selector: selectors.BaseSelector,
        ready: list[tuple[selectors.SelectorKey, int]],
        wake_read: int,
    ) -> Taken:
        """All there is of the links that are ready."""
        taken: list[tuple[int, bytes | LinkError]] = []
        for key, events in ready:
            if key.data is None:
                os.read(wake_read, 4096)
                continue
            link = self.links[key.data]
            try:
                if events & selectors.EVENT_WRITE:
                    link.flush()
                    self._watch(selector, key.data)
                if events & selectors.EVENT_READ:
                    data = link.read()
                    if data:
                        taken.append((key.data, data))
            except LinkError as error:
                taken.append((key.data, error))
        arrival_ns = self._clock_ns() if taken else 0
        return [(i, arrival_ns, data) for i, data in taken]

    def _decode(
        self, selector: selectors.BaseSelector, taken: Taken
    ) -> tuple[Arrivals, dict[int, LinkError]]:
        """Look at what was taken, all at once: after each wait Python's code and data are far from
        the processor.

        Returns the frames, and the links to close with the reason of each.
        """
        batch: Arrivals = []
        failed: dict[int, LinkError] = {}
        now = time.monotonic()
        for i, arrival_ns, data in taken:
            link = self.links[i]
            if i in failed:
                continue
            if isinstance(data, LinkError):
                failed[i] = data
                continue
            frames: list[Frame] = []
            self._sessions[i].last_byte = now
            try:
                for frame in link.decoder.feed(data):
                    if self._note(i, frame):
                        frames.append(frame)
                if link.unsent:
                    self._watch(selector, i)
            except LinkError as error:
                failed[i] = error
            if frames:
                batch.append((i, arrival_ns, frames))
        return batch, failed

    def _gathering(self, taken: Taken) -> float:
        """How long to wait for links that deliver but have not yet, s."""
        # A zero that does not begin the data ends a frame.
        came = {i for i, _, data in taken if isinstance(data, bytes) and data.find(0, 1) > 0}
        if len(came) in (0, len(self.links)):
            return 0.0
        late = [
            session.actual_us
            for i, (link, session) in enumerate(zip(self.links, self._sessions, strict=True))
            if i not in came
            and link.state is LinkState.OPEN
            and session.greeted
            and session.started
        ]
        share, most = GATHER
        return min(1e-6 * share * min(late), most) if late else 0.0

    def _note(self, i: int, frame: Frame) -> bool:
        """What a frame means for the link itself; whether to deliver it. LinkError: close the
        link."""
        link, session = self.links[i], self._sessions[i]
        if isinstance(frame, Sample):
            session.last_sample = session.last_byte
            if link.state is not LinkState.OPEN or link.error is not None:
                self._set_state(i, LinkState.OPEN, None)
            # After a replug it may be another hub: nothing is delivered under the old one's name.
            link.before_hello += not session.greeted
            return session.greeted
        if isinstance(frame, Hello):
            wanted = link.config.hub_uid
            if wanted is not None and frame.hub_uid != wanted:
                link.next_candidate()
                raise LinkError(
                    f"{link.path}: hub {frame.hub_uid:#018x} answers, "
                    f"link {link.config.name!r} wants {wanted:#018x}: swap the cables or correct the uid",
                    "wrong_hub",
                )
            link.hello = frame
            link.reset_pause()
            session.actual_us = frame.period_us
            other_period = session.period_us is not None and frame.period_us != session.period_us
            if not session.greeted or link.state is LinkState.SILENT or other_period:
                session.greeted = True
                self._configure(i)
        elif (
            isinstance(frame, Ack)
            and frame.request == Command.SET_PERIOD
            and frame.result == Result.DONE
        ):
            session.actual_us = frame.argument
        return True

    def _configure(self, i: int) -> None:
        link, session = self.links[i], self._sessions[i]
        if session.period_us is not None:
            link.write(encode(Request(Command.SET_PERIOD, session.period_us)))
        link.write(encode(Request(Command.START if session.started else Command.STOP)))
        if not session.started:
            self._set_state(i, LinkState.OPEN, None)

    def _send_requests(self, selector: selectors.BaseSelector) -> None:
        while self._requests:
            i, request = self._requests.popleft()
            link, session = self.links[i], self._sessions[i]
            if request.request == Command.SET_PERIOD:
                session.period_us = request.argument
                session.actual_us = max(session.actual_us, request.argument)
            elif request.request in (Command.START, Command.STOP):
                session.started = request.request == Command.START
                session.last_sample = time.monotonic()
            if link.is_open:
                try:
                    link.write(encode(request))
                    self._watch(selector, i)
                except LinkError as error:
                    self._drop(selector, i, error)

    def _tick(self, selector: selectors.BaseSelector, i: int, now: float) -> None:
        link, session = self.links[i], self._sessions[i]
        try:
            if not link.is_open:
                self._try_open(selector, i, now)
                return
            if (
                session.started
                and link.state is LinkState.OPEN
                and now - session.last_sample > session.silent_after()
            ):
                link.silences += 1
                session.hello_at = now
                period = (
                    f"sample period {session.actual_us} µs"
                    if session.actual_us
                    else "sample period not known yet"
                )
                self._set_state(
                    i,
                    LinkState.SILENT,
                    LinkError(
                        f"{link.path}: no sample for {now - session.last_sample:.2f} s ({period}): "
                        "check the hub's power and firmware; it is asked again every second",
                        "silent",
                    ),
                )
            if now - session.last_byte > REOPEN_S:
                link.next_candidate()
                raise LinkError(
                    f"{link.path}: not a byte for {REOPEN_S:g} s: opening it anew; check the hub's power",
                    "silent",
                )
            if link.is_pattern and not session.greeted and now - session.opened_at > REOPEN_S:
                link.next_candidate()
                raise LinkError(
                    f"{link.path}: no hub answers here: trying the next match of {link.config.port}",
                    "wrong_hub",
                )
            if (link.state is LinkState.SILENT or not session.greeted) and now >= session.hello_at:
                self._ask_hello(selector, i, now)
        except LinkError as error:
            self._drop(selector, i, error)

    def _ask_hello(self, selector: selectors.BaseSelector, i: int, now: float) -> None:
        self._sessions[i].hello_at = now + HELLO_S
        self.links[i].write(encode(Request(Command.HELLO)))
        self._watch(selector, i)

    def _try_open(self, selector: selectors.BaseSelector, i: int, now: float) -> None:
        link, session = self.links[i], self._sessions[i]
        if now >= session.look_at:
            session.look_at = now + LOOK_S
            fingerprint = link.fingerprint()
            if fingerprint != session.fingerprint:
                session.fingerprint = fingerprint
                session.retry_at = now
                link.reset_pause()
        if now < session.retry_at:
            return
        if link.state is LinkState.CLOSED:
            self._set_state(i, LinkState.WAITING, None)
        if not link.open():
            return
        now = time.monotonic()
        session.opened_at = session.last_byte = session.last_sample = now
        session.greeted = session.watching_writes = False
        selector.register(link, selectors.EVENT_READ, i)
        self._set_state(i, LinkState.OPEN, None)
        self._ask_hello(selector, i, now)

    def _drop(self, selector: selectors.BaseSelector, i: int, error: LinkError) -> None:
        """The link failed: close it and try again later."""
        link, session = self.links[i], self._sessions[i]
        if link.is_open:
            link.lost += 1
            selector.unregister(link)
        link.close()
        session.fingerprint = link.fingerprint()
        session.retry_at = time.monotonic() + link.next_pause()
        self._set_state(i, LinkState.WAITING, error)

    def _watch(self, selector: selectors.BaseSelector, i: int) -> None:
        """Wake up for writing only while bytes wait to be sent."""
        link, session = self.links[i], self._sessions[i]
        if link.unsent != session.watching_writes:
            session.watching_writes = link.unsent
            selector.modify(
                link, selectors.EVENT_READ | (selectors.EVENT_WRITE if link.unsent else 0), i
            )

    def _set_state(self, i: int, state: LinkState, error: LinkError | None) -> None:
        link = self.links[i]
        before = (link.state, link.error and link.error.kind)
        link.state, link.error = state, error
        if before != (state, error and error.kind):
            self._call(self._on_state, i, state, error)

    def _call(self, callback: Callable[..., None], *arguments: object) -> None:
        try:
            callback(*arguments)
        except Exception:  # noqa: BLE001  (whatever the caller's code raises, the links go on)
            self.callback_errors += 1
            # The first of each power of ten tells enough; at 1 kHz all of them would bury it.
            if self.callback_errors in (1, 10, 100, 1000, 10_000):
                _log.exception("callback failed (%d so far); reading goes on", self.callback_errors)

    def _shut(self, selector: selectors.BaseSelector, wake_read: int) -> None:
        for link in self.links:
            if link.is_open:
                with contextlib.suppress(LinkError):
                    link.write(encode(Request(Command.STOP)))
        until = time.monotonic() + DRAIN_S
        while any(link.draining() for link in self.links) and time.monotonic() < until:
            time.sleep(0.002)
        for i, link in enumerate(self.links):
            link.close()
            self._set_state(i, LinkState.CLOSED, None)
        selector.close()
        with self._wake_lock:
            os.close(wake_read)
            os.close(self._wake_write)
            self._wake_write = -1
