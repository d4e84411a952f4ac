"""One link: a byte stream to and from a hub over a serial port, a pseudo-terminal or TCP.

Nothing here blocks, starts a thread or knows frames; `session.py` controls a link. pyserial opens
serial ports by their path, and ``os.read`` reads them, up to 4 kB per call. Every failure is a
`LinkError`, whose `kind` is one word and whose text names the fix:

    no_port  no_permission  busy  not_serial  bad_port  bad_baud      opening a serial port
    refused  no_answer  unreachable  unresolved                       opening a TCP link
    lost  overflow                                                    while the link is open
    silent  wrong_hub                                                 found by the session
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import glob
import os
import socket
import struct
import termios
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

import serial

from ...config.port import TCP, port_problem
from ...core.errors import LinkError
from ..wire.decoder import Decoder
from ..wire.protocol import Hello
from .tcp import TcpConnection

READ_CHUNK = 1 << 16
"""Largest number of bytes read from one link at a time, so that a link that sends without pause
does not hold up the others."""
MAX_UNSENT = 4096
"""Largest number of bytes that may wait to be sent. They only accumulate if a hub does not read."""
MIN_PAUSE_S = 0.25
"""Pause after the first failed attempt to open a link. It doubles with each further attempt."""
MAX_PAUSE_S = 5.0
"""Longest pause between two attempts to open a serial port. Its device file announces a hub that is
plugged in again, and then the pause is over at once."""
MAX_TCP_PAUSE_S = 1.5
"""Longest pause between two attempts to open a TCP link. Nothing announces that a TCP peer is back,
and a link should be back within 2 s."""
END_OF_STREAM = OSError(errno.EIO, "end of stream")
"""Error of a read that returned no byte, although the port was ready."""

_NO_PERMISSION = (
    "add yourself to the group dialout (sudo usermod -aG dialout $USER) and log in again"
)
_NO_DEVICE = "nothing is behind this port: plug the hub in or correct the port"
_IN_USE = "another program has it open: end that one (fuser -v shows which)"
_NOT_SERIAL = "this is no serial port: correct the port"
_OPEN_ERRORS = {
    errno.ENOENT: ("no_port", "plug the hub in or correct the port"),
    errno.ENXIO: ("no_port", _NO_DEVICE),
    errno.ENODEV: ("no_port", _NO_DEVICE),
    errno.EIO: ("no_port", _NO_DEVICE),
    errno.EACCES: ("no_permission", _NO_PERMISSION),
    errno.EPERM: ("no_permission", _NO_PERMISSION),
    errno.EBUSY: ("busy", _IN_USE),
    errno.EAGAIN: ("busy", _IN_USE),
    errno.ENOTTY: ("not_serial", _NOT_SERIAL),
    errno.EINVAL: ("not_serial", _NOT_SERIAL),
    errno.EISDIR: ("not_serial", _NOT_SERIAL),
    errno.ENOTDIR: ("not_serial", _NOT_SERIAL),
}
"""Kind and fix of the errors of opening a serial port."""


class LinkState(str, Enum):
    """State of a link.

    CLOSED: it is not in use. WAITING: it is not open, and the next attempt to open it follows.
        OPEN:
    the port is open. SILENT: the port is open, but there was no sample for max(3 sample periods,
    0.2 s) although samples were requested.
    """

    CLOSED = "closed"
    WAITING = "waiting"
    OPEN = "open"
    SILENT = "silent"


@dataclass(frozen=True)
class LinkConfig:
    """Place and identity of a hub.

    Attributes:
        name: Name of the link in the skin file.
        port: Device path or ``socket://host:port``; other URLs are refused. A device path may be a
            pattern such as ``/dev/ttyACM*``: its matches are tried one after the other, which finds
            a hub that comes back under another name.
        baud: Baud rate of a serial adapter. USB and TCP ignore it.
        hub_uid: Unique number of the hub that must answer; None for any.
        is_simulated: Whether a simulator makes the port, perhaps later. Then a port that has never
            existed is not logged as missing.
    """

    name: str
    port: str
    baud: int = 921_600
    hub_uid: int | None = None
    is_simulated: bool = False


class Link:
    """One link, which can be opened and closed many times.

    Args:
        config: Place and identity of the hub.

    Attributes:
        state: State, which the session sets.
        error: Reason of the state, which the session sets; None if there is none.
        period_problem: What is wrong with the sample period of the hub, in words; set by the
            session.
        decoder: Decoder of the received bytes, kept when the link is reopened.
        hello: Last HELLO of the hub, kept when the link is reopened; None before the first.
        path: Path of the port that was opened last, one match if the port is a pattern.

    Raises:
        LinkError: `bad_port`: the port is neither a device path nor a TCP address.
    """

    def __init__(self, config: LinkConfig) -> None:
        self.config = config
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
        self._first_match = 0  # index of the match of the pattern to try first
        problem = port_problem(config.port)
        if problem:
            raise LinkError(f"link {config.name!r}: port: {problem}", "bad_port")

    @property
    def counters(self) -> dict[str, int]:
        """Counters of the decoder and of the link by name.

        opened, lost, silences: number of times the link was opened, lost, and became silent.
        before_hello: samples that were not delivered because the hub had not identified itself.
        """
        return {
            **self.decoder.counters.as_dict(),
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
        """Whether bytes wait here because the kernel's buffer is full."""
        return bool(self._out)

    def fileno(self) -> int:
        """Return the file descriptor of the open port; -1 if it is closed."""
        return self._fd

    def open(self) -> bool:
        """Take one step towards an open link.

        Returns:
            Whether the link is open; if not, a TCP connection is under way: call again.

        Raises:
            LinkError: This attempt failed.
        """
        if self._tcp:
            self._open_tcp()
        else:
            self._open_serial()
        if self._stream is None:
            return False
        self._fd = self._stream.fileno()
        self.opened += 1
        return True

    def read(self) -> bytes:
        """Return the bytes of one system call, at most `READ_CHUNK`; empty if there are none.

        A serial port gives 4 kB at a time. A second call at once would wait until the kernel has
        fetched the next 4 kB, which it does while the other links are read.

        Raises:
            LinkError: `lost`: the other end is gone.
        """
        try:
            data = os.read(self._fd, READ_CHUNK)
        except BlockingIOError:
            return b""
        except OSError as error:
            raise self._lost(error) from error
        if not data:
            raise self.read_error(0)
        return data

    def read_error(self, number: int) -> LinkError:
        """Return the LinkError for a read that failed with this errno; 0: the stream ended."""
        return self._lost(OSError(number, os.strerror(number)) if number else END_OF_STREAM)

    def write(self, data: bytes) -> None:
        """Send without blocking. Bytes that the kernel does not accept now wait for `flush`.

        Raises:
            LinkError: `overflow`: more than `MAX_UNSENT` bytes would wait, because the hub does not
                read. `lost`: the other end is gone.
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
        """Send the bytes that wait, as many as the kernel accepts.

        Raises:
            LinkError: `lost`: the other end is gone.
        """
        try:
            while self._out:
                sent = os.write(self._fd, self._out)
                self.bytes_out += sent
                del self._out[:sent]
        except BlockingIOError:
            pass
        except OSError as error:
            raise self._lost(error) from error

    def is_draining(self) -> bool:
        """Return whether bytes have not yet left this machine's serial port."""
        if self._tcp or self._stream is None:
            return False
        try:
            answer = fcntl.ioctl(self._fd, termios.TIOCOUTQ, bytes(4))
            (waiting,) = struct.unpack("i", answer)
        except OSError:
            return False
        return bool(self._out) or waiting > 0

    def close(self) -> None:
        """Close at once, in any state; a second call does nothing.

        An unfinished frame counts as `framing`.
        """
        if self._connecting is not None:
            self._connecting.close()
            self._connecting = None
        if self._stream is not None:
            if self.is_draining():
                # Without the flush, closing waits for up to 30 s until the hub has read the bytes.
                with contextlib.suppress(termios.error):
                    termios.tcflush(self._fd, termios.TCOFLUSH)
            with contextlib.suppress(OSError):
                self._stream.close()
            self._stream = None
            self.decoder.reset()
        self._fd = -1
        self._out.clear()

    def increase_pause(self) -> float:
        """Return the time until the next attempt, in s, and double it: 0.25, 0.5 … 5 (TCP: 1.5)."""
        pause = self._pause
        self._pause = min(2 * pause, MAX_TCP_PAUSE_S if self._tcp else MAX_PAUSE_S)
        return pause

    def reset_pause(self) -> None:
        """Begin with the shortest pause after the next loss, because the hub answered."""
        self._pause = MIN_PAUSE_S

    def skip_match(self) -> None:
        """Begin with the next match of the pattern, because the opened port is the wrong one."""
        self._first_match += 1

    def identify_ports(self) -> tuple[object, ...]:
        """Return which files the path of the port leads to now.

        After a change of them it is useful to try again at once.
        """
        if self._tcp:
            return ()
        return tuple(_identify_file(path) for path in self._matches())

    def _matches(self) -> list[str]:
        """Return the paths that match the port."""
        if not self.is_pattern:
            return [self.config.port]
        return sorted(glob.glob(self.config.port))  # noqa: PTH207  (Path.glob takes no absolute pattern)

    def _open_serial(self) -> None:
        """Open the first match that can be opened, beginning with `_first_match`."""
        paths = self._matches()
        error = LinkError(
            f"no port matches {self.config.port}: plug the hub in or correct the pattern", "no_port"
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
        """Begin or continue a TCP connection."""
        if self._connecting is None:
            self._connecting = TcpConnection(self.config.port)
        try:
            self._stream = self._connecting.poll()
        except LinkError:
            self._connecting = None
            raise
        if self._stream is not None:
            self._connecting = None

    def _lost(self, error: OSError) -> LinkError:
        """Return the LinkError for a connection that broke."""
        reason = error.strerror or str(error)
        return LinkError(
            f"{self.path}: connection lost ({reason}): replug the hub, "
            "the link opens again by itself",
            "lost",
        )


def explain_open_error(path: str, error: BaseException) -> LinkError:
    """Return the LinkError for a failed attempt to open `path`."""
    code = getattr(error, "errno", None)
    for source in (error, error.__context__):
        # pyserial passes on some errors of termios, and hides the number of others.
        if code is None and isinstance(source, termios.error):
            code = source.args[0]
    if code in _OPEN_ERRORS:
        kind, fix = _OPEN_ERRORS[code]
        return LinkError(f"{path}: {os.strerror(code)}: {fix}", kind)
    return LinkError(f"{path}: cannot open it ({error}): correct the port", "bad_port")


def _open_port(path: str, baud: int) -> serial.Serial:
    """Open and lock one serial port; raise LinkError if that fails."""
    try:
        # inter_byte_timeout=0 sets VMIN to 1. Then reading an empty port fails with EAGAIN, and an
        # empty result always means that the hub was unplugged.
        port = serial.Serial(path, baud, timeout=0, inter_byte_timeout=0, exclusive=True)
    except (OSError, termios.error) as error:
        raise explain_open_error(path, error) from error
    except ValueError as error:
        kind = "bad_baud" if "baud" in str(error).lower() else "bad_port"
        raise LinkError(
            f"{path} at {baud} baud: {error}: correct the port or the baud rate", kind
        ) from error
    with contextlib.suppress(ValueError, AttributeError, NotImplementedError, OSError):
        port.set_low_latency_mode(True)
    return port


def _identify_file(path: str) -> tuple[object, ...] | None:
    """Return path, inode, device and permissions of a file; None if it does not exist."""
    try:
        status = Path(path).stat()
    except OSError:
        return None
    # The permissions belong to it, because a change of them may allow to open the port.
    permissions = status.st_mode, status.st_uid, status.st_gid
    return path, status.st_ino, status.st_rdev, permissions
