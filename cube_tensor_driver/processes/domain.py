"""The DDS domain of this process and of those that it starts."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager

from ..core.errors import ConfigError

VARIABLE = "ROS_DOMAIN_ID"
RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
HIGHEST = 232
"""The UDP ports of higher domains do not exist."""
HIGHEST_OWN = 100
"""The ports of higher domains are those that the system gives to anybody."""
FIRST_PORT, PORTS = 7400, 250
"""The first UDP port of domain 0, and how many each domain has (DDSI-RTPS 9.6.2)."""
FREE_OFFSET, PARTICIPANT_OFFSET = 5, 10
"""Among a domain's ports: one that DDS never uses, and the one of its first participant."""


def check_domain() -> None:
    """Raise ConfigError if ROS_DOMAIN_ID names no DDS domain: the middleware would fail later,
    and not say why."""
    text = os.environ.get(VARIABLE, "")
    try:
        fits = not text or 0 <= int(text) <= HIGHEST
    except ValueError:
        fits = False
    if not fits:
        raise ConfigError(f"{VARIABLE} is {text!r}, allowed: 0 to {HIGHEST}; set it or unset it")


@contextmanager
def own_domain() -> Iterator[int]:
    """A DDS domain that nobody on this host uses, for this process and those that it starts, kept
    to this host. ConfigError: all are in use."""
    domain, claim = _claim_domain()
    before = {name: os.environ.get(name) for name in (VARIABLE, RANGE)}
    os.environ.update({VARIABLE: str(domain), RANGE: "LOCALHOST"})
    try:
        yield domain
    finally:
        _restore(before)
        claim.close()


def _claim_domain() -> tuple[int, socket.socket]:
    """A silent domain, and what keeps others of us out of it until it is closed."""
    for domain in range(HIGHEST_OWN, 0, -1):
        claim = _bind(domain, FREE_OFFSET)
        # DDS binds the port of its first participant, so nobody else can.
        participant = claim and _bind(domain, PARTICIPANT_OFFSET)
        if claim and participant:
            participant.close()
            return domain, claim
        if claim:
            claim.close()
    raise ConfigError(f"all {HIGHEST_OWN} DDS domains of this host are in use; end some nodes")


def _bind(domain: int, offset: int) -> socket.socket | None:
    """One UDP port of a domain; None if somebody has it."""
    bound = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        bound.bind(("", FIRST_PORT + PORTS * domain + offset))
    except OSError:
        bound.close()
        return None
    return bound


def _restore(variables: dict[str, str | None]) -> None:
    for name, value in variables.items():
        if value is None:
            os.environ.pop(name, None)
        else:
            os.environ[name] = value
