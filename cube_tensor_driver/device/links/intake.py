"""Reading and decoding of all links that are ready, in one step.

With the wire module in C it is a single call for all links, during which other threads run.
"""

from __future__ import annotations

import errno
from collections.abc import Callable, Sequence

from ...core.errors import LinkError
from ..wire.decoder import NativeDecoder, unpack_all
from ..wire.native import wire
from ..wire.protocol import Frame
from .link import Link

ReadResult = list[Frame] | LinkError | None
"""Result of reading one link: the frames that its bytes complete, the error by which the link is
lost, or None if there were no bytes."""


def read_links(
    links: Sequence[Link],
    clock_ns: Callable[[], int],
) -> tuple[int, list[ReadResult]]:
    """Read each link once and decode its bytes.

    Args:
        links: Links that are ready to be read.
        clock_ns: The clock of arrivals.

    Returns:
        The time after reading, which no byte came after, and the result of each link.
    """
    pairs = [
        (link.decoder.wire, link.fileno())
        for link in links
        if isinstance(link.decoder, NativeDecoder)
    ]
    if wire is None or len(pairs) < len(links):
        return _read_in_python(links, clock_ns)

    arrival_ns, counts = wire.read_links(pairs, clock_ns)
    results: list[ReadResult] = []
    for link, (count, raws) in zip(links, counts, strict=True):
        if count > 0:
            results.append(unpack_all(raws))
        elif count == -errno.EAGAIN:
            results.append(None)
        else:
            results.append(link.read_error(-count))
    return arrival_ns, results


def _read_in_python(
    links: Sequence[Link],
    clock_ns: Callable[[], int],
) -> tuple[int, list[ReadResult]]:
    """Read each link once and decode its bytes, without the wire module in C."""
    reads: list[bytes | LinkError] = []
    for link in links:
        try:
            reads.append(link.read())
        except LinkError as error:
            reads.append(error)

    # The clock is read before decoding, which takes time, and after the last byte has come.
    arrival_ns = clock_ns()
    results: list[ReadResult] = []
    for link, data in zip(links, reads, strict=True):
        if isinstance(data, LinkError):
            results.append(data)
        else:
            results.append(link.decoder.feed(data) if data else None)
    return arrival_ns, results
