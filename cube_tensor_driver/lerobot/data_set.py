"""The files of a LeRobot data set, version 3.0: Parquet in data/ and meta/, and JSON in meta/.

Source of the format: `lerobot.datasets` in the package lerobot 0.4.4.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow
import pyarrow.parquet

from ..config.skin import Skin
from ..core.arrays import AnyArray
from ..core.modes import COMPONENTS, STRESS
from .images import IMAGE_TYPES, EncodedImage
from .plan import BagPlan, Episode
from .statistics import Statistics
from .topics import Topic
from .windows import TACTILE, WINDOW_COLUMNS

VERSION = "v3.0"
"""Version of the format LeRobotDataset in which data sets are written."""

MAX_FILES_PER_CHUNK = 1000
"""Largest number of Parquet files in one folder (which LeRobot calls chunk) of a data set."""

MAX_FILE_MB = 100
"""Size of a Parquet file, in MB (2**20 bytes), from which on the next episode begins a new file.

An episode is never divided between files, so a file can become larger than this.
"""

FILE_NAME = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
"""Pattern (for `str.format`) of a Parquet file's path, relative to data/ or meta/episodes/."""

COUNTER_FEATURES = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}
"""Features that state the time and the numbers of each frame, its episode and its task, with their
types. LeRobot requires them in every data set."""

_IMAGE = pyarrow.struct(
    [
        ("bytes", pyarrow.binary()),
        ("path", pyarrow.string()),
    ]
)
"""Parquet type of an image as LeRobot stores it: the bytes of the image file, or its path."""


