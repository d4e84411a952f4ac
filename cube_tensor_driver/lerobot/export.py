"""Bags to one data set: plan all bags, then reconstruct each and write its frames."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..bags.read import Bag
from ..bags.reprocess import AS_RECORDED, Overrides, reconstruct, settings_with
from ..bags.source import BagSource, open_bag
from ..config.skin import Skin
from ..core.errors import BagError
from ..core.modes import COMPONENTS, STRESS
from ..core.rows import StressRows
from .files import COUNTED, DataFiles, feature, info, write_episodes, write_json, write_tasks
from .images import Encoded, ImageStream
from .plan import BagPlan, Episode, plan_bag
from .statistics import Statistics
from .topics import IMAGES, JOINTS, Signal, read_signal, stamped_topics
from .windows import COLUMNS, TACTILE, Windows

Report = Callable[[float, float, str], None]
"""Called with what is done, the total, and what is being done."""
STATE, ACTION = "observation.state", "action"
LOOKED_AT = 20
"""Images of an episode that statistics are taken from, and every how many pixels of them."""
PIXELS = 4


@dataclass(frozen=True)
class Choices:
    """What a person chooses.

    fps: frames per second
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


class Exported(NamedTuple):
    """What was written, and what was not.

    rows: samples of cubes; depth: samples in a window; features: of the other topics
    outside, unknown, empty: as in `BagPlan`, of all bags
    """

    episodes: int
    frames: int
    rows: int
    depth: int
    features: list[str]
    outside: int
    unknown: int
    empty: int


class _Topic(NamedTuple):
    """Another topic: its name in the data set, its type, the names of its numbers or the shape of
    its images."""

    key: str
    kind: str
    names: list[str]
    shape: tuple[int, int, int]


def export_lerobot(
    bags: Sequence[Path], folder: Path, choices: Choices, report: Report
) -> Exported:
    """Write a data set into a folder that is empty or not there yet. It appears when it is
    complete.

    BagError: what is wrong with a bag, the choices or the folder.
    """
    check_empty(folder)
    plans = [_plan(path, choices, report) for path in bags]
    skin = _one_skin(plans)
    episodes = [episode for plan in plans for episode in plan.episodes]
    if not episodes:
        raise BagError(f"{bags[0]}: no sample lies between the marks; nothing to export")
    topics = _topics(bags, choices)
    partial = folder.absolute().parent / f"{folder.absolute().name}.partial"
    try:
        shutil.rmtree(partial, ignore_errors=True)
        (partial / "meta").mkdir(parents=True)
        depth = max(int(episode.counts.max()) for episode in episodes)
        data_set = _DataSet(partial, skin, choices, topics, depth, report)
        with data_set.files:
            for plan in plans:
                data_set.add_bag(plan)
        data_set.write_meta()
        partial.replace(folder)
    except OSError as error:
        raise BagError(
            f"{folder}: {error.strerror or error}; name a folder on a disk with room"
        ) from None
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return Exported(
        len(episodes),
        data_set.frames,
        sum(int(episode.counts.sum()) for episode in episodes),
        depth,
        [topic.key for topic in topics.values()],
        sum(plan.outside for plan in plans),
        sum(plan.unknown for plan in plans),
        sum(plan.empty for plan in plans),
    )


def check_empty(folder: Path) -> None:
    """BagError: there is something in a folder for results."""
    if folder.is_dir() and any(folder.iterdir()):
        raise BagError(f"{folder} is not empty; name another folder, or remove what is in it")


def _plan(path: Path, choices: Choices, report: Report) -> BagPlan:
    def counted(done: int, total: int) -> None:
        report(done, total, f"counting {path}")

    return plan_bag(path, choices.fps, choices.frequencies, choices.task, choices.marks, counted)


def _one_skin(plans: list[BagPlan]) -> Skin:
    """BagError: the bags were recorded with different cubes, or in other places."""
    first = plans[0]
    for plan in plans[1:]:
        for cube, other in zip(first.skin.cubes, plan.skin.cubes, strict=False):
            if (cube.name, cube.xyz, cube.rpy) != (other.name, other.xyz, other.rpy):
                raise BagError(
                    f"{plan.path}: cube {other.name} at {other.xyz}, in {first.path} {cube.name} "
                    f"at {cube.xyz}; export them into two folders"
                )
        if len(first.skin.cubes) != len(plan.skin.cubes):
            raise BagError(
                f"{plan.path} has {len(plan.skin.cubes)} cubes, {first.path} "
                f"{len(first.skin.cubes)}; export them into two folders"
            )
    return first.skin


