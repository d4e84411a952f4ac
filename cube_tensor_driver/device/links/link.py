"""One link: a byte stream from and to a hub over a serial port, a pseudo-terminal or TCP.

Nothing here blocks, has a thread or knows a frame; `session.py` drives it. Serial ports are opened
by pyserial, by their path only, and read with ``os.read``, which gives up to 4 kB per call. What
goes wrong is a `LinkError`. Its `kind` is one word, its text names the fix:

    no_port  no_permission  busy  not_serial  bad_port  bad_baud      opening a serial port
    refused  no_answer  unreachable  unresolved                       opening a TCP link
    lost  overflow                                                    while open
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
from .tcp import Connecting

READ_CHUNK = 1 << 16
"""Bytes read from one link at a time, so that a link that floods does not hold up the others."""
OUT_LIMIT = 4096
"""Bytes that may wait to be sent."""
BACKOFF_S = (0.25, 5.0)
"""Shortest and longest pause between two attempts to open a link."""
BACKOFF_TCP_S = 1.5
"""Longest pause for TCP. Nothing announces that a TCP peer is back, and a link shall be back within
2 s."""

END_OF_STREAM = OSError(errno.EIO, "end of stream")

_NO_PERMISSION = (
    "add yourself to the group dialout (sudo usermod -aG dialout $USER) and log in again"
)
_OPEN_ERRORS = {
    errno.ENOENT: ("no_port", "plug the hub in or correct the port"),
    errno.ENXIO: ("no_port", "nothing is behind this port: plug the hub in or correct the port"),
    errno.ENODEV: ("no_port", "nothing is behind this port: plug the hub in or correct the port"),
    errno.EIO: ("no_port", "nothing is behind this port: plug the hub in or correct the port"),
    errno.EACCES: ("no_permission", _NO_PERMISSION),
    errno.EPERM: ("no_permission", _NO_PERMISSION),
    errno.EBUSY: ("busy", "another program has it open: end that one (fuser -v shows which)"),
    errno.EAGAIN: ("busy", "another program has it open: end that one (fuser -v shows which)"),
    errno.ENOTTY: ("not_serial", "this is no serial port: correct the port"),
    errno.EINVAL: ("not_serial", "this is no serial port: correct the port"),
    errno.EISDIR: ("not_serial", "this is no serial port: correct the port"),
    errno.ENOTDIR: ("not_serial", "this is no serial port: correct the port"),
}


class LinkState(str, Enum):
    """closed: not in use. waiting: not open, tried again and again. open: the port is open.
    silent: open, but no sample for max(3 sample periods, 0.2 s) although samples were asked for."""

    CLOSED = "closed"
    WAITING = "waiting"
    OPEN = "open"
    SILENT = "silent"


@dataclass(frozen=True)
class LinkConfig:
    """Where a hub is.

    port: device path or ``socket://host:port``; other URLs are refused. A device path may be a
    pattern such as ``/dev/ttyACM*``: its matches are tried one after the other, which finds a
    hub that comes back under another name.
    baud: ignored by USB and TCP.
    hub_uid: the hub that must answer; None for any.
    is_simulated: a simulator that may start later makes the port. It is no news that the port is
        missing until then.
    """

    name: str
    port: str
    baud: int = 921_600
    hub_uid: int | None = None
    is_simulated: bool = False


class Link:
    """One link, opened and closed many times.

    state, error: set by the session.
    period_problem: set by the session: what the hub made of the sample period, if that is wrong.
    decoder, hello, counters: kept over reconnects; hello is the hub's last, None before the first.
    """

    def __init__(self, config: LinkConfig) -> None:
        """LinkError `bad_port`: neither a device path nor a TCP address."""
        self.config = config
        self.state = LinkState.CLOSED
        self.error: LinkError | None = None
        self.decoder = Decoder()
        self.hello: Hello | None = None
        self.opened = self.lost = self.silences = self.before_hello = self.bytes_out = 0
        self.period_problem = ""
        self.path = config.port
        self.is_pattern = "://" not in config.port and glob.has_magic(config.port)
        self._tcp = config.port.startswith(TCP)
        self._stream: serial.Serial | socket.socket | None = None
        self._connecting: Connecting | None = None
        self._fd = -1
        self._out = bytearray()
        self._backoff = BACKOFF_S[0]
        self._first_candidate = 0  # which match of the pattern to try first
        problem = port_problem(config.port)
        if problem:
            raise LinkError(f"link {config.name!r}: port: {problem}", "bad_port")

    @property
    def counters(self) -> dict[str, int]:
        """The decoder's counters, and how often the link was opened, lost and silent.

        before_hello: samples not delivered because the hub had not said yet who it is.
        """
        names = ("opened", "lost", "silences", "before_hello", "bytes_out")
        return {**self.decoder.counters.as_dict(), **{name: getattr(self, name) for name in names}}

    @property
    def is_open(self) -> bool:
        return self._stream is not None

    @property
    def unsent(self) -> bool:
        """Whether bytes wait in our buffer for room in the kernel's."""
        return bool(self._out)

    def fileno(self) -> int:
        return self._fd

    def open(self) -> bool:
        """Take one step towards an open link. True: it is open. False: a TCP connection is under
        way; call again.

        LinkError: this attempt failed.
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
        """The bytes that one call gives, at most READ_CHUNK; b"" if there are none.

        A tty gives 4 kB at a time. Asking again at once would mean waiting until the kernel has
        fetched the next 4 kB; it does so while the other links are read.
        LinkError `lost`: the other end is gone.
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
        """The LinkError for a read that failed with this error number; 0: the stream ended."""
        return self._lost(OSError(number, os.strerror(number)) if number else END_OF_STREAM)

    def write(self, data: bytes) -> None:
        """Send without blocking. Bytes that the kernel does not accept now wait for `flush`.

        LinkError `overflow`: more than OUT_LIMIT bytes would wait, because the hub does not read.
        LinkError `lost`: the other end is gone.
        """
        if len(self._out) + len(data) > OUT_LIMIT:
            raise LinkError(
                f"{self.path}: the hub has not read the last {len(self._out)} bytes "
                f"(limit {OUT_LIMIT}): check flow control, or replug it",
                "overflow",
            )
        self._out += data
        self.flush()

    def flush(self) -> None:
        """Send bytes that wait, as many as the kernel accepts. LinkError `lost`."""
        try:
            while self._out:
                sent = os.write(self._fd, self._out)
                self.bytes_out += sent
                del self._out[:sent]
        except BlockingIOError:
            pass
        except OSError as error:
            raise self._lost(error) from error

    def draining(self) -> bool:
        """Whether bytes have not left this machine's serial port yet."""
        if self._tcp or self._stream is None:
            return False
        try:
            (waiting,) = struct.unpack("i", fcntl.ioctl(self._fd, termios.TIOCOUTQ, b"\0" * 4))
        except OSError:
            return False
        return bool(self._out) or waiting > 0

    def close(self) -> None:
        """Close at once, in any state. Safe to call twice. An unfinished frame counts as
        framing."""
        if self._connecting is not None:
            self._connecting.close()
            self._connecting = None
        if self._stream is not None:
            if self.draining():
                # Otherwise the kernel waits for up to 30 s for a hub that does not read.
                with contextlib.suppress(termios.error):
                    termios.tcflush(self._fd, termios.TCOFLUSH)
            with contextlib.suppress(OSError):
                self._stream.close()
            self._stream = None
            self.decoder.reset()
        self._fd = -1
        self._out.clear()

    def next_pause(self) -> float:
        """Seconds until the next attempt: 0.25, 0.5, 1 … 5 (TCP 1.5)."""
        pause = self._backoff
        self._backoff = min(2 * pause, BACKOFF_TCP_S if self._tcp else BACKOFF_S[1])
        return pause

    def reset_pause(self) -> None:
        """The hub answered: after the next loss, begin with the shortest pause again."""
        self._backoff = BACKOFF_S[0]

    def next_candidate(self) -> None:
        """The port that was opened is not the right one: try the next match of the pattern
        first."""
        self._first_candidate += 1

    def fingerprint(self) -> tuple[object, ...]:
        """Which files the port's path leads to now. After a change, trying again at once is worth
        it."""
        if self._tcp:
            return ()
        return tuple(_identity(path) for path in self._candidates())

    def _candidates(self) -> list[str]:
        if not self.is_pattern:
            return [self.config.port]
        return sorted(glob.glob(self.config.port))  # noqa: PTH207  (Path.glob takes no absolute pattern)

    def _open_serial(self) -> None:
        paths = self._candidates()
        error = LinkError(
            f"no port matches {self.config.port}: plug the hub in or correct the pattern", "no_port"
        )
        for i in range(len(paths)):
            self.path = paths[(self._first_candidate + i) % len(paths)]
            try:
                self._stream = _open_port(self.path, self.config.baud)
                self._first_candidate += i
                return
            except LinkError as failure:
                error = failure
        raise error

    def _open_tcp(self) -> None:
        if self._connecting is None:
            self._connecting = Connecting(self.config.port)
        try:
            self._stream = self._connecting.poll()
        except LinkError:
            self._connecting = None
            raise
        if self._stream is not None:
            self._connecting = None

    def _lost(self, error: OSError) -> LinkError:
        reason = error.strerror or str(error)
        return LinkError(
            f"{self.path}: connection lost ({reason}): replug the hub, "
            "the link opens again by itself",
            "lost",
        )


def open_error(path: str, error: BaseException) -> LinkError:
    """The LinkError for a failed attempt to open `path`."""
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
    try:
        # inter_byte_timeout=0 sets VMIN to 1: then reading an empty port gives EAGAIN, and b""
        # always means unplugged.
        port = serial.Serial(path, baud, timeout=0, inter_byte_timeout=0, exclusive=True)
    except (OSError, termios.error) as error:
        raise open_error(path, error) from error
    except ValueError as error:
        kind = "bad_baud" if "baud" in str(error).lower() else "bad_port"
        raise LinkError(
            f"{path} at {baud} baud: {error}: correct the port or the baud rate", kind
        ) from error
    with contextlib.suppress(ValueError, AttributeError, NotImplementedError, OSError):
        port.set_low_latency_mode(True)
    return port


def _identity(path: str) -> tuple[object, ...] | None:
    try:
        status = Path(path).stat()
    except OSError:
        return None
    return path, status.st_ino, status.st_rdev, status.st_mode, status.st_uid, status.st_gid
