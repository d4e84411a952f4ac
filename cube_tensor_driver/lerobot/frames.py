"""Frames: the steps of a data set, and which step an instant belongs to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

SECOND = 1_000_000_000
FARTHEST = 1 << 62


@dataclass(frozen=True)
class Frames:
    """The frames of an episode. Frame k holds what was measured since frame k - 1:

        begin + k / fps <= t < begin + (k + 1) / fps

    begin_ns: when the episode begins; fps: frames per second
    """

    begin_ns: int
    fps: int

    def number_of(self, stamp_ns: NDArray[np.int64]) -> NDArray[Any]:
        """(N,) the frame of each instant; below 0 before the episode."""
        reach = FARTHEST // self.fps  # a stamp of a clock that was not set must not overflow
        since_ns = np.clip(stamp_ns - self.begin_ns, -reach, reach)
        return since_ns * self.fps // SECOND
