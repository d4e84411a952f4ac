# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Which requests the server of the page answers.

A server that listens on this machine only answers a browser of this machine that shows this page.
Without a check, any page of the internet that is open in a browser here could talk to it: by its
address, or by a name that leads to this machine (DNS rebinding). A server on other addresses
answers browsers that were given its token.

viser (1.1) has no setting for these checks and calls no function of its user before the handshake.
A private method of viser makes the server with `websockets.asyncio.server.serve`. `guarded_server`
therefore replaces this function, only while the server is being made. Other solutions are worse: a
proxy leaves viser's own port open to other pages, and a subclass repeats 300 lines of private code.
"""

from __future__ import annotations

import hmac
import http
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from urllib.parse import parse_qs, urlsplit

import websockets.asyncio.server
from websockets import Headers
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

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


def refusal(
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


def check_host(host: str) -> None:
    """Check that a server can listen on an address.

    If this machine does not have the address, viser (the library of the page) would believe that
    the port is in use, and wait for ever.

    Args:
        host: Name or IP address.

    Raises:
        ConfigError: This machine does not have the address.
    """
    try:
        for family, kind, _, _, address in socket.getaddrinfo(
            host,
            0,
            type=socket.SOCK_STREAM,
        ):
            with socket.socket(family, kind) as probe:
                probe.bind(address)
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ConfigError(
            f"--host {host}: {reason}; name an address of this machine, or 0.0.0.0 for all of them"
        ) from None


ProcessRequest = Callable[[ServerConnection, Request], Response | None]
"""Function that answers an HTTP request, or returns None to continue with the websocket."""


@contextmanager
def guarded_server(token: str = "") -> Iterator[None]:
    """Make a websocket server that is created in this `with` block check each request.

    It refuses a request for which `refusal` returns a reason, or which lacks a required token.

    Args:
        token: Secret text that a browser must send: once in the address (?token=…), and from then
            on as a cookie. Empty if the server listens on this machine only and needs none.
    """
    serve: Callable[..., object] = websockets.asyncio.server.serve

    def guarded_serve(
        *arguments: object,
        process_request: ProcessRequest,
        **options: object,
    ) -> object:
        def check(connection: ServerConnection, request: Request) -> Response | None:
            return _answer(connection, request, token, process_request)

        return serve(*arguments, process_request=check, **options)

    websockets.asyncio.server.serve = guarded_serve  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        websockets.asyncio.server.serve = serve  # type: ignore[assignment, misc]


def _answer(
    connection: ServerConnection,
    request: Request,
    token: str,
    process_request: ProcessRequest,
) -> Response | None:
    """Refuse a request, or let viser answer it and add a cookie with the token to the answer.

    Args:
        connection: The connection, as the websockets library passes it.
        request: The HTTP request with which the connection begins.
        token: Secret text that browsers must send; empty if none is needed.
        process_request: Function of viser that answers the request.
    """
    host = request.headers.get("Host", "")
    problem = refusal(host, request.headers.get("Origin"), local=not token)
    if problem:
        return _make_refusal(problem)
    # A browser sends a cookie to every port of a host. Two servers on one host therefore need
    # cookies with different names, and the name contains the port.
    cookie = f"cube_view_{_split(host)[1]}={token}"
    cookies = request.headers.get("Cookie", "").split("; ")
    if not token or _contains(cookies, cookie):
        return process_request(connection, request)

    query = request.path.partition("?")[2]
    if not _contains(parse_qs(query).get("token", []), token):
        return _make_refusal(MISSING_TOKEN)
    answer = process_request(connection, request)
    if answer is not None:
        answer.headers["Set-Cookie"] = f"{cookie}; HttpOnly; SameSite=Lax"
    return answer


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


def _make_refusal(problem: str) -> Response:
    headers = Headers({"Content-Type": "text/plain; charset=utf-8"})
    text = f"refused: {problem}\n".encode()
    return Response(
        http.HTTPStatus.FORBIDDEN,
        "Forbidden",
        headers,
        text,
    )
