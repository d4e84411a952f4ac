# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Links over real pseudo-terminals and local TCP sockets; what cannot be provoked as root goes
through errno."""

from __future__ import annotations

import contextlib
import errno
import os
import select
import socket
import termios
import time
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest
import serial

from conftest import open_files
from cube_tensor_driver.core.errors import LinkError
from cube_tensor_driver.device.links import tcp
from cube_tensor_driver.device.links.link import (
    MAX_UNSENT,
    READ_CHUNK,
    Link,
    LinkConfig,
    explain_open_error,
)

WAIT_S = 5.0


def until(condition, what: str) -> None:
    """Poll what has no event to wait for; the bound only ends a failing test."""
    give_up = time.monotonic() + WAIT_S
    while not condition():
        if time.monotonic() > give_up:
            raise TimeoutError(what)
        select.select([], [], [], 0.001)


def opened(link: Link) -> Link:
    until(link.open, f"{link.config.port} did not open")
    return link


def readable(link: Link) -> bytes:
    ready, _, _ = select.select([link], [], [], WAIT_S)
    if not ready:
        raise TimeoutError("nothing to read")
    return link.read()


@pytest.fixture
def pty() -> Iterator[tuple[int, str]]:
    master, slave = os.openpty()
    tty.setraw(slave)
    yield master, os.ttyname(slave)
    for fd in (master, slave):
        with contextlib.suppress(OSError):
            os.close(fd)


@pytest.fixture
def server() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        yield listening


def url(server: socket.socket) -> str:
    return f"socket://127.0.0.1:{server.getsockname()[1]}"


def test_pty_both_ways(pty: tuple[int, str]) -> None:
    master, path = pty
    link = opened(Link(LinkConfig("a", path)))
    assert link.read() == b""
    os.write(master, bytes(range(256)))
    assert readable(link) == bytes(range(256))
    link.write(b"\0\r\n\x03\x11")
    assert os.read(master, 100) == b"\0\r\n\x03\x11"
    assert link.counters["bytes_out"] == 5
    link.close()
    link.close()
    assert not link.is_open


def test_pty_unplugged_is_lost(pty: tuple[int, str]) -> None:
    master, path = pty
    link = opened(Link(LinkConfig("a", path)))
    os.write(master, b"last words")
    os.close(master)
    got = b""
    with pytest.raises(LinkError, match="connection lost") as lost:
        while True:
            got += readable(link)
    assert lost.value.kind == "lost"
    # The kernel may drop what an unplugged port held; what it hands over must not be lost by us.
    assert got in (b"", b"last words")
    link.close()


def test_tcp_both_ways_and_lost(server: socket.socket) -> None:
    link = opened(Link(LinkConfig("a", url(server))))
    peer, _ = server.accept()
    with peer:
        with socket.socket(fileno=os.dup(link.fileno())) as same:
            assert same.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY), (
                "requests must not be held back"
            )
        peer.sendall(b"hello")
        assert readable(link) == b"hello"
        link.write(b"answer")
        assert peer.recv(100) == b"answer"
        peer.sendall(b"last words")
    until(lambda: select.select([link], [], [], 0)[0], "end of stream")
    assert link.read() == b"last words"
    with pytest.raises(LinkError, match="connection lost") as lost:
        link.read()
    assert lost.value.kind == "lost"
    link.close()


def test_links_without_file_descriptors(
    pty: tuple[int, str], server: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on Windows, pyserial and the socket move the bytes and tell that the other end is gone."""
    monkeypatch.setattr(Link, "HAS_DESCRIPTORS", False)
    master, path = pty
    port, tcp_link = opened(Link(LinkConfig("a", path))), opened(Link(LinkConfig("b", url(server))))
    peer, _ = server.accept()
    ends = [
        (port, lambda data: os.write(master, data), lambda: os.read(master, 100)),
        (tcp_link, peer.sendall, lambda: peer.recv(100)),
    ]
    for link, send, receive in ends:
        assert link.fileno() == -1 and link.read() == b""
        send(bytes(range(256)))
        got = bytearray()
        until(lambda got=got, link=link: got.extend(link.read()) or len(got) == 256, "256 bytes")
        assert bytes(got) == bytes(range(256))
        link.write(b"\0\r\n\x03\x11")
        assert receive() == b"\0\r\n\x03\x11" and link.counters["bytes_out"] == 5
    os.close(master)
    peer.close()
    for link in (port, tcp_link):
        with pytest.raises(LinkError, match="connection lost") as lost:
            until(link.read, "lost")
        assert lost.value.kind == "lost"
        link.close()


