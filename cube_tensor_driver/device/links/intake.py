"""Waiting for data of all links, reading and decoding them, in one step.

With the wire module in C, a single call does all of this without Python's global interpreter lock,
so that other threads can run meanwhile. It also counts and stamps usual samples (`LinkTrack`), for
which Python then has nothing left to do but to put them into rows.
"""

from __future__ import annotations

import ctypes
import select
from collections.abc import Callable, Sequence
from typing import NamedTuple

from ...core.errors import LinkError
from ..wire.decoder import NativeDecoder, unpack_all
from ..wire.native import wire
from ..wire.protocol import Frame
from .link import Link


class UsualSamples(NamedTuple):
    """Samples that are counted and stamped already, in the order of their arrival.

    Attributes:
        links: Index of the link of each sample.
        raws: Bytes of each sample, from its type to its CRC.
        stamps_ns: Host time at which each sample was taken, in ns since the Unix epoch.
    """

    links: list[int]
    raws: list[bytes]
    stamps_ns: list[int]


class LinkRead(NamedTuple):
    """Result of reading one link once, if it holds anything but usual samples.

    Attributes:
        link: Index of the link.
        arrival_ns: Host time, in ns, at which the bytes had arrived.
        result: The decoded frames, or the error that shows that the link is lost.
    """

    link: int
    arrival_ns: int
    result: list[Frame] | LinkError


class Intake:
    """Waits for data of links and reads them.

    Args:
        links: All links; those that are closed are not read.
        wake_fd: File descriptor of a pipe; a byte in it ends the wait.
        clock_ns: Clock of the arrival times, in ns. It is read after the bytes, so that no arrival
            time is earlier than the true one.
    """

    def __init__(
        self,
        links: Sequence[Link],
        wake_fd: int,
        clock_ns: Callable[[], int],
    ) -> None:
        self._links = links
        self._wake_fd = wake_fd
        self._clock_ns = clock_ns
        self.update()

    def update(self) -> None:
        """Take over which links are open. It is called after each opening and closing."""
        self._targets = [
            (link.decoder.wire, link.fileno(), ctypes.addressof(link.track))
            for link in self._links
            if isinstance(link.decoder, NativeDecoder)
        ]

    def read(
        self,
        timeout_s: float,
        gather_s: float,
        expected: int,
    ) -> tuple[bool, UsualSamples, list[LinkRead]]:
        """Read each link that has data once, and the others for a while.

        Args:
            timeout_s: Longest wait for data, in s.
            gather_s: Longest wait, in s, for frames of the other links after the first ones.
            expected: Number of links with frames at which this wait ends.

        Returns:
            Whether data were there without waiting, so this host is behind; the usual samples; and
            all other results of reading.
        """
        if wire is None or len(self._targets) < len(self._links):
            return self._read_in_python(timeout_s)
        is_late, links, raws, stamps_ns, reads = wire.read_links(
            self._targets, self._wake_fd, timeout_s, gather_s, expected, self._clock_ns
        )
        events = []
        for i, arrival_ns, size, frames in reads:
            result = unpack_all(frames) if size > 0 else self._links[i].read_error(-size)
            events.append(LinkRead(i, arrival_ns, result))
        return is_late, UsualSamples(links, raws, stamps_ns), events

    def _read_in_python(self, timeout_s: float) -> tuple[bool, UsualSamples, list[LinkRead]]:
        """Wait, read and decode in Python; see `read`. It does not wait for the other links."""
        numbers = {link.fileno(): i for i, link in enumerate(self._links) if link.is_open}
        poll = select.poll()
        for fd in (self._wake_fd, *numbers):
            poll.register(fd, select.POLLIN)
        ready = poll.poll(0)
        is_late = bool(ready)
        ready = ready or poll.poll(1000 * timeout_s)
        reads = self._read_ready([numbers[fd] for fd, _ in ready if fd in numbers])
        return is_late, UsualSamples([], [], []), reads

    def _read_ready(self, ready: Sequence[int]) -> list[LinkRead]:
        """Read and decode the links with these indices once."""
        results: list[bytes | LinkError] = []
        for i in ready:
            try:
                results.append(self._links[i].read())
            except LinkError as error:
                results.append(error)
        # The clock is read after all links, so that no byte arrives after this time, and before the
        # decoding, which would delay it.
        arrival_ns = self._clock_ns()
        return [
            LinkRead(
                i,
                arrival_ns,
                self._links[i].decoder.feed(data) if isinstance(data, bytes) else data,
            )
            for i, data in zip(ready, results, strict=True)
        ]
