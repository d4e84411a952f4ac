# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Search for the serial ports of this machine, and for the hubs connected to them."""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from serial.tools import list_ports

from ...core.errors import LinkError
from ..wire.protocol import Command, Hello, Request, encode
from .link import Link, LinkConfig

ANSWER_S = 1.0
"""Longest time, in s, to wait for the answer of a hub to the request HELLO (identify yourself)."""
ASK_PERIOD_S = 0.005
"""Time, in s, between two looks at the ports for an answer."""
DEMO_PORTS = "cube_demo_*/ports/*"
"""Pattern of the paths of the simulated serial ports of running demos, relative to the system's
folder for temporary files."""


@dataclass
class Port:
    """A serial port of this machine, and the hub that answered there.

    Attributes:
        path: Device path.
        description: Description by the operating system; empty if there is none.
        hello: HELLO frame by which the hub identified itself; None without an answer.
        problem: Text of the error if the port could not be opened, read or written; else empty.
    """

    path: str
    description: str = ""
    hello: Hello | None = None
    problem: str = ""


def find_ports() -> list[Port]:
    """Return the serial ports of this machine, and the simulated ports of running demos.

    No port is opened.
    """
    ports: list[Port] = []
    for found in list_ports.comports():
        has_description = found.description not in (None, "n/a")
        ports.append(Port(found.device, found.description if has_description else ""))
    folder = Path(tempfile.gettempdir())
    for path in sorted(folder.glob(DEMO_PORTS)):
        # A simulated hub makes a symbolic link to its pseudo-terminal. Other files are no ports.
        if path.is_symlink():
            ports.append(Port(str(path), "demo"))
    return ports


def ask_ports(ports: list[Port]) -> None:
    """Send the request HELLO to all ports, and wait up to `ANSWER_S` in total for the answers.

    Args:
        ports: The ports. The attribute `hello` or `problem` of each is set to the result.
    """
    links: list[tuple[Link, Port]] = []
    question = encode(Request(Command.HELLO))
    try:
        for port in ports:
            try:
                link = Link(LinkConfig(port.path, port.path))
                link.open()
                links.append((link, port))
                link.write(question)
            except LinkError as error:
                port.problem = str(error)
        _listen(links)
    finally:
        for link, _ in links:
            link.close()


def _listen(links: list[tuple[Link, Port]]) -> None:
    """Read the links until a HELLO has come from each, for at most `ANSWER_S`.

    Args:
        links: Each open link and its port.
    """
    until = time.monotonic() + ANSWER_S
    while links and time.monotonic() < until:
        links = [(link, port) for link, port in links if not _has_answered(link, port)]
        # Windows has no call that waits for serial ports and sockets together.
        time.sleep(ASK_PERIOD_S)


def _has_answered(link: Link, port: Port) -> bool:
    """Read a link, and return whether no further answer is expected from its hub.

    Then the hub has answered (`port.hello` is set) or reading has failed (`port.problem` is set).
    """
    try:
        frames = link.decoder.feed(link.read())
    except LinkError as error:
        port.problem = str(error)
        return True
    for frame in frames:
        if isinstance(frame, Hello):
            port.hello = frame
    return port.hello is not None
