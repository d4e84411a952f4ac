# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Messages of a storage file in arrays, so that numpy finds and copies many of them at once."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ..core.arrays import AnyArray, Index, Mask, Times

BLOCK_BYTES = 1 << 18
"""Minimum total size, in bytes, of single messages that are joined to one block (`StoredMessages`
with common bytes), so that numpy handles many messages at once. Messages in a chunk of an MCAP file
have common bytes already, and are not joined."""


@dataclass(frozen=True, slots=True)
class StoredMessages:
    """N messages in the order of their times of recording.

    Attributes:
        data: Bytes in which the serialised messages lie.
        begin: (N,) byte offsets in `data` at which the messages begin.
        end: (N,) byte offsets in `data` at which they end.
        time_ns: (N,) times of recording, in ns since the Unix epoch.
        channel: (N,) number of each message's topic in the file.
    """

    data: bytes
    begin: Index
    end: Index
    time_ns: Times
    channel: AnyArray

    def __len__(self) -> int:
        return len(self.begin)

    def __iter__(self) -> Iterator[tuple[int, int, bytes]]:
        """Yield channel, time of recording in ns, and serialised bytes of each message."""
        columns = (self.channel, self.time_ns, self.begin, self.end)
        lists = [column.tolist() for column in columns]
        for channel, time_ns, begin, end in zip(*lists, strict=True):
            yield channel, time_ns, self.data[begin:end]

    def select(self, chosen: slice | Index | Mask) -> StoredMessages:
        """Return the messages that are chosen by a slice, a mask or their indices."""
        return StoredMessages(
            self.data,
            self.begin[chosen],
            self.end[chosen],
            self.time_ns[chosen],
            self.channel[chosen],
        )

    def group_by_length(self) -> Iterator[tuple[Times, AnyArray]]:
        """Divide the messages into groups of successive messages of equal length.

        Yields:
            For each group of M messages: times of recording (M,) in ns, and bytes (M, length).
        """
        sizes = self.end - self.begin
        changes = np.flatnonzero(np.diff(sizes)) + 1
        bounds = [0, *changes.tolist(), len(self)]
        for first, last in pairwise(bounds):
            if first < last:
                size = int(sizes[first])
                # Row i of `windows` is a view of the `size` bytes that begin at byte i of the data,
                # so the rows overlap. Only the rows at which messages begin are copied.
                n_windows = len(self.data) - size + 1
                windows: AnyArray = np.ndarray(
                    (n_windows, size),
                    np.uint8,
                    self.data,
                    strides=(1, 1),
                )
                begin = self.begin[first:last]
                yield self.time_ns[first:last], windows[begin]


def join(messages: Sequence[tuple[int, int, bytes]]) -> StoredMessages:
    """Join single messages to one object with arrays.

    Args:
        messages: Channel, time of recording in ns, and serialised bytes of each message; at least
            one.
    """
    channel, time_ns, data = zip(*messages, strict=True)
    sizes = np.array([len(one) for one in data])
    end = np.cumsum(sizes)
    return StoredMessages(
        b"".join(data),
        end - sizes,
        end,
        np.array(time_ns),
        np.array(channel),
    )


def join_in_blocks(messages: Iterable[tuple[int, int, bytes]]) -> Iterator[StoredMessages]:
    """Join single messages to blocks (`StoredMessages` with common bytes).

    Blocks have at least `BLOCK_BYTES`; the last one may be smaller.

    Args:
        messages: Channel, time of recording in ns, and serialised bytes of each message.
    """
    waiting: list[tuple[int, int, bytes]] = []
    size = 0
    for message in messages:
        waiting.append(message)
        size += len(message[2])
        if size >= BLOCK_BYTES:
            yield join(waiting)
            waiting, size = [], 0
    if waiting:
        yield join(waiting)