class DataSet:
    """A data set that is written episode after episode; a context manager that closes its files.

    Attributes:
        fps: Frames per second.
        depth: Number of samples of each cube that a frame has room for.
        widths: Number of columns of each feature for which statistics are computed, by its name.
        frames: Number of frames written so far.
        episodes: Description of each complete episode: a row of the table in meta/episodes/.
    """

    def __init__(
        self,
        folder: Path,
        skin: Skin,
        topics: list[Topic],
        *,
        fps: int,
        depth: int,
        samples: int,
    ) -> None:
        """Create the folder of the data set.

        Args:
            folder: Folder of the data set.
            skin: Skin of all bags.
            topics: Topics other than stress that become features, such as images.
            fps: Frames per second.
            depth: Number of samples of each cube that a frame has room for.
            samples: Total number of samples of cubes that will be written.
        """
        (folder / "meta").mkdir(parents=True)
        self.fps, self.depth = fps, depth
        self.frames = 0
        self.episodes: list[dict[str, Any]] = []
        # Integer columns beside the stress (stamps, status bits) have no statistics, because
        # policies do not normalise them.
        self.widths = {
            TACTILE: len(COMPONENTS),
            f"{TACTILE}.residual": 1,
        }
        for topic in topics:
            bands = topic.shape[2]
            self.widths[topic.key] = bands or len(topic.names)
        self.widths |= dict.fromkeys(COUNTER_FEATURES, 1)
        self._folder = folder
        self._skin = skin
        self._topics = topics
        self._image_keys = {topic.key for topic in topics if topic.msgtype in IMAGE_TYPES}
        self._statistics = {}
        for key, width in self.widths.items():
            self._statistics[key] = Statistics(width, samples)
        self._tasks: list[str] = []
        self._calibrations: list[dict[str, Any]] = []
        self._writer: Any = None
        # There is no file yet: each is created with its first frames, whose types its columns get.
        self._path = folder
        self._file_number = -1

    def __enter__(self) -> DataSet:
        return self

    def __exit__(self, *_: object) -> None:
        self._close_file()

    def begin_episode(self, task: str) -> tuple[dict[str, int], int]:
        """Choose the data file of the next episode.

        Args:
            task: Task of the episode, as a text.

        Returns:
            The numbers of the file and of its folder, as the table of episodes states them, and the
            index of the task.
        """
        if task not in self._tasks:
            self._tasks.append(task)
        # The size on disk lags behind what has been written by one row group, so files can exceed
        # the limit by as much.
        is_new = self._writer is None
        if is_new or self._path.stat().st_size >= MAX_FILE_MB << 20:
            self._close_file()
            self._file_number += 1
        chunk, file = divmod(self._file_number, MAX_FILES_PER_CHUNK)
        place = {"chunk_index": chunk, "file_index": file}
        if self._writer is None:
            self._path = self._folder / "data" / FILE_NAME.format(**place)
            self._path.parent.mkdir(parents=True, exist_ok=True)
        described = {
            "data/chunk_index": chunk,
            "data/file_index": file,
        }
        return described, self._tasks.index(task)

    def write(self, columns: dict[str, AnyArray | list[EncodedImage]]) -> None:
        """Write successive frames as one row group of the current Parquet file.

        Args:
            columns: By the names of the features (columns of the data set): arrays whose first
                dimension is the frames, or a list of images with one per frame.
        """
        arrays = {}
        for name, values in columns.items():
            arrays[name] = _column(values)
        table = pyarrow.table(arrays)
        if self._writer is None:
            # Dictionary encoding saves space only if values repeat. Measured ones rarely do.
            self._writer = pyarrow.parquet.ParquetWriter(
                self._path,
                table.schema,
                compression="zstd",
                use_dictionary=False,
            )
        self._writer.write_table(table)
        self.frames += len(table)

    def count(
        self,
        key: str,
        rows: AnyArray,
        of_episode: dict[str, Statistics],
    ) -> None:
        """Add values of a feature (column) to the statistics of the data set and of an episode.

        Args:
            key: Name of the feature.
            rows: (n, D) values of the feature's D columns.
            of_episode: Statistics of the current episode, by the names of the features.
        """
        self._statistics[key].add(rows)
        of_episode[key].add(rows)

    def end_episode(
        self,
        plan: BagPlan,
        episode: Episode,
        place: dict[str, int],
        statistics: dict[str, Statistics],
    ) -> None:
        """Add an episode, whose frames have all been written, to the table of episodes.

        Args:
            plan: The bag of the episode.
            episode: The episode.
            place: Numbers of its file and folder, as `begin_episode` returned them.
            statistics: Statistics of the episode, by the names of the features.
        """
        frames = len(episode.counts)
        described = {
            "episode_index": len(self.episodes),
            "tasks": [episode.task],
            "length": frames,
            **place,
            "dataset_from_index": self.frames - frames,
            "dataset_to_index": self.frames,
            # The descriptions of all episodes are in one file, because each takes only some kB.
            "meta/episodes/chunk_index": 0,
            "meta/episodes/file_index": 0,
            "bag": plan.path.name,
            "begin_ns": episode.begin_ns,
        }
        for key, one in statistics.items():
            result = one.result(frames)
            for name, values in self._as_lists(key, result).items():
                described[f"stats/{key}/{name}"] = values
        self.episodes.append(described)

    def note_calibrations(
        self,
        bag: str,
        since_ns: int,
        ids: list[str],
    ) -> None:
        """Note the calibrations with which the stress of a bag is computed.

        Args:
            bag: Name of the bag.
            since_ns: Earliest stamp of the stress, in ns since the Unix epoch.
            ids: Id of the calibration of each cube, by the cube's index.
        """
        # Only changes are noted, because most data sets have the same calibrations throughout.
        if self._calibrations and self._calibrations[-1]["ids"] == ids:
            return
        self._calibrations.append(
            {
                "bag": bag,
                "since_ns": since_ns,
                "ids": ids,
            }
        )

    def write_meta(self) -> None:
        """Write episodes, tasks, features and statistics into the folder meta/ of the data set.

        It is called once, after the last episode.
        """
        meta = self._folder / "meta"
        path = meta / "episodes" / FILE_NAME.format(chunk_index=0, file_index=0)
        path.parent.mkdir(parents=True, exist_ok=True)
        episodes = pyarrow.Table.from_pylist(self.episodes)
        tasks = _task_table(self._tasks)
        pyarrow.parquet.write_table(episodes, path)
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
                "data_files_size_in_mb": MAX_FILE_MB,
                "video_files_size_in_mb": 2 * MAX_FILE_MB,
                "fps": self.fps,
                "splits": {"train": f"0:{len(self.episodes)}"},
                "data_path": f"data/{FILE_NAME}",
                "video_path": None,
                "features": self._features(),
            },
        )
        statistics = {
            key: self._as_lists(key, one.result(self.frames))
            for key, one in self._statistics.items()
        }
        _write_json(meta / "stats.json", statistics)

    def _close_file(self) -> None:
        """Complete the current Parquet file, if there is one."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None

    def _as_lists(self, key: str, result: dict[str, AnyArray]) -> dict[str, Any]:
        """Return the statistics of a feature as lists, which JSON and Parquet can contain.

        Those of images get the shape (bands, 1, 1), where bands are colour channels.

        Args:
            key: Name of the feature.
            result: Statistics of the feature, by their names such as ``mean``.
        """
        lists = {}
        for name, values in result.items():
            if key in self._image_keys and name != "count":
                # LeRobot normalises images of the shape (bands, height, width), to which statistics
                # of the shape (bands, 1, 1) are broadcast.
                values = values[:, np.newaxis, np.newaxis]
            lists[name] = values.tolist()
        return lists

    def _features(self) -> dict[str, Any]:
        """Return the description of all features (columns of the data set) for info.json.

        The skin is described under the key ``info`` of the tactile feature, because LeRobot's tools
        keep this key when they copy or merge data sets.
        """
        cubes = len(self._skin.cubes)
        window = (self.depth, cubes)
        about = describe_skin(self._skin) | {"calibrations": self._calibrations}
        tactile = _feature(
            "float32",
            (*window, len(COMPONENTS)),
            ["sample", "cube", "component"],
        )
        features = {TACTILE: tactile | {"info": about}}
        for name, kind in WINDOW_COLUMNS.items():
            dtype = np.dtype(kind).name
            features[f"{TACTILE}.{name}"] = _feature(dtype, window, ["sample", "cube"])
        names = list(self._skin.names)
        features[f"{TACTILE}.count"] = _feature("int64", (cubes,), names)
        for topic in self._topics:
            if topic.key in self._image_keys:
                axes = ["height", "width", "channels"]
                features[topic.key] = _feature("image", topic.shape, axes)
            else:
                width = len(topic.names)
                features[topic.key] = _feature("float32", (width,), topic.names)
        for key, dtype in COUNTER_FEATURES.items():
            features[key] = _feature(dtype, (1,), None)
        return features


def describe_skin(skin: Skin) -> dict[str, Any]:
    """Describe the feature `observation.tactile`: components, units, and the cubes' poses."""
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


