"""The files of a LeRobot data set, version 3.0: Parquet in data/ and meta/, and JSON in meta/.

Source: `lerobot.datasets` of the package lerobot 0.4.4, which reads and writes them.
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
from .images import IMAGES, EncodedImage
from .plan import BagPlan, Episode
from .statistics import Statistics
from .topics import Topic
from .windows import COLUMNS, TACTILE

VERSION = "v3.0"
"""Version of the format LeRobotDataset that is written."""

MAX_FILES_PER_CHUNK = 1000
"""Largest number of Parquet files in one folder ("chunk") of a data set."""

MAX_FILE_MB = 100
"""Size of a Parquet file, in MB, after which the next episode begins a new file. An episode is
never divided between files."""

FILE_NAME = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
"""Path of a Parquet file below data/ or meta/episodes/, as a pattern for `str.format`."""

COUNTED = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}
"""Features that count frames, episodes and tasks, with their types. LeRobot requires them."""

_IMAGE = pyarrow.struct(
    [
        ("bytes", pyarrow.binary()),
        ("path", pyarrow.string()),
    ]
)


class DataSet:
    """A data set that is written episode after episode; a context manager.

    Attributes:
        fps: Frames per second.
        depth: Number of samples in a window.
        widths: Number of columns of each feature that has statistics.
        frames: Number of frames written so far.
        episodes: Descriptions of the complete episodes.
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
        """Create the folder.

        Args:
            folder: Folder of the data set.
            skin: Skin of all bags.
            topics: Other topics.
            fps: Frames per second.
            depth: Number of samples in a window.
            samples: Number of samples of cubes that are to come.
        """
        (folder / "meta").mkdir(parents=True)
        self.fps, self.depth = fps, depth
        self.frames = 0
        self.episodes: list[dict[str, Any]] = []
        # Columns of whole numbers beside the stress are not normalised, so they have no statistics.
        self.widths = {
            TACTILE: len(COMPONENTS),
            f"{TACTILE}.residual": 1,
        }
        for topic in topics:
            bands = topic.shape[2]
            self.widths[topic.key] = bands or len(topic.names)
        self.widths |= dict.fromkeys(COUNTED, 1)
        self._folder = folder
        self._skin = skin
        self._topics = topics
        self._image_keys = {topic.key for topic in topics if topic.msgtype in IMAGES}
        self._statistics = {}
        for key, width in self.widths.items():
            self._statistics[key] = Statistics(width, samples)
        self._tasks: list[str] = []
        self._calibrations: list[dict[str, Any]] = []
        self._writer: Any = None
        # A file is created with its first frames, which determine the types of its columns.
        self._path = folder
        self._file_number = -1

    def __enter__(self) -> DataSet:
        return self

    def __exit__(self, *_: object) -> None:
        self._close_file()

    def begin_episode(self, task: str) -> tuple[dict[str, int], int]:
        """Return the place of the next episode's file, and the number of its task."""
        if task not in self._tasks:
            self._tasks.append(task)
        # The size on disk lags behind by one row group, so files are a little larger.
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
        """Write frames that follow each other, as one row group."""
        arrays = {}
        for name, values in columns.items():
            arrays[name] = _column(values)
        table = pyarrow.table(arrays)
        if self._writer is None:
            # Measured numbers hardly repeat: a dictionary of them only costs time.
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
        """Add rows (n, D) of a feature to the statistics of the data set and of an episode."""
        self._statistics[key].add(rows)
        of_episode[key].add(rows)

    def end_episode(
        self,
        plan: BagPlan,
        episode: Episode,
        place: dict[str, int],
        statistics: dict[str, Statistics],
    ) -> None:
        """Describe an episode whose frames are written; `place` is that of its file."""
        frames = len(episode.counts)
        described = {
            "episode_index": len(self.episodes),
            "tasks": [episode.task],
            "length": frames,
            **place,
            "dataset_from_index": self.frames - frames,
            "dataset_to_index": self.frames,
            # All descriptions stand in one file: a row takes some kB.
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
        """Note with which calibrations of the cubes the stress of a bag is made from a stamp on."""
        # Only changes are noted: most data sets have one calibration throughout.
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
        """Write what describes the data, once it is complete."""
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
        if self._writer is not None:
            self._writer.close()
            self._writer = None

    def _as_lists(self, key: str, result: dict[str, AnyArray]) -> dict[str, Any]:
        """Return statistics as lists; those of images have the shape (bands, 1, 1)."""
        lists = {}
        for name, values in result.items():
            if key in self._image_keys and name != "count":
                # LeRobot applies them to images (bands, height, width) by broadcasting.
                values = values[:, np.newaxis, np.newaxis]
            lists[name] = values.tolist()
        return lists

    def _features(self) -> dict[str, Any]:
        """Describe the features as info.json does.

        The skin is described in ``info`` of a feature, which LeRobot's tools carry on.
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
        for name, kind in COLUMNS.items():
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
        for key, dtype in COUNTED.items():
            features[key] = _feature(dtype, (1,), None)
        return features


def describe_skin(skin: Skin) -> dict[str, Any]:
    """Describe the numbers of `observation.tactile`: components, units, cubes and their poses."""
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
    """Describe a feature as info.json does."""
    return {
        "dtype": dtype,
        "shape": list(shape),
        "names": names,
    }


def _column(values: AnyArray | list[EncodedImage]) -> pyarrow.Array:
    """Return (n, ...) as lists of lists, (n, 1) as n numbers, and images as their bytes."""
    if isinstance(values, list):
        # LeRobot reads an image from its bytes where there is no path.
        images = [{"bytes": image.data, "path": None} for image in values]
        return pyarrow.array(images, _IMAGE)
    flat = np.ascontiguousarray(values).reshape(-1)
    array = pyarrow.array(flat)
    shape = values.shape[1:]
    if shape == (1,):
        return array
    # From the innermost dimension outwards, each list holds `size` lists of the one before.
    for size in reversed(shape):
        offsets = np.arange(0, len(array) + 1, size, dtype=np.int32)
        array = pyarrow.ListArray.from_arrays(offsets, array)
    return array


def _task_table(tasks: list[str]) -> pyarrow.Table:
    """Return the numbers of the tasks, with the texts as what pandas reads as the table's index."""

    def column(
        name: str,
        pandas_type: str,
        numpy_type: str,
    ) -> dict[str, Any]:
        kinds = {"pandas_type": pandas_type, "numpy_type": numpy_type}
        return {
            "name": name,
            "field_name": name,
            **kinds,
            "metadata": None,
        }

    # The format of this description: https://pandas.pydata.org/docs/development/developer.html
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
    path.write_text(
        json.dumps(
            value,
            indent=4,
            ensure_ascii=False,
        )
        + "\n",
        encoding="utf-8",
    )
