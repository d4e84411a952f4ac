"""Serial ports of this machine, and which of them answer as hubs."""

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
"""How long a hub may take to say who it is."""
DEMO_PORTS = "cube_demo_*/ports/*"
"""Pseudo-terminals of demos that run, below the folder for temporary files."""


@dataclass
class Port:
    """hello: of the hub that answered; problem: why the port could not be asked."""

    path: str
    description: str = ""
    hello: Hello | None = None
    problem: str = ""


def find_ports() -> list[Port]:
    """Serial ports that there are, and those of a demo that runs; nothing is opened."""
    ports = [
        Port(found.device, "" if found.description in (None, "n/a") else found.description)
        for found in list_ports.comports()
    ]
    of_demo = sorted(Path(tempfile.gettempdir()).glob(DEMO_PORTS))
    ports += [Port(str(path), "demo") for path in of_demo if path.is_symlink()]
    return ports


def ask_ports(ports: list[Port]) -> None:
    """Ask all ports at once who is there, and wait for answers. Sends nothing but the question."""
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
    """Until every link has answered, or ANSWER_S are over."""
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
