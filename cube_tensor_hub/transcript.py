"""What was asked and what was heard in a conversation with a hub."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TypeVar

from cube_tensor_driver.device.wire.decoder import MAX_RUN, Decoder
from cube_tensor_driver.device.wire.protocol import Ack, Frame, Hello, Request, Sample, Stats, Time

FrameType = TypeVar("FrameType", Hello, Sample, Stats, Ack, Time)


@dataclass(frozen=True, slots=True)
class Heard:
    """One frame from the hub.

    at_s: the host's clock when its last byte had come
    opened: whether a zero of its own opened it, behind the zero that closed the frame before;
        None if there was no frame just before
    """

    at_s: float
    frame: Frame
    opened: bool | None = None


@dataclass
class Step:
    """Something that was sent, and what came until the next step.

    name: what the step is for
    requests: the sound requests that were sent, in order
    sent_s, end_s: when it began and ended, host's clock
    heard: the frames that came, in order
    damaged: runs of bytes that were no frame
    """

    name: str
    requests: tuple[Request, ...] = ()
    sent_s: float = 0.0
    end_s: float = 0.0
    heard: list[Heard] = field(default_factory=list)
    damaged: int = 0

    def frames(self, kind: type[FrameType]) -> list[FrameType]:
        return [heard.frame for heard in self.heard if isinstance(heard.frame, kind)]

    @property
    def acks(self) -> list[Ack]:
        return self.frames(Ack)

    @property
    def n_answers(self) -> int:
        return len(self.acks) + len(self.frames(Time))

    def ack(self, request: int) -> Ack | None:
        """The first ACK of a request."""
        return next((ack for ack in self.acks if ack.request == request), None)


@dataclass
class Transcript:
    """A conversation.

    port: what was checked; is_tcp: whether it is a TCP address
    steps: by name, in the order in which they were made
    first_bytes: the first that came, at most 16
    damage: what was wrong with damaged runs: counter of `Decoder` -> runs
    other_version: of frames whose version is not ours
    """

    port: str
    is_tcp: bool
    steps: dict[str, Step] = field(default_factory=dict)
    first_bytes: bytes = b""
    damage: dict[str, int] = field(default_factory=dict)
    other_version: int | None = None

    def heard(self, *names: str) -> Iterator[Heard]:
        """All frames of these steps, or of all."""
        for name, step in self.steps.items():
            if not names or name in names:
                yield from step.heard

    def frames(self, kind: type[FrameType], *names: str) -> list[FrameType]:
        return [heard.frame for heard in self.heard(*names) if isinstance(heard.frame, kind)]

    @property
    def first_visit(self) -> list[str]:
        """The names of the steps before the port was closed."""
        return list(itertools.takewhile(lambda name: name != "gone", self.steps))

    @property
    def hello(self) -> Hello | None:
        """The last HELLO."""
        hellos = self.frames(Hello)
        return hellos[-1] if hellos else None


class Ear:
    """Bytes in, frames out, and what a decoder does not tell: the zeros around each frame.

    damaged: runs that were no frame
    """

    def __init__(self) -> None:
        self.decoder = Decoder()
        self.damaged = 0
        self.reopen()

    def reopen(self) -> None:
        """The port was opened: the first run's beginning may have been sent before."""
        self._tail = b""
        self._is_first = True
        self._follows_frame = False
        self._opening_zeros = 0

    def hear(self, data: bytes, at_s: float) -> list[Heard]:
        """The frames that `data` completes."""
        runs = (self._tail + data).split(b"\0")
        self._tail = runs.pop()
        heard = []
        for run in runs:
            if run:
                heard += self._hear_run(run, at_s)
            else:
                self._opening_zeros += 1
        if len(self._tail) > MAX_RUN:
            # No frame is so long. One run more than it is may be counted, but memory is bounded.
            self._hear_run(self._tail, at_s)
            self._tail = b""
        return heard

    def _hear_run(self, run: bytes, at_s: float) -> list[Heard]:
        opened = self._opening_zeros > 0 if self._follows_frame else None
        frames = self.decoder.feed(run + b"\0")
        self.damaged += not frames and not self._is_first
        self._opening_zeros = 0
        self._is_first = False
        self._follows_frame = bool(frames)
        return [Heard(at_s, frame, opened) for frame in frames]
