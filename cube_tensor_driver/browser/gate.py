# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The server that browsers reach: it checks each request and passes it on to viser.

Without checks, any web page that is open in a browser on this machine could control the skin: it
could send requests to the address of the server, or to a name that leads to this machine (DNS
rebinding). Therefore requests that a page of another site makes are refused. In addition, a server
that only this machine can reach accepts no other host names than `LOCAL_HOSTS`, and a server that
other machines can reach answers only browsers that were given its token.

viser (1.1) has no setting for these checks. So viser listens at a secret address of this machine
(`make_secret_address`) and at a port that the system chooses, and `Gate` listens at the address of
the page. A page of another site would have to try 2^38 pairs of an address and a port to find
viser, or only the ports on a system such as macOS, which has no secret addresses. Other users of
this machine could look up address and port; they are trusted.
"""

from __future__ import annotations

import asyncio
import errno
import hmac
import http.client
import io
import ipaddress
import logging
import secrets
import socket
import threading
from concurrent.futures import Future
from contextlib import suppress
from urllib.parse import parse_qs, urlsplit

from ..core.errors import ConfigError

LOCAL_HOSTS = ("127.0.0.1", "localhost", "::1")
"""Names of this machine that may stand in the Host header of an HTTP request.

The port in the header is not compared, because a browser that connects through a tunnel (ssh -L)
sends the port of the tunnel.
"""

MISSING_TOKEN = (
    "this page is for those who have its token; "
    "open the whole address that ./cube view printed, with ?token=… at its end"
)
"""Text that a browser shows if its request contains neither the token nor the cookie with it."""

MAX_HEAD_S = 10.0
"""Maximum time, in seconds, from the beginning of a connection until the head of its request has
arrived. After this time the connection is closed."""

_log = logging.getLogger(__name__)

_CHUNK_BYTES = 1 << 18
"""Maximum number of bytes that are read at once, from the browser or from viser, and passed on."""


def make_secret_address(lowest: str = "127.1.0.1") -> str:
    """Return one of 2^23 addresses of this machine (127.x.x.x), chosen at random.

    If the system does not have that address, as macOS, which has only 127.0.0.1, a warning is
    logged and 127.0.0.1 is returned.

    Args:
        lowest: Lowest address that may be chosen.
    """
    address = str(ipaddress.ip_address(lowest) + secrets.randbelow(1 << 23))
    try:
        socket.create_server((address, 0)).close()
    except OSError:
        _log.warning(
            f"this system has no address {address}, so the view is less protected: a web page in "
            "a browser of this machine that tries all ports of 127.0.0.1 can reach it"
        )
        return "127.0.0.1"
    return address


def find_refusal(
    host: str,
    origin: str | None,
    *,
    local: bool = True,
) -> str:
    """Return why a request is refused, or an empty text if it is accepted.

    Args:
        host: Host header of the request: name and port of the server, as the browser sees them.
        origin: Origin header of the request: the site whose page makes it. None if it is missing,
            which means that no script of another site made the request.
        local: Whether the server listens on this machine only.
    """
    if local and _split(host)[0] not in LOCAL_HOSTS:
        return f"host {host!r}, allowed: {', '.join(LOCAL_HOSTS)}"
    if origin is not None and origin not in (f"http://{host}", f"https://{host}"):
        return f"origin {origin!r}, allowed: http://{host}"
    return ""


class Gate:
    """Server, in a thread of its own, that passes accepted requests on to the server behind it.

    It refuses a request for which `find_refusal` returns a reason, or which lacks a required token.
    The server behind it must answer only one request per connection, as viser does, because the
    gate checks only the first request of a connection.

    Attributes:
        port: TCP port on which the gate listens.
    """

    def __init__(
        self,
        host: str,
        port: int,
        token: str,
        inner: tuple[str, int],
    ) -> None:
        """Begin to listen.

        Args:
            host: Name or IP address on which the gate listens.
            port: TCP port; if it is in use, the next free one is taken. 0: any free port.
            token: Secret text that a browser must send: once in the address (?token=…), and from
                then on as a cookie. Empty if only this machine can reach the gate.
            inner: Address and port of the server behind the gate.

        Raises:
            ConfigError: This machine does not have the address, or the port cannot be opened.
        """
        self._token = token
        self._inner = inner
        started: Future[int] = Future()
        self._thread = threading.Thread(
            target=lambda: asyncio.run(self._run(host, port, started)),
            daemon=True,
        )
        self._thread.start()
        self.port = started.result()

    def close(self) -> None:
        """Stop to listen, and end all connections."""
        self._loop.call_soon_threadsafe(self._ended.set)
        self._thread.join()

    async def _run(
        self,
        host: str,
        port: int,
        started: Future[int],
    ) -> None:
        """Listen until `close` is called; set the result of `started` to the port."""
        self._loop = asyncio.get_running_loop()
        self._ended = asyncio.Event()
        try:
            server = await self._listen(host, port)
        # A host name with an empty or a too long part raises UnicodeError.
        except (OSError, UnicodeError) as error:
            reason = getattr(error, "strerror", None) or error
            mistake = ConfigError(
                f"--host {host}, --port {port}: {reason}; name an address of this machine, or "
                "0.0.0.0 for all of them, and a port that you may use"
            )
            started.set_exception(mistake)
            return
        started.set_result(server.sockets[0].getsockname()[1])
        await self._ended.wait()
        server.close()

    async def _listen(self, host: str, port: int) -> asyncio.Server:
        try:
            return await asyncio.start_server(self._answer, host, port)
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise
        return await self._listen(host, port + 1)

    async def _answer(
        self,
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
    ) -> None:
        """Answer one connection of a browser."""
        # `close` cancels connections; asyncio of Python 3.11 would print that as an error.
        with suppress(
            OSError,
            EOFError,
            asyncio.LimitOverrunError,
            asyncio.TimeoutError,
            asyncio.CancelledError,
        ):
            head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), MAX_HEAD_S)
            problem, cookie = self._check(head)
            if problem:
                text = f"refused: {problem}\n".encode()
                writer.write(
                    b"HTTP/1.1 403 Forbidden\r\nConnection: close\r\n"
                    b"Content-Type: text/plain; charset=utf-8\r\n\r\n" + text
                )
            else:
                inner_reader, inner_writer = await asyncio.open_connection(*self._inner)
                inner_writer.write(head)
                # The cookie is the first header after the status line of the answer.
                writer.write(await inner_reader.readline() + cookie)
                copies = _copy(reader, inner_writer), _copy(inner_reader, writer)
                await asyncio.gather(*copies)
        writer.close()

    def _check(self, head: bytes) -> tuple[str, bytes]:
        """Check the head of an HTTP request.

        Returns:
            Why the request is refused, empty if it is accepted; and a line that sets a cookie with
            the token, empty if the browser needs none.
        """
        request, _, fields = head.partition(b"\r\n")
        headers = http.client.parse_headers(io.BytesIO(fields))
        host = headers.get("Host", "")
        problem = find_refusal(
            host,
            headers.get("Origin"),
            local=not self._token,
        )
        # A browser sends a cookie to every port of a host. Two servers on one host therefore need
        # cookies with different names, and the name contains the port.
        cookie = f"cube_view_{_split(host)[1]}={self._token}"
        cookies = headers.get("Cookie", "").split("; ")
        if problem or not self._token or _contains(cookies, cookie):
            return problem, b""

        query = request.decode("latin-1").partition("?")[2].partition(" ")[0]
        if not _contains(parse_qs(query).get("token", []), self._token):
            return MISSING_TOKEN, b""
        return "", f"Set-Cookie: {cookie}; HttpOnly; SameSite=Lax\r\n".encode()


async def _copy(
    reader: asyncio.StreamReader,
    writer: asyncio.StreamWriter,
) -> None:
    """Pass bytes on until the connection ends at one side, then end it at the other side."""
    with suppress(OSError):
        while data := await reader.read(_CHUNK_BYTES):
            writer.write(data)
            # `drain` waits while the receiver does not read. Otherwise the data that wait for a
            # slow browser would fill the memory.
            await writer.drain()
    writer.close()


def _split(host: str) -> tuple[str | None, int | None]:
    """Return name and port of a Host header such as "localhost:8080"; None for a missing part.

    Both are None if the header is malformed.
    """
    try:
        parts = urlsplit(f"//{host}")
        return parts.hostname, parts.port
    except ValueError:
        return None, None


def _contains(texts: list[str], wanted: str) -> bool:
    """Return whether one of the texts is equal to the wanted one.

    The comparison always takes the same time, so an attacker cannot learn from its duration how
    many characters of a guessed token are right.

    Args:
        texts: Tokens or cookies that a browser has sent.
        wanted: The right token or cookie.
    """
    return any(
        hmac.compare_digest(text.encode(errors="replace"), wanted.encode()) for text in texts
    )
