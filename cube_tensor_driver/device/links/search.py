"""Search for the serial ports of this machine and for the hubs behind them."""

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
"""Time that a hub may take to identify itself, in s."""
DEMO_PORTS = "cube_demo_*/ports/*"
"""Pattern of the pseudo-terminals of running demos, in the folder for temporary files."""


@dataclass
class Port:
    """A port of this machine.

    Attributes:
        path: Device path.
        description: Description by the system; empty if there is none.
        hello: Answer of the hub; None if there was none.
        problem: Why the port could not be asked; empty if it could.
    """

    path: str
    description: str = ""
    hello: Hello | None = None
    problem: str = ""


def find_ports() -> list[Port]:
    """Return the serial ports of the machine and of running demos, without opening any."""
    ports: list[Port] = []
    for found in list_ports.comports():
        has_description = found.description not in (None, "n/a")
        ports.append(Port(found.device, found.description if has_description else ""))
    folder = Path(tempfile.gettempdir())
    for path in sorted(folder.glob(DEMO_PORTS)):
        # Simulated hubs put symbolic links to their pseudo-terminals there.
        if path.is_symlink():
            ports.append(Port(str(path), "demo"))
    return ports


def ask_ports(ports: list[Port]) -> None:
    """Send the request HELLO to all ports at once and wait for the answers.

    Args:
        ports: The ports, to which the answers and problems are added.
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
    """Wait until every link has answered, for at most `ANSWER_S`."""
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
