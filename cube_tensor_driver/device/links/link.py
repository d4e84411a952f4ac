# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""One link: a byte stream to and from a hub over a serial port, a pseudo-terminal or TCP.

A link moves bytes without blocking and without a thread; `session.py` decides what is sent on it.
pyserial opens serial ports by their path. On Linux ``os.read`` reads them, up to 4 kB per call; on
other systems pyserial does, because Windows has no file descriptors of ports. Every failure is a
`LinkError`, whose `kind` is one word and whose text names the fix:

    no_port  no_permission  busy  not_serial  bad_port  bad_baud      opening a serial port
    refused  no_answer  unreachable  unresolved                       opening a TCP link
    lost  overflow                                                    while the link is open
    silent  wrong_hub                                                 found by the session
"""

from __future__ import annotations

import contextlib
import errno
import glob
import os
import socket
import sys
from dataclasses import asdict, dataclass
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from ...config.port import TCP, find_port_problem
from ...core.errors import LinkError
from ..track import LinkTrack
from ..wire.decoder import Decoder
from ..wire.protocol import Hello
from .tcp import TcpConnection

if TYPE_CHECKING:
    import serial

READ_CHUNK = 1 << 16
"""Largest number of bytes that one call reads from one link. The limit keeps a link with much data
from delaying the reading of the other links."""
MAX_UNSENT = 4096
"""Largest number of bytes that may wait to be sent on one link. Bytes wait only if the hub does not
read; at the limit the link is closed and opened again."""
MIN_PAUSE_S = 0.25
"""Pause after the first failed attempt to open a link, in s. Each further failure doubles it."""
MAX_PAUSE_S = 5.0
"""Longest pause between two attempts to open a serial port, in s. If the device file of the port
appears or changes, because a hub was plugged in, the next attempt follows without this pause."""
MAX_TCP_PAUSE_S = 1.5
"""Longest pause between two attempts to open a TCP link, in s. Unlike a device file, a TCP peer
gives no sign when it can be reached again, and a link should be open again within 2 s."""
END_OF_STREAM = OSError(errno.EIO, "end of stream")
"""Error for a read that returned no byte although the port was ready: the other end was unplugged
or has closed the connection."""

_NO_PERMISSION = (
    "no_permission",
    "add yourself to the group dialout (sudo usermod -aG dialout $USER) and log in again",
)
"""Kind of error and fix if the user may not open the port."""
_NO_DEVICE = "no_port", "nothing is behind this port: plug the hub in or correct the port"
"""Kind of error and fix if the device file exists, but no device answers."""
_IN_USE = "busy", "another program has it open: end that one (fuser -v shows which)"
"""Kind of error and fix if another program has the port open."""
_NOT_SERIAL = "not_serial", "this is no serial port: correct the port"
"""Kind of error and fix if the path is no serial port."""
_OPEN_ERRORS = {
    errno.ENOENT: ("no_port", "plug the hub in or correct the port"),
    errno.ENXIO: _NO_DEVICE,
    errno.ENODEV: _NO_DEVICE,
    errno.EIO: _NO_DEVICE,
    errno.EACCES: _NO_PERMISSION,
    errno.EPERM: _NO_PERMISSION,
    errno.EBUSY: _IN_USE,
    errno.EAGAIN: _IN_USE,
    errno.ENOTTY: _NOT_SERIAL,
    errno.EINVAL: _NOT_SERIAL,
    errno.EISDIR: _NOT_SERIAL,
    errno.ENOTDIR: _NOT_SERIAL,
}
"""Kind of the LinkError and text of the fix for each errno with which opening a serial port
fails."""


class LinkState(str, Enum):
    """State of a link.

    Attributes:
        CLOSED: The link is not in use.
        WAITING: The port is not open; it is tried again after a pause of at most 5 s.
        OPEN: The port is open.
        SILENT: The port is open, but no sample has come for max(3 sample periods, 0.2 s) although
            samples were requested.
    """

    CLOSED = "closed"
    WAITING = "waiting"
    OPEN = "open"
    SILENT = "silent"


@dataclass(frozen=True)
class LinkConfig:
    """Port of a link, and the hub that is expected there.

    Attributes:
        name: Name of the link in the skin file.
        port: Device path or ``socket://host:port``; other URLs are refused. A device path may be a
            pattern such as ``/dev/ttyACM*``: its matches are tried one after the other, which finds
            a hub that comes back under another device name.
        baud: Baud rate of a serial adapter. USB and TCP ignore it.
        hub_uid: Unique number of the hub that must answer; None accepts any hub.
        is_simulated: Whether a simulator makes the port, perhaps after this link was started. Then
            a port that has never existed is not logged as missing.
    """

    name: str
    port: str
    baud: int = 921_600
    hub_uid: int | None = None
    is_simulated: bool = False


class Link:
    """Byte stream to and from one hub, which can be opened and closed many times.

    Args:
        config: Port of the link, and the hub that is expected there.
        track: Sample numbers and clock values of the link; None for new ones.

    Attributes:
        HAS_DESCRIPTORS: Whether serial ports and sockets have file descriptors that one call (poll)
            waits for, which is so on Linux. If not, links are asked one after the other.
        track: Sample numbers and clock values of the link, which are kept when it is reopened.
        state: State of the link; `Session` sets it.
        error: Reason of the state; None if there is none. `Session` sets it.
        period_problem: Text about a sample period of the hub that differs from the requested one;
            empty if they agree. `Session` sets it.
        decoder: Decoder of the received bytes. Its counters continue when the link is reopened.
        hello: Last HELLO frame of the hub, kept when the link is reopened; None before the first.
        path: Path of the port that was tried last. If the configured port is a pattern, it is the
            match that was tried.
        is_pattern: Whether the configured port is a pattern such as ``/dev/ttyACM*``.

    Raises:
        LinkError: With the kind `bad_port`: the port is neither a device path nor a TCP address.
    """

    HAS_DESCRIPTORS: ClassVar[bool] = sys.platform == "linux"

    def __init__(self, config: LinkConfig, track: LinkTrack | None = None) -> None:
        self.config = config
        self.track = track or LinkTrack()
        self.state = LinkState.CLOSED
        self.error: LinkError | None = None
        self.decoder = Decoder()
        self.hello: Hello | None = None
        self.opened = 0
        self.lost = 0
        self.silences = 0
        self.before_hello = 0
        self.bytes_out = 0
        self.period_problem = ""
        self.path = config.port
        self.is_pattern = "://" not in config.port and glob.has_magic(config.port)
        self._tcp = config.port.startswith(TCP)
        self._stream: serial.Serial | socket.socket | None = None
        self._connecting: TcpConnection | None = None
        self._fd = -1
        self._out = bytearray()
        self._pause = MIN_PAUSE_S
        self._first_match = 0  # index, among the paths that match the pattern, of the next to try
        problem = find_port_problem(config.port)
        if problem:
            raise LinkError(f"link {config.name!r}: port: {problem}", "bad_port")

    @property
    def counters(self) -> dict[str, int]:
        """Counters of the decoder and of the link by name.

        `opened`, `lost` and `silences` count how often the link was opened, lost, and became
        silent. `before_hello` counts samples that were discarded because the hub had not sent HELLO
        since the port was opened. `bytes_out` counts the sent bytes.
        """
        return {
            **asdict(self.decoder.counters),
            "opened": self.opened,
            "lost": self.lost,
            "silences": self.silences,
            "before_hello": self.before_hello,
            "bytes_out": self.bytes_out,
        }

    @property
    def is_open(self) -> bool:
        """Whether the port is open."""
        return self._stream is not None

    @property
    def unsent(self) -> bool:
        """Whether bytes wait to be sent because the kernel accepts no more at the moment."""
        return bool(self._out)

    def fileno(self) -> int:
        """Return the file descriptor of the open port; -1 if it is closed or has none."""
        return self._fd

    def open(self) -> bool:
        """Open the port, or take the next step of a TCP connection. It does not block.

        Returns:
            Whether the link is open. If not, a TCP connection is being made, and the caller must
            call again later.

        Raises:
            LinkError: The serial port could not be opened, or no TCP connection was made. Its kind
                and text tell why, for example `no_port` or `no_permission`.
        """
        if self._tcp:
            self._open_tcp()
        else:
            self._open_serial()
        if self._stream is None:
            return False
        if self.HAS_DESCRIPTORS:
            self._fd = self._stream.fileno()
        self.opened += 1
        return True

    def read(self) -> bytes:
        """Return the bytes of one system call, at most `READ_CHUNK`; empty if there are none.

        A serial port gives at most 4 kB at a time. This method does not read a second time, because
        the kernel fetches the next 4 kB while the other links are read.

        Raises:
            LinkError: With the kind `lost`: the other end was unplugged or closed the connection.
        """
        try:
            if self.HAS_DESCRIPTORS:
                data = os.read(self._fd, READ_CHUNK)
            elif isinstance(self._stream, socket.socket):
                data = self._stream.recv(READ_CHUNK)
            elif self._stream is not None:
                # pyserial returns no byte if none has arrived; for an unplugged port it raises an
                # OSError.
                return self._stream.read(self._stream.in_waiting)
            else:
                return b""
        except BlockingIOError:
            return b""
        except OSError as error:
            raise self._handle_loss(error) from error
        if not data:
            raise self.read_error(0)
        return data

    def read_error(self, number: int) -> LinkError:
        """Return the LinkError for a failed read.

        Args:
            number: The errno of the read; 0 if it returned no byte because the stream ended.
        """
        return self._handle_loss(OSError(number, os.strerror(number)) if number else END_OF_STREAM)

    def write(self, data: bytes) -> None:
        """Send bytes without blocking. Those that the kernel does not accept now wait for `flush`.

        Raises:
            LinkError: With the kind `overflow`: more than `MAX_UNSENT` bytes would wait, because
                the hub does not read. With the kind `lost`: sending failed, because the other end
                was unplugged or closed the connection.
        """
        if len(self._out) + len(data) > MAX_UNSENT:
            raise LinkError(
                f"{self.path}: the hub has not read the last {len(self._out)} bytes "
                f"(limit {MAX_UNSENT}): check flow control, or replug it",
                "overflow",
            )
        self._out += data
        self.flush()

    def flush(self) -> None:
        """Send as many of the waiting bytes as the kernel accepts, without blocking.

        Raises:
            LinkError: With the kind `lost`: sending failed, because the other end was unplugged or
                closed the connection.
        """
        try:
            while self._out:
                if self.HAS_DESCRIPTORS:
                    sent = os.write(self._fd, self._out)
                elif isinstance(self._stream, socket.socket):
                    sent = self._stream.send(self._out)
                elif self._stream is not None:
                    sent = self._stream.write(self._out) or 0
                else:
                    return
                self.bytes_out += sent
                del self._out[:sent]
        except BlockingIOError:
            pass
        except OSError as error:
            raise self._handle_loss(error) from error

    def is_draining(self) -> bool:
        """Return whether written bytes still wait in this process or in the kernel's serial driver.

        For TCP the result is False, because the kernel sends the rest after closing.
        """
        if self._stream is None or isinstance(self._stream, socket.socket):
            return False
        try:
            return bool(self._out) or self._stream.out_waiting > 0
        except OSError:
            return False

    def close(self) -> None:
        """Close the port at once, in any state of the link; a second call does nothing.

        A frame that was received in part is discarded and increases the decoder's counter
        `framing`.
        """
        if self._connecting is not None:
            self._connecting.close()
            self._connecting = None
        if self._stream is not None:
            if self.is_draining() and not isinstance(self._stream, socket.socket):
                # The bytes that the hub has not read are discarded. Otherwise the kernel would
                # block in close for up to 30 s to send them.
                with contextlib.suppress(OSError, _find_terminal_error()):
                    self._stream.reset_output_buffer()
            with contextlib.suppress(OSError):
                self._stream.close()
            self._stream = None
            self.decoder.reset()
        self._fd = -1
        self._out.clear()

    def increase_pause(self) -> float:
        """Return the pause before the next attempt to open the link, and double it for later.

        The pauses are 0.25, 0.5, 1 … at most 5 s (serial) or 1.5 s (TCP).
        """
        pause = self._pause
        self._pause = min(2 * pause, MAX_TCP_PAUSE_S if self._tcp else MAX_PAUSE_S)
        return pause

    def reset_pause(self) -> None:
        """Set the pause before the next attempt to open the link to the shortest one.

        It is called when the hub has answered or the device file of the port has changed.
        """
        self._pause = MIN_PAUSE_S

    def skip_match(self) -> None:
        """Make the next attempt begin with the next path that matches the pattern of the port.

        It is called when the path that is open now does not lead to the expected hub.
        """
        self._first_match += 1

    def identify_ports(self) -> tuple[object, ...]:
        """Return the identities (path, inode, device, permissions) of the files at the port's path.

        If they differ from those of an earlier call, a hub was plugged in or the permissions were
        changed, and the port is worth trying at once. For TCP the result is empty.
        """
        if self._tcp:
            return ()
        return tuple(_identify_file(path) for path in self._find_matches())

    def _find_matches(self) -> list[str]:
        """Return the paths that match the configured port: one, unless it is a pattern."""
        if not self.is_pattern:
            return [self.config.port]
        return sorted(glob.glob(self.config.port))  # noqa: PTH207  (Path.glob takes no absolute pattern)

    def _open_serial(self) -> None:
        """Open the first path of the port's pattern that can be opened, from `_first_match` on.

        If none can be opened, the error of the last one is raised.
        """
        paths = self._find_matches()
        error = LinkError(
            f"no port matches {self.config.port}: plug the hub in or correct the pattern",
            "no_port",
        )
        for i in range(len(paths)):
            self.path = paths[(self._first_match + i) % len(paths)]
            try:
                self._stream = _open_port(self.path, self.config.baud)
                self._first_match += i
                return
            except LinkError as failure:
                error = failure
        raise error

    def _open_tcp(self) -> None:
        """Begin or continue a TCP connection; `_stream` is set once it is made."""
        if self._connecting is None:
            self._connecting = TcpConnection(self.config.port)
        try:
            self._stream = self._connecting.poll()
        except LinkError:
            self._connecting = None
            raise
        if self._stream is not None:
            self._connecting = None

    def _handle_loss(self, error: OSError) -> LinkError:
        """Return the LinkError of the kind `lost` for a failed read or write of the port."""
        reason = error.strerror or str(error)
        return LinkError(
            f"{self.path}: connection lost ({reason}): replug the hub, "
            "the link opens again by itself",
            "lost",
        )


def explain_open_error(path: str, error: BaseException) -> LinkError:
    """Return the LinkError, with its fix, for a failed attempt to open a serial port.

    Args:
        path: Path of the port.
        error: The exception that opening raised.
    """
    code = getattr(error, "errno", None)
    for source in (error, error.__context__):
        # An error of the terminal (termios.error) has no attribute `errno`. It comes from pyserial
        # unchanged or as the context of another error.
        if code is None and isinstance(source, _find_terminal_error()):
            code = source.args[0]
    if code in _OPEN_ERRORS:
        kind, fix = _OPEN_ERRORS[code]
        return LinkError(f"{path}: {os.strerror(code)}: {fix}", kind)
    return LinkError(f"{path}: cannot open it ({error}): correct the port", "bad_port")


def _find_terminal_error() -> type[Exception]:
    """Return the class of errors of the terminal, termios.error; OSError where Python has none."""
    try:
        import termios
    except ImportError:  # Windows
        return OSError
    return termios.error


def _open_port(path: str, baud: int) -> serial.Serial:
    """Open one serial port for this process only; raise LinkError if that fails."""
    import serial

    try:
        # inter_byte_timeout=0 makes pyserial set the terminal's VMIN to 1. Then reading a port
        # without data fails with EAGAIN, and an empty result always means an unplugged hub.
        port = serial.Serial(
            path,
            baud,
            timeout=0,
            write_timeout=0,
            inter_byte_timeout=0,
            exclusive=True,
        )
    except (OSError, _find_terminal_error()) as error:
        raise explain_open_error(path, error) from error
    except ValueError as error:
        kind = "bad_baud" if "baud" in str(error).lower() else "bad_port"
        raise LinkError(
            f"{path} at {baud} baud: {error}: correct the port or the baud rate",
            kind,
        ) from error
    with contextlib.suppress(ValueError, AttributeError, NotImplementedError, OSError):
        port.set_low_latency_mode(True)
    return port


def _identify_file(path: str) -> tuple[object, ...] | None:
    """Return path, inode, device number and permissions of a file; None if it does not exist."""
    try:
        status = Path(path).stat()
    except OSError:
        return None
    # Permissions are included, because a change of them may make it possible to open the port.
    permissions = status.st_mode, status.st_uid, status.st_gid
    return path, status.st_ino, status.st_rdev, permissions
