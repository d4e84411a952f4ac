# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""What a check sends to a hub, step by step, and how long it listens.

Every step has a name, by which the rules find what they check. A step with requests first waits
until each is answered, or for `ANSWER_S`; then it listens for as long as the step says.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
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

from .transcript import CheckStep, FrameListener, Transcript

ANSWER_S = 1.0
"""Longest time, in seconds, that the check waits for the answer of a hub to a request. The driver
sends a request again after this time."""

GRACE_S = 0.15
"""Time, in seconds, for which the check listens on after the expected answers, so that it notices
superfluous ones."""

PERIOD_US = 40_000
"""Sample period, in µs, of most of the check: so long that every hub keeps it, on a slow line and
in an emulator, too."""

SLOWER_US = 60_000
"""Longer sample period, in µs, to which the check changes while samples flow."""

FAST_US = 1_000
"""Shortest sample period, in µs, that the check asks for. At this period the buffers of hub and
line are full after a moment in which the host does not read."""

QUIET_S = 3.4
"""Time, in seconds, for which the check listens to a stopped hub. Three HELLOs and three STATS,
which a hub sends once a second, arrive in it."""

FLOW_S = 4.4
"""Time, in seconds, for which the check listens to samples of the period `PERIOD_US` (40 ms). About
100 samples arrive in it, and three HELLOs and STATS, which come once a second."""

NEW_PERIOD_S = 0.8
"""Time, in seconds, for which the check listens after a change of the sample period to 60 ms."""

SECOND_S = 1.2
"""Time, in seconds, in which at least one HELLO and one STATS arrive, which a hub sends once a
second."""

STOPPED_S = 0.3
"""Time, in seconds, for which the check listens after a STOP. Of a hub that did not stop, several
samples would arrive in it."""

UNREAD_S = 3.0
"""Time, in seconds, for which the check does not read what the hub sends, so that buffers
overflow."""

SETTLE_S = 2.3
"""Time, in seconds, for which the check reads after buffers have overflowed. A hub empties its
buffers in it and sends two STATS."""

AWAY_S = 1.5
"""Time, in seconds, for which the check closes the port while samples flow."""

DURATION_S = 26.0
"""Approximate duration of a whole conversation, in seconds, for the progress bar."""

ANY_ARGUMENT = 0xFF0D0A40
"""Argument of requests whose argument hubs must ignore. Its bytes FF, 0D and 0A are special to
Telnet and to terminals, so a bridge or a terminal driver that changes bytes is noticed."""

BETWEEN_START_S = 0.212
"""Time between two STARTs of a hub that has started, in seconds. It is no multiple of the sample
period of 40 ms, so that each START comes at another phase of the period."""

MAX_FRAMES = 200_000
"""Largest number of frames from a hub that a check keeps in memory. It is far more than a check
asks for; a hub that exceeds it ends the check with an error."""

DAMAGED = {231: "that is cut off", 232: "with a wrong CRC", 233: "of version 2"}
"""Number of a request that is sent damaged -> how it is damaged. No hub knows these numbers, so an
ACK with one of them shows which damage the hub did not notice."""

AFTER_DAMAGE = 234
"""Number of a request that no hub knows, sent intact behind the damaged requests."""

AFTER_WRONG_WAY = 235
"""Number of a request that no hub knows, sent behind frames that only hubs send."""

UNKNOWN = 236
"""Number of a request that no hub knows, sent alone."""

N_FIRST_BYTES = 16
"""Number of bytes from the beginning of the connection that are kept, to recognise Telnet and
TLS."""

XON = b"\x11\0"
"""Byte with which software flow control lets a sender continue, closed by a zero byte."""
XOFF = b"\x13\0"
"""Byte with which software flow control stops a sender, closed by a zero byte. A hub without flow
control ignores it."""


class Wire(Protocol):
    """The line to a hub, and a clock.

    Attributes:
        port: Name of the port.
        is_tcp: Whether it is a TCP address.
    """

    port: str
    is_tcp: bool

    def now(self) -> float:
        """Return the time on the host's clock, in seconds."""

    def send(self, data: bytes) -> None:
        """Send bytes without waiting until they are gone."""

    def listen(self, seconds: float) -> bytes:
        """Wait for bytes from the hub, at most for this time, and return the first that come.

        The result is b"" if none came.
        """

    def ignore(self, seconds: float) -> None:
        """Let time pass without reading."""

    def reopen(self, seconds: float) -> None:
        """Close the port, and open it again after a time."""


Report = Callable[[float, float, str], None]
"""Function that shows the progress of a check. Its arguments are the time that has passed and the
whole duration, both in seconds, and the name of the step."""


