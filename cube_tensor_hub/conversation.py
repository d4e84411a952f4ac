"""What a check says to a hub, step by step, and how long it listens.

Every step has a name, by which the rules find what they judge. A step with requests ends when each
was answered, or after ANSWER_S; then it listens on for as long as it says.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np

from cube_tensor_driver.core.errors import CubeError, LinkError
from cube_tensor_driver.device.wire.protocol import (
    Ack,
    Command,
    Frame,
    Hello,
    Request,
    Sample,
    Stats,
    Time,
    encode,
)

from .transcript import Ear, Step, Transcript

ANSWER_S = 1.0
"""How long a hub may take to answer; the host asks again after that."""
GRACE_S = 0.15
"""How long an answer too many may take to come."""
PERIOD_US, SLOWER_US = 40_000, 60_000
"""Sample periods that any hub can do, on any line, and in an emulator."""
FAST_US = 1_000
"""A period at which the line and all buffers are soon full when nobody reads."""
QUIET_S, FLOW_S, NEW_PERIOD_S = 3.4, 4.4, 0.8
"""Three of the once-a-second frames come in the first two."""
UNREAD_S, SETTLE_S, AWAY_S = 3.0, 2.3, 1.5
DURATION_S = 25.0
"""Of a whole conversation with a hub that answers, roughly."""
ANY_ARGUMENT = 0xFF0D0A40
"""With bytes that Telnet, terminals and flow control treat in their own way."""
BETWEEN_START_S = 0.212
"""No whole number of periods, so that each START falls into another part of a period."""
MAX_FRAMES = 200_000
"""Far more than a hub can be asked for; a conversation is kept in memory."""
DAMAGED = {231: "that is cut off", 232: "with a wrong CRC", 233: "of version 2"}
"""Requests that no hub knows, so that an answer names the one that it belongs to."""
AFTER_DAMAGE, AFTER_WRONG_WAY, UNKNOWN = 234, 235, 236


class Wire(Protocol):
    """The bytes to and from a hub, and the time."""

    port: str
    is_tcp: bool

    def now(self) -> float:
        """Host's clock, s."""

    def send(self, data: bytes) -> None:
        """Without waiting."""

    def listen(self, seconds: float) -> bytes:
        """What came, as soon as something comes; b"" if nothing does."""

    def ignore(self, seconds: float) -> None:
        """Let time pass without reading."""

    def reopen(self, seconds: float) -> None:
        """Close, and open again after so long."""


Report = Callable[[float, float, str], None]


def converse(wire: Wire, report: Report = lambda done, total, what: None) -> Transcript:
    """Go through all steps. report: of a progress bar.

    LinkError: the line was lost. CubeError: the hub floods.
    """
    return Conversation(wire, report).run()


