# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Ports: texts that state where a hub is connected.

A port is a device path, a pattern of device paths such as /dev/ttyACM*, or a TCP address.
"""

from __future__ import annotations

from urllib.parse import urlsplit

TCP = "socket://"
"""Prefix of a port that is a TCP address (socket://host:port), the same as in pyserial."""

ALLOWED = "a device path, a pattern such as /dev/ttyACM*, or socket://host:port"
"""Description of the texts that are allowed as the port of a link, for error messages."""


def parse_tcp_address(url: str) -> tuple[str, int] | None:
    """Return host and port number of ``socket://host:port``, or None if the text has another form.

    An IPv6 address must be written in brackets, as in ``socket://[::1]:7000``.
    """
    try:
        parts = urlsplit(url)
        host = parts.hostname
        port = parts.port
    except ValueError:
        return None

    # A URL with a path, a query or a user name is not the address of a hub.
    has_more = parts.path.strip("/") or parts.query or parts.fragment or "@" in parts.netloc
    if not url.startswith(TCP) or not host or not port or has_more:
        return None
    return host, port


def find_port_problem(port: str) -> str:
    """Return an error message for the text of a port, or "" if it is valid.

    URLs of pyserial other than socket:// are refused, because some of them write files or connect
    to a host that the skin file does not name.
    """
    if not port.strip() or not port.isprintable():
        return f"found {port!r}, allowed: {ALLOWED}"
    if port.startswith(TCP) and parse_tcp_address(port) is None:
        return f"{port!r} is no TCP address: write socket://host:port with a port from 1 to 65535"
    if "://" in port and not port.startswith(TCP):
        return f"found {port!r}, allowed: {ALLOWED}; other URLs are not opened"
    return ""
