"""Which requests the page's server answers.

On this machine alone: those of this machine's browser for this page. Any page of the internet that
is open in a browser here could talk to the server too: by its address, or by a name that leads to
this machine (DNS rebinding). On other addresses: those of a browser that was given the token.

viser has no setting for either. Its server is made by `websockets.asyncio.server.serve`, which is
wrapped here for the moment of its making.
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

HOSTS = ("127.0.0.1", "localhost", "::1")
"""A tunnel (ssh -L) has another port, but one of these names too."""
TOKEN_IS_MISSING = (
    "this page is for those who have its token; "
    "open the whole address that ./cube view printed, with ?token=… at its end"
)


def refusal(host: str, origin: str | None, *, local: bool = True) -> str:
    """Why a request with these headers is refused; empty if it is not.

    local: the server listens on this machine only. Programs send no Origin; they are no browser
    that somebody else's page controls.
    """
    if local and _split(host)[0] not in HOSTS:
        return f"host {host!r}, allowed: {', '.join(HOSTS)}"
    if origin is not None and origin not in (f"http://{host}", f"https://{host}"):
        return f"origin {origin!r}, allowed: http://{host}"
    return ""


def check_host(host: str) -> None:
    """ConfigError: a server cannot listen there.

    viser would take that for a port that is taken, and wait for ever.
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
    """A websocket server that is started meanwhile refuses what `refusal` names.

    token: what a browser needs, once in the address (?token=…) and from then on as a cookie, which
    its websocket sends too; empty: the server listens on this machine only.
    """
    serve: Callable[..., Any] = websockets.asyncio.server.serve

    def guarded(*arguments: Any, process_request: Callable[..., Any], **options: Any) -> Any:
        def check(connection: Any, request: Request) -> Any:
            host = request.headers.get("Host", "")
            problem = refusal(host, request.headers.get("Origin"), local=not token)
            if problem:
                return _refused(problem)
            cookie = f"cube_view_{_split(host)[1]}={token}"
            if not token or _has(request.headers.get("Cookie", "").split("; "), cookie):
                return process_request(connection, request)
            if not _has(parse_qs(request.path.partition("?")[2]).get("token", []), token):
                return _refused(TOKEN_IS_MISSING)
            answer = process_request(connection, request)
            if answer is not None:
                answer.headers["Set-Cookie"] = f"{cookie}; HttpOnly; SameSite=Lax"
            return answer

        return serve(*arguments, process_request=check, **options)

    websockets.asyncio.server.serve = guarded  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        websockets.asyncio.server.serve = serve  # type: ignore[assignment, misc]


def _split(host: str) -> tuple[str | None, int | None]:
    """Name and port of a Host header. Browsers share cookies between all ports of a name, so the
    cookie's name has the port."""
    try:
        parts = urlsplit(f"//{host}")
        return parts.hostname, parts.port
    except ValueError:
        return None, None


def _has(found: list[str], wanted: str) -> bool:
    """Whether one is equal; how long it takes does not tell how much of it is right."""
    return any(
        hmac.compare_digest(text.encode(errors="replace"), wanted.encode()) for text in found
    )


def _refused(problem: str) -> Response:
    headers = Headers({"Content-Type": "text/plain; charset=utf-8"})
    text = f"refused: {problem}\n".encode()
    return Response(http.HTTPStatus.FORBIDDEN, "Forbidden", headers, text)