def _topics(paths: Sequence[Path], choices: Choices) -> dict[str, _Topic]:
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
    joints = [topic for topic, kind in kinds.items() if kind == JOINTS]
    others = [topic for topic in joints if topic != choices.action]
    state = choices.state or (others[0] if len(others) == 1 else None)
    return {
        topic: _Topic(
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


@dataclass
class _DataSet:
    """A data set that is being written, bag after bag."""

    folder: Path
    skin: Skin
    choices: Choices
    topics: dict[str, _Topic]
    depth: int
    report: Report
    frames: int = 0
    episodes: list[dict[str, Any]] = field(default_factory=list)
    tasks: list[str] = field(default_factory=list)
    calibrations: list[dict[str, Any]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.files = DataFiles(self.folder)
        self.total = {key: Statistics(width, 1) for key, width in self._widths().items()}

    def _widths(self) -> dict[str, int]:
        """Columns of the features that have statistics, by name."""
        numbers = {topic.key: topic.shape[2] or len(topic.names) for topic in self.topics.values()}
        return (
            {TACTILE: len(COMPONENTS), f"{TACTILE}.residual": 1}
            | numbers
            | dict.fromkeys(COUNTED, 1)
        )

    def add_bag(self, plan: BagPlan) -> None:
        """All episodes of a bag. BagError: damaged, or the overrides do not fit."""
        with ExitStack() as stack:
            source = stack.enter_context(open_bag(plan.path, self.choices.frequencies))
            others = _Others(stack.enter_context(Bag(plan.path)), self.topics)
            parts = [_Part(self, plan, episode, others) for episode in plan.episodes]
            waiting = iter(parts)
            now = next(waiting, None)
            total = sum(part.episode.counts.sum() for part in parts)
            done = 0
            for rows in self._rows(source, plan):
                for part in parts:
                    done += part.add(rows)
                while now is not None and now.write():
                    now = next(waiting, None)
                self.report(done, float(total), f"exporting {plan.path}")

    def _rows(self, source: BagSource, plan: BagPlan) -> Iterator[StressRows]:
        """The stress of all rows of cubes that the skin has; notes which calibrations are used."""
        settings = settings_with(source, self.choices.overrides)
        cubes = len(self.skin.cubes)
        for segment, rows in reconstruct(source, self.choices.overrides):
            known = rows.cube < cubes
            if not known.all():
                rows = rows.select(known)
            if len(rows):
                ids = [one.id for one in settings[segment.number].calibrations]
                if not self.calibrations or self.calibrations[-1]["ids"] != ids:
                    since_ns = int(rows.stamp_ns.min())
                    self.calibrations.append(
                        {"bag": plan.path.name, "since_ns": since_ns, "ids": ids}
                    )
                yield rows

    def describe(self, plan: BagPlan, episode: Episode, stats: dict[str, Statistics]) -> None:
        """An episode that was written."""
        frames = len(episode.counts)
        described = {
            "episode_index": len(self.episodes),
            "tasks": [episode.span.task],
            "length": frames,
            **self._place,
            "dataset_from_index": self.frames - frames,
            "dataset_to_index": self.frames,
            "meta/episodes/chunk_index": 0,
            "meta/episodes/file_index": 0,
            "bag": plan.path.name,
            "begin_ns": episode.frames.begin_ns,
        }
        for key, one in stats.items():
            self.total[key].add_all(one)
            for name, values in self.shaped(key, one.result(frames)).items():
                described[f"stats/{key}/{name}"] = values
        self.episodes.append(described)

    def shaped(self, key: str, result: dict[str, NDArray[Any]]) -> dict[str, Any]:
        """Statistics as lists; those of images (bands, 1, 1)."""
        image = any(topic.key == key and topic.shape[2] for topic in self.topics.values())
        return {
            name: (values[:, None, None] if image and name != "count" else values).tolist()
            for name, values in result.items()
        }

    def begin_episode(self, task: str) -> int:
        """The number of its task."""
        self._place = self.files.begin_episode()
        if task not in self.tasks:
            self.tasks.append(task)
        return self.tasks.index(task)

    def write_meta(self) -> None:
        """What describes the data, once it is complete."""
        meta = self.folder / "meta"
        write_episodes(self.folder, self.episodes)
        write_tasks(self.folder, self.tasks)
        counts = (len(self.episodes), self.frames, len(self.tasks))
        described = info(self._features(), self.choices.fps, self.skin.name, *counts)
        write_json(meta / "info.json", described)
        stats = {key: self.shaped(key, one.result(self.frames)) for key, one in self.total.items()}
        write_json(meta / "stats.json", stats)

    def _features(self) -> dict[str, Any]:
        """As in info.json. What is said of the skin stands where LeRobot says what is special
        about a feature, so that its tools carry it on."""
        cubes = len(self.skin.cubes)
        window = (self.depth, cubes)
        features = {
            TACTILE: feature(
                "float32",
                (*window, len(COMPONENTS)),
                ["sample", "cube", "component"],
                info=describe_skin(self.skin) | {"calibrations": self.calibrations},
            )
        }
        for name, kind in COLUMNS.items():
            features[f"{TACTILE}.{name}"] = feature(np.dtype(kind).name, window, ["sample", "cube"])
        features[f"{TACTILE}.count"] = feature("int64", (cubes,), list(self.skin.names))
        for topic in self.topics.values():
            if topic.kind in IMAGES:
                names = ["height", "width", "channels"]
                features[topic.key] = feature("image", topic.shape, names)
            else:
                features[topic.key] = feature("float32", (len(topic.names),), topic.names)
        return features | {key: feature(kind, (1,)) for key, kind in COUNTED.items()}


def describe_skin(skin: Skin) -> dict[str, Any]:
    """What the numbers of `observation.tactile` mean: components, units, cubes and their poses."""
    cubes = [
        {
            "name": cube.name,
            "frame": skin.frame(cube),
            "xyz": list(cube.xyz),
            "rpy": list(cube.rpy),
            "half_side": cube.calibration.half_side,
            "uid": cube.uid,
        }
        for cube in skin.cubes
    ]
    return {
        "components": list(COMPONENTS),
        "units": ["Pa"] * len(STRESS) + ["Pa/m"] * (len(COMPONENTS) - len(STRESS)),
        "sign": "tension is positive",
        "frame": "each cube's own: right-handed, z out of the skin",
        "unknown": "NaN: not observed, or in front of the first sample of a window",
        "parent_frame": skin.parent_frame,
        "pose_units": "m, rad (fixed axes x y z)",
        "cubes": cubes,
    }


class _Others:
    """The other topics of one bag."""

    def __init__(self, bag: Bag, topics: dict[str, _Topic]) -> None:
        self._topics = topics
        self._signals: dict[str, Signal] = {}
        self._images: dict[str, ImageStream] = {}
        for name, topic in topics.items():
            if topic.kind in IMAGES:
                self._images[name] = ImageStream(bag, name, topic.kind, topic.shape)
            else:
                self._signals[name] = read_signal(bag, name, topic.kind)

    def at(self, episode: Episode, first: int, last: int) -> dict[str, Any]:
        """The values of some frames, by the names of the features."""
        found: dict[str, Any] = {}
        for name, topic in self._topics.items():
            if name in self._images:
                found[topic.key] = self._images[name].at(episode.frames, first, last)
            else:
                signal = self._signals[name]
                found[topic.key] = signal.at(episode.frames, first, last, topic.names)
        return found


class _Part:
    """One episode that is being written."""

    def __init__(
        self, data_set: _DataSet, plan: BagPlan, episode: Episode, others: _Others
    ) -> None:
        self.episode = episode
        self._data_set, self._plan, self._others = data_set, plan, others
        self._windows: Windows | None = None
        self._task = 0
        samples = int(episode.counts.sum())
        rows = dict.fromkeys(data_set.total, len(episode.counts))
        rows |= {TACTILE: samples, f"{TACTILE}.residual": samples}
        self._stats = {
            key: Statistics(width, rows[key]) for key, width in data_set._widths().items()
        }
        self._begun = False

    def add(self, rows: StressRows) -> int:
        """Take what belongs to the episode; how many rows did."""
        inside = self.episode.rows_in(rows.stamp_ns)
        if not inside.any():
            return 0
        if not inside.all():
            rows = rows.select(inside)
        if self._windows is None:
            self._windows = Windows(self.episode.counts, self._data_set.depth)
        self._windows.add(self.episode.frame_of(rows.stamp_ns), rows)
        self._stats[TACTILE].add(np.hstack([rows.stress, rows.gradient]))
        self._stats[f"{TACTILE}.residual"].add(rows.residual[:, None])
        return len(rows)

    def write(self) -> bool:
        """Write the frames that are complete; whether all are."""
        windows = self._windows
        if windows is None:
            return False
        if not self._begun:
            self._begun = True
            self._task = self._data_set.begin_episode(self.episode.span.task)
        while True:
            first = windows.taken
            columns = windows.take()
            frames = windows.taken - first
            if not frames:
                break
            self._write(first, columns)
        if windows.taken < windows.frames:
            return False
        self._windows = None
        self._data_set.describe(self._plan, self.episode, self._stats)
        return True

    def _write(self, first: int, columns: dict[str, Any]) -> None:
        data_set = self._data_set
        frames = len(columns[TACTILE])
        others = self._others.at(self.episode, first, first + frames)
        number = np.arange(first, first + frames)
        counted: dict[str, Any] = {
            "timestamp": (number / data_set.choices.fps).astype(np.float32),
            "frame_index": number,
            "episode_index": np.full(frames, len(data_set.episodes)),
            "index": np.arange(data_set.frames, data_set.frames + frames),
            "task_index": np.full(frames, self._task),
        }
        counted = {key: values[:, None] for key, values in counted.items()}
        data_set.files.write(columns | others | counted)
        data_set.frames += frames
        for key, values in (others | counted).items():
            if isinstance(values, list):
                self._look_at(key, first, values)
            else:
                self._stats[key].add(values)

    def _look_at(self, key: str, first: int, images: list[Encoded]) -> None:
        """Statistics of some pixels of some images."""
        every = -(-len(self.episode.counts) // LOOKED_AT)
        for number, image in enumerate(images, first):
            if number % every == 0:
                pixels = image.pixels()[::PIXELS, ::PIXELS]
                self._stats[key].add(pixels.reshape(-1, pixels.shape[2]))
