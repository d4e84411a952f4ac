# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Requests to one hub and handling of its answers, each time its port is opened.

After each opening, the hub is asked for HELLO; when HELLO has come, the hub is sent its settings
(sample period, START). A hub that restarts while its port stays open sends no samples until
its next HELLO, on which it is started again. A hub that delivers samples is asked for its time
about once a second.

A session does not wait and has no thread: the reader passes it the frames and the time. Times are
those of time.monotonic() in s, unless their names end in _ns.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from ...core.errors import LinkError
from ...core.rows import COUNTER_RANGE
from ..wire.protocol import Ack, Command, Frame, Hello, Request, Result, Sample, Time, encode
from .link import Link, LinkState

SILENT_S = 0.2
"""Time without a sample, in s, after which the state of an open link becomes SILENT. The limit is
three sample periods if they are longer."""
TICK_S = 0.02
"""Period, in s, at which the reader checks the timers of all links: for silence, for the next
attempt to open the port, for the next request to the hub, and for bytes that wait to be sent."""
HELLO_S = 1.0
"""Period, in s, at which the request HELLO is repeated while a hub is silent or has not sent HELLO
since its port was opened."""
ASK_TIME_S = 0.983
"""Period, in s, at which a hub is asked for its time. It is not a multiple of usual sample periods,
so that the requests fall on all phases of the sample period in turn."""
REOPEN_S = 5.0
"""Time without a received byte, in s, after which a link is closed and opened again. A working hub
sends HELLO every second, so after this time the open port leads to no working hub."""
CHECK_PORT_S = 0.25
"""Period, in s, at which a link whose port is not open checks whether the device file of the port
has appeared or changed."""
PERIOD_TOLERANCE = 0.01
"""Largest relative difference between the sample period that a hub reports and the requested one
that is accepted as rounding in the hub. A larger difference is reported as a problem."""

OnState = Callable[[LinkState, LinkError | None], None]


