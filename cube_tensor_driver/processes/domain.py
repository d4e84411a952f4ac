# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The DDS domain (number that separates groups of ROS nodes) of this process and its children."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager

from ..core.errors import ConfigError

VARIABLE = "ROS_DOMAIN_ID"
"""Name of the environment variable with the number of the DDS domain. ROS nodes find only nodes of
their own domain."""

RANGE_VARIABLE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
"""Name of the environment variable whose value, such as LOCALHOST, states where ROS nodes search
for each other."""

MAX_DOMAIN = 232
"""Largest number of a DDS domain. The UDP ports of larger ones would exceed 65535."""

MAX_OWN_DOMAIN = 100
"""Largest number of a DDS domain that `use_own_domain` chooses. Linux assigns the UDP ports of
higher domains (from 32768 up) to any program that asks for a free port."""

FIRST_PORT = 7400
"""First UDP port of DDS domain 0 (DDSI-RTPS 2.2, section 9.6.2)."""

PORTS_PER_DOMAIN = 250
"""Number of consecutive UDP ports of each DDS domain (DDSI-RTPS 2.2, section 9.6.2)."""

FREE_OFFSET = 5
"""Offset, from the first UDP port of a DDS domain, of a port that DDS does not use. Binding this
port reserves the domain among processes of this package."""

PARTICIPANT_OFFSET = 10
"""Offset, from the first UDP port of a DDS domain, of the port that the first DDS participant (ROS
process) in the domain binds. If the port is taken, a node runs in the domain."""


def check_domain() -> None:
    """Raise ConfigError if the environment variable ROS_DOMAIN_ID is no number of a DDS domain.

    Without this check the middleware would fail later, with a message that does not name the
    variable.
    """
    text = os.environ.get(VARIABLE, "")
    try:
        is_domain = not text or 0 <= int(text) <= MAX_DOMAIN
    except ValueError:
        is_domain = False
    if not is_domain:
        raise ConfigError(f"{VARIABLE} is {text!r}, allowed: 0 to {MAX_DOMAIN}; set it or unset it")


def is_domain_used() -> bool:
    """Return whether a ROS node of this host runs in the DDS domain of this process.

    It looks at the UDP port that the first node of a domain uses. The result is wrong if that node
    has ended while others run, or if another program uses the port.

    Raises:
        ConfigError: The environment variable ROS_DOMAIN_ID is no number of a DDS domain.
    """
    check_domain()
    socket_of_first = _bind(int(os.environ.get(VARIABLE) or 0), PARTICIPANT_OFFSET)
    if socket_of_first is not None:
        socket_of_first.close()
    return socket_of_first is None


@contextmanager
def use_own_domain() -> Iterator[int]:
    """Set, for a `with` block, a DDS domain that no other process on this host uses.

    The domain holds for this process and for those that it starts in the block. Their nodes are not
    visible to other hosts. Afterwards the environment variables are as before.

    Yields:
        The number of the domain.

    Raises:
        ConfigError: All domains up to `MAX_OWN_DOMAIN` are in use.
    """
    domain, claim = _claim_domain()
    # The values are saved, so that the end of the block can restore them.
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
    """Return a DDS domain without nodes, and the socket that reserves it while it is open.

    Raises:
        ConfigError: All domains up to `MAX_OWN_DOMAIN` are in use.
    """
    for domain in range(MAX_OWN_DOMAIN, 0, -1):
        claim = _bind(domain, FREE_OFFSET)
        # If the port is in use, another process of this package has reserved the domain.
        if claim is None:
            continue
        # If the port of the first participant is in use, a node runs in the domain.
        participant = _bind(domain, PARTICIPANT_OFFSET)
        if participant is not None:
            participant.close()
            return domain, claim
        claim.close()
    raise ConfigError(f"all {MAX_OWN_DOMAIN} DDS domains of this host are in use; end some nodes")


def _bind(domain: int, offset: int) -> socket.socket | None:
    """Return a socket bound to a UDP port of a DDS domain, or None if the port is in use.

    Args:
        domain: Number of the domain.
        offset: Offset of the port from the first one of the domain.
    """
    bound = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        bound.bind(("", FIRST_PORT + PORTS_PER_DOMAIN * domain + offset))
    except OSError:
        bound.close()
        return None
    return bound
