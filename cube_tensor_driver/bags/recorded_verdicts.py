"""What the reconstruction found bad while a bag was recorded: pads left out and status bits,
message by message.

`Health` remembers more than a bag holds: what it saw before the recording began, and where its
windows begin. So what it found stands in the recorded stress, and whoever makes the same stress
again takes it from there.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.rows import StressRows
from ..core.status import WORDS
from .message_codec import SECOND, Decoded
from .read import STRESS, Bag

AHEAD_NS = SECOND
"""How far stress is read ahead of frequencies: messages may stand in a bag a little out of
order."""
BITS = np.uint16(sum(WORDS))


class Verdict(NamedTuple):
    """Of B messages: whether their stress is recorded (B,); pads left out and status bits, (B,
    rows)."""

    known: NDArray[np.bool_]
    left_out: NDArray[np.uint32]
    bits: NDArray[np.uint16]


class _Batch(NamedTuple):
    """Messages of stress by stamp. begin_ns, end_ns: of the first and the last."""

    begin_ns: int
    end_ns: int
    stamp_ns: NDArray[np.int64]
    cube: NDArray[np.uint16]
    left_out: NDArray[np.uint32]
    bits: NDArray[np.uint16]


class RecordedVerdicts:
    """Reads the stress beside the frequencies `topic` of a bag; from the start again when time
    jumps back."""

    def __init__(self, bag: Bag, topic: str, wanted: bool = True) -> None:
        """wanted: False finds nothing."""
        stress = topic.removesuffix("frequencies") + "stress"
        self._bag, self._topic = bag, stress
        self._asked_ns: int
        self._newest_ns: int
        self._there = wanted and bag.version > 1 and stress in bag.topics(STRESS)
        self._begin()

    def of(self, stamp_ns: NDArray[np.int64], cube: NDArray[np.uint16]) -> Verdict:
        """What was found of messages of frequencies by their stamps (B,) and cubes (B, rows), which
        tell them apart."""
        found = Verdict(
            np.zeros(len(cube), bool),
            np.zeros(cube.shape, np.uint32),
            np.zeros(cube.shape, np.uint16),
        )
        if not self._there or not cube.size:
            return found
        begin_ns, end_ns = int(stamp_ns.min()), int(stamp_ns.max())
        if end_ns < self._asked_ns - AHEAD_NS:
            self._begin()
        self._asked_ns = end_ns
        while self._waiting and self._waiting[0].end_ns < begin_ns - AHEAD_NS:
            self._waiting.popleft()
        for batch in self._near(end_ns + AHEAD_NS):
            if (
                batch.begin_ns > end_ns
                or batch.end_ns < begin_ns
                or batch.left_out.shape[1] != cube.shape[1]
            ):
                continue
            if np.array_equal(batch.stamp_ns, stamp_ns) and np.array_equal(batch.cube, cube[:, 0]):
                return Verdict(np.ones(len(cube), bool), batch.left_out, batch.bits)
            place = np.minimum(np.searchsorted(batch.stamp_ns, stamp_ns), len(batch.stamp_ns) - 1)
            same = (batch.stamp_ns[place] == stamp_ns) & (batch.cube[place] == cube[:, 0])
            found.known[same] = True
            found.left_out[same], found.bits[same] = (
                batch.left_out[place[same]],
                batch.bits[place[same]],
            )
            if found.known.all():
                break
        return found

    def _near(self, until_ns: int) -> Iterator[_Batch]:
        """Stress read before, and what stands behind it, read on until then."""
        yield from tuple(self._waiting)
        while self._newest_ns < until_ns and (read := next(self._unread, None)) is not None:
            if len(read[0].rows):
                self._take(read[0])
                yield self._waiting[-1]

    def _begin(self) -> None:
        self._asked_ns = self._newest_ns = 0
        self._waiting: deque[_Batch] = deque()
        self._unread: Iterator[Any] = self._bag.stress(self._topic) if self._there else iter(())

    def _take(self, messages: Decoded[StressRows]) -> None:
        order = np.argsort(messages.stamp_ns, kind="stable")
        stamp_ns, rows = messages.stamp_ns[order], messages.rows
        begin_ns, end_ns = int(stamp_ns[0]), int(stamp_ns[-1])
        self._newest_ns = max(self._newest_ns, end_ns)
        # Copies: the messages themselves need not be kept.
        self._waiting.append(
            _Batch(
                begin_ns,
                end_ns,
                stamp_ns,
                messages.by_message(rows.cube)[order, 0],
                messages.by_message(rows.left_out)[order],
                messages.by_message(rows.status)[order] & BITS,
            )
        )
