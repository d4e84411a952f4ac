"""What ready links have, in one go: read, and decoded to frames.

With the wire in C it is one call for all links, during which other threads run.
"""

from __future__ import annotations

import errno
from collections.abc import Callable, Sequence

from ...core.errors import LinkError
from ..wire.decoder import NativeDecoder, unpack_all
from ..wire.native import wire
from ..wire.protocol import Frame
from .link import Link

Intake = list[Frame] | LinkError | None
"""Of one link: the frames that its bytes complete; why it is lost; None: no bytes came."""


def take_in(links: Sequence[Link], clock_ns: Callable[[], int]) -> tuple[int, list[Intake]]:
    """Read each link once, and decode it.

    Returns the time after reading, before which all bytes came, and what each link gave.
    """
    pairs = [
        (link.decoder.wire, link.fileno())
        for link in links
        if isinstance(link.decoder, NativeDecoder)
    ]
    if wire is None or len(pairs) < len(links):
        return _take_in_python(links, clock_ns)
    arrival_ns, results = wire.read_links(pairs, clock_ns)
    taken: list[Intake] = []
    for link, (count, raws) in zip(links, results, strict=True):
        if count > 0:
            taken.append(unpack_all(raws))
        else:
            taken.append(None if count == -errno.EAGAIN else link.read_error(-count))
    return arrival_ns, taken


def _take_in_python(links: Sequence[Link], clock_ns: Callable[[], int]) -> tuple[int, list[Intake]]:
    reads: list[bytes | LinkError] = []
    for link in links:
        try:
            reads.append(link.read())
        except LinkError as error:
            reads.append(error)
    arrival_ns = clock_ns()
    taken: list[Intake] = []
    for link, data in zip(links, reads, strict=True):
        if isinstance(data, LinkError):
            taken.append(data)
        else:
            taken.append(link.decoder.feed(data) if data else None)
    return arrival_ns, taken
