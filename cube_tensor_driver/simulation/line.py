# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Line between a simulated hub and the host: a pseudo-terminal.

The faults of injector.py can unplug it, stall it, or let it send in bursts.
"""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from ..core.errors import ConfigError

MAX_QUEUED_BYTES = 1 << 16
"""Maximum number of bytes that wait to be sent on a line. A hub drops and counts samples for which
there is no room."""

BURST_PERIOD_US = 16_000
"""Period, in µs, at which a line under the fault `burst` sends all waiting bytes. The latency timer
of common USB serial chips has the same period."""

_READ_BYTES = 65536
"""Maximum number of bytes that one read from a line returns."""


class SimulatedLine:
    """A pseudo-terminal (virtual serial port) between a hub and the host.

    The hub has one end; the other end appears as the symbolic link `port`.

    Attributes:
        port: Path of the port.
        fd: File descriptor of the hub's end, -1 while it is unplugged.
        held_until_us: Simulated time in µs until which nothing is sent (fault `stall`).
        burst_until_us: Simulated time in µs until which all waiting bytes are sent once per
            `BURST_PERIOD_US`.
    """

    def __init__(self, port: Path) -> None:
        self.port = port
        self.fd = -1
        self.held_until_us = 0
        self.burst_until_us = 0
        self._far_end = -1
        self._queue = bytearray()
        self._next_burst_us = 0
        self.plug()

    @property
    def plugged(self) -> bool:
        """Whether the port exists, so that the host can open it."""
        return self.fd >= 0

    def plug(self, port: Path | None = None) -> None:
        """Create the port.

        Args:
            port: New path of the port; None: the path does not change.

        Raises:
            ConfigError: The system has no pseudo-terminals.
        """
        self.port = port or self.port
        try:
            import tty
        except ImportError:  # Windows
            raise ConfigError(
                "simulated ports are pseudo-terminals, which this system does not have: use Linux "
                "or macOS, or simulate() in Python"
            ) from None
        # The host's end stays open in this process. Otherwise, the hub's end would report an error
        # whenever the driver closes the port.
        self.fd, self._far_end = os.openpty()
        tty.setraw(self._far_end)
        os.set_blocking(self.fd, False)
        self.port.unlink(missing_ok=True)
        self.port.symlink_to(os.ttyname(self._far_end))

    def unplug(self) -> None:
        """Remove the port; bytes that wait to be sent are lost."""
        if self.plugged:
            self.port.unlink(missing_ok=True)
            os.close(self.fd)
            os.close(self._far_end)
            self.fd = self._far_end = -1
        self._queue.clear()

    def send(self, data: bytes, now_us: int) -> bool:
        """Queue bytes, and write as many of the waiting bytes as the line takes now.

        Args:
            data: Bytes to send.
            now_us: Simulated time in µs.

        Returns:
            Whether there was room for the bytes in the queue; otherwise they are lost.
        """
        size = len(self._queue) + len(data)
        has_room = self.plugged and size <= MAX_QUEUED_BYTES
        if has_room:
            self._queue += data
        self.flush(now_us)
        return has_room

    def flush(self, now_us: int) -> None:
        """Write as many waiting bytes as the line takes at simulated time `now_us`."""
        if not self.plugged or now_us < self._find_blocked_until_us(now_us):
            return
        # During the fault `burst`, waiting bytes are written once per period.
        self._next_burst_us = (now_us // BURST_PERIOD_US + 1) * BURST_PERIOD_US
        # If the line takes no more bytes, the rest stays in the queue until the host reads.
        with contextlib.suppress(BlockingIOError):
            while self._queue:
                written = os.write(self.fd, self._queue)
                del self._queue[:written]

    def is_waiting(self, now_us: int) -> bool:
        """Return whether bytes wait to be sent although no fault (stall or burst) delays them."""
        is_delayed = self.find_due_us(now_us) is not None
        return self.plugged and bool(self._queue) and not is_delayed

    def find_due_us(self, now_us: int) -> int | None:
        """Return the simulated time in µs at which a stall or burst lets waiting bytes be sent.

        Args:
            now_us: Present simulated time in µs.

        Returns:
            Time at which `flush` has to be called; None if no bytes wait or they can be sent now.
        """
        blocked_us = self._find_blocked_until_us(now_us)
        return blocked_us if self._queue and now_us < blocked_us else None

    def _find_blocked_until_us(self, now_us: int) -> int:
        """Return the simulated time in µs before which a stall or burst lets nothing be sent."""
        is_burst = now_us < self.burst_until_us
        return max(self.held_until_us, self._next_burst_us if is_burst else 0)

    def read(self) -> bytes:
        """Return the bytes that the host has sent since the last call."""
        if not self.plugged:
            return b""
        try:
            return os.read(self.fd, _READ_BYTES)
        except BlockingIOError:
            return b""
