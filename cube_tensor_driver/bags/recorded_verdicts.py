"""What the reconstruction found bad while a bag was recorded: pads left out and status bits, row by
row.

`Health` remembers more than a bag holds: what it saw before the recording began, and where its
windows begin. So its verdicts are taken from the recorded stress, and used when the same stress is
made again.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.reconstructor import RecordedHealth
from ..core.rows import FrequencyRows
from ..core.status import WORDS
from ..messages.codec import SECOND
from ..messages.types import STRESS
from .read import Bag

AHEAD_NS = SECOND
"""How far stress is read ahead of frequencies: messages may stand in a bag a little out of
order."""
HEALTH_BITS = np.uint16(sum(WORDS))
"""The status bits that `Health` sets."""


class _Part(NamedTuple):
    """Rows of stress that were read together. begin_ns, end_ns: earliest and latest stamp."""

    begin_ns: int
    end_ns: int
    stamp_ns: NDArray[np.int64]
    cube: NDArray[np.uint16]
    left_out: NDArray[np.uint32]
    status: NDArray[np.uint16]


class VerdictReader:
    """Reads the stress beside the frequencies on a topic of a bag, and starts again when time jumps
    back."""

    def __init__(self, bag: Bag, topic: str) -> None:
        self._bag = bag
        self._topic = topic.removesuffix("frequencies") + "stress"
        self._available = self._topic in bag.topics(STRESS)
        self._asked_ns = 0
        self._newest_ns = 0
        self._parts: deque[_Part] = deque()
        self._unread = self._read()

    def of(self, rows: FrequencyRows) -> RecordedHealth:
        """The verdicts about rows, which their cubes and stamps identify."""
        known = np.zeros(len(rows), bool)
        left_out = np.zeros(len(rows), np.uint32)
        status = np.zeros(len(rows), np.uint16)
        if self._available and len(rows):
            for part in self._near(int(rows.stamp_ns.min()), int(rows.stamp_ns.max())):
                if np.array_equal(part.stamp_ns, rows.stamp_ns) and np.array_equal(
                    part.cube, rows.cube
                ):
                    return RecordedHealth(np.ones(len(rows), bool), part.left_out, part.status)
                at, same = _find(part, rows)
                known |= same
                left_out[same] = part.left_out[at[same]]
                status[same] = part.status[at[same]]
                if known.all():
                    break
        return RecordedHealth(known, left_out, status)

    def _near(self, begin_ns: int, end_ns: int) -> Iterator[_Part]:
        """Stress of a time. The bag is read on only as far as the caller asks for more."""
        if end_ns < self._asked_ns - AHEAD_NS:
            self._newest_ns = 0
            self._parts.clear()
            self._unread = self._read()
        self._asked_ns = end_ns
        while self._parts and self._parts[0].end_ns < begin_ns - AHEAD_NS:
            self._parts.popleft()
        for part in self._kept_and_unread(end_ns + AHEAD_NS):
            if part.begin_ns <= end_ns and part.end_ns >= begin_ns:
                yield part

    def _kept_and_unread(self, until_ns: int) -> Iterator[_Part]:
        yield from tuple(self._parts)
        while self._newest_ns < until_ns:
            part = next(self._unread, None)
            if part is None:
                return
            self._newest_ns = max(self._newest_ns, part.end_ns)
            self._parts.append(part)
            yield part

    def _read(self) -> Iterator[_Part]:
        names = ("cube", "left_out", "status")
        for stamp_ns, cube, left_out, status in self._bag.stress_columns(self._topic, names):
            if len(cube):
                begin_ns, end_ns = int(stamp_ns.min()), int(stamp_ns.max())
                yield _Part(begin_ns, end_ns, stamp_ns, cube, left_out, status & HEALTH_BITS)


def _find(part: _Part, rows: FrequencyRows) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Where in a part the rows are, (N,), and whether they are there, (N,)."""
    # One number for stamp and cube; stamps are taken from the part's begin on, so that both fit.
    keys = _key(part, part.begin_ns)
    wanted = _key(rows, part.begin_ns)
    order = np.argsort(keys, kind="stable")
    at = order[np.minimum(np.searchsorted(keys[order], wanted), len(order) - 1)]
    same = (part.stamp_ns[at] == rows.stamp_ns) & (part.cube[at] == rows.cube)
    return at, same


def _key(rows: Any, begin_ns: int) -> NDArray[np.int64]:
    key: NDArray[np.int64] = (rows.stamp_ns - begin_ns) * 65536 + rows.cube
    return key
