# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The files of a LeRobot data set, version 3.0: Parquet in data/ and meta/, and JSON in meta/.

Source of the format: `lerobot.datasets` in the package lerobot 0.4.4.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow
import pyarrow.parquet

from ..bags.tables import as_column
from ..config.skin import Skin
from ..core.arrays import AnyArray
from ..core.modes import COMPONENTS, STRESS
from .plan import Episode
from .statistics import Statistics
from .topics import Topic
from .windows import TACTILE, WINDOW_COLUMNS

VERSION = "v3.0"
"""Version of LeRobotDataset, the file format for robot learning in which data sets are written."""

MAX_FILES_PER_CHUNK = 1000
"""Largest number of Parquet files in one folder (which LeRobot calls chunk) of a data set."""

FILE_MB = 100
"""Size of a file, in MB (2**20 bytes), above which LeRobot begins a new one if it adds episodes to
a data set. The files that are written here contain one bag each, whatever its size is."""

FILE_NAME = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
"""Pattern (for `str.format`) of a Parquet file's path, relative to data/ or meta/episodes/."""

RESIDUAL = f"{TACTILE}.residual"
"""Name of the feature with the residual: the part of the pads' measurements that no stress
explains, divided by their noise."""

COUNTER_FEATURES = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}
"""Features that state the time and the numbers of each frame, its episode and its task, with their
types. LeRobot requires them in every data set."""


_IMAGE = pyarrow.struct([("bytes", pyarrow.binary()), ("path", pyarrow.string())])
"""Parquet type of an image as LeRobot stores it: the bytes of the image file, or its path."""