class Conversation:
    """Talks to a hub: goes once through all steps of a check and notes what the hub sends."""

    def __init__(self, wire: Wire, report: Report) -> None:
        """Prepare the conversation.

        Args:
            wire: The line to the hub.
            report: Shows the progress.
        """
        self._wire, self._report = wire, report
        self._listener = FrameListener()
        self._begin_s = wire.now()
        self._n_frames = 0
        self._step = CheckStep("")
        self._transcript = Transcript(wire.port, wire.is_tcp)

    def run(self) -> Transcript:
        """Go through all steps; without an answer to the first ones the others are left out.

        Raises:
            LinkError: The line was lost.
            CubeError: The hub sends more than `MAX_FRAMES`.
        """
        try:
            # A hub that was running sends HELLO and STATS by itself.
            self._ask("opened", seconds=SECOND_S)
            self._ask("hello", Command.HELLO)
            if self._n_frames:
                self._send_requests()
                self._test_sampling()
                self._stop_reading()
                self._leave_as_found()
        except LinkError as error:
            raise LinkError(
                f"{self._wire.port}: the connection was lost in the step '{self._step.name}' "
                f"({error.kind}): check again, and if it is the same step, look at what the hub "
                "does then",
                error.kind,
            ) from error
        # Bytes and frames are counted as well, but are no damage.
        counters = asdict(self._listener.decoder.counters)
        for name in ("bytes", "frames"):
            counters.pop(name)
        self._transcript.damage = {name: count for name, count in counters.items() if count}
        self._transcript.other_version = self._listener.decoder.other_version
        return self._transcript

    def _send_requests(self) -> None:
        """Send all kinds of requests and bytes that are no requests to a stopped hub."""
        self._ask("stop", Command.STOP)
        self._ask("quiet", seconds=QUIET_S)
        self._ask(
            # A hub must keep order, and must read more than one request at a time.
            "three at once",
            Request(Command.IDENTIFY, 1),
            Request(Command.STOP, ANY_ARGUMENT),
            Request(Command.HELLO, ANY_ARGUMENT),
        )
        self._ask_time("stopped")
        self._ask("unknown request", Request(UNKNOWN, ANY_ARGUMENT))
        self._send_bytes("damaged", _make_damaged_requests(), AFTER_DAMAGE)
        self._send_bytes(
            "wrong way",
            b"".join(map(encode, _make_frames_of_hubs())),
            AFTER_WRONG_WAY,
        )
        self._send_bytes("XOFF", XOFF, Command.STOP)
        # A hub with flow control would stay silent for the rest of the check without an XON.
        self._send_bytes("XON", XON, Command.STOP)

    def _test_sampling(self) -> None:
        """Start the hub, start it again, change its sample period, and stop it."""
        self._ask("impossible period", Request(Command.SET_PERIOD, 0))
        self._ask("after impossible period", Command.HELLO)
        self._ask("period", Request(Command.SET_PERIOD, PERIOD_US))
        self._ask("after period", Command.HELLO)
        self._ask(
            "start",
            Request(Command.START, ANY_ARGUMENT),
            seconds=FLOW_S,
        )
        self._ask_time("started")
        # Each START comes at another phase of the sample period.
        for number in range(3):
            self._ask(
                f"start again {number}",
                Command.START,
                seconds=BETWEEN_START_S,
            )
        self._ask(
            "refused while started",
            Request(Command.SET_PERIOD, 0),
            seconds=STOPPED_S,
        )
        self._ask(
            "slower",
            Request(Command.SET_PERIOD, SLOWER_US),
            seconds=NEW_PERIOD_S,
        )
        self._ask("stop samples", Command.STOP, seconds=STOPPED_S)
        self._ask("stop again", Command.STOP)
        self._ask("start after stop", Command.START, seconds=SECOND_S)

    def _stop_reading(self) -> None:
        """Let buffers overflow without reading, then close and open the port."""
        self._ask(
            "fast",
            Request(Command.SET_PERIOD, FAST_US),
            seconds=SECOND_S,
        )
        # At this rate the buffers overflow while nobody reads.
        self._begin("unread")
        self._wire.ignore(UNREAD_S)
        self._listen(GRACE_S)
        self._ask(
            "period again",
            Request(Command.SET_PERIOD, PERIOD_US),
            seconds=SETTLE_S,
        )
        self._begin("gone")
        self._wire.reopen(AWAY_S)
        self._listener.reopen()
        self._ask("back", Command.HELLO, seconds=SECOND_S)

    def _leave_as_found(self) -> None:
        """Stop the hub, open its port once more, and restore its sample period."""
        self._ask("end", Command.STOP)
        # A hub that was stopped when its port was closed must not send samples to the next host.
        self._begin("gone while stopped")
        self._wire.reopen(STOPPED_S)
        self._listener.reopen()
        self._ask("back while stopped", Command.HELLO, seconds=STOPPED_S)
        # The first sample comes so soon after START that its device time is known from TIME.
        self._ask("shortest period", Request(Command.SET_PERIOD, FAST_US))
        self._ask_time("before start")
        self._ask("start at once", Command.START)
        self._ask("last stop", Command.STOP)
        hello = next(iter(self._transcript.select_frames(Hello)), None)
        # 0 means that no host had set a period yet.
        if hello is not None and hello.period_us:
            self._ask("first period", Request(Command.SET_PERIOD, hello.period_us))

    def _ask(self, name: str, *asked: Request | Command, seconds: float = GRACE_S) -> None:
        """Send requests at once, wait for their ACKs and HELLOs, and listen for `seconds`.

        A command stands for its request with the argument 0.
        """
        requests = [Request(one) if isinstance(one, Command) else one for one in asked]
        step = self._begin(name, *requests)
        self._wire.send(b"".join(map(encode, requests)))
        hellos = sum(request.request == Command.HELLO for request in requests)
        # HELLO is a second answer, behind the ACK of its request.
        if requests:
            self._listen(
                ANSWER_S,
                lambda: (
                    step.n_answers >= len(requests) and len(step.select_frames(Hello)) >= hellos
                ),
            )
        self._listen(seconds)

    def _ask_time(self, state: str) -> None:
        """Ask for TIME three times, far enough apart to notice a clock that stands still."""
        for number in range(3):
            question = Request(Command.TIME, ANY_ARGUMENT + number)
            self._ask(f"time {state} {number}", question)

    def _send_bytes(
        self,
        name: str,
        data: bytes,
        last: int,
    ) -> None:
        """Send bytes that a hub must ignore, and the valid request `last` behind them."""
        step = self._begin(name)
        self._wire.send(data + encode(Request(last)))
        self._listen(ANSWER_S, lambda: step.find_ack(last) is not None)
        self._listen(GRACE_S)

    def _begin(self, name: str, *requests: Request) -> CheckStep:
        """Begin a step; what comes from now on belongs to it."""
        now = self._wire.now()
        done = min(now - self._begin_s, DURATION_S)
        self._report(done, DURATION_S, name.rstrip(" 0123456789"))
        self._step = CheckStep(name, requests, now, now)
        self._transcript.steps[name] = self._step
        return self._step

    def _listen(
        self,
        seconds: float,
        enough: Callable[[], bool] = lambda: False,
    ) -> None:
        """Add the frames that come to the step, for a time in seconds, or until `enough()`."""
        step = self._step
        until = self._wire.now() + seconds
        while (left := until - self._wire.now()) > 0 and not enough():
            data = self._wire.listen(left)
            if len(self._transcript.first_bytes) < N_FIRST_BYTES:
                self._transcript.first_bytes += data[:N_FIRST_BYTES]
            damaged = self._listener.damaged
            heard = self._listener.hear(data, self._wire.now())
            step.heard += heard
            step.damaged += self._listener.damaged - damaged
            self._n_frames += len(heard)
            if self._n_frames > MAX_FRAMES:
                raise CubeError(
                    f"{self._wire.port}: {self._n_frames} frames by the step {step.name!r}, the "
                    f"limit is {MAX_FRAMES}: this is more than a hub can be asked for; mend that "
                    "first"
                )
        step.end_s = self._wire.now()


def _make_damaged_requests() -> bytes:
    """Return the requests of `DAMAGED`, behind noise that is longer than any request."""
    cut, wrong_crc, version = DAMAGED
    flipped = bytearray(encode(Request(wrong_crc)))
    # One bit of the frame is wrong, which the CRC must detect.
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


def _make_frames_of_hubs() -> list[Frame]:
    """Return one frame of each kind that only hubs send, with the uid of no hub."""
    no_fault, unknown = np.zeros(1, "<u4"), np.full(1, -32768, "<i2")
    return [
        Ack(Command.START),
        Stats(1, 2, 3),
        Time(1, 2),
        Hello(1, 1, 1, PERIOD_US, np.array([1], "<u8")),
        Sample(
            0,
            0,
            0,
            np.ones((1, 1), "<u4"),
            no_fault,
            unknown,
        ),
    ]
