"""One thread that reads all links: it opens and reopens them, decodes, and calls back once per
wake-up.

After every opening a link is brought up in the same way: the reader asks for HELLO, and on HELLO
sends what the hub should do (period, start or stop). A hub that restarts behind an open port falls
silent, and its next HELLO brings it up again. No link waits for another: ports are read and TCP
connections are made without blocking, and bytes that a link does not take stay in a bounded buffer
of its own.
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
from typing import NamedTuple

from ..core.errors import LinkError
from .intake import take_in
from .link import Link, LinkConfig, LinkState
from .protocol import Ack, Command, Frame, Hello, Request, Result, Sample, Time, encode

TICK_S = 0.02
"""Interval of the timers: silence, back-off, connections under way."""
SILENT_S = 0.2
"""A link is silent after so long without a sample, or after three sample periods if they are
longer."""
HELLO_S = 1.0
"""Interval at which a hub that does not answer is asked again."""
ASK_TIME_S = 0.983
"""Interval at which a hub is asked for its time. It is no whole number of usual sample periods, so
that the questions come at all times between two samples."""
REOPEN_S = 5.0
"""A link without a single byte for so long is opened again. Hubs say HELLO every second."""
LOOK_S = 0.25
"""Interval at which the reader looks whether the port of a waiting link has come back."""
GATHER_PERIODS = 0.2
GATHER_S = 1e-3
"""Hubs sample together, but their bytes come one after the other. The reader waits for the other
hubs for this part of the sample period, and at most for this time. So all come in one callback."""
GATHER_STEP_S = 2e-4
"""While it waits it looks at this interval, instead of waking up for each hub. Arrival times may be
later than true by that."""
NO_WAIT_S = 5e-5
"""If waiting for data took less than this, data was there already."""
DRAIN_S = 0.05
"""How long closing waits for the last requests to leave the serial ports."""
ROUNDING = 0.01
"""A hub may round the sample period by so much of it without a note."""
CLOSE_S = 1.5
"""How long closing waits for the thread to end."""


class LinkRead(NamedTuple):
    """What one read of a link gave: index of the link, time of arrival in ns, frames or error."""

    link: int
    arrival_ns: int
    result: list[Frame] | LinkError


class LinkFrames(NamedTuple):
    """Frames that one read of a link completed: index of the link, time of arrival in ns.

    asked_ns: when the question was sent that a TIME among the frames answers
    """

    link: int
    arrival_ns: int
    frames: list[Frame]
    asked_ns: int = 0


OnFrames = Callable[[list[LinkFrames]], None]
OnState = Callable[[int, LinkState, LinkError | None], None]

_log = logging.getLogger(__name__)


class _Session:
    """What the reader remembers of one link between wake-ups. Times are time.monotonic() s."""

    def __init__(self, period_us: int | None) -> None:
        self.period_us = period_us  # asked for; None leaves the hub's own
        self.started = True  # samples are asked for
        self.actual_us = period_us or 0  # in force, as the hub says
        self.answered_us: int | None = None  # what the hub made of the period that was asked for
        self.greeted = False  # HELLO has come since the port was opened
        self.opened_at = 0.0
        self.last_byte = 0.0
        self.last_sample = 0.0
        self.retry_at = 0.0
        self.look_at = 0.0
        self.hello_at = 0.0
        self.ask_time_at = 0.0
        self.knows_time = True  # the hub has not refused to say its time
        self.question = 0  # number of the last question for the time
        self.asked_ns: int | None = None  # when it was sent; None: it is answered
        self.fingerprint: tuple[object, ...] = ()
        self.watching_writes = False

    def has_question(self, now: float) -> bool:
        """Whether to ask for the hub's time: not before the first sample, with which its answer is
        compared."""
        has_sample = self.last_sample > self.opened_at
        return self.knows_time and has_sample and now >= self.ask_time_at

    def silent_after(self) -> float:
        return max(3e-6 * self.actual_us, SILENT_S) - TICK_S


class Reader:
    """Reads all links in one thread.

    on_frames: called once per wake-up with a list of `LinkFrames`, in order of arrival per link.
    on_state: called with (link index, LinkState, LinkError or None) when the state of a link, or
    the reason why it waits, changes.
    Both run in the reader's thread and must return soon. If they raise, the error is logged and the
    reader goes on.
    clock_ns: the clock of arrival times. It is read after the bytes, so that no arrival is earlier
    than true.
    period_us: sample period to set on every hub; None leaves the hub's own.
    on_end: called last of all in the reader's thread, however it ends.

    failure: the error that ended the thread; None while it runs and after `close`.
    callback_errors: how often a callback raised.
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
        """LinkError `bad_port`: a port that can never be opened."""
        self.links = [Link(config) for config in links]
        self.callback_errors = 0
        self.failure: Exception | None = None
        self._sessions = [_Session(period_us) for _ in links]
        self._on_frames = on_frames
        self._on_state = on_state
        self._on_end = on_end
        self._clock_ns = clock_ns
        self._requests: deque[tuple[int, Request]] = deque()
        self._stopping = False
        self._thread: threading.Thread | None = None
        self._wake_lock = threading.Lock()
        self._wake_write = -1

    def start(self) -> None:
        """Begin. LinkError `closed`: it was started before; a reader runs once."""
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
        """Send a request, from any thread.

        Start, stop and set period are remembered and sent again after each reopening, so they may
        be given while the link is down. LinkError `closed`: any other request while it is down.
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
        """Deliver no answer to what was asked until now; to be called by `on_frames`."""
        for session in self._sessions:
            session.asked_ns = None

    def close(self) -> None:
        """Stop the hubs, close all links and end the thread, within CLOSE_S. Safe to call twice."""
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
            self._loop(selector, wake_read)
        except Exception as error:  # noqa: BLE001  (a thread that ends unseen would look like silent hubs)
            self.failure = error
            _log.exception("the thread that reads the links has ended")
        finally:
            try:
                self._close_all(selector, wake_read)
            finally:
                self._on_end()

    def _loop(self, selector: selectors.BaseSelector, wake_read: int) -> None:
        tick_at = 0.0
        while not self._stopping:
            now = time.monotonic()
            ready = selector.select(max(0.0, tick_at - now))
            awake_at = time.monotonic()
            reads = self._read_ready(selector, ready, wake_read)
            # If data was there already, this thread is late and does not wait for more.
            if reads and awake_at - now > NO_WAIT_S:
                while time.monotonic() - awake_at < self._gather_time(reads):
                    time.sleep(GATHER_STEP_S)
                    reads += self._read_ready(selector, selector.select(0), wake_read)
            received, failed = self._handle_reads(selector, reads)
            if received:
                self._call(self._on_frames, received)
            # Only after its frames were delivered: they would make the link look alive again.
            for i, error in failed.items():
                self._drop(selector, i, error)
            if self._requests:
                self._send_requests(selector)
            now = time.monotonic()
            if now >= tick_at:
                tick_at = now + TICK_S
                for i in range(len(self.links)):
                    self._tick(selector, i, now)

    def _read_ready(
        self,
        selector: selectors.BaseSelector,
        ready: list[tuple[selectors.SelectorKey, int]],
        wake_read: int,
    ) -> list[LinkRead]:
        """Read and decode all links that are ready, and send what waits to be sent."""
        reads: list[LinkRead] = []
        readable: list[int] = []
        for key, events in ready:
            if key.data is None:
                os.read(wake_read, 4096)
                continue
            if events & selectors.EVENT_WRITE:
                try:
                    self.links[key.data].flush()
                    self._watch(selector, key.data)
                except LinkError as error:
                    reads.append(LinkRead(key.data, 0, error))
                    continue
            if events & selectors.EVENT_READ:
                readable.append(key.data)
        if readable:
            links = [self.links[i] for i in readable]
            arrival_ns, results = take_in(links, self._clock_ns)
            for i, result in zip(readable, results, strict=True):
                if result is not None:
                    reads.append(LinkRead(i, arrival_ns, result))
        return reads

    def _handle_reads(
        self, selector: selectors.BaseSelector, reads: list[LinkRead]
    ) -> tuple[list[LinkFrames], dict[int, LinkError]]:
        """The frames to deliver, and the links to close, each with the reason.

        All reads of a wake-up are handled in one go, because after each wait Python's code and data
        have left the processor's caches.
        """
        received: list[LinkFrames] = []
        failed: dict[int, LinkError] = {}
        now = time.monotonic()
        for i, arrival_ns, result in reads:
            link = self.links[i]
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
                    if self._handle(i, frame):
                        frames.append(frame)
                if link.unsent:
                    self._watch(selector, i)
            except LinkError as error:
                failed[i] = error
            if frames:
                received.append(LinkFrames(i, arrival_ns, frames, asked_ns))
        return received, failed

    def _gather_time(self, reads: list[LinkRead]) -> float:
        """How long to wait for links that deliver but have not come yet, s."""
        came = {i for i, _, result in reads if isinstance(result, list) and result}
        if len(came) in (0, len(self.links)):
            return 0.0
        periods_us = [
            session.actual_us
            for i, (link, session) in enumerate(zip(self.links, self._sessions, strict=True))
            if i not in came
            and link.state is LinkState.OPEN
            and session.greeted
            and session.started
        ]
        if not periods_us:
            return 0.0
        return min(GATHER_PERIODS * 1e-6 * min(periods_us), GATHER_S)

    def _handle(self, i: int, frame: Frame) -> bool:
        """Act on what a frame says about the link itself. Returns whether to deliver the frame.

        LinkError: the link must be closed.
        """
        link, session = self.links[i], self._sessions[i]
        if isinstance(frame, Sample):
            session.last_sample = session.last_byte
            if link.state is not LinkState.OPEN or link.error is not None:
                self._set_state(i, LinkState.OPEN, None)
            # After a replug it may be another hub, whose samples must not pass for the old one's.
            link.before_hello += not session.greeted
            return session.greeted
        if isinstance(frame, Hello):
            wanted = link.config.hub_uid
            if wanted is not None and frame.hub_uid != wanted:
                link.next_candidate()
                raise LinkError(
                    f"{link.path}: hub {frame.hub_uid:#018x} answers, link {link.config.name!r} "
                    f"wants {wanted:#018x}: swap the cables or correct the uid",
                    "wrong_hub",
                )
            link.hello = frame
            link.reset_pause()
            session.actual_us = frame.period_us
            # A hub may round the period, or refuse it. It has answered then: it is not asked again.
            known = (session.period_us, session.answered_us)
            other_period = session.period_us is not None and frame.period_us not in known
            if not session.greeted or link.state is LinkState.SILENT or other_period:
                session.greeted = True
                self._configure(i)
        elif isinstance(frame, Ack) and frame.request == Command.SET_PERIOD:
            session.actual_us = session.answered_us = frame.argument
            link.period_problem = _period_problem(session.period_us, frame)
        elif isinstance(frame, Ack) and frame.request == Command.TIME:
            session.knows_time = False
        elif isinstance(frame, Time):
            is_answer = session.asked_ns is not None and frame.number == session.question
            if is_answer:
                session.asked_ns = None
            return is_answer
        return True

    def _configure(self, i: int) -> None:
        link, session = self.links[i], self._sessions[i]
        session.knows_time = True
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
                session.answered_us = None
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
        """Look at the timers of one link."""
        link, session = self.links[i], self._sessions[i]
        try:
            if not link.is_open:
                self._try_open(selector, i, now)
                return
            self._check_silence(i, now)
            if now - session.last_byte > REOPEN_S:
                link.next_candidate()
                raise LinkError(
                    f"{link.path}: not a byte for {REOPEN_S:g} s: opening it again; "
                    "check the hub's power",
                    "silent",
                )
            if link.is_pattern and not session.greeted and now - session.opened_at > REOPEN_S:
                link.next_candidate()
                raise LinkError(
                    f"{link.path}: no hub answers here: trying the next match of "
                    f"{link.config.port}",
                    "wrong_hub",
                )
            if link.state is LinkState.SILENT or not session.greeted:
                if now >= session.hello_at:
                    self._ask_hello(selector, i, now)
            elif session.has_question(now):
                self._ask_time(selector, i, now)
        except LinkError as error:
            self._drop(selector, i, error)

    def _check_silence(self, i: int, now: float) -> None:
        link, session = self.links[i], self._sessions[i]
        silence = now - session.last_sample
        if (
            not session.started
            or link.state is not LinkState.OPEN
            or silence <= session.silent_after()
        ):
            return
        link.silences += 1
        session.hello_at = now
        period = "sample period not known yet"
        if session.actual_us:
            period = f"sample period {session.actual_us} µs"
        error = LinkError(
            f"{link.path}: no sample for {silence:.2f} s ({period}): "
            "check the hub's power and firmware; it is asked again every second",
            "silent",
        )
        self._set_state(i, LinkState.SILENT, error)

    def _ask_hello(self, selector: selectors.BaseSelector, i: int, now: float) -> None:
        self._sessions[i].hello_at = now + HELLO_S
        self.links[i].write(encode(Request(Command.HELLO)))
        self._watch(selector, i)

    def _ask_time(self, selector: selectors.BaseSelector, i: int, now: float) -> None:
        link, session = self.links[i], self._sessions[i]
        session.ask_time_at = now + ASK_TIME_S
        session.question = (session.question + 1) % (1 << 32)
        request = encode(Request(Command.TIME, session.question))
        session.asked_ns = self._clock_ns()  # no later than true
        link.write(request)
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
        session.answered_us = session.asked_ns = None
        link.period_problem = ""
        selector.register(link, selectors.EVENT_READ, i)
        self._set_state(i, LinkState.OPEN, None)
        self._ask_hello(selector, i, now)

    def _drop(self, selector: selectors.BaseSelector, i: int, error: LinkError) -> None:
        """Close a link that failed, and try again later."""
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
            events = selectors.EVENT_READ
            if link.unsent:
                events |= selectors.EVENT_WRITE
            selector.modify(link, events, i)

    def _set_state(self, i: int, state: LinkState, error: LinkError | None) -> None:
        link = self.links[i]
        before = link.state, link.error and link.error.kind
        after = state, error and error.kind
        link.state = state
        link.error = error
        if after != before:
            self._call(self._on_state, i, state, error)

    def _call(self, callback: Callable[..., None], *arguments: object) -> None:
        try:
            callback(*arguments)
        except Exception:  # noqa: BLE001  (whatever a callback raises, the links go on)
            self.callback_errors += 1
            # Not all of them: at 1 kHz they would fill the log.
            if self.callback_errors in (1, 10, 100, 1000, 10_000):
                _log.exception("callback failed (%d so far); reading goes on", self.callback_errors)

    def _close_all(self, selector: selectors.BaseSelector, wake_read: int) -> None:
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


def _period_problem(asked_us: int | None, answer: Ack) -> str:
    """What is wrong with the hub's answer to request 4, with the fix; empty if nothing is."""
    if asked_us is None:
        return ""
    in_force = f"the hub samples every {answer.argument} µs, asked for were {asked_us} µs"
    if answer.result == Result.REFUSED:
        return f"{in_force}, which it refused: set a rate that it can do"
    if answer.result != Result.DONE:
        return f"{in_force}, and it cannot change that: leave the rate to it"
    if abs(answer.argument - asked_us) > ROUNDING * asked_us:
        return f"{in_force}: set a rate that it can do"
    return ""
