# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""TCP connections that are made without blocking the caller.

Looking up the name of a host can block for half a minute, and connecting for some seconds. One
thread reads all links, so it must not wait for that.
"""

from __future__ import annotations

import contextlib
import os
import socket
import threading

from ...config.port import find_port_problem, parse_tcp_address
from ...core.errors import LinkError

CONNECT_TIMEOUT_S = 2.0
"""Longest time, in s, to wait for a TCP connection to each address of the host. The limit is needed
because a host that is switched off does not answer at all, not even to refuse the connection."""


def parse_url(url: str) -> tuple[str, int]:
    """Return host and port number of ``socket://host:port``; an IPv6 host stands in brackets.

    Raises:
        LinkError: With the kind `bad_port`: the text is not such a URL.
    """
    address = parse_tcp_address(url)
    if address is None:
        raise LinkError(find_port_problem(url), "bad_port")
    return address


class TcpConnection:
    """One attempt to connect, in a thread of its own, to the addresses of a host in turn.

    The caller repeats `poll` until it returns the socket or raises.

    Args:
        url: ``socket://host:port``.

    Raises:
        LinkError: With the kind `bad_port`: the text is not such a URL.
    """

    def __init__(self, url: str) -> None:
        self._url = url
        self._address = parse_url(url)
        self._socket: socket.socket | None = None
        self._error: LinkError | None = None
        self._is_closed = False
        threading.Thread(target=self._connect, name=f"connect {url}", daemon=True).start()

    def poll(self) -> socket.socket | None:
        """Return the connected, non-blocking socket; None while the connection is being made.

        Raises:
            LinkError: The name of the host was not found, or none of its addresses accepted the
                connection within `CONNECT_TIMEOUT_S`.
        """
        if self._error is not None:
            raise self._error
        return self._socket

    def close(self) -> None:
        """Give up the attempt to connect; a second call does nothing."""
        self._is_closed = True
        if self._socket is not None:
            self._socket.close()

    def _connect(self) -> None:
        """Connect, and store the socket or the error for `poll`."""
        try:
            connected = socket.create_connection(self._address, CONNECT_TIMEOUT_S)
        except (OSError, UnicodeError) as error:
            self._error = self._explain(error)
            return
        with contextlib.suppress(OSError):  # the other end may have closed the connection already
            connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connected.setblocking(False)
        self._socket = connected
        # `close` may have been called before the socket was stored, and then has not closed it.
        if self._is_closed:
            connected.close()

    def _explain(self, error: Exception) -> LinkError:
        """Return the LinkError, with its fix, for a failed attempt to connect."""
        host, _ = self._address
        # The name of a host is encoded before it is looked up, which raises a UnicodeError for
        # names that no host can have.
        if isinstance(error, (socket.gaierror, UnicodeError)):
            return LinkError(
                f"{self._url}: cannot find the host {host!r} ({error}): "
                "correct the name, use its number, or check the network",
                "unresolved",
            )
        code = getattr(error, "errno", None)
        reason = str(error) if code is None else os.strerror(code)
        if isinstance(error, ConnectionRefusedError):
            kind = "refused"
            fix = "start the bridge there or correct the port"
        elif isinstance(error, TimeoutError):
            kind = "no_answer"
            fix = "switch the bridge on, or check the address and the network"
        else:
            kind = "unreachable"
            fix = "check the address and the network"
        return LinkError(f"{self._url}: {reason}: {fix}", kind)
