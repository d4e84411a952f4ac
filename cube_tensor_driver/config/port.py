"""The texts that say where a hub is: device paths, patterns of them, and TCP addresses."""

from __future__ import annotations

from urllib.parse import urlsplit

TCP = "socket://"
ALLOWED = "a device path, a pattern such as /dev/ttyACM*, or socket://host:port"


def tcp_address(url: str) -> tuple[str, int] | None:
    """Host and port of ``socket://host:port``, IPv6 hosts in brackets; None: it is something
    else."""
    try:
        parts = urlsplit(url)
        host, port = parts.hostname, parts.port
    except ValueError:
        return None
    is_more = parts.path.strip("/") or parts.query or parts.fragment or "@" in parts.netloc
    if not url.startswith(TCP) or not host or not port or is_more:
        return None
    return host, port


def port_problem(port: str) -> str:
    """What is wrong with a port, in words, with what is allowed; empty if nothing is.

    Other URLs that pyserial knows are refused: some of them write files or connect to where the
    skin file did not say.
    """
    if not port.strip() or not port.isprintable():
        return f"found {port!r}, allowed: {ALLOWED}"
    if port.startswith(TCP):
        if tcp_address(port) is None:
            return (
                f"{port!r} is no TCP address: write socket://host:port with a port from 1 to 65535"
            )
    elif "://" in port:
        return f"found {port!r}, allowed: {ALLOWED}; other URLs are not opened"
    return ""
