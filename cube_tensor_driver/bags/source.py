"""A bag as a source: its recorded frequencies as a stream of rows."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..config.skin import Skin
from ..core.errors import BagError
from ..core.pattern import count_repeats
from ..core.rows import FrequencyRows
from ..messages.codec import Decoded
from ..messages.types import FREQUENCIES
from .read import Bag
from .recording import Recording


class Segment(NamedTuple):
    """Messages that follow each other, with the same cubes and under the same info.

    recorded_ns: (M,) when each was recorded; number: of the info in `Recording.infos`
    """

    messages: Decoded[FrequencyRows]
    recorded_ns: NDArray[np.int64]
    number: int


class BagSource:
    """The frequencies on one topic of a bag. A context manager, which closes the bag.

    bag: the bag, open
    topic: of the frequencies
    recording: settings and verdicts that belong to the rows
    skin: as it was recorded
    is_live: False
    messages, rows: delivered so far
    """

    is_live = False

    def __init__(self, bag: Bag, topic: str) -> None:
        """BagError: there is no info for the topic."""
        self.bag, self.topic = bag, topic
        self.recording = Recording(bag, topic)
        self.skin: Skin = self.recording.skin
        self.messages = self.rows = 0

    def __enter__(self) -> BagSource:
        return self

    def __exit__(self, *error: object) -> None:
        self.bag.close()

    def __iter__(self) -> Iterator[FrequencyRows]:
        """All rows in the order of recording: of several messages at a time where that is the same
        to those who process them. BagError: damaged."""
        for segment in self.segments():
            yield segment.messages.rows

    def statistics(self) -> dict[str, object]:
        """Messages and rows that were delivered so far."""
        return {"messages": self.messages, "rows": self.rows}

    def segments(self) -> Iterator[Segment]:
        """The stream as messages, for those who need their stamps. BagError: damaged."""
        for messages, recorded_ns in self.bag.frequencies(self.topic):
            cube = messages.by_message(messages.rows.cube)
            times_ns = messages.by_message(messages.rows.stamp_ns)
            newest_ns = times_ns.max(axis=1) if times_ns.size else messages.stamp_ns
            number = self.recording.number_at(newest_ns)
            ends = (cube[1:] != cube[:-1]).any(axis=1) | (number[1:] != number[:-1])
            bounds = [0, *(np.flatnonzero(ends) + 1).tolist(), len(messages)]
            for begin, end in pairwise(bounds):
                # Only repeats of one scan mean the same together as they do one by one.
                step = end - begin if count_repeats(cube[begin]) else 1
                for first in range(begin, end, step):
                    chosen = slice(first, first + step)
                    part = messages.select(chosen)
                    self.messages += len(part)
                    self.rows += len(part.rows)
                    yield Segment(part, recorded_ns[chosen], int(number[first]))


def open_bag(path: Path | str, topic: str | None = None) -> BagSource:
    """The frequencies that a bag holds. topic: where it holds those of several skins.

    BagError: no bag, no such topic, several skins, or no info for it.
    """
    bag = Bag(Path(path))
    bag.open()
    try:
        topics = bag.topics(FREQUENCIES)
        if topic is None:
            topic = f"{bag.skin()}frequencies"
        elif topic not in topics:
            raise BagError(
                f"{path}: no frequencies on {topic}; there are {', '.join(topics) or 'none'}"
            )
        return BagSource(bag, topic)
    except BaseException:
        bag.close()
        raise