def _feature(
    dtype: str,
    shape: tuple[int, ...],
    names: list[str] | None,
) -> dict[str, Any]:
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


def _column(values: AnyArray | list[EncodedImage]) -> pyarrow.Array:
    """Convert the values of a feature in n frames to a column of a Parquet file.

    Args:
        values: n images, or an array (n, …). An array (n, 1) becomes n numbers, one with more
            dimensions becomes nested lists.
    """
    if isinstance(values, list):
        # If the path is None, LeRobot reads the image from the bytes.
        images = [{"bytes": image.data, "path": None} for image in values]
        return pyarrow.array(images, _IMAGE)
    flat = np.ascontiguousarray(values).reshape(-1)
    array = pyarrow.array(flat)
    shape = values.shape[1:]
    if shape == (1,):
        return array
    # Lists are nested from the last dimension to the first: each step joins `size` successive
    # numbers or lists to one list.
    for size in reversed(shape):
        offsets = np.arange(0, len(array) + 1, size, dtype=np.int32)
        array = pyarrow.ListArray.from_arrays(offsets, array)
    return array


def _task_table(tasks: list[str]) -> pyarrow.Table:
    """Return the table of tasks: the index of each task, and its text as the row label in pandas.

    Args:
        tasks: Texts of the tasks, by their indices.
    """

    def column(
        name: str,
        pandas_type: str,
        numpy_type: str,
    ) -> dict[str, Any]:
        """Return pandas' description of a column: its name and types.

        Args:
            name: Name of the column.
            pandas_type: Type in pandas, such as "unicode".
            numpy_type: Type in numpy, such as "object".
        """
        kinds = {"pandas_type": pandas_type, "numpy_type": numpy_type}
        return {
            "name": name,
            "field_name": name,
            **kinds,
            "metadata": None,
        }

    # Format of this metadata: https://pandas.pydata.org/docs/development/developer.html
    described = {
        "index_columns": ["task"],
        "column_indexes": [],
        "columns": [
            column("task_index", "int64", "int64"),
            column("task", "unicode", "object"),
        ],
        "pandas_version": "2.0.0",
    }
    numbers = range(len(tasks))
    table = pyarrow.table({"task_index": numbers, "task": tasks})
    return table.replace_schema_metadata({"pandas": json.dumps(described)})


def _write_json(path: Path, value: Any) -> None:
    """Write a value to a JSON file as LeRobot does: indented, in UTF-8."""
    path.write_text(
        json.dumps(
            value,
            indent=4,
            ensure_ascii=False,
        )
        + "\n",
        encoding="utf-8",
    )
