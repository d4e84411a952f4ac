"""The line between a simulated hub and the host: a pseudo-terminal or TCP. It can be unplugged,
stalled, and made to send in bursts."""

from __future__ import annotations

import contextlib
import os
import socket
import tty
from pathlib import Path

from ..core.errors import ConfigError
from ..device.links.tcp import parse_url

OUT_LIMIT = 1 << 16
"""Bytes that wait for the line at most: the hub drops and counts what it samples beyond."""
BURST_US = 16_000
"""The latency timer of common USB serial chips."""


class Line:
    """A pseudo-terminal. One end is the hub's; the other appears as the symbolic link `port`.

    fd: of the hub's end, -1 while it is unplugged
    held_until_us: until this simulated time nothing goes out
    burst_until_us: until this simulated time all that waits goes out every BURST_US
    """

    def __init__(self, port: Path) -> None:
        self.port = port
        self.fd = self._far = -1
        self.held_until_us = self.burst_until_us = 0
        self._out = bytearray()
        self._burst = 0
        self.plug()

    @property
    def plugged(self) -> bool:
        return self.fd >= 0

    def plug(self, port: Path | None = None) -> None:
        """Appear, under another name if `port` is given."""
        self.port = port or self.port
        # The far end stays open, else the near one reports an error whenever the driver closes it.
        self.fd, self._far = os.openpty()
        tty.setraw(self._far)
        os.set_blocking(self.fd, False)
        self.port.unlink(missing_ok=True)
        self.port.symlink_to(os.ttyname(self._far))

    def unplug(self) -> None:
        """Vanish, together with all that was on its way."""
        if self.plugged:
            self.port.unlink(missing_ok=True)
            os.close(self.fd)
            os.close(self._far)
            self.fd = self._far = -1
        self._out.clear()

    def send(self, data: bytes, now_us: int) -> bool:
        """Queue bytes for the line and write what it takes; False when there was no room for
        them."""
        room = self.plugged and len(self._out) + len(data) <= OUT_LIMIT
        if room:
            self._out += data
        self.flush(now_us)
        return room

    def flush(self, now_us: int) -> None:
        """Write what the line takes now."""
        if not self.plugged or now_us < self.held_until_us:
            return
        if now_us < self.burst_until_us:
            burst = now_us // BURST_US
            if burst == self._burst:
                return
            self._burst = burst
        with contextlib.suppress(BlockingIOError):
            while self._out:
                del self._out[: os.write(self.fd, self._out)]

    def due_us(self, now_us: int) -> int | None:
        """When `flush` is worth calling again, None if nothing waits for its time."""
        if not self._out:
            return None
        if now_us < self.held_until_us:
            return self.held_until_us
        return (now_us // BURST_US + 1) * BURST_US if now_us < self.burst_until_us else None

    def read(self) -> bytes:
        """What the host sent."""
        if not self.plugged:
            return b""
        try:
            return os.read(self.fd, 65536)
        except BlockingIOError:
            return b""


class TcpLine(Line):
    """A line behind a bridge that listens at a url socket://host:port. Unplugging takes the bridge
    away; it always comes back under the same name."""

    def __init__(self, url: str) -> None:
        """LinkError: the url is no such address. ConfigError: the address cannot be used."""
        self._address = parse_url(url)
        self._listener: socket.socket | None = None
        self._connection: socket.socket | None = None
        super().__init__(Path(url))

    def plug(self, port: Path | None = None) -> None:
        """Listen."""
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
        """Vanish, together with all that was on its way."""
        self._hang_up()
        if self._listener is not None:
            self._listener.close()
            self._listener, self.fd = None, -1
        self._out.clear()

    def flush(self, now_us: int) -> None:
        """Write what the line takes now; without a connection it waits."""
        if self._connection is None:
            return
        try:
            super().flush(now_us)
        except ConnectionError:
            self._hang_up()

    def read(self) -> bytes:
        """What the host sent. The first call accepts its connection."""
        if self._connection is None and self._listener is not None:
            with contextlib.suppress(OSError):  # the host went away again
                self._connection, _ = self._listener.accept()
                self._connection.setblocking(False)
                self._connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self.fd = self._connection.fileno()
            return b""
        try:
            data = super().read()
        except ConnectionError:
            data = b""
        if not data:
            self._hang_up()
        return data

    def _hang_up(self) -> None:
        if self._connection is not None:
            self._connection.close()
            self._connection = None
            self.fd = self._listener.fileno() if self._listener is not None else -1
