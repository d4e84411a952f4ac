"""The reader over real pseudo-terminals and a real TCP socket; the test plays the hub, byte by byte, on the other end."""

from __future__ import annotations

import os
import queue
import select
import socket
import threading
import time
import tty
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from cube_tensor_driver.core.errors import LinkError
from cube_tensor_driver.device.link import LinkConfig, LinkState
from cube_tensor_driver.device.protocol import Ack, Command, Decoder, Frame, Hello, Request, Sample, encode
from cube_tensor_driver.device.reader import Reader

WAIT_S = 5.0  # bound of every wait; nothing here is measured with it


class FakeHub:
    """The device's end of a link: frames out, requests in."""

    def __init__(self, send: Callable[[bytes], object], receive: Callable[[], bytes], fileno: int) -> None:
        self.send, self._receive, self._fileno = send, receive, fileno
        self._decoder = Decoder()
        self._inbox: list[Frame] = []
        self.sequence = 0

    def expect(self, command: Command) -> Request:
        """The next request of this kind; others before it are taken as read."""
        until = time.monotonic() + WAIT_S
        while True:
            while self._inbox:
                frame = self._inbox.pop(0)
                if isinstance(frame, Request) and frame.request == command:
                    return frame
            ready, _, _ = select.select([self._fileno], [], [], until - time.monotonic())
            if not ready:
                raise TimeoutError(f"no {command.name} request within {WAIT_S} s")
            self._inbox += self._decoder.feed(self._receive())

    def hello(self, uid: int = 0xC0FFEE, period_us: int = 10_000) -> None:
        self.send(encode(Hello(uid, 1, 8, period_us, np.arange(2, dtype="<u8"))))

    def sample(self, sequence: int | None = None) -> None:
        self.sequence = self.sequence + 1 if sequence is None else sequence
        self.send(encode(make_sample(self.sequence)))

    def greet(self, **hello: int) -> None:
        self.expect(Command.HELLO)
        self.hello(**hello)
        self.expect(Command.START)


def make_sample(sequence: int) -> Sample:
    return Sample(
        sequence, 0, 1000 * sequence, np.full((2, 8), sequence, "<u4"), np.zeros(2, "<u4"), np.zeros(2, "<i2")
    )


class PtyHub(FakeHub):
    """A hub on a pseudo-terminal, under a symbolic link where the test wants it."""

    def __init__(self, path: Path | None = None) -> None:
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        self.port = os.ttyname(self.slave)
        super().__init__(
            lambda data: os.write(self.master, data), lambda: os.read(self.master, 4096), self.master
        )
        self.path = path
        if path is not None:
            path.symlink_to(self.port)

    def unplug(self) -> None:
        if self.path is not None:
            self.path.unlink(missing_ok=True)
        for fd in (self.master, self.slave):
            if fd >= 0:
                os.close(fd)
        self.master = self.slave = -1


class Watch:
    """A reader and what it called back, to be waited for."""

    def __init__(self, configs: list[LinkConfig], **options: object) -> None:
        self.frames: queue.Queue[tuple[int, int, Frame]] = queue.Queue()
        self.states: queue.Queue[tuple[int, LinkState, LinkError | None]] = queue.Queue()
        self.reader = Reader(
            configs,
            lambda batch: [self.frames.put(item) for item in batch] and None,
            lambda *state: self.states.put(state),
            **options,  # type: ignore[arg-type]
        )

    def state(self, state: LinkState, kind: str | None = None, link: int = 0) -> LinkError | None:
        until = time.monotonic() + WAIT_S
        while True:
            index, found, error = self.states.get(timeout=max(0.001, until - time.monotonic()))
            if (index, found, error and error.kind) == (link, state, kind):
                return error

    def frame(self, kind: type[Frame], link: int = 0) -> Frame:
        until = time.monotonic() + WAIT_S
        while True:
            index, _, frame = self.frames.get(timeout=max(0.001, until - time.monotonic()))
            if index == link and isinstance(frame, kind):
                return frame
