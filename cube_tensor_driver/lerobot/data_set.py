"""A data set that is being written: its frames, and all that is said about them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..config.skin import Skin
from ..core.modes import COMPONENTS, STRESS
from .files import COUNTED, DataFiles, feature, info, write_episodes, write_json, write_tasks
from .others import Topic
from .plan import BagPlan, Episode
from .statistics import Statistics
from .topics import IMAGES
from .windows import COLUMNS, TACTILE


class DataSet:
    """Written episode after episode.

    fps: frames per second; depth: samples in a window
    frames: written so far; episodes: descriptions of those that are complete
    widths: columns of the features that have statistics, by name
    """

    def __init__(
        self, folder: Path, skin: Skin, topics: list[Topic], fps: int, depth: int, samples: int
    ) -> None:
        """samples: of cubes, to come."""
        (folder / "meta").mkdir(parents=True)
        self.fps, self.depth = fps, depth
        self.files = DataFiles(folder)
        self.frames = 0
        self.episodes: list[dict[str, Any]] = []
        self.widths = {TACTILE: len(COMPONENTS), f"{TACTILE}.residual": 1}
        self.widths |= {topic.key: topic.shape[2] or len(topic.names) for topic in topics}
        self.widths |= dict.fromkeys(COUNTED, 1)
        self._folder, self._skin, self._topics = folder, skin, topics
        self._total = {key: Statistics(width, samples) for key, width in self.widths.items()}
        self._tasks: list[str] = []
        self._calibrations: list[dict[str, Any]] = []

    def begin_episode(self, task: str) -> tuple[dict[str, int], int]:
        """In which file it goes, and the number of its task."""
        if task not in self._tasks:
            self._tasks.append(task)
        return self.files.begin_episode(), self._tasks.index(task)

    def write(self, columns: dict[str, Any]) -> None:
        """Frames that follow each other."""
        self.files.write(columns)
        self.frames += len(columns[TACTILE])

    def end_episode(
        self, plan: BagPlan, episode: Episode, place: dict[str, int], stats: dict[str, Statistics]
    ) -> None:
        """Describe an episode whose frames are written. place: the file it is in."""
        frames = len(episode.counts)
        described = {
            "episode_index": len(self.episodes),
            "tasks": [episode.span.task],
            "length": frames,
            **place,
            "dataset_from_index": self.frames - frames,
            "dataset_to_index": self.frames,
            "meta/episodes/chunk_index": 0,
            "meta/episodes/file_index": 0,
            "bag": plan.path.name,
            "begin_ns": episode.frames.begin_ns,
        }
        for key, one in stats.items():
            self._total[key].add_all(one)
            for name, values in self._shaped(key, one.result(frames)).items():
                described[f"stats/{key}/{name}"] = values
        self.episodes.append(described)

    def note_calibrations(self, bag: str, since_ns: int, ids: list[str]) -> None:
        """With which calibrations of the cubes the samples of a bag are made from a stamp on."""
        if not self._calibrations or self._calibrations[-1]["ids"] != ids:
            self._calibrations.append({"bag": bag, "since_ns": since_ns, "ids": ids})

    def write_meta(self) -> None:
        """What describes the data, once it is complete."""
        write_episodes(self._folder, self.episodes)
        write_tasks(self._folder, self._tasks)
        counts = (len(self.episodes), self.frames, len(self._tasks))
        described = info(self._features(), self.fps, self._skin.name, *counts)
        write_json(self._folder / "meta" / "info.json", described)
        stats = {
            key: self._shaped(key, one.result(self.frames)) for key, one in self._total.items()
        }
        write_json(self._folder / "meta" / "stats.json", stats)

    def _shaped(self, key: str, result: dict[str, NDArray[Any]]) -> dict[str, Any]:
        """Statistics as lists; those of images (bands, 1, 1)."""
        image = any(topic.key == key and topic.kind in IMAGES for topic in self._topics)
        return {
            name: (values[:, None, None] if image and name != "count" else values).tolist()
            for name, values in result.items()
        }

    def _features(self) -> dict[str, Any]:
        """As in info.json. What is said of the skin stands where LeRobot says what is special
        about a feature, so that its tools carry it on."""
        cubes = len(self._skin.cubes)
        window = (self.depth, cubes)
        features = {
            TACTILE: feature(
                "float32",
                (*window, len(COMPONENTS)),
                ["sample", "cube", "component"],
                info=describe_skin(self._skin) | {"calibrations": self._calibrations},
            )
        }
        for name, kind in COLUMNS.items():
            key, dtype = f"{TACTILE}.{name}", np.dtype(kind).name
            features[key] = feature(dtype, window, ["sample", "cube"])
        features[f"{TACTILE}.count"] = feature("int64", (cubes,), list(self._skin.names))
        for topic in self._topics:
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
