"""The conversation with one hub, which continues when its port is reopened.

After each opening, the hub is asked for HELLO; on HELLO it receives its settings (sample period,
start or stop). A hub that restarts behind an open port becomes silent, and its next HELLO starts it
again. A hub that delivers samples is asked for its time about once a second.

Nothing here waits or starts a thread: the reader passes on the frames and the time. Times are those
of time.monotonic() in s, unless they end in _ns.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from ...core.errors import LinkError
from ..wire.protocol import Ack, Command, Frame, Hello, Request, Result, Sample, Time, encode
from .link import Link, LinkState

SILENT_S = 0.2
"""Time without a sample, in s, after which a link is silent. Three sample periods count if they are
longer."""
TICK_S = 0.02
"""Period at which the reader checks the timers of all links (silence, retries, questions), in s."""
HELLO_S = 1.0
"""Period at which a hub that does not answer is asked for HELLO again, in s."""
ASK_TIME_S = 0.983
"""Period at which a hub is asked for its time, in s. It is not a multiple of usual sample periods,
so that the questions are spread over all times between two samples."""
REOPEN_S = 5.0
"""Time without a single byte, in s, after which a link is reopened. Hubs send HELLO every
second."""
CHECK_PORT_S = 0.25
"""Period at which a waiting link checks, in s, whether its port has come back."""
PERIOD_TOLERANCE = 0.01
"""Relative deviation from the requested sample period, because of rounding in the hub, above which
a note is given."""

OnState = Callable[[LinkState, LinkError | None], None]


class Session:
    """Starts the hub of one link after each opening, and keeps the state of the link.

    Args:
        link: The link.
        period_us: Sample period to request, in µs; None leaves the hub's own.
        clock_ns: The clock of arrivals.
        on_state: Called when the state of the link, or its reason, changes.

    Attributes:
        link: The link.
        actual_us: Sample period in force, in µs, as the hub reports it; 0 before that.
        last_byte: Time of the last received byte.
        asked_ns: Time of `clock_ns` at which the hub was asked for its time; None if no answer is
            expected.
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
        self._clock_ns, self._on_state = clock_ns, on_state
        self._period_us = period_us
        self._answered_us: int | None = None  # the hub's answer to the requested period
        self._is_started = True  # samples are requested
        self._has_hello = False  # HELLO has come since the port was opened
        self._opened_at = self._last_sample = 0.0
        self._retry_at = self._check_port_at = self._hello_at = self._ask_time_at = 0.0
        self._knows_time = True  # the hub has not refused the request TIME
        self._question = 0  # number of the last request TIME
        self._ports: tuple[object, ...] = ()

    @property
    def is_delivering(self) -> bool:
        """Whether samples are expected."""
        return self.link.state is LinkState.OPEN and self._has_hello and self._is_started

    def open(self, now: float) -> bool:
        """Open the link if it is time to try.

        Returns:
            Whether the link is open.

        Raises:
            LinkError: The link cannot be opened.
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
        return True

    def begin(self) -> None:
        """Ask the hub for HELLO, because the link was opened.

        Raises:
            LinkError: The link must be closed.
        """
        self.set_state(LinkState.OPEN)
        self._ask_hello(time.monotonic())

    def close(self, error: LinkError) -> None:
        """Close the link because of an error; it is opened again later."""
        link = self.link
        link.close()
        self._ports = link.identify_ports()
        self._retry_at = time.monotonic() + link.increase_pause()
        self.set_state(LinkState.WAITING, error)

    def send(self, request: Request) -> None:
        """Send a request.

        The period, START and STOP are remembered and sent again after each opening.

        Raises:
            LinkError: The link must be closed.
        """
        if request.request == Command.SET_PERIOD:
            self._period_us = request.argument
            self._answered_us = None
            self.actual_us = max(self.actual_us, request.argument)
        elif request.request in (Command.START, Command.STOP):
            self._is_started = request.request == Command.START
            self._last_sample = time.monotonic()
        if self.link.is_open:
            self.link.write(encode(request))

    def take(self, frame: Frame) -> bool:
        """Handle what a frame means for the link itself.

        Returns:
            Whether to deliver the frame.

        Raises:
            LinkError: The link must be closed.
        """
        link = self.link
        if isinstance(frame, Sample):
            self._last_sample = self.last_byte
            if link.state is not LinkState.OPEN or link.error is not None:
                self.set_state(LinkState.OPEN)
            # After a replug the port may lead to another hub. Its samples must not be taken for
            # those of the hub before.
            link.before_hello += not self._has_hello
            return self._has_hello
        if isinstance(frame, Hello):
            self._handle_hello(frame)
        elif isinstance(frame, Ack) and frame.request == Command.SET_PERIOD:
            self.actual_us = self._answered_us = frame.argument
            link.period_problem = _period_problem(self._period_us, frame)
        elif isinstance(frame, Ack) and frame.request == Command.TIME:
            self._knows_time = False
        elif isinstance(frame, Time):
            is_answer = self.asked_ns is not None and frame.number == self._question
            if is_answer:
                self.asked_ns = None
            return is_answer
        return True

    def check_timers(self, now: float) -> None:
        """Check the timers of the open link.

        Raises:
            LinkError: The link must be closed.
        """
        link = self.link
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
        # The answer is compared with samples, so it is useless before the first one.
        elif self._knows_time and self._last_sample > self._opened_at and now >= self._ask_time_at:
            self._ask_time(now)

    def set_state(self, state: LinkState, error: LinkError | None = None) -> None:
        """Set the state and its reason, and call back if they have changed."""
        link = self.link
        before = link.state, link.error and link.error.kind
        link.state, link.error = state, error
        if (state, error and error.kind) != before:
            self._on_state(state, error)

    def _handle_hello(self, frame: Hello) -> None:
        """Check the identity and the period of the hub, and start it if necessary."""
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
        # A hub may round the period or refuse it. Once it has answered, it is not asked again.
        expected = (self._period_us, self._answered_us)
        has_other_period = self._period_us is not None and frame.period_us not in expected
        if not self._has_hello or link.state is LinkState.SILENT or has_other_period:
            self._has_hello = True
            self._configure()

    def _configure(self) -> None:
        """Send the hub its sample period and START or STOP."""
        self._knows_time = True
        if self._period_us is not None:
            self.link.write(encode(Request(Command.SET_PERIOD, self._period_us)))
        command = Command.START if self._is_started else Command.STOP
        self.link.write(encode(Request(command)))
        if not self._is_started:
            self.set_state(LinkState.OPEN)

    def _check_silence(self, now: float) -> None:
        """Set the state SILENT if the last sample is too long ago."""
        link = self.link
        silence = now - self._last_sample
        limit = max(3e-6 * self.actual_us, SILENT_S) - TICK_S
        if not self._is_started or link.state is not LinkState.OPEN or silence <= limit:
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
        """Ask the hub for HELLO."""
        self._hello_at = now + HELLO_S
        self.link.write(encode(Request(Command.HELLO)))

    def _ask_time(self, now: float) -> None:
        """Ask the hub for its time."""
        self._ask_time_at = now + ASK_TIME_S
        self._question = (self._question + 1) % (1 << 32)
        request = encode(Request(Command.TIME, self._question))
        self.asked_ns = self._clock_ns()  # before the write, so that it is not later than true
        self.link.write(request)


def _period_problem(asked_us: int | None, answer: Ack) -> str:
    """Return what is wrong with the hub's answer to SET_PERIOD, and the fix; empty if it is
    right."""
    if asked_us is None:
        return ""
    in_force = f"the hub samples every {answer.argument} µs, asked for were {asked_us} µs"
    if answer.result == Result.REFUSED:
        return f"{in_force}, which it refused: set a rate that it can do"
    if answer.result != Result.DONE:
        return f"{in_force}, and it cannot change that: leave the rate to it"
    if abs(answer.argument - asked_us) > PERIOD_TOLERANCE * asked_us:
        return f"{in_force}: set a rate that it can do"
    return ""