def test_read_takes_much_but_lets_others_in(server: socket.socket) -> None:
    link = opened(Link(LinkConfig("a", url(server))))
    peer, _ = server.accept()
    peer.setblocking(False)
    data = os.urandom(4 * READ_CHUNK)
    sent, got = 0, b""
    while len(got) < len(data):
        with contextlib.suppress(BlockingIOError):
            sent += peer.send(data[sent:]) if sent < len(data) else 0
        piece = readable(link)
        assert 0 < len(piece) <= READ_CHUNK
        got += piece
    assert got == data
    peer.close()
    link.close()


def test_output_is_bounded(server: socket.socket) -> None:
    link = opened(Link(LinkConfig("a", url(server))))
    peer, _ = server.accept()  # and never read
    with peer, pytest.raises(LinkError, match=rf"limit {MAX_UNSENT}") as full:
        for _ in range(1_000_000):
            link.write(b"x" * 1000)
    assert full.value.kind == "overflow"
    assert link.unsent
    link.close()
    assert not link.unsent


def test_close_discards_what_the_hub_does_not_read(pty: tuple[int, str], monkeypatch) -> None:
    """Else the kernel waits up to 30 s in closing a real serial port; for a pseudo-terminal it
    never does."""
    flushed = []
    monkeypatch.setattr(termios, "tcflush", lambda fd, which: flushed.append(which))
    link = opened(Link(LinkConfig("a", pty[1])))
    link.close()
    assert flushed == [termios.TCIFLUSH]  # by pyserial, when it opened the port
    link = opened(Link(LinkConfig("a", pty[1])))
    with pytest.raises(LinkError):
        while True:
            link.write(b"x" * 1000)
    link.close()
    assert flushed[-1] == termios.TCOFLUSH


def test_half_a_frame_at_the_end_is_counted(pty: tuple[int, str]) -> None:
    link = opened(Link(LinkConfig("a", pty[1])))
    link.decoder.feed(b"\0half a fra")
    link.close()
    assert link.counters["framing"] == 1


@pytest.mark.parametrize(
    ("port", "kind", "words"),
    [
        ("/nowhere/ttyACM0", "no_port", "plug the hub in"),
        ("/dev/null", "not_serial", "no serial port"),
        ("/dev", "not_serial", "no serial port"),
        (__file__, "not_serial", "no serial port"),
        ("/nowhere/tty*", "no_port", "no port matches /nowhere/tty"),
    ],
)
def test_open_errors(port: str, kind: str, words: str) -> None:
    link = Link(LinkConfig("a", port))
    with pytest.raises(LinkError, match=words) as failed:
        link.open()
    assert failed.value.kind == kind
    assert not link.is_open


NEVER = [
    "",
    "socket://",
    "socket://host",
    "socket://host:0",
    "socket://host:99999",
    "socket://[::1:5",
    "socket://somebody@host:5",
    "socket://host:5?logging=debug",
    "SOCKET://host:5",
    "loop://",
    "spy:///dev/null?file=/nowhere/log",
    "rfc2217://127.0.0.1:5",
    "hwgrep://.*",
    "alt:///dev/null?class=VTIMESerial",
    "nothing://x",
    "/dev/tty\nACM0",
]


@pytest.mark.parametrize("port", NEVER)
def test_port_that_can_never_be(port: str) -> None:
    with pytest.raises(LinkError) as failed:
        Link(LinkConfig("a", port))
    assert failed.value.kind == "bad_port"
    assert "\n" not in str(failed.value)


def test_bad_baud(pty: tuple[int, str]) -> None:
    with pytest.raises(LinkError, match="-5") as failed:
        Link(LinkConfig("a", pty[1], baud=-5)).open()
    assert failed.value.kind == "bad_baud"


@pytest.mark.skipif(
    os.geteuid() == 0, reason="root may open every port; see test_classified_by_errno"
)
def test_no_permission(pty: tuple[int, str]) -> None:
    Path(pty[1]).chmod(0)
    with pytest.raises(LinkError, match="dialout") as failed:
        Link(LinkConfig("a", pty[1])).open()
    assert failed.value.kind == "no_permission"


@pytest.mark.parametrize(
    ("code", "kind", "words"),
    [
        (errno.EACCES, "no_permission", "dialout"),
        (errno.EPERM, "no_permission", "dialout"),
        (errno.EBUSY, "busy", "fuser"),
        (errno.ENXIO, "no_port", "plug"),
        (errno.EIO, "no_port", "plug"),
        (errno.EXDEV, "bad_port", "correct the port"),
    ],
)
def test_classified_by_errno(code: int, kind: str, words: str) -> None:
    error = explain_open_error("/dev/ttyX", serial.SerialException(code, "could not open port"))
    assert error.kind == kind
    assert words in str(error)
    assert "/dev/ttyX" in str(error)


