# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Waiting for data of all links, reading and decoding them, in one step.

With the wire module in C, a single call does all of this without Python's global interpreter lock,
so that other threads can run meanwhile. The same call counts usual samples and computes their
stamps (host times of sampling). A usual sample has the next number, all cubes of its hub, and a
device time (hub's clock) that fits its number and the clock line of its link (`LinkTrack`).
"""

from __future__ import annotations

import ctypes
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

from ...core.errors import LinkError
from ..wire.decoder import NativeDecoder, unpack_all
from ..wire.native import wire
from ..wire.protocol import Frame
from .link import Link

ASK_PERIOD_S = 1e-3
"""Time, in s, between two looks at the links for bytes without the module in C, or on systems that
cannot wait for serial ports (all but Linux). Bytes arrive up to this time late."""


class NativeSamples(NamedTuple):
    """Samples that the module in C has counted and stamped already, in the order of arrival.

    Attributes:
        links: Index of the link of each sample.
        raws: Bytes of each sample, from its type to its CRC.
        stamps_ns: Host time at which each sample was taken, in ns since the Unix epoch.
    """

    links: list[int]
    raws: list[bytes]
    stamps_ns: list[int]


NO_SAMPLES = NativeSamples([], [], [])
"""Result of reading where the module in C has counted and stamped no samples."""


class LinkRead(NamedTuple):
    """Result of reading one link once: frames, or an error that shows that the link is lost.

    There is no such result if the module in C has handled all frames of the read.

    Attributes:
        link: Index of the link.
        arrival_ns: Host time, in ns, at which the bytes had arrived.
        result: The decoded frames, or the error that shows that the link is lost.
    """

    link: int
    arrival_ns: int
    result: list[Frame] | LinkError


class Intake:
    """Waits until links have received bytes, reads them and decodes them to frames.

    Args:
        links: All links; those that are closed are not read.
        wake_fd: File descriptor of a pipe; a byte in it ends the wait. It is not used where
            `Link.HAS_DESCRIPTORS` is false.
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
        """Update the list of open links. It must be called after a link was opened or closed."""
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
    ) -> tuple[bool, NativeSamples, list[LinkRead]]:
        """Wait for bytes, and read and decode the links that have some.

        Args:
            timeout_s: Longest wait for the first bytes, in s.
            gather_s: Longest wait, in s, for frames of the other links after the first frame.
            expected: Number of links that deliver samples. The wait for frames of the other links
                ends early when this many have delivered some.

        Returns:
            Whether bytes had been waiting before the call, so that this host is behind; the samples
            that were counted and stamped in C; and all other results of reading.
        """
        if not Link.HAS_DESCRIPTORS or len(self._targets) < len(self._links):
            return self._ask_links(timeout_s)
        is_late, links, raws, stamps_ns, reads = wire.read_links(
            self._targets,
            self._wake_fd,
            timeout_s,
            gather_s,
            expected,
            self._clock_ns,
        )
        others = []
        for i, arrival_ns, size, frames in reads:
            # A size that is not positive is the negative errno of a failed read.
            result = unpack_all(frames) if size > 0 else self._links[i].read_error(-size)
            others.append(LinkRead(i, arrival_ns, result))
        return is_late, NativeSamples(links, raws, stamps_ns), others

    def _ask_links(self, timeout_s: float) -> tuple[bool, NativeSamples, list[LinkRead]]:
        """Read the open links repeatedly until frames or an error come, at most for `timeout_s`.

        Returns:
            As `read`, with all frames among the other results: they are not decoded in C.
        """
        until = time.monotonic() + timeout_s
        is_first = True
        while True:
            reads = [read for read in self._read_open() if read.result]
            if reads or time.monotonic() >= until:
                return is_first and bool(reads), NO_SAMPLES, reads
            is_first = False
            # There is no call on Windows that waits for serial ports and sockets together.
            time.sleep(ASK_PERIOD_S)

    def _read_open(self) -> list[LinkRead]:
        """Read all open links once each, and decode their bytes in Python."""
        results: list[tuple[int, bytes | LinkError]] = []
        for i, link in enumerate(self._links):
            if not link.is_open:
                continue
            try:
                results.append((i, link.read()))
            except LinkError as error:
                results.append((i, error))
        # The clock is read after the bytes, so that none of them arrived later, and before the
        # decoding, which takes time.
        arrival_ns = self._clock_ns()
        reads = []
        for i, result in results:
            if isinstance(result, LinkError):
                reads.append(LinkRead(i, arrival_ns, result))
            else:
                frames = self._links[i].decoder.feed(result)
                reads.append(LinkRead(i, arrival_ns, frames))
        return reads
