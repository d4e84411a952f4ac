"""The DDS domain of this process and of those that it starts."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager

from ..core.errors import ConfigError

VARIABLE = "ROS_DOMAIN_ID"
"""Environment variable with the number of the domain."""

RANGE_VARIABLE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
"""Environment variable that says how far nodes look for each other."""

MAX_DOMAIN = 232
"""Highest domain. The UDP ports of higher ones do not exist."""

MAX_OWN_DOMAIN = 100
"""Highest domain that `own_domain` takes. The system gives the ports of higher ones to anybody."""

FIRST_PORT = 7400
"""First UDP port of domain 0 (DDSI-RTPS 9.6.2)."""

PORTS_PER_DOMAIN = 250
"""Number of UDP ports of a domain (DDSI-RTPS 9.6.2)."""

FREE_OFFSET = 5
"""Offset, within a domain's ports, of one that DDS never uses."""

PARTICIPANT_OFFSET = 10
"""Offset, within a domain's ports, of the one that DDS binds for its first participant."""


def check_domain() -> None:
    """Raise ConfigError if ROS_DOMAIN_ID names no DDS domain.

    The middleware would fail later, and not say why.
    """
    text = os.environ.get(VARIABLE, "")
    try:
        is_domain = not text or 0 <= int(text) <= MAX_DOMAIN
    except ValueError:
        is_domain = False
    if not is_domain:
        raise ConfigError(f"{VARIABLE} is {text!r}, allowed: 0 to {MAX_DOMAIN}; set it or unset it")


@contextmanager
def own_domain() -> Iterator[int]:
    """Give this process and those that it starts a DDS domain that nobody on this host uses.

    The domain is kept to this host.

    Raises:
        ConfigError: All domains are in use.
    """
    domain, claim = _claim_domain()
    # The domain holds for the block, so the variables are restored.
    before = {name: os.environ.get(name) for name in (VARIABLE, RANGE_VARIABLE)}
    os.environ.update({VARIABLE: str(domain), RANGE_VARIABLE: "LOCALHOST"})
    try:
        yield domain
    finally:
        for name, value in before.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value
        claim.close()


def _claim_domain() -> tuple[int, socket.socket]:
    """Return a domain without nodes, and the socket that keeps others of us out of it."""
    for domain in range(MAX_OWN_DOMAIN, 0, -1):
        claim = _bind(domain, FREE_OFFSET)
        # Another process of ours has claimed the domain.
        if claim is None:
            continue
        # Where a node runs, it has bound the port of the first participant.
        participant = _bind(domain, PARTICIPANT_OFFSET)
        if participant is not None:
            participant.close()
            return domain, claim
        claim.close()
    raise ConfigError(f"all {MAX_OWN_DOMAIN} DDS domains of this host are in use; end some nodes")


def _bind(domain: int, offset: int) -> socket.socket | None:
    """Return a socket on one UDP port of a domain, or None if somebody has the port."""
    bound = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        bound.bind(("", FIRST_PORT + PORTS_PER_DOMAIN * domain + offset))
    except OSError:
        bound.close()
        return None
    return bound
