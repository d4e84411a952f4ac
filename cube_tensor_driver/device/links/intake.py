"""Reading and decoding of all links that have data, in one step.

With the wire module in C, a single call reads and decodes all links without Python's global
interpreter lock, so that other threads can run meanwhile.
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
"""Result of reading one link once: the frames that the read bytes complete, the error that shows
that the link is lost, or None if there were no bytes to read."""


def read_links(
    links: Sequence[Link],
    clock_ns: Callable[[], int],
) -> tuple[int, list[ReadResult]]:
    """Read each link once and decode its bytes.

    Args:
        links: Links that have data to read.
        clock_ns: Clock of the arrival times, in ns.

    Returns:
        Arrival time of the bytes, in ns, which is read from the clock after the last byte; and the
        result of each link, in order.
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
    """Read each link once and decode its bytes in Python; see `read_links`."""
    reads: list[bytes | LinkError] = []
    for link in links:
        try:
            reads.append(link.read())
        except LinkError as error:
            reads.append(error)

    # The clock is read after all links, so that no byte arrives after this time, and before the
    # decoding, which would delay it.
    arrival_ns = clock_ns()
    results: list[ReadResult] = []
    for link, data in zip(links, reads, strict=True):
        if isinstance(data, LinkError):
            results.append(data)
        else:
            results.append(link.decoder.feed(data) if data else None)
    return arrival_ns, results
