# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The thread that reads all links of a skin.

The thread opens and reopens the links, decodes their bytes, and calls back once each time it has
read data. No link waits for another: ports are read and TCP connections are made without blocking,
and each link has a bounded buffer for bytes that could not be sent yet. `session.py` decides what
is sent on a link.
"""

from __future__ import annotations

import contextlib
import logging
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import NamedTuple

from ...core.errors import LinkError
from ..track import LinkTrack
from ..wire.protocol import Command, Frame, Request, encode
from .intake import Intake, LinkRead, NativeSamples
from .link import Link, LinkConfig, LinkState
from .session import TICK_S, Session

MAX_WAIT_PERIODS = 0.2
"""Longest time, in sample periods, for which the reader waits for the other hubs after the first
one has delivered a sample. Hubs sample at the same time, but their bytes arrive one after the
other; the wait lets one callback receive them all."""
MAX_WAIT_S = 1e-3
"""Longest time, in s, for which the reader waits for the other hubs after the first one has
delivered a sample; `MAX_WAIT_PERIODS` is the limit at high sample rates."""
DRAIN_S = 0.05
"""Longest time, in s, that closing the links waits until the STOP requests (send no more samples)
have left the serial ports."""
LOGGED_ERRORS = (1, 10, 100, 1000, 10_000)
"""Numbers of the exceptions of callbacks that are logged: the 1st, 10th, 100th … At a sample rate
of 1 kHz, logging all of them would fill the log."""
CLOSE_S = 1.5
"""Longest time, in s, for which `Reader.close` waits for the end of the reader's thread. If the
thread still runs then, an error is logged."""


class LinkFrames(NamedTuple):
    """Frames of one link that were completed by reading it once, for the callback.

    Attributes:
        link: Index of the link.
        arrival_ns: Host time, in ns, at which the bytes of the frames had arrived.
        frames: The frames, in order.
        asked_ns: Host time, in ns, at which the hub was asked for its time, if the answer (a TIME
            frame) may be among the frames; 0 if no answer is expected.
        is_late: Whether these bytes had been waiting for this thread, because it was still busy
            with earlier ones.
    """

    link: int
    arrival_ns: int
    frames: list[Frame]
    asked_ns: int = 0
    is_late: bool = False


OnFrames = Callable[[list[LinkFrames], NativeSamples], None]
OnState = Callable[[int, LinkState, LinkError | None], None]

_log = logging.getLogger(__name__)


class Reader:
    """Opens, reads and reopens all links of a skin in one thread.

    The callbacks run in this thread and must return soon. If one raises an exception, the exception
    is logged and reading continues.

    Args:
        links: Port of each link, and the hub that is expected there.
        on_frames: Called each time data were read, with a list of `LinkFrames`, and with the
            samples that came before these frames and were counted and stamped in C
            (`NativeSamples`). The frames of each link are in the order of their arrival.
        on_state: Called when the state of a link or its reason changes, with the index of the link,
            the state, and the error that is the reason (None if there is none).
        clock_ns: Clock of the arrival times, in ns. It is read after the bytes, so that no arrival
            time is earlier than the true one.
        period_us: Sample period to set on every hub, in µs; with None the hubs keep their own.
        on_end: Called in this thread as its last step, also after an error.
        tracks: Sample numbers and clock values of each link; None for new ones.

    Attributes:
        links: The links, in the order of the argument.
        failure: Exception that ended the thread; None while it runs or if it ended by `close`.
        callback_errors: Number of exceptions that the callbacks have raised.
        behind_s: Time, in s, for which received bytes have been waiting without a break when this
            thread came to read them; about 0 for a host that is fast enough.

    Raises:
        LinkError: With the kind `bad_port`: a port is neither a device path nor a TCP address.
    """

    def __init__(
        self,
        links: Sequence[LinkConfig],
        on_frames: OnFrames,
        on_state: OnState,
        clock_ns: Callable[[], int] = time.time_ns,
        period_us: int | None = None,
        on_end: Callable[[], None] = lambda: None,
        tracks: Sequence[LinkTrack] | None = None,
    ) -> None:
        tracks = tracks or [LinkTrack() for _ in links]
        self.links = [Link(*pair) for pair in zip(links, tracks, strict=True)]
        self.callback_errors = 0
        self.behind_s = 0.0
        self.failure: Exception | None = None
        self._sessions = [
            Session(link, period_us, clock_ns, partial(self._call, on_state, i))
            for i, link in enumerate(self.links)
        ]
        self._on_frames = on_frames
        self._on_end = on_end
        self._clock_ns = clock_ns
        # Sample periods that other threads have requested: index of the link, period in µs.
        self._periods: deque[tuple[int, int]] = deque()
        self._stopping = False
        self._lag_s = 0.0
        # Number of links that deliver samples, and the longest wait for the frames of all of them
        # after the first frame, in s.
        self._expected = 0
        self._gather_s = 0.0
        self._thread: threading.Thread | None = None
        self._wake_lock = threading.Lock()
        self._wake_write = -1

    def start(self) -> None:
        """Start the thread. A reader can be started only once."""
        wake_read = -1
        if Link.HAS_DESCRIPTORS:
            wake_read, self._wake_write = os.pipe()
            os.set_blocking(wake_read, False)
            os.set_blocking(self._wake_write, False)
        self._thread = threading.Thread(
            target=self._run,
            args=(wake_read,),
            name="cube reader",
            daemon=True,
        )
        self._thread.start()

    def set_period(self, link: int, period_us: int) -> None:
        """Let the reader's thread set another sample period on a hub. Any thread may call this.

        The period is set again each time the link is opened.

        Args:
            link: Index of the link.
            period_us: Sample period, in µs.
        """
        self._periods.append((link, period_us))
        self._wake()

    def take_lag_s(self) -> float:
        """Return the largest delay of this thread in reading received bytes since the last call.

        Returns:
            Largest value of `behind_s`, in s.
        """
        lag_s = self._lag_s
        self._lag_s = 0.0
        return lag_s

    def forget_questions(self) -> None:
        """Ignore the answers to all TIME requests (for the hub's time) that were sent until now.

        It is called in the reader's thread, from `on_frames`, after the host's clock was set.
        """
        for session in self._sessions:
            session.asked_ns = None

    def close(self) -> None:
        """Send STOP to the hubs, close all links, and wait up to `CLOSE_S` for the thread to end.

        A second call does nothing. If the thread does not end in time, an error is logged.
        """
        self._stopping = True
        self._wake()
        thread = self._thread
        if thread is not None and thread is not threading.current_thread():
            thread.join(CLOSE_S)
            if thread.is_alive():
                _log.error(
                    "the reader did not end within %.1f s: a port hangs in the kernel",
                    CLOSE_S,
                )

    def _wake(self) -> None:
        """Wake up the reader's thread if it waits for data."""
        # The lock prevents that the reader's thread closes the pipe meanwhile, and the byte is
        # written to another file with the same file descriptor.
        with self._wake_lock:
            if self._wake_write >= 0:
                with contextlib.suppress(BlockingIOError):
                    os.write(self._wake_write, b"\0")

    def _run(self, wake_read: int) -> None:
        """Read the links until `close` is called or an error is raised, then close them.

        Args:
            wake_read: File descriptor of the pipe by which other threads wake up this one.
        """
        try:
            self._intake = Intake(self.links, wake_read, self._clock_ns)
            self._run_loop()
        except Exception as error:  # noqa: BLE001  (a thread that ends unseen would look like silent hubs)
            self.failure = error
            _log.exception("the thread that reads the links has ended")
        finally:
            try:
                self._close_all(wake_read)
            finally:
                self._on_end()

    def _run_loop(self) -> None:
        """Wait for data of the links and handle them, until `close` is called."""
        tick_at = 0.0
        in_time_at = time.monotonic()
        while not self._stopping:
            now = time.monotonic()
            is_late, native, reads = self._intake.read(
                max(0.0, tick_at - now),
                self._gather_s,
                self._expected,
            )
            awake_at = time.monotonic()
            if is_late:
                self.behind_s = awake_at - in_time_at
            else:
                # A wait for longer than its limit TICK_S shows that the machine did not let this
                # thread run, so received bytes may have waited.
                self.behind_s = max(0.0, awake_at - now - TICK_S)
                in_time_at = awake_at
            self._lag_s = max(self._lag_s, self.behind_s)
            received, failed = self._handle_reads(reads, is_late)
            if received or native.links:
                self._call(self._on_frames, received, native)
            # Failed links are closed after the callback. In the other order, the callback would
            # mark a closed link as delivering, because it still receives frames of this link.
            for i, error in failed.items():
                self._drop(i, error)
            while self._periods:
                i, period_us = self._periods.popleft()
                with self._close_on_error(i) as session:
                    session.set_period(period_us)
            now = time.monotonic()
            if now >= tick_at:
                tick_at = now + TICK_S
                for i, link in enumerate(self.links):
                    with self._close_on_error(i) as session:
                        if link.is_open:
                            session.check_timers(now)
                        elif session.open(now):
                            self._intake.update()
                self._plan_gathering()

    def _handle_reads(
        self,
        reads: list[LinkRead],
        is_late: bool,
    ) -> tuple[list[LinkFrames], dict[int, LinkError]]:
        """Pass the frames of several reads to the sessions of their links.

        All reads since the last callback are handled together. One by one they would take longer,
        because after each wait Python's code and data have left the caches of the processor.

        Args:
            reads: Results of reading since the last callback.
            is_late: Whether the bytes of these reads had been waiting to be read.

        Returns:
            The frames to deliver; and, by index, the links that must be closed with their errors.
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
            except LinkError as error:
                failed[i] = error
            if frames:
                received.append(LinkFrames(i, arrival_ns, frames, asked_ns, is_late))
        return received, failed

    def _plan_gathering(self) -> None:
        """Determine how many links deliver samples, and the longest wait for all of their frames.

        The wait, which begins with the first frame, is limited by the shortest sample period,
        because no hub must deliver its next sample during the wait.
        """
        periods_us = [session.actual_us for session in self._sessions if session.is_delivering]
        self._expected = len(periods_us)
        period_s = 1e-6 * min(periods_us, default=0)
        self._gather_s = min(MAX_WAIT_PERIODS * period_s, MAX_WAIT_S)

    @contextlib.contextmanager
    def _close_on_error(self, i: int) -> Iterator[Session]:
        """Yield the session of a link; close the link if the `with` block raises a LinkError."""
        try:
            yield self._sessions[i]
        except LinkError as error:
            self._drop(i, error)

    def _drop(self, i: int, error: LinkError) -> None:
        """Close the link with index `i` because of an error; it is opened again after a pause."""
        link = self.links[i]
        if link.is_open:
            link.lost += 1
        self._sessions[i].close(error)
        self._intake.update()

    def _call(self, callback: Callable[..., None], *arguments: object) -> None:
        """Call a callback with these arguments; if it raises an exception, log and count it."""
        try:
            callback(*arguments)
        except Exception:  # noqa: BLE001  (whatever a callback raises, the links go on)
            self.callback_errors += 1
            if self.callback_errors in LOGGED_ERRORS:
                _log.exception("callback failed (%d so far); reading goes on", self.callback_errors)

    def _close_all(self, wake_read: int) -> None:
        """Send STOP to all hubs, wait up to `DRAIN_S` until it has left, and close all links.

        Args:
            wake_read: File descriptor of the pipe by which other threads wake up this one.
        """
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
        with self._wake_lock:
            if self._wake_write >= 0:
                os.close(wake_read)
                os.close(self._wake_write)
                self._wake_write = -1
