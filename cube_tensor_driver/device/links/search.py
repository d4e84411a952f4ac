# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Search for the serial ports of this machine, and for the hubs connected to them."""

from __future__ import annotations

import select
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
    links: dict[int, tuple[Link, Port]] = {}
    question = encode(Request(Command.HELLO))
    try:
        for port in ports:
            try:
                link = Link(LinkConfig(port.path, port.path))
                link.open()
                links[link.fileno()] = link, port
                link.write(question)
            except LinkError as error:
                port.problem = str(error)
        _listen(links)
    finally:
        for link, _ in links.values():
            link.close()


def _listen(links: dict[int, tuple[Link, Port]]) -> None:
    """Read the links until a HELLO has come from each, for at most `ANSWER_S`.

    Args:
        links: Each open link and its port, by file descriptor.
    """
    until = time.monotonic() + ANSWER_S
    waiting = set(links)
    while waiting and (left := until - time.monotonic()) > 0:
        for number in select.select(waiting, [], [], left)[0]:
            link, port = links[number]
            try:
                frames = link.decoder.feed(link.read())
            except LinkError as error:
                port.problem = str(error)
                waiting.discard(number)
                continue
            for frame in frames:
                if isinstance(frame, Hello):
                    port.hello = frame
                    waiting.discard(number)