class Conversation:
    """One pass through the steps on a wire."""

    def __init__(self, wire: Wire, report: Report) -> None:
        self._wire, self._report = wire, report
        self._ear = Ear()
        self._begin_s = wire.now()
        self._n_frames = 0
        self._step = Step("")
        self._transcript = Transcript(wire.port, wire.is_tcp)

    def run(self) -> Transcript:
        try:
            self._ask("opened", seconds=1.2)
            self._ask("hello", Request(Command.HELLO))
            if self._n_frames:  # else nobody is there to talk to
                self._requests()
                self._samples()
                self._host_that_does_not_read()
                self._leave_as_found()
        except LinkError as error:
            raise LinkError(
                f"{self._wire.port}: the connection was lost in the step '{self._step.name}' "
                f"({error.kind}): check again, and if it is the same step, look at what the hub "
                "does then",
                error.kind,
            ) from error
        counters = self._ear.decoder.counters.as_dict()
        for name in ("bytes", "frames"):
            counters.pop(name)
        self._transcript.damage = {name: count for name, count in counters.items() if count}
        self._transcript.other_version = self._ear.decoder.other_version
        return self._transcript

    def _requests(self) -> None:
        self._ask("stop", Request(Command.STOP))
        self._ask("quiet", seconds=QUIET_S)
        self._ask(
            "three at once",
            Request(Command.IDENTIFY, 1),
            Request(Command.STOP, ANY_ARGUMENT),
            Request(Command.HELLO, ANY_ARGUMENT),
        )
        self._ask_time("stopped")
        self._ask("unknown request", Request(UNKNOWN, ANY_ARGUMENT))
        self._say("damaged", _damaged_requests(), AFTER_DAMAGE)
        self._say("wrong way", b"".join(map(encode, _frames_of_hubs())), AFTER_WRONG_WAY)
        self._say("XOFF", b"\x13\0", Command.STOP)
        self._say("XON", b"\x11\0", Command.STOP)

    def _samples(self) -> None:
        self._ask("impossible period", Request(Command.SET_PERIOD, 0))
        self._ask("after impossible period", Request(Command.HELLO))
        self._ask("period", Request(Command.SET_PERIOD, PERIOD_US))
        self._ask("after period", Request(Command.HELLO))
        self._ask("start", Request(Command.START, ANY_ARGUMENT), seconds=FLOW_S)
        self._ask_time("started")
        for number in range(3):
            self._ask(f"start again {number}", Request(Command.START), seconds=BETWEEN_START_S)
        self._ask("slower", Request(Command.SET_PERIOD, SLOWER_US), seconds=NEW_PERIOD_S)
        self._ask("stop samples", Request(Command.STOP), seconds=0.3)
        self._ask("stop again", Request(Command.STOP))
        self._ask("start after stop", Request(Command.START), seconds=1.2)

    def _host_that_does_not_read(self) -> None:
        self._ask("fast", Request(Command.SET_PERIOD, FAST_US), seconds=1.2)
        self._begin("unread")
        self._wire.ignore(UNREAD_S)
        self._listen(GRACE_S)
        self._ask("period again", Request(Command.SET_PERIOD, PERIOD_US), seconds=SETTLE_S)
        self._begin("gone")
        self._wire.reopen(AWAY_S)
        self._ear.reopen()
        self._ask("back", Request(Command.HELLO), seconds=1.2)

    def _leave_as_found(self) -> None:
        self._ask("end", Request(Command.STOP))
        hello = next(iter(self._transcript.frames(Hello)), None)
        if hello is not None and hello.period_us:
            self._ask("first period", Request(Command.SET_PERIOD, hello.period_us))

    def _ask(self, name: str, *requests: Request, seconds: float = GRACE_S) -> None:
        """Send requests at once, wait for their ACKs (and HELLO), and listen on."""
        step = self._begin(name, *requests)
        self._wire.send(b"".join(map(encode, requests)))
        hellos = sum(request.request == Command.HELLO for request in requests)
        if requests:
            self._listen(
                ANSWER_S,
                lambda: step.n_answers >= len(requests) and len(step.frames(Hello)) >= hellos,
            )
        self._listen(seconds)

    def _ask_time(self, state: str) -> None:
        """Ask for TIME three times, far enough apart to tell a clock that stands still."""
        for number in range(3):
            question = Request(Command.TIME, ANY_ARGUMENT + number)
            self._ask(f"time {state} {number}", question)

    def _say(self, name: str, data: bytes, last: int) -> None:
        """Send bytes that a hub must ignore, and a sound request behind them."""
        step = self._begin(name)
        self._wire.send(data + encode(Request(last)))
        self._listen(ANSWER_S, lambda: step.ack(last) is not None)
        self._listen(GRACE_S)

    def _begin(self, name: str, *requests: Request) -> Step:
        now = self._wire.now()
        done = min(now - self._begin_s, DURATION_S)
        self._report(done, DURATION_S, name.rstrip(" 0123456789"))
        self._step = Step(name, requests, now, now)
        self._transcript.steps[name] = self._step
        return self._step

    def _listen(self, seconds: float, enough: Callable[[], bool] = lambda: False) -> None:
        """Hear what comes within so long, or until it is enough."""
        step = self._step
        until = self._wire.now() + seconds
        while (left := until - self._wire.now()) > 0 and not enough():
            data = self._wire.listen(left)
            if len(self._transcript.first_bytes) < 16:
                self._transcript.first_bytes += data[:16]
            damaged = self._ear.damaged
            heard = self._ear.hear(data, self._wire.now())
            step.heard += heard
            step.damaged += self._ear.damaged - damaged
            self._n_frames += len(heard)
            if self._n_frames > MAX_FRAMES:
                raise CubeError(
                    f"{self._wire.port}: {self._n_frames} frames by the step {step.name!r}, the "
                    f"limit is {MAX_FRAMES}: this is more than a hub can be asked for; mend that "
                    "first"
                )
        step.end_s = self._wire.now()


def _damaged_requests() -> bytes:
    """The requests of DAMAGED behind noise that is longer than any request."""
    cut, wrong_crc, version = DAMAGED
    flipped = bytearray(encode(Request(wrong_crc)))
    flipped[-3] ^= 0x40
    noise = bytes(range(1, 256)) * 4
    return b"".join(
        (
            noise,
            encode(Request(cut))[:-4],
            b"\0",
            flipped,
            encode(Request(version), version=2),
        )
    )


def _frames_of_hubs() -> list[Frame]:
    """One of each, with numbers of a hub that is not there."""
    no_fault, unknown = np.zeros(1, "<u4"), np.full(1, -32768, "<i2")
    return [
        Ack(Command.START),
        Stats(1, 2, 3),
        Time(1, 2),
        Hello(1, 1, 1, PERIOD_US, np.array([1], "<u8")),
        Sample(0, 0, 0, np.ones((1, 1), "<u4"), no_fault, unknown),
    ]