class DataSet:
    """A LeRobot data set (table of frames, which are time steps at a constant rate).

    It is written episode after episode (an episode is one execution of a task), and is a context
    manager that closes its files.

    Attributes:
        fps: Frames per second.
        depth: Number of samples of each cube that a frame has room for.
        frames: Number of frames written so far.
        episodes: Description of each complete episode: a row of the table in meta/episodes/.
        calibrations: One entry for the first calibrations, and one for each change: the ids of the
            cubes' calibrations, and bag and stamp (ns since the Unix epoch) from which on they were
            used.
    """

    def __init__(
        self,
        folder: Path,
        skin: Skin,
        topics: list[Topic],
        *,
        fps: int,
        depth: int,
        frames: int,
    ) -> None:
        """Create the folder of the data set.

        Args:
            folder: Folder of the data set.
            skin: Skin of all bags.
            topics: Topics other than stress that become features (columns), such as images.
            fps: Frames per second.
            depth: Number of samples of each cube that a frame has room for.
            frames: Total number of frames that will be written.
        """
        (folder / "meta" / "episodes" / "chunk-000").mkdir(parents=True)
        self.fps, self.depth = fps, depth
        self.frames = 0
        self.episodes: list[dict[str, object]] = []
        self.calibrations: list[dict[str, object]] = []
        self._folder = folder
        self._skin = skin
        self._topics = topics
        self._tasks: list[str] = []
        self._writer: pyarrow.parquet.ParquetWriter | None = None
        self._file_number = 0
        # Integer columns beside the stress (stamps, status bits) have no statistics, because
        # policies do not normalise them. Statistics of the stress have one row for each sample of a
        # cube that the frames have room for, all others one per frame.
        samples = frames * depth * len(skin.cubes)
        self._statistic_rows = {TACTILE: samples, RESIDUAL: samples}
        others = [topic.key for topic in topics]
        for key in [*others, *COUNTER_FEATURES]:
            self._statistic_rows[key] = frames
        self._statistics = self.new_statistics()

    def __enter__(self) -> DataSet:
        return self

    def __exit__(self, *_: object) -> None:
        self.close_file()

    def new_statistics(self) -> dict[str, Statistics]:
        """Return empty statistics, by the names of the features (columns) that have statistics."""
        return {key: Statistics(rows) for key, rows in self._statistic_rows.items()}

    def write(
        self,
        columns: dict[str, AnyArray | list[bytes]],
    ) -> None:
        """Write successive frames (time steps) as one group of rows of the current Parquet file.

        Args:
            columns: By the names of the features (columns of the data set): arrays whose first
                dimension is the frames, or a list of image files with one per frame.
        """
        table = pyarrow.table({name: _as_column(values) for name, values in columns.items()})
        if self._writer is None:
            name = FILE_NAME.format(**self._place())
            path = self._folder / "data" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            # Dictionary encoding saves space only if values repeat. Measured ones rarely do.
            self._writer = pyarrow.parquet.ParquetWriter(
                path,
                table.schema,
                compression="zstd",
                use_dictionary=False,
            )
        self._writer.write_table(table)
        self.frames += len(table)

    def close_file(self) -> None:
        """Complete the current Parquet file, if there is one; frames that follow get a new file."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None
            self._file_number += 1

    def task_index(self, task: str) -> int:
        """Return the index of a task, which is described by a text, in the table of tasks."""
        if task not in self._tasks:
            self._tasks.append(task)
        return self._tasks.index(task)

    def end_episode(
        self,
        episode: Episode,
        statistics: dict[str, Statistics],
    ) -> None:
        """Add an episode (one execution of a task) to the table of episodes.

        Args:
            episode: The episode, whose frames have all been written.
            statistics: Statistics of the episode, by the names of the features.
        """
        frames = len(episode.counts)
        place = self._place()
        described = {
            "episode_index": len(self.episodes),
            "tasks": [episode.task],
            "length": frames,
            "data/chunk_index": place["chunk_index"],
            "data/file_index": place["file_index"],
            "dataset_from_index": self.frames - frames,
            "dataset_to_index": self.frames,
            # The descriptions of all episodes are in one file, because each takes only some kB.
            "meta/episodes/chunk_index": 0,
            "meta/episodes/file_index": 0,
            "bag": episode.bag.name,
            "begin_ns": episode.begin_ns,
        }
        for key, one in statistics.items():
            lists = _as_lists(one, frames)
            for name, values in lists.items():
                described[f"stats/{key}/{name}"] = values
            self._statistics[key].merge(one)
        self.episodes.append(described)

    def write_meta(self) -> None:
        """Write episodes, tasks, features and statistics into the folder meta/ of the data set.

        It is called once, after the last episode.
        """
        meta = self._folder / "meta"
        episodes = pyarrow.Table.from_pylist(self.episodes)
        path = FILE_NAME.format(chunk_index=0, file_index=0)
        pyarrow.parquet.write_table(episodes, meta / "episodes" / path)
        tasks = _make_task_table(self._tasks)
        pyarrow.parquet.write_table(tasks, meta / "tasks.parquet")
        _write_json(
            meta / "info.json",
            {
                "codebase_version": VERSION,
                "robot_type": self._skin.name,
                "total_episodes": len(self.episodes),
                "total_frames": self.frames,
                "total_tasks": len(self._tasks),
                "chunks_size": MAX_FILES_PER_CHUNK,
                "data_files_size_in_mb": FILE_MB,
                "video_files_size_in_mb": FILE_MB,
                "fps": self.fps,
                "splits": {"train": f"0:{len(self.episodes)}"},
                "data_path": f"data/{FILE_NAME}",
                "video_path": None,
                "features": self._describe_features(),
            },
        )
        statistics = {}
        for key, one in self._statistics.items():
            statistics[key] = _as_lists(one, self.frames)
        _write_json(meta / "stats.json", statistics)

    def _place(self) -> dict[str, int]:
        """Return the numbers of the current Parquet file and of its folder, which LeRobot calls
        chunk."""
        chunk, file = divmod(self._file_number, MAX_FILES_PER_CHUNK)
        return {"chunk_index": chunk, "file_index": file}

    def _describe_features(self) -> dict[str, dict[str, object]]:
        """Return the description of all features (columns of the data set) for info.json.

        The skin is described under the key ``info`` of the tactile feature, because LeRobot's tools
        keep this key when they copy or merge data sets.
        """
        cubes = len(self._skin.cubes)
        window = (self.depth, cubes)
        axes = ["sample", "cube", "component"]
        about = describe_skin(self._skin) | {"calibrations": self.calibrations}
        shape = (*window, len(COMPONENTS))
        tactile = _describe_feature("float32", shape, axes)
        features = {TACTILE: tactile | {"info": about}}
        for name, kind in WINDOW_COLUMNS.items():
            dtype = np.dtype(kind).name
            features[f"{TACTILE}.{name}"] = _describe_feature(dtype, window, axes[:2])
        names = list(self._skin.names)
        features[f"{TACTILE}.count"] = _describe_feature("int64", (cubes,), names)
        for topic in self._topics:
            if topic.is_image:
                axes = ["height", "width", "channels"]
                described = _describe_feature("image", topic.shape, axes)
            else:
                width = len(topic.names)
                described = _describe_feature("float32", (width,), topic.names)
            features[topic.key] = described
        for key, dtype in COUNTER_FEATURES.items():
            features[key] = _describe_feature(dtype, (1,), None)
        return features


def _as_column(values: AnyArray | list[bytes]) -> pyarrow.Array:
    """Return the values of a feature in n frames as a column of the Parquet file.

    Args:
        values: Contents of n image files, or an array (n, …).
    """
    if isinstance(values, list):
        # LeRobot reads an image from the bytes if it has no path to an image file.
        return pyarrow.array([{"bytes": image, "path": None} for image in values], _IMAGE)
    # LeRobot stores a feature of one number as this number, and not as a list of it.
    is_one_number = values.shape[1:] == (1,)
    return as_column(values[:, 0] if is_one_number else values)


def describe_skin(skin: Skin) -> dict[str, object]:
    """Describe the feature `observation.tactile` (stress): components, units, and cubes' poses."""
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
        "units": ["Pa" if name in STRESS else "Pa/m" for name in COMPONENTS],
        "sign": "tension is positive",
        "frame": "each cube's own: right-handed, z out of the skin",
        "unknown": "NaN: not observed, or in front of the first sample of a window",
        "parent_frame": skin.parent_frame,
        "pose_units": "m, rad (fixed axes x y z)",
        "cubes": cubes,
    }


