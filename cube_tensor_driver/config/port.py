"""Texts that say where a hub is: device paths, patterns of them, and TCP addresses."""

from __future__ import annotations

from urllib.parse import urlsplit

TCP = "socket://"
"""Prefix of a TCP address, as in pyserial."""

ALLOWED = "a device path, a pattern such as /dev/ttyACM*, or socket://host:port"


def tcp_address(url: str) -> tuple[str, int] | None:
    """Return host and port of ``socket://host:port``, or None if the text is something else.

    IPv6 hosts stand in brackets.
    """
    try:
        parts = urlsplit(url)
        host, port = parts.hostname, parts.port
    except ValueError:
        return None

    # A path or a user name shows that something else was meant.
    has_more = parts.path.strip("/") or parts.query or parts.fragment or "@" in parts.netloc
    if not url.startswith(TCP) or not host or not port or has_more:
        return None
    return host, port


def port_problem(port: str) -> str:
    """Return what is wrong with a port and what is allowed, or an empty text if nothing is wrong.

    Other URLs that pyserial knows are refused: some of them write files, or connect to a host that
    the skin file does not name.
    """
    if not port.strip() or not port.isprintable():
        return f"found {port!r}, allowed: {ALLOWED}"
    if port.startswith(TCP) and tcp_address(port) is None:
        return f"{port!r} is no TCP address: write socket://host:port with a port from 1 to 65535"
    if "://" in port and not port.startswith(TCP):
        return f"found {port!r}, allowed: {ALLOWED}; other URLs are not opened"
    return ""