class Session:
    """Starts the hub of one link each time the link is opened, and sets the state of the link.

    Args:
        link: The link.
        period_us: Sample period to set on the hub, in µs; with None the hub keeps its own.
        clock_ns: Clock of the arrival times, in ns.
        on_state: Called with the state of the link and its reason when one of them changes.

    Attributes:
        link: The link.
        actual_us: Sample period of the hub, in µs, as it reports it. Before its first report, the
            requested period, or 0 if there is none.
        last_byte: Monotonic time, in s, at which bytes were received last.
        asked_ns: Time of `clock_ns` at which the hub was last asked for its time; None if no answer
            is expected.
    """

    def __init__(
        self,
        link: Link,
        period_us: int | None,
        clock_ns: Callable[[], int],
        on_state: OnState,
    ) -> None:
        self.link = link
        self.actual_us = period_us or 0
        self.last_byte = 0.0
        self.asked_ns: int | None = None
        self._clock_ns = clock_ns
        self._on_state = on_state
        self._period_us = period_us
        # Sample period, in µs, in the hub's answer to the last SET_PERIOD; None before the answer.
        self._answered_us: int | None = None
        self._has_hello = False  # whether HELLO has come since the port was opened
        self._opened_at = self._last_sample = 0.0
        self._retry_at = self._check_port_at = self._hello_at = self._ask_time_at = 0.0
        # Whether the hub supports the request TIME. A hub without it answers the request by an ACK.
        self._knows_time = True
        # Numbers of received bytes, and of samples that the module in C has handled, at the last
        # check of the timers.
        self._n_bytes = self._n_native = 0
        self._question = 0  # number of the last request TIME
        self._ports: tuple[object, ...] = ()

    @property
    def is_delivering(self) -> bool:
        """Whether samples are expected: the link is open, and HELLO has come."""
        return self.link.state is LinkState.OPEN and self._has_hello

    def open(self, now: float) -> bool:
        """Open the link if the pause after the last attempt is over or its device file changed.

        Then the state becomes OPEN, and the hub is asked for HELLO.

        Args:
            now: Monotonic time, in s.

        Returns:
            Whether the link is open.

        Raises:
            LinkError: The attempt to open the link failed, or sending.
        """
        link = self.link
        if now >= self._check_port_at:
            self._check_port_at = now + CHECK_PORT_S
            ports = link.identify_ports()
            if ports != self._ports:
                self._ports = ports
                self._retry_at = now
                link.reset_pause()
        if now < self._retry_at:
            return False
        if link.state is LinkState.CLOSED:
            self.set_state(LinkState.WAITING)
        if not link.open():
            return False
        self._opened_at = self.last_byte = self._last_sample = time.monotonic()
        self._has_hello = False
        self._answered_us = self.asked_ns = None
        link.period_problem = ""
        self.set_state(LinkState.OPEN)
        self._ask_hello(now)
        return True

    def close(self, error: LinkError) -> None:
        """Close the link because of an error, and set the state WAITING.

        Later calls of `open` try again after a pause, or as soon as the device file of the port
        changes.
        """
        link = self.link
        link.close()
        self._ports = link.identify_ports()
        self._retry_at = time.monotonic() + link.increase_pause()
        self.set_state(LinkState.WAITING, error)

    def set_period(self, period_us: int) -> None:
        """Set another sample period on the hub, now if the link is open, and at each HELLO.

        Args:
            period_us: Sample period, in µs.

        Raises:
            LinkError: Sending failed, so the link must be closed.
        """
        self._period_us = period_us
        self._answered_us = None
        self.actual_us = max(self.actual_us, period_us)
        if self.link.is_open:
            self._send(Command.SET_PERIOD, period_us)

    def take(self, frame: Frame) -> bool:
        """Update the state of the link from one received frame.

        Args:
            frame: The frame.

        Returns:
            Whether to deliver the frame. Samples that come before HELLO, and TIME frames
            that answer no pending request, are not delivered.

        Raises:
            LinkError: HELLO shows another hub than the skin file asks for, or sending its settings
                failed. The link must be closed.
        """
        link = self.link
        if isinstance(frame, Sample):
            self._last_sample = self.last_byte
            if link.state is not LinkState.OPEN or link.error is not None:
                self.set_state(LinkState.OPEN)
            # If cables were swapped, the port leads to another hub, whose samples must not be
            # assigned to the cubes of the previous hub before its HELLO has come.
            link.before_hello += not self._has_hello
            return self._has_hello
        if isinstance(frame, Hello):
            self._handle_hello(frame)
        elif isinstance(frame, Ack) and frame.request == Command.SET_PERIOD:
            # If the hub does not support SET_PERIOD, only HELLO states its sample period.
            actual_us = frame.argument
            if frame.result == Result.UNKNOWN and link.hello is not None:
                actual_us = link.hello.period_us
            self.actual_us = self._answered_us = actual_us
            link.period_problem = _find_period_problem(
                self._period_us,
                actual_us,
                frame.result,
            )
        elif isinstance(frame, Ack) and frame.request == Command.TIME:
            self._knows_time = False
        elif isinstance(frame, Time):
            is_answer = self.asked_ns is not None and frame.number == self._question
            if is_answer:
                self.asked_ns = None
            return is_answer
        return True

    def check_timers(self, now: float) -> None:
        """Check the open link for silence, and send the next request to the hub if it is due.

        Args:
            now: Monotonic time, in s.

        Raises:
            LinkError: No byte has come for `REOPEN_S`; the port was found by a pattern such as
                /dev/ttyACM*, and no hub has identified itself there (HELLO) within `REOPEN_S`; or
                sending failed. The link must be closed.
        """
        link = self.link
        if link.unsent:
            link.flush()
        self._note_progress(now)
        self._check_silence(now)
        if now - self.last_byte > REOPEN_S:
            link.skip_match()
            raise LinkError(
                f"{link.path}: not a byte for {REOPEN_S:g} s: opening it again; "
                "check the hub's power",
                "silent",
            )
        if link.is_pattern and not self._has_hello and now - self._opened_at > REOPEN_S:
            link.skip_match()
            raise LinkError(
                f"{link.path}: no hub answers here: trying the next match of {link.config.port}",
                "wrong_hub",
            )
        if link.state is LinkState.SILENT or not self._has_hello:
            if now >= self._hello_at:
                self._ask_hello(now)
            return
        # The request TIME (for the hub's time) follows the first sample, because the answer is
        # compared with the device times (hub's clock) of samples.
        has_samples = self._last_sample > self._opened_at
        if self._knows_time and has_samples and now >= self._ask_time_at:
            self._ask_time(now)

    def set_state(self, state: LinkState, error: LinkError | None = None) -> None:
        """Set the state of the link and its reason; call `on_state` if one of them has changed.

        Args:
            state: The new state.
            error: Reason of the state; None if there is none. Two errors of the same kind count as
                the same reason.
        """
        link = self.link
        before = link.state, link.error and link.error.kind
        link.state = state
        link.error = error
        if (state, error and error.kind) != before:
            self._on_state(state, error)

    def _note_progress(self, now: float) -> None:
        """Store the time at which bytes or samples came last, if there are new ones.

        Samples that the module in C has handled do not come as frames, but increase a counter.

        Args:
            now: Monotonic time, in s.
        """
        n_bytes = self.link.decoder.counters.bytes
        n_native = self.link.track.n_native
        if n_bytes != self._n_bytes:
            self._n_bytes = n_bytes
            self.last_byte = now
        if n_native != self._n_native:
            self._n_native = n_native
            self._last_sample = now

    def _handle_hello(self, frame: Hello) -> None:
        """Check the unique number and the sample period of a hub, and send its settings if needed.

        Args:
            frame: HELLO frame of the hub.

        Raises:
            LinkError: The hub is not the one that the skin file asks for, or sending failed.
        """
        link = self.link
        wanted = link.config.hub_uid
        if wanted is not None and frame.hub_uid != wanted:
            link.skip_match()
            raise LinkError(
                f"{link.path}: hub {frame.hub_uid:#018x} answers, link {link.config.name!r} "
                f"wants {wanted:#018x}: swap the cables or correct the uid",
                "wrong_hub",
            )
        link.hello = frame
        link.reset_pause()
        self.actual_us = frame.period_us
        # A hub may round or refuse the requested period. The period in its answer is accepted, so
        # that the request is not repeated at every HELLO.
        expected = (self._period_us, self._answered_us)
        has_other_period = self._period_us is not None and frame.period_us not in expected
        if not self._has_hello or link.state is LinkState.SILENT or has_other_period:
            self._has_hello = self._knows_time = True
            if self._period_us is not None:
                self._send(Command.SET_PERIOD, self._period_us)
            self._send(Command.START)

    def _check_silence(self, now: float) -> None:
        """Set the state SILENT if no sample has come for the time limit.

        The limit is `SILENT_S` or three sample periods, whichever is longer. The period of this
        check (`TICK_S`) is subtracted from it, so that the state is never set later.

        Args:
            now: Monotonic time, in s.
        """
        link = self.link
        silence = now - self._last_sample
        limit = max(3e-6 * self.actual_us, SILENT_S) - TICK_S
        if link.state is not LinkState.OPEN or silence <= limit:
            return
        link.silences += 1
        self._hello_at = now
        period = "sample period not known yet"
        if self.actual_us:
            period = f"sample period {self.actual_us} µs"
        error = LinkError(
            f"{link.path}: no sample for {silence:.2f} s ({period}): "
            "check the hub's power and firmware; it is asked again every second",
            "silent",
        )
        self.set_state(LinkState.SILENT, error)

    def _ask_hello(self, now: float) -> None:
        """Send the request HELLO (identify yourself), and schedule the next one.

        Args:
            now: Monotonic time, in s.
        """
        self._hello_at = now + HELLO_S
        self._send(Command.HELLO)

    def _ask_time(self, now: float) -> None:
        """Send the request TIME (report your clock), and schedule the next one.

        Args:
            now: Monotonic time, in s.
        """
        self._ask_time_at = now + ASK_TIME_S
        self._question = (self._question + 1) % COUNTER_RANGE
        # The clock is read before the request is written, so that the time of asking is not later
        # than the true one.
        self.asked_ns = self._clock_ns()
        self._send(Command.TIME, self._question)

    def _send(self, command: Command, argument: int = 0) -> None:
        """Send a request to the hub; raise LinkError if that fails."""
        self.link.write(encode(Request(command, argument)))


def _find_period_problem(asked_us: int | None, actual_us: int, result: int) -> str:
    """Return a text with the fix if the hub's sample period is not the requested one; else empty.

    Args:
        asked_us: Requested sample period, in µs; None if none was requested.
        actual_us: Sample period in force, in µs.
        result: Result of the request SET_PERIOD, as the hub's ACK states it.
    """
    if asked_us is None or abs(actual_us - asked_us) <= PERIOD_TOLERANCE * asked_us:
        return ""
    in_force = f"the hub samples every {actual_us} µs, asked for were {asked_us} µs"
    if result == Result.REFUSED:
        return f"{in_force}, which it refused: set a rate that it can do"
    if result != Result.DONE:
        return f"{in_force}, and it cannot change that: leave the rate to it"
    return f"{in_force}: set a rate that it can do"
