"""Which other topics of the bags are added, under which names, and their values in each frame."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from ..bags.read import Bag
from ..core.errors import BagError
from .choices import Choices
from .frames import Frames
from .images import ImageStream
from .topics import IMAGES, JOINTS, Signal, read_signal, stamped_topics

STATE, ACTION = "observation.state", "action"


class Topic(NamedTuple):
    """Another topic: its name in the data set, its type, the names of its numbers or the shape of
    its images."""

    key: str
    kind: str
    names: list[str]
    shape: tuple[int, int, int]


def find_topics(paths: Sequence[Path], choices: Choices) -> dict[str, Topic]:
    """The other topics that are added, by name. BagError: a chosen one is not there."""
    kinds: dict[str, str] = {}
    names: dict[str, list[str]] = {}
    shapes: dict[str, tuple[int, int, int]] = {}
    there: set[str] = set()
    wanted = set(choices.topics or ())
    wanted |= {topic for topic in (choices.state, choices.action) if topic is not None}
    for path in paths:
        with Bag(path) as bag:
            prefix = (choices.frequencies or f"{bag.skin()}frequencies").removesuffix("frequencies")
            found = stamped_topics(bag, prefix)
            there |= found.keys()
            if choices.topics is not None:
                found = {topic: kind for topic, kind in found.items() if topic in wanted}
            for topic, kind in found.items():
                if kinds.setdefault(topic, kind) != kind:
                    raise BagError(
                        f"{path}: {topic} is {kind}, in other bags {kinds[topic]}; leave it out "
                        "by naming the others with --topics"
                    )
                if kind in IMAGES:
                    shapes.setdefault(topic, ImageStream(bag, topic, kind).shape)
                else:
                    known = names.setdefault(topic, [])
                    new = read_signal(bag, topic, kind).names
                    known += [name for name in new if name not in known]
    missing = sorted(topic for topic in wanted if topic not in kinds)
    if missing:
        raise BagError(
            f"{paths[0]}: no images and no stamped numbers on {', '.join(missing)}; there are "
            f"{', '.join(sorted(there)) or 'none'}"
        )
    kinds = {topic: kind for topic, kind in kinds.items() if kind in IMAGES or names[topic]}
    joints = [topic for topic, kind in kinds.items() if kind == JOINTS]
    others = [topic for topic in joints if topic != choices.action]
    state = choices.state or (others[0] if len(others) == 1 else None)
    return {
        topic: Topic(
            _key(topic, kind, state, choices.action),
            kind,
            names.get(topic, []),
            shapes.get(topic, (0, 0, 0)),
        )
        for topic, kind in kinds.items()
    }


def _key(topic: str, kind: str, state: str | None, action: str | None) -> str:
    """The name of a topic in the data set."""
    if topic in (state, action):
        return STATE if topic == state else ACTION
    name = topic.strip("/").replace("/", ".")
    return f"observation.images.{name}" if kind in IMAGES else f"observation.topics.{name}"


class Others:
    """The other topics of one bag."""

    def __init__(self, bag: Bag, topics: dict[str, Topic]) -> None:
        self._topics = topics
        self._signals: dict[str, Signal] = {}
        self._images: dict[str, ImageStream] = {}
        for name, topic in topics.items():
            if topic.kind in IMAGES:
                self._images[name] = ImageStream(bag, name, topic.kind, topic.shape)
            else:
                self._signals[name] = read_signal(bag, name, topic.kind)

    def at(self, frames: Frames, first: int, last: int) -> dict[str, Any]:
        """The values of some frames, by the names of the features."""
        found: dict[str, Any] = {}
        for name, topic in self._topics.items():
            if name in self._images:
                found[topic.key] = self._images[name].at(frames, first, last)
            else:
                signal = self._signals[name]
                found[topic.key] = signal.at(frames, first, last, topic.names)
        return found