def _describe_feature(
    dtype: str,
    shape: tuple[int, ...],
    names: list[str] | None,
) -> dict[str, object]:
    """Return the description of one feature (column of the data set) for info.json.

    Args:
        dtype: Name of its type, such as ``float32`` or ``image``.
        shape: Shape of its value in one frame.
        names: Names of the axes, or of the numbers of a vector; None: it has none.
    """
    return {
        "dtype": dtype,
        "shape": list(shape),
        "names": names,
    }


def _as_lists(
    statistics: Statistics,
    frames: int,
) -> dict[str, object]:
    """Return the statistics of a feature as lists, which JSON and Parquet can contain.

    Args:
        statistics: Statistics of the feature.
        frames: Number of frames (time steps of the data set), which LeRobot uses as the weight of
            the statistics when it merges data sets.
    """
    lists = {name: values.tolist() for name, values in statistics.result().items()}
    return {"count": [frames], **lists}


def _make_task_table(tasks: list[str]) -> pyarrow.Table:
    """Return the table of tasks: the index of each task, and its text as the row label in pandas.

    Args:
        tasks: Texts of the tasks, by their indices.
    """
    # This metadata makes the texts the row labels in pandas. Its format is described in
    # https://pandas.pydata.org/docs/development/developer.html
    label = {
        "name": "task",
        "field_name": "task",
        "pandas_type": "unicode",
        "numpy_type": "object",
    }
    described = {"index_columns": ["task"], "columns": [label]}
    columns = {
        "task_index": range(len(tasks)),
        "task": tasks,
    }
    table = pyarrow.table(columns)
    return table.replace_schema_metadata({"pandas": json.dumps(described)})


def _write_json(path: Path, value: object) -> None:
    """Write a value to a JSON file as LeRobot does: indented, in UTF-8."""
    text = json.dumps(value, indent=4, ensure_ascii=False)
    path.write_text(text + "\n", encoding="utf-8")
