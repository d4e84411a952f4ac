"""A bag as a source: its recorded frequencies as a stream of rows."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..config.skin import Skin
from ..core.arrays import Times
from ..core.errors import BagError
from ..core.pattern import count_repeats
from ..core.rows import FrequencyRows
from ..messages.codec import Decoded
from ..messages.types import FREQUENCIES
from .read import Bag
from .recording import Recording


class Segment(NamedTuple):
    """Messages that follow each other, with the same cubes and under the same info.

    Attributes:
        messages: M messages of frequencies.
        recorded_ns: (M,) when each was recorded, in ns.
        number: Place of the info in `Recording.infos`.
    """

    messages: Decoded[FrequencyRows]
    recorded_ns: Times
    number: int


class BagSource:
    """The frequencies on one topic of a bag; a context manager that closes the bag.

    Attributes:
        bag: The open bag.
        topic: Topic of the frequencies.
        recording: Settings and recorded health that belong to the rows.
        skin: The skin as it was recorded.
        is_live: Always false.
        messages: Number of messages delivered so far.
        rows: Number of rows delivered so far.
    """

    is_live = False

    def __init__(self, bag: Bag, topic: str) -> None:
        """Prepare to read a topic.

        Raises:
            BagError: There is no info for the topic.
        """
        self.bag, self.topic = bag, topic
        self.recording = Recording(bag, topic)
        self.skin: Skin = self.recording.skin
        self.messages = self.rows = 0

    def __repr__(self) -> str:
        seconds = (self.bag.end_ns - self.bag.start_ns) * 1e-9
        return f"BagSource({str(self.bag.path)!r}, {self.topic}: {self.skin!r}, {seconds:.1f} s)"

    def __enter__(self) -> BagSource:
        return self

    def __exit__(self, *error: object) -> None:
        self.bag.close()

    def __iter__(self) -> Iterator[FrequencyRows]:
        """Yield all rows in the order of recording.

        Rows of several messages come at once where that gives the same results.

        Raises:
            BagError: The bag is damaged.
        """
        for segment in self.segments():
            yield segment.messages.rows

    def statistics(self) -> dict[str, object]:
        """Return the numbers of messages and rows delivered so far."""
        return {"messages": self.messages, "rows": self.rows}

    def segments(self) -> Iterator[Segment]:
        """Yield the rows together with the messages that they came in.

        Raises:
            BagError: The bag is damaged.
        """
        for messages, recorded_ns in self.bag.frequencies(self.topic):
            cube = messages.by_message(messages.rows.cube)
            times_ns = messages.by_message(messages.rows.stamp_ns)
            # A message may have no rows.
            newest_ns = times_ns.max(axis=1) if times_ns.size else messages.stamp_ns
            number = self.recording.number_at(newest_ns)

            # A segment ends where the cubes change, or the info that holds.
            has_other_cubes = (cube[1:] != cube[:-1]).any(axis=1)
            has_other_info = number[1:] != number[:-1]
            ends = np.flatnonzero(has_other_cubes | has_other_info) + 1
            bounds = [0, *ends.tolist(), len(messages)]
            for begin, end in pairwise(bounds):
                # Only repeats of one scan give the same results together as one by one.
                step = end - begin if count_repeats(cube[begin]) else 1
                for first in range(begin, end, step):
                    chosen = slice(first, first + step)
                    part = messages.select(chosen)
                    self.messages += len(part)
                    self.rows += len(part.rows)
                    yield Segment(part, recorded_ns[chosen], int(number[first]))


def open_bag(path: Path | str, topic: str | None = None) -> BagSource:
    """Open the frequencies of a bag.

    Args:
        path: Folder or file of the bag.
        topic: Topic of the frequencies; needed where the bag has those of several skins.

    Raises:
        BagError: There is no bag, no such topic, no info for it, or several skins.
    """
    # The source closes the bag; until there is one, an error must do so.
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
