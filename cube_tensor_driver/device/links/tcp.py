# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""TCP connections that are made without blocking the caller.

pyserial could open ``socket://`` URLs, too, but blocks for up to 5 s while it looks up the name of
the host and connects. One thread reads all links, and would not read the others in this time.
"""

from __future__ import annotations

import contextlib
import errno
import os
import socket
import threading
import time
from typing import Any

from ...config.port import port_problem, tcp_address
from ...core.errors import LinkError

CONNECT_TIMEOUT_S = 2.0
"""Longest time, in s, to wait for a TCP connection to each address of the host. The limit is needed
because a host that is switched off does not answer at all, not even to refuse the connection."""


def parse_url(url: str) -> tuple[str, int]:
    """Return host and port number of ``socket://host:port``; an IPv6 host stands in brackets.

    Raises:
        LinkError: With the kind `bad_port`: the text is not such a URL.
    """
    address = tcp_address(url)
    if address is None:
        raise LinkError(port_problem(url), "bad_port")
    return address


class TcpConnection:
    """One attempt to connect. The caller repeats `poll` until it returns the socket or raises.

    The name of the host is looked up in a thread of its own, because the resolver of the system can
    block for half a minute and cannot be cancelled. Numeric hosts need no thread.

    Args:
        url: ``socket://host:port``.

    Raises:
        LinkError: With the kind `bad_port`: the text is not such a URL.
    """

    def __init__(self, url: str) -> None:
        self._url = url
        self._host, self._port = parse_url(url)
        self._addresses: list[Any] | None = None
        self._socket: socket.socket | None = None
        self._deadline = 0.0
        self._error: LinkError | None = None
        try:
            self._addresses = self._look_up(socket.AI_NUMERICHOST)
        except socket.gaierror:
            threading.Thread(
                target=self._resolve, name=f"resolve {self._host}", daemon=True
            ).start()

    def poll(self) -> socket.socket | None:
        """Return the connected, non-blocking socket; None while the connection is being made.

        Raises:
            LinkError: The name of the host was not found, or none of its addresses accepted the
                connection within `CONNECT_TIMEOUT_S`.
        """
        if self._addresses is None:
            if self._error:
                raise self._error
            return None
        while True:
            if self._socket is None:
                if not self._addresses:
                    raise self._error or LinkError(
                        f"{self._url}: {self._host} has no address", "unresolved"
                    )
                self._start(self._addresses.pop(0))
            if self._socket is not None:
                code = self._socket.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
                if code:
                    self._fail(code)
                elif self._is_connected():
                    connected, self._socket = self._socket, None
                    connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                    return connected
                elif time.monotonic() > self._deadline:
                    self._fail(errno.ETIMEDOUT)
                else:
                    return None

    def close(self) -> None:
        """Close the socket of the attempt; a second call does nothing."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _look_up(self, flags: int) -> list[Any]:
        """Return the addresses of the host, as `socket.getaddrinfo` gives them.

        Args:
            flags: Flags of `socket.getaddrinfo`; with AI_NUMERICHOST no name server is asked.
        """
        return list(
            socket.getaddrinfo(self._host, self._port, type=socket.SOCK_STREAM, flags=flags)
        )

    def _resolve(self) -> None:
        """Look up the name of the host and store its addresses or the error.

        This method runs in a thread of its own, because the look-up can block.
        """
        try:
            self._addresses = self._look_up(0)
        except (OSError, UnicodeError) as error:
            self._error = LinkError(
                f"{self._url}: cannot find the host {self._host!r} ({error}): "
                "correct the name, use its number, or check the network",
                "unresolved",
            )

    def _start(self, address: Any) -> None:
        """Begin to connect to one address, an entry of `socket.getaddrinfo`."""
        family, kind, protocol, _, target = address
        try:
            self._socket = socket.socket(family, kind | socket.SOCK_NONBLOCK, protocol)
            self._deadline = time.monotonic() + CONNECT_TIMEOUT_S
            code = self._socket.connect_ex(target)
        except OSError as error:
            code = error.errno or errno.EIO
        if code not in (0, errno.EINPROGRESS):
            self._fail(code)

    def _is_connected(self) -> bool:
        """Return whether the connection has been made, so that the socket has a peer address."""
        with contextlib.suppress(OSError):
            return self._socket is not None and bool(self._socket.getpeername())
        return False

    def _fail(self, code: int) -> None:
        """Close the socket to one address and store the error; `poll` tries the next address.

        Args:
            code: The errno with which the connection failed.
        """
        self.close()
        if code == errno.ECONNREFUSED:
            kind, fix = "refused", "start the bridge there or correct the port"
        elif code == errno.ETIMEDOUT:
            kind, fix = "no_answer", "switch the bridge on, or check the address and the network"
        else:
            kind, fix = "unreachable", "check the address and the network"
        self._error = LinkError(f"{self._url}: {os.strerror(code)}: {fix}", kind)