def test_classified_through_termios() -> None:
    """pyserial hides the number of what termios reports in the exception's context."""
    try:
        try:
            raise termios.error(errno.ENOTTY, "Inappropriate ioctl for device")
        except termios.error as inner:
            raise serial.SerialException(f"Could not configure port: {inner}")  # noqa: B904  (as pyserial does)
    except serial.SerialException as error:
        assert explain_open_error("x", error).kind == "not_serial"


@pytest.mark.parametrize("function", ["tcsetattr", "tcflush"])
def test_a_hub_unplugged_while_its_port_is_opened(
    function: str, pty: tuple[int, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """pyserial passes on what these two report, and it is no OSError."""

    def gone(*_: object) -> None:
        raise termios.error(errno.EIO, "Input/output error")

    monkeypatch.setattr(termios, function, gone)
    with pytest.raises(LinkError, match="plug the hub in") as failed:
        Link(LinkConfig("a", pty[1])).open()
    assert failed.value.kind == "no_port"


def test_tcp_refused(server: socket.socket) -> None:
    port = url(server)
    server.close()
    link = Link(LinkConfig("a", port))
    with pytest.raises(LinkError, match="start the bridge") as failed:
        opened(link)
    assert failed.value.kind == "refused"


def test_tcp_unresolved(monkeypatch: pytest.MonkeyPatch) -> None:
    """The resolver is replaced: a real one may need the network, or take half a minute."""

    def no_such_host(*arguments: object) -> list[object]:
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(tcp.socket, "getaddrinfo", no_such_host)
    with pytest.raises(LinkError, match=r"'nohost\.invalid'.*correct the name") as failed:
        opened(Link(LinkConfig("a", "socket://nohost.invalid:5")))
    assert failed.value.kind == "unresolved"


def test_tcp_tries_every_address(server: socket.socket, monkeypatch: pytest.MonkeyPatch) -> None:
    """A name with a dead first address, like localhost with nobody on ::1."""
    with socket.create_server(("127.0.0.1", 0)) as dead:
        dead_address = dead.getsockname()
    good = server.getsockname()
    found = [
        (socket.AF_INET, socket.SOCK_STREAM, 0, "", address) for address in (dead_address, good)
    ]
    monkeypatch.setattr(tcp.socket, "getaddrinfo", lambda *a, **o: list(found))
    opened(Link(LinkConfig("a", f"socket://name:{good[1]}"))).close()


def test_tcp_no_answer(deaf: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tcp, "CONNECT_TIMEOUT_S", 0.05)
    with pytest.raises(LinkError, match="switch the bridge on") as failed:
        opened(Link(LinkConfig("a", deaf)))
    assert failed.value.kind == "no_answer"


def test_pauses_double_up_to_the_limit() -> None:
    usb = Link(LinkConfig("a", "/dev/x"))
    assert [usb.increase_pause() for _ in range(7)] == [0.25, 0.5, 1.0, 2.0, 4.0, 5.0, 5.0]
    usb.reset_pause()
    assert usb.increase_pause() == 0.25
    tcp_link = Link(LinkConfig("a", "socket://127.0.0.1:1"))
    assert [tcp_link.increase_pause() for _ in range(5)] == [0.25, 0.5, 1.0, 1.5, 1.5]


def test_pattern_tries_the_matches_in_turn(tmp_path: Path, pty: tuple[int, str]) -> None:
    (tmp_path / "hub0").write_bytes(b"")
    (tmp_path / "hub1").symlink_to(pty[1])
    link = Link(LinkConfig("a", str(tmp_path / "hub*")))
    assert opened(link).path == str(tmp_path / "hub1")
    link.close()
    other_master, other_slave = os.openpty()
    (tmp_path / "hub2").symlink_to(os.ttyname(other_slave))
    link.skip_match()
    assert opened(link).path == str(tmp_path / "hub2")
    link.close()
    os.close(other_master)
    os.close(other_slave)


def test_fingerprint_changes_with_the_port(tmp_path: Path, pty: tuple[int, str]) -> None:
    port = tmp_path / "hub"
    link = Link(LinkConfig("a", str(port)))
    gone = link.identify_ports()
    port.symlink_to(pty[1])
    there = link.identify_ports()
    assert there != gone
    Path(pty[1]).chmod(Path(pty[1]).stat().st_mode ^ 0o004)
    assert link.identify_ports() != there
    port.unlink()
    assert link.identify_ports() == gone


def test_no_file_is_left_open(pty: tuple[int, str]) -> None:
    before = open_files()
    for port in (pty[1], "/dev/null", "/nowhere") * 5:
        link = Link(LinkConfig("a", port))
        with contextlib.suppress(LinkError):
            link.open()
        link.close()
    assert open_files() == before
