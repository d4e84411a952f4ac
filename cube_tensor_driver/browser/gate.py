"""Which requests the server of the page answers.

A server that listens on this machine only answers a browser of this machine that shows this page.
Without a check, any page of the internet that is open in a browser here could talk to it: by its
address, or by a name that leads to this machine (DNS rebinding). A server on other addresses
answers browsers that were given its token.

viser (1.1) has no setting for either, no hook before the handshake, and its server is made inside
a private method by `websockets.asyncio.server.serve`. That name is therefore replaced while the
server is being made, and only then: `guarded_server`. Everything else would be larger: a proxy
leaves viser's own port open to other pages, and a subclass repeats 300 lines of private code.
"""

from __future__ import annotations

import hmac
import http
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import parse_qs, urlsplit

import websockets.asyncio.server
from websockets import Headers
from websockets.http11 import Request, Response

from ..core.errors import ConfigError

LOCAL_HOSTS = ("127.0.0.1", "localhost", "::1")
"""Names of this machine in a Host header. Through a tunnel (ssh -L) the port is another one, but
the name is one of these."""

MISSING_TOKEN = (
    "this page is for those who have its token; "
    "open the whole address that ./cube view printed, with ?token=… at its end"
)
"""Text for a browser without the token."""


def refusal(host: str, origin: str | None, *, local: bool = True) -> str:
    """Return why a request is refused, empty if it is not.

    Args:
        host: The Host header.
        origin: The Origin header; None: there is none, so that the request is not made by a script
            of somebody else's page.
        local: Whether the server listens on this machine only.
    """
    if local and _split(host)[0] not in LOCAL_HOSTS:
        return f"host {host!r}, allowed: {', '.join(LOCAL_HOSTS)}"
    if origin is not None and origin not in (f"http://{host}", f"https://{host}"):
        return f"origin {origin!r}, allowed: http://{host}"
    return ""


def check_host(host: str) -> None:
    """Check that a server can listen on an address.

    viser would take an address that it cannot have for a port in use, and wait for ever.

    Raises:
        ConfigError: The address is none of this machine.
    """
    try:
        for family, kind, _, _, address in socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM):
            with socket.socket(family, kind) as probe:
                probe.bind(address)
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ConfigError(
            f"--host {host}: {reason}; name an address of this machine, or 0.0.0.0 for all of them"
        ) from None


@contextmanager
def guarded_server(token: str = "") -> Iterator[None]:
    """Let a websocket server that is made in this block refuse what `refusal` names.

    Args:
        token: What a browser needs: once in the address (?token=…), and from then on as a cookie,
            which its websocket sends too. Empty: the server listens on this machine only.
    """
    serve: Callable[..., Any] = websockets.asyncio.server.serve

    def guarded_serve(*arguments: Any, process_request: Callable[..., Any], **options: Any) -> Any:
        def check(connection: Any, request: Request) -> Any:
            return _answer(connection, request, token, process_request)

        return serve(*arguments, process_request=check, **options)

    websockets.asyncio.server.serve = guarded_serve  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        websockets.asyncio.server.serve = serve  # type: ignore[assignment, misc]


def _answer(
    connection: Any, request: Request, token: str, process_request: Callable[..., Any]
) -> Any:
    """Answer a request: refuse it, or let viser answer it and add the cookie."""
    host = request.headers.get("Host", "")
    problem = refusal(host, request.headers.get("Origin"), local=not token)
    if problem:
        return _refused(problem)
    # Browsers share cookies between all ports of a host, so that the name contains the port.
    cookie = f"cube_view_{_split(host)[1]}={token}"
    cookies = request.headers.get("Cookie", "").split("; ")
    if not token or _contains(cookies, cookie):
        return process_request(connection, request)

    query = request.path.partition("?")[2]
    if not _contains(parse_qs(query).get("token", []), token):
        return _refused(MISSING_TOKEN)
    answer = process_request(connection, request)
    if answer is not None:
        answer.headers["Set-Cookie"] = f"{cookie}; HttpOnly; SameSite=Lax"
    return answer


def _split(host: str) -> tuple[str | None, int | None]:
    """Return name and port of a Host header, None where it is malformed."""
    try:
        parts = urlsplit(f"//{host}")
        return parts.hostname, parts.port
    except ValueError:
        return None, None


def _contains(texts: list[str], wanted: str) -> bool:
    """Return whether one text is equal, in a time that does not tell how much of it is right."""
    return any(
        hmac.compare_digest(text.encode(errors="replace"), wanted.encode()) for text in texts
    )


def _refused(problem: str) -> Response:
    headers = Headers({"Content-Type": "text/plain; charset=utf-8"})
    text = f"refused: {problem}\n".encode()
    return Response(http.HTTPStatus.FORBIDDEN, "Forbidden", headers, text)
