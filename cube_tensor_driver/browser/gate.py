"""Which requests the page's server answers: those of this machine's browser for this page.

The server listens on this machine only, but any page of the internet that is open in a browser here
could talk to it: by its address, or by a name that leads to this machine (DNS rebinding). viser has
no setting against that. Its server is made by `websockets.asyncio.server.serve`, which is wrapped
here for the moment of its making.
"""

from __future__ import annotations

import http
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlsplit

import websockets.asyncio.server
from websockets import Headers
from websockets.http11 import Request, Response

HOSTS = ("127.0.0.1", "localhost", "::1")
"""A tunnel (ssh -L) has another port, but one of these names too."""


def refusal(host: str, origin: str | None) -> str:
    """Why a request with these headers is refused; empty if it is not.

    Programs send no Origin; they are no browser that somebody else's page controls.
    """
    try:
        name = urlsplit(f"//{host}").hostname
    except ValueError:
        name = None
    if name not in HOSTS:
        return f"host {host!r}, allowed: {', '.join(HOSTS)}"
    if origin is not None and origin not in (f"http://{host}", f"https://{host}"):
        return f"origin {origin!r}, allowed: http://{host}"
    return ""


@contextmanager
def guarded_server() -> Iterator[None]:
    """A websocket server that is started meanwhile refuses what `refusal` names."""
    serve: Callable[..., Any] = websockets.asyncio.server.serve

    def guarded(*arguments: Any, process_request: Callable[..., Any], **options: Any) -> Any:
        def check(connection: Any, request: Request) -> Any:
            problem = refusal(request.headers.get("Host", ""), request.headers.get("Origin"))
            if problem:
                text = f"refused: {problem}\n".encode()
                return Response(http.HTTPStatus.FORBIDDEN, "Forbidden", Headers(), text)
            return process_request(connection, request)

        return serve(*arguments, process_request=check, **options)

    websockets.asyncio.server.serve = guarded  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        websockets.asyncio.server.serve = serve  # type: ignore[assignment, misc]
