# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""A hub on a port of this machine, or on TCP."""

from __future__ import annotations

import select
import time

from cube_tensor_driver.config.port import TCP
from cube_tensor_driver.core.errors import LinkError
from cube_tensor_driver.device.links.link import Link, LinkConfig

RETRY_PERIOD_S = 0.01
"""Time, in seconds, between two attempts to open the port of a hub."""

MAX_REOPEN_S = 5.0
"""Longest time, in seconds, for which the check tries to open a port again that it has closed. The
port of a board on USB that restarts when it is opened is missing for some seconds."""


class PortWire:
    """The `Wire` of a port of this machine; a context manager, inside which the port is open.

    Entering and all methods raise LinkError if the port cannot be opened, or was lost.
    """

    def __init__(self, port: str, baud: int) -> None:
        self._link = Link(LinkConfig("hub", port, baud))
        self.port = port
        self.is_tcp = port.startswith(TCP)

    def __enter__(self) -> PortWire:
        self._open()
        return self

    def __exit__(self, *_: object) -> None:
        self._link.close()

    def now(self) -> float:
        return time.monotonic()

    def send(self, data: bytes) -> None:
        self._link.write(data)

    def listen(self, seconds: float) -> bytes:
        until = self.now() + seconds
        while (left := until - self.now()) > 0:
            # Bytes for which the kernel had no room are sent as soon as it has.
            waiting = [self._link.fileno()] if self._link.unsent else []
            readable, writable, _ = select.select(
                [self._link.fileno()],
                waiting,
                [],
                left,
            )
            if writable:
                self._link.flush()
            if readable:
                return self._link.read()
        return b""

    def ignore(self, seconds: float) -> None:
        time.sleep(seconds)

    def reopen(self, seconds: float) -> None:
        self._link.close()
        time.sleep(seconds)
        until = self.now() + MAX_REOPEN_S
        # The port disappears while the board restarts.
        while not self._link.is_open:
            try:
                self._open()
            except LinkError:
                if self.now() > until:
                    raise
                time.sleep(RETRY_PERIOD_S)

    def _open(self) -> None:
        while not self._link.open():
            time.sleep(RETRY_PERIOD_S)
