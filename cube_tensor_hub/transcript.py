# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""What was asked and what was heard in a conversation with a hub."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TypeVar

from cube_tensor_driver.device.wire.decoder import MAX_RUN, Decoder
from cube_tensor_driver.device.wire.protocol import Ack, Frame, Hello, Request, Sample, Stats, Time

FrameType = TypeVar(
    "FrameType",
    Hello,
    Sample,
    Stats,
    Ack,
    Time,
)

REOPENING_STEP = "gone"
"""Name of the step of a check in which the port is closed and opened again while samples flow."""


@dataclass(frozen=True, slots=True)
class Heard:
    """One frame from the hub.

    Attributes:
        at_s: Time on the host's clock at which its last byte had come, in seconds.
        frame: The frame.
        opened: Whether two zero bytes lie between the frame before and this one, so that this one
            begins with a zero of its own; None: there was no frame just before it.
    """

    at_s: float
    frame: Frame
    opened: bool | None = None


@dataclass
class CheckStep:
    """Something that was sent to the hub, and what came until the next step.

    Attributes:
        name: What the step is for; rules find it by this name.
        requests: The valid requests that were sent, in order.
        sent_s: Time at which it began, on the host's clock.
        end_s: Time at which it ended, on the host's clock.
        heard: The frames that came, in order.
        damaged: Number of runs of bytes that were no frame.
    """

    name: str
    requests: tuple[Request, ...] = ()
    sent_s: float = 0.0
    end_s: float = 0.0
    heard: list[Heard] = field(default_factory=list)
    damaged: int = 0

    def select_frames(self, kind: type[FrameType]) -> list[FrameType]:
        """Return the frames of a kind, such as `Sample`, in the order of arrival."""
        return [heard.frame for heard in self.heard if isinstance(heard.frame, kind)]

    @property
    def acks(self) -> list[Ack]:
        """ACKs (answers to requests) that came in this step, in the order of arrival."""
        return self.select_frames(Ack)

    @property
    def n_answers(self) -> int:
        """Number of answers to requests: ACKs, and TIMEs, which answer the request for TIME."""
        return len(self.acks) + len(self.select_frames(Time))

    def find_ack(self, request: int) -> Ack | None:
        """Return the first ACK (answer) to a request with this number; None: there is none."""
        return next((ack for ack in self.acks if ack.request == request), None)


@dataclass
class Transcript:
    """A conversation with a hub.

    Attributes:
        port: Port of the hub.
        is_tcp: Whether the port is a TCP address.
        steps: The steps by name, in the order in which they were made.
        first_bytes: The first bytes that came, at most 16.
        damage: Counter of `Decoder` -> number of damaged runs that it counted.
        other_version: Protocol version of frames with a version that is not ours; None: there were
            none.
    """

    port: str
    is_tcp: bool
    steps: dict[str, CheckStep] = field(default_factory=dict)
    first_bytes: bytes = b""
    damage: dict[str, int] = field(default_factory=dict)
    other_version: int | None = None

    def iterate_heard(self, *names: str) -> Iterator[Heard]:
        """Yield all frames of the named steps, or of all steps."""
        for name, step in self.steps.items():
            if not names or name in names:
                yield from step.heard

    def select_frames(self, kind: type[FrameType], *names: str) -> list[FrameType]:
        """Return the frames of a kind in the named steps, or in all steps."""
        return [
            heard.frame for heard in self.iterate_heard(*names) if isinstance(heard.frame, kind)
        ]

    def find_ack(self, name: str, request: int) -> Ack | None:
        """Return the first ACK to a request in the named step; None: there is none."""
        return self.steps[name].find_ack(request)

    @property
    def first_visit(self) -> list[str]:
        """Names of the steps before the port was closed for the first time.

        Rules that count samples use only these, because bytes that the kernel holds are lost when
        the port is closed.
        """
        return list(itertools.takewhile(lambda name: name != REOPENING_STEP, self.steps))

    def select_visit_frames(self, kind: type[FrameType]) -> list[FrameType]:
        """Return the frames of a kind in the steps of `first_visit`."""
        return self.select_frames(kind, *self.first_visit)

    def iterate_visit_frames(self) -> Iterator[Frame]:
        """Yield all frames in the steps of `first_visit`."""
        return (heard.frame for heard in self.iterate_heard(*self.first_visit))

    @property
    def hello(self) -> Hello | None:
        """Last HELLO of the hub; None: none came."""
        hellos = self.select_frames(Hello)
        return hellos[-1] if hellos else None


class FrameListener:
    """Turns bytes into frames, and notes what a decoder does not tell: the zeros around frames.

    Attributes:
        decoder: The decoder, with its counters.
        damaged: Number of runs that were no frame.
    """

    def __init__(self) -> None:
        self.decoder = Decoder()
        self.damaged = 0
        self.reopen()

    def reopen(self) -> None:
        """Forget unfinished bytes after the port was opened.

        The first bytes that come then may be the end of a frame that was sent before. They do not
        count as damaged.
        """
        self._tail = b""
        self._is_first = True
        self._follows_frame = False
        self._opening_zeros = 0

    def hear(self, data: bytes, at_s: float) -> list[Heard]:
        """Return the frames that are completed by bytes which came at a time, in seconds."""
        # Zeros separate the frames on the wire; none occurs inside of one.
        runs = (self._tail + data).split(b"\0")
        self._tail = runs.pop()
        heard = []
        for run in runs:
            if run:
                heard += self._hear_run(run, at_s)
            else:
                self._opening_zeros += 1
        if len(self._tail) > MAX_RUN:
            # No frame is so long. The run may be counted twice, but the memory is bounded.
            self._hear_run(self._tail, at_s)
            self._tail = b""
        return heard

    def _hear_run(self, run: bytes, at_s: float) -> list[Heard]:
        """Decode one run of bytes between two zeros, and note the zeros before it.

        Args:
            run: The bytes, without zeros.
            at_s: Time on the host's clock at which their last byte had come, in seconds.
        """
        opened = self._opening_zeros > 0 if self._follows_frame else None
        frames = self.decoder.feed(run + b"\0")
        # The first run may be the end of a frame that was sent before the port was opened.
        self.damaged += not frames and not self._is_first
        self._opening_zeros = 0
        self._is_first = False
        self._follows_frame = bool(frames)
        return [Heard(at_s, frame, opened) for frame in frames]
