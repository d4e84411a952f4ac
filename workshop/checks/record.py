"""What the judge is given: what came, as it came, and what was done to the nodes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Generic

import numpy as np
from numpy.typing import NDArray

from cube_tensor_driver.config.skin import Skin
from cube_tensor_driver.core.rows import FrequencyRows, StressRows
from cube_tensor_driver.messages.codec import AnyRows


@dataclass(frozen=True)
class Received(Generic[AnyRows]):
    """The rows of a topic, in the order in which they came.

    gaps: (row that came next, messages) where messages were sent that did not come here, by the
        numbers that DDS gives to messages. Nothing can be said of what was in them
    unreadable: messages that could not be decoded, or had another frame than the skin's
    sent_ns: (N,) wall clock at which each row was sent, as DDS says
    """

    rows: AnyRows
    sent_ns: NDArray[np.int64]
    gaps: tuple[tuple[int, int], ...] = ()
    unreadable: int = 0

    @property
    def missed(self) -> int:
        """Messages that were sent and did not come here."""
        return sum(messages for _, messages in self.gaps)

    def in_gap(self, stamp_ns: NDArray[np.int64], margin_ns: int) -> NDArray[np.bool_]:
        """(N,) whether rows of these stamps may have been in messages that did not come."""
        stamps = self.rows.stamp_ns
        inside = np.zeros(len(stamp_ns), bool)
        for row, _ in self.gaps:
            before = stamps[max(0, row - NEAR) : row].min(initial=np.iinfo(np.int64).max)
            after = stamps[row : row + NEAR].max(initial=np.iinfo(np.int64).min)
            low = min(int(before), int(after)) if row else np.iinfo(np.int64).min
            inside |= (stamp_ns >= low - margin_ns) & (stamp_ns <= int(after) + margin_ns)
        return inside


NEAR = 100
"""Rows before and behind a gap whose stamps say when it was."""


Tensor = tuple[int, NDArray[np.float64], float, int, int, NDArray[np.float64]]
"""stamp_ns, 6 stresses and 9 gradients (15,), residual, status, observed, covariance (225,)."""
Wrench = tuple[int, NDArray[np.float64]]
"""stamp_ns, force and torque (6,)."""


@dataclass(frozen=True)
class CubeMessages:
    """Some messages of the topics of one cube.

    cube: its index in the skin; frame_ids: that they had
    """

    cube: int
    frame_ids: frozenset[str]
    tensors: tuple[Tensor, ...]
    wrenches: tuple[Wrench, ...]


NEW_DRIVER = ("restart driver",)
"""Deeds that kill the driver and start it again."""
STOPPING = ("cycle driver", *NEW_DRIVER)
"""Deeds during which nobody takes what the hubs send."""
LAST_WORDS_NS = 500_000_000
"""What a driver was sent, or sent itself, so shortly before it was killed may not have come: a busy
host is late."""
DOWN = ("restart reconstruction", "reconfigure reconstruction")
"""Deeds during which there is no reconstruction."""


@dataclass(frozen=True)
class Deed:
    """Something that was done to the nodes.

    kind: one of DEEDS of workshop/torture/mix.py
    begin_ns, end_ns: wall clock
    done: whether it succeeded; answer: what the node said
    cubes: that were tared
    """

    kind: str
    begin_ns: int
    end_ns: int
    done: bool
    answer: str = ""
    cubes: tuple[int, ...] = ()


@dataclass(frozen=True)
class Record:
    """All that came of a tortured skin.

    instants: how many instants of the load the hubs repeat
    counters: of the driver, summed over all links, and of all rows; the newest, summed over its
        lives
    messages_lost: that the reconstruction says it lost on the way, of all its lives
    begin_ns, end_ns: samples that were taken in this time (wall clock) are judged
    """

    skin: Skin
    instants: int
    frequencies: Received[FrequencyRows]
    stress: Received[StressRows]
    cube_messages: CubeMessages
    deeds: tuple[Deed, ...]
    counters: Mapping[str, int]
    messages_lost: int
    begin_ns: int
    end_ns: int

    def near_death(self, time_ns: NDArray[np.int64], before_ns: int) -> NDArray[np.bool_]:
        """(N,) wall clock, whether there was no driver, or one that was killed so soon after."""
        near = np.zeros(len(time_ns), bool)
        for deed in self.deeds:
            if deed.kind in NEW_DRIVER:
                near |= (time_ns > deed.begin_ns - before_ns) & (time_ns < deed.end_ns)
        return near
