"""Line between a simulated hub and the host: a pseudo-terminal or a TCP connection.

It can be unplugged, stalled, and made to send in bursts.
"""

from __future__ import annotations

import contextlib
import os
import socket
import tty
from pathlib import Path

from ..core.errors import ConfigError
from ..device.links.tcp import parse_url

MAX_QUEUED_BYTES = 1 << 16
"""Largest number of bytes that wait for the line. The hub drops and counts samples beyond it."""

BURST_PERIOD_US = 16_000
"""Period in µs at which a line in bursts sends: the latency timer of common USB serial chips."""

_READ_BYTES = 65536


class SimulatedLine:
    """A pseudo-terminal. One end is the hub's, the other one appears as the symbolic link `port`.

    Attributes:
        port: Path of the port.
        fd: File descriptor of the hub's end, -1 while it is unplugged.
        held_until_us: Simulated time until which nothing is sent.
        burst_until_us: Simulated time until which all waiting bytes are sent once per
            `BURST_PERIOD_US`.
    """

    def __init__(self, port: Path) -> None:
        self.port = port
        self.fd = -1
        self.held_until_us = 0
        self.burst_until_us = 0
        self._far_end = -1
        self._queue = bytearray()
        self._newest_burst = 0
        self.plug()

    @property
    def plugged(self) -> bool:
        """Whether the port exists."""
        return self.fd >= 0

    def plug(self, port: Path | None = None) -> None:
        """Create the port, under another name if `port` is given."""
        self.port = port or self.port
        # The far end stays open here. Otherwise, the near end reports an error whenever the driver
        # closes the port.
        self.fd, self._far_end = os.openpty()
        tty.setraw(self._far_end)
        os.set_blocking(self.fd, False)
        self.port.unlink(missing_ok=True)
        self.port.symlink_to(os.ttyname(self._far_end))

    def unplug(self) -> None:
        """Remove the port; bytes that wait are lost."""
        if self.plugged:
            self.port.unlink(missing_ok=True)
            os.close(self.fd)
            os.close(self._far_end)
            self.fd = self._far_end = -1
        self._queue.clear()

    def send(self, data: bytes, now_us: int) -> bool:
        """Queue bytes and write what the line takes.

        Returns:
            Whether there was room for the bytes.
        """
        has_room = self.plugged and len(self._queue) + len(data) <= MAX_QUEUED_BYTES
        if has_room:
            self._queue += data
        self.flush(now_us)
        return has_room

    def flush(self, now_us: int) -> None:
        """Write the waiting bytes that the line takes now."""
        if not self.plugged or now_us < self.held_until_us:
            return
        if now_us < self.burst_until_us:
            # At most one write per period.
            burst = now_us // BURST_PERIOD_US
            if burst == self._newest_burst:
                return
            self._newest_burst = burst
        # The rest stays in the queue until the host reads.
        with contextlib.suppress(BlockingIOError):
            while self._queue:
                del self._queue[: os.write(self.fd, self._queue)]

    def due_us(self, now_us: int) -> int | None:
        """Return when `flush` should be called again; None if nothing waits for its time."""
        if not self._queue:
            return None
        if now_us < self.held_until_us:
            return self.held_until_us
        if now_us < self.burst_until_us:
            return (now_us // BURST_PERIOD_US + 1) * BURST_PERIOD_US
        return None

    def read(self) -> bytes:
        """Return what the host sent."""
        if not self.plugged:
            return b""
        try:
            return os.read(self.fd, _READ_BYTES)
        except BlockingIOError:
            return b""


class TcpLine(SimulatedLine):
    """A line behind a bridge that listens at a URL socket://host:port.

    Unplugging removes the bridge. It always comes back at the same address.
    """

    def __init__(self, url: str) -> None:
        """Listen at the address.

        Raises:
            LinkError: The URL is no such address.
            ConfigError: The address cannot be used.
        """
        self._address = parse_url(url)
        self._listener: socket.socket | None = None
        self._connection: socket.socket | None = None
        super().__init__(Path(url))

    def plug(self, port: Path | None = None) -> None:
        """Listen; the address is the same whatever `port` is."""
        try:
            self._listener = socket.create_server(self._address, backlog=1)
        except OSError as error:
            host, number = self._address
            raise ConfigError(
                f"{host}:{number}: {error.strerror}; name an address that is free here"
            ) from None
        self._listener.setblocking(False)
        self.fd = self._listener.fileno()

    def unplug(self) -> None:
        """Close connection and listener; bytes that wait are lost."""
        self._hang_up()
        if self._listener is not None:
            self._listener.close()
            self._listener = None
            self.fd = -1
        self._queue.clear()

    def flush(self, now_us: int) -> None:
        """Write the waiting bytes that the line takes; without a connection they wait."""
        if self._connection is None:
            return
        try:
            super().flush(now_us)
        except ConnectionError:
            self._hang_up()

    def read(self) -> bytes:
        """Return what the host sent. The first call accepts its connection."""
        if self._connection is None:
            self._accept()
            return b""
        try:
            data = super().read()
        except ConnectionError:
            data = b""
        if not data:  # the host has closed the connection
            self._hang_up()
        return data

    def _accept(self) -> None:
        """Accept the connection that made the listener readable."""
        if self._listener is None:
            return
        with contextlib.suppress(OSError):  # the host has closed it again
            self._connection, _ = self._listener.accept()
            self._connection.setblocking(False)
            # Samples must not wait to be sent together.
            self._connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self.fd = self._connection.fileno()

    def _hang_up(self) -> None:
        """Close the connection and wait for the next one."""
        if self._connection is not None:
            self._connection.close()
            self._connection = None
            self.fd = self._listener.fileno() if self._listener is not None else -1
