"""The conversation with one hub, over all openings of its port.

After every opening the hub is asked for HELLO, and on HELLO it is told what it should do (period,
start or stop). A hub that restarts behind an open port falls silent, and its next HELLO brings it
up again. Once it delivers, it is asked for its time about once a second.

Nothing here waits or has a thread: the reader says what came and what time it is. Times are
time.monotonic() in s.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from ...core.errors import LinkError
from ..wire.protocol import Ack, Command, Frame, Hello, Request, Result, Sample, Time, encode
from .link import Link, LinkState

SILENT_S = 0.2
"""A link is silent after so long without a sample, or after three sample periods if they are
longer."""
TICK_S = 0.02
"""Interval at which the reader looks at timers."""
HELLO_S = 1.0
"""Interval at which a hub that does not answer is asked again."""
ASK_TIME_S = 0.983
"""Interval at which a hub is asked for its time. It is no whole number of usual sample periods, so
that the questions come at all times between two samples."""
REOPEN_S = 5.0
"""A link without a single byte for so long is opened again. Hubs say HELLO every second."""
LOOK_S = 0.25
"""Interval at which a waiting link is looked at: its port may have come back."""
ROUNDING = 0.01
"""A hub may round the sample period by so much of it without a note."""

OnState = Callable[[LinkState, LinkError | None], None]


class Session:
    """Brings up one link again and again, and keeps its state.

    on_state: called when the state of the link, or the reason why it waits, changes
    clock_ns: the clock of arrival times

    link: the link
    actual_us: sample period in force, as the hub says; 0: not known yet
    last_byte: when something came last
    asked_ns: when the hub was asked for its time, in clock_ns; None: no answer is awaited
    """

    def __init__(
        self, link: Link, period_us: int | None, clock_ns: Callable[[], int], on_state: OnState
    ) -> None:
        """period_us: to ask for; None leaves the hub's own."""
        self.link = link
        self.actual_us = period_us or 0
        self.last_byte = 0.0
        self.asked_ns: int | None = None
        self._clock_ns, self._on_state = clock_ns, on_state
        self._period_us = period_us
        self._answered_us: int | None = None  # what the hub made of the period that was asked for
        self._started = True  # samples are asked for
        self._greeted = False  # HELLO has come since the port was opened
        self._opened_at = self._last_sample = 0.0
        self._retry_at = self._look_at = self._hello_at = self._ask_time_at = 0.0
        self._knows_time = True  # the hub has not refused to say its time
        self._question = 0  # number of the last question for the time
        self._fingerprint: tuple[object, ...] = ()

    @property
    def is_delivering(self) -> bool:
        """Whether samples are to be expected."""
        return self.link.state is LinkState.OPEN and self._greeted and self._started

    def open(self, now: float) -> bool:
        """Open the link if it is time to try, and it can be; whether it is open. LinkError: it
        cannot be opened."""
        link = self.link
        if now >= self._look_at:
            self._look_at = now + LOOK_S
            fingerprint = link.fingerprint()
            if fingerprint != self._fingerprint:
                self._fingerprint = fingerprint
                self._retry_at = now
                link.reset_pause()
        if now < self._retry_at:
            return False
        if link.state is LinkState.CLOSED:
            self.set_state(LinkState.WAITING)
        if not link.open():
            return False
        self._opened_at = self.last_byte = self._last_sample = time.monotonic()
        self._greeted = False
        self._answered_us = self.asked_ns = None
        link.period_problem = ""
        return True

    def begin(self) -> None:
        """The link was opened: ask the hub who it is. LinkError: the link must be closed."""
        self.set_state(LinkState.OPEN)
        self._ask_hello(time.monotonic())

    def close(self, error: LinkError) -> None:
        """Close a link that failed, to try again later."""
        link = self.link
        link.close()
        self._fingerprint = link.fingerprint()
        self._retry_at = time.monotonic() + link.next_pause()
        self.set_state(LinkState.WAITING, error)

    def send(self, request: Request) -> None:
        """Send a request; what a hub should do is remembered, and sent again after each opening.
        LinkError: the link must be closed."""
        if request.request == Command.SET_PERIOD:
            self._period_us = request.argument
            self._answered_us = None
            self.actual_us = max(self.actual_us, request.argument)
        elif request.request in (Command.START, Command.STOP):
            self._started = request.request == Command.START
            self._last_sample = time.monotonic()
        if self.link.is_open:
            self.link.write(encode(request))

    def take(self, frame: Frame) -> bool:
        """Act on what a frame says about the link itself. Whether to deliver the frame.

        LinkError: the link must be closed.
        """
        link = self.link
        if isinstance(frame, Sample):
            self._last_sample = self.last_byte
            if link.state is not LinkState.OPEN or link.error is not None:
                self.set_state(LinkState.OPEN)
            # After a replug it may be another hub, whose samples must not pass for the old one's.
            link.before_hello += not self._greeted
            return self._greeted
        if isinstance(frame, Hello):
            self._take_hello(frame)
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

    def look(self, now: float) -> None:
        """Look at the timers of the open link. LinkError: it must be closed."""
        link = self.link
        self._check_silence(now)
        if now - self.last_byte > REOPEN_S:
            link.next_candidate()
            raise LinkError(
                f"{link.path}: not a byte for {REOPEN_S:g} s: opening it again; "
                "check the hub's power",
                "silent",
            )
        if link.is_pattern and not self._greeted and now - self._opened_at > REOPEN_S:
            link.next_candidate()
            raise LinkError(
                f"{link.path}: no hub answers here: trying the next match of {link.config.port}",
                "wrong_hub",
            )
        if link.state is LinkState.SILENT or not self._greeted:
            if now >= self._hello_at:
                self._ask_hello(now)
        # Not before the first sample, with which the answer is compared.
        elif self._knows_time and self._last_sample > self._opened_at and now >= self._ask_time_at:
            self._ask_time(now)

    def set_state(self, state: LinkState, error: LinkError | None = None) -> None:
        """Keep state and reason, and call back if they are others."""
        link = self.link
        before = link.state, link.error and link.error.kind
        link.state, link.error = state, error
        if (state, error and error.kind) != before:
            self._on_state(state, error)

    def _take_hello(self, frame: Hello) -> None:
        link = self.link
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
        self.actual_us = frame.period_us
        # A hub may round the period, or refuse it. It has answered then: it is not asked again.
        known = (self._period_us, self._answered_us)
        other_period = self._period_us is not None and frame.period_us not in known
        if not self._greeted or link.state is LinkState.SILENT or other_period:
            self._greeted = True
            self._configure()

    def _configure(self) -> None:
        self._knows_time = True
        if self._period_us is not None:
            self.link.write(encode(Request(Command.SET_PERIOD, self._period_us)))
        self.link.write(encode(Request(Command.START if self._started else Command.STOP)))
        if not self._started:
            self.set_state(LinkState.OPEN)

    def _check_silence(self, now: float) -> None:
        link = self.link
        silence = now - self._last_sample
        limit = max(3e-6 * self.actual_us, SILENT_S) - TICK_S
        if not self._started or link.state is not LinkState.OPEN or silence <= limit:
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
        self._hello_at = now + HELLO_S
        self.link.write(encode(Request(Command.HELLO)))

    def _ask_time(self, now: float) -> None:
        self._ask_time_at = now + ASK_TIME_S
        self._question = (self._question + 1) % (1 << 32)
        request = encode(Request(Command.TIME, self._question))
        self.asked_ns = self._clock_ns()  # no later than true
        self.link.write(request)


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
