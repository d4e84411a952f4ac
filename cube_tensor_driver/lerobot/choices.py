"""What a person chooses for a data set."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from ..bags.reprocess.job import AS_RECORDED, Overrides


@dataclass(frozen=True)
class Choices:
    """fps: frames per second

    task: of every episode without a mark
    marks: topic of the marks; None: each bag is one episode
    frequencies: topic of the frequencies, where a bag has those of several skins
    topics: other topics to add; None: all that can be
    state, action: topics that become observation.state and action; None: the only topic of joint
        states, and none
    overrides: as for `reprocess`
    """

    fps: int
    task: str
    marks: str | None = None
    frequencies: str | None = None
    topics: Sequence[str] | None = None
    state: str | None = None
    action: str | None = None
    overrides: Overrides = AS_RECORDED
