# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The files of a LeRobot data set, version 3.0: Parquet in data/ and meta/, and JSON in meta/.

Source of the format: `lerobot.datasets` in the package lerobot 0.4.4.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow
import pyarrow.parquet

from ..bags.tables import as_column
from ..config.skin import Skin
from ..core.arrays import AnyArray
from ..core.modes import COMPONENTS, STRESS
from .images import decode
from .plan import Episode
from .statistics import MAX_SAMPLE_ROWS, Part, describe, summarise
from .topics import Topic
from .windows import TACTILE

VERSION = "v3.0"
"""Version of LeRobotDataset, the file format for robot learning in which data sets are written."""

FILES_PER_CHUNK = 1000
"""Number of Parquet files in one folder (LeRobot: chunk), above which LeRobot begins a new folder
if it adds episodes to a data set."""

FILE_MB = 100
"""Size of a file, in MB (2**20 bytes), above which LeRobot begins a new one if it adds episodes to
a data set. The files that are written here contain one bag each, whatever its size is."""

FILE_NAME = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
"""Pattern (for `str.format`) of a Parquet file's path, relative to data/ or meta/episodes/."""

RESIDUAL = f"{TACTILE}.residual"
"""Name of the feature with the residual: the part of the pads' measurements that no stress
explains, divided by their noise."""

AXES = ("sample", "cube", "component")
"""Names of the axes of a feature of the stress in one frame: sample in the frame, cube, and
component of stress or gradient."""

IMAGE_AXES = ("height", "width", "channels")
"""Names of the axes of an image."""

PIXEL_STRIDE = 4
"""Step, in pixels, along height and width between the pixels that enter the statistics of colours.
With 4, one pixel in 16 is used."""

_IMAGE = pyarrow.struct([("bytes", pyarrow.binary()), ("path", pyarrow.string())])
"""Parquet type of an image as LeRobot stores it: the bytes of the image file, or its path."""

Columns = Mapping[str, AnyArray | list[bytes]]
"""Values in n frames by the name of the feature: an array (n, …), or the contents of n image
files."""


class DataSet:
    """A LeRobot data set (table of frames, which are time steps at a constant rate).

    It is written episode after episode (an episode is one execution of a task).

    Attributes:
        calibrations: One entry for the first calibrations, and one for each change. An entry has
            the ids of the cubes' calibrations, and the bag and the stamp (ns since the Unix epoch)
            from which on they were used.
    """

    def __init__(
        self,
        folder: Path,
        skin: Skin,
        topics: list[Topic],
        fps: int,
        frames: int,
    ) -> None:
        """Begin an empty data set.

        Args:
            folder: Folder of the data set.
            skin: Skin of all bags.
            topics: Topics other than stress that become features (columns), such as images.
            fps: Frames per second.
            frames: Total number of frames that will be written.
        """
        self.calibrations: list[dict[str, object]] = []
        self._folder = folder
        self._skin = skin
        self._fps = fps
        self._total_frames = frames
        self._names = {topic.key: list(topic.names) for topic in topics}
        self._names[f"{TACTILE}.count"] = list(skin.names)
        self._features: dict[str, dict[str, object]] = {}
        self._tasks: dict[str, int] = {}
        self._episodes: list[dict[str, object]] = []
        self._writer: pyarrow.parquet.ParquetWriter | None = None
        self._file_number = 0
        self._frames = self._first_frame = 0
        self._random = np.random.default_rng(0)
        # Each call of `write` appends one part (statistics of its frames) to every feature's list.
        # The parts from index `_first_part` on belong to the current episode.
        self._parts: dict[str, list[Part]] = defaultdict(list)
        self._first_part = 0

    def write(self, columns: Columns, task: str) -> None:
        """Write successive frames of an episode as one group of rows of the current Parquet file.

        Args:
            columns: Values of the features by their names, without time and indices (of frame,
                episode and task), which are added here.
            task: Text of the episode's task.
        """
        index = self._frames + np.arange(len(columns[TACTILE]))
        frame = index - self._first_frame
        task_index = self._tasks.setdefault(task, len(self._tasks))
        counters: dict[str, AnyArray] = {
            "timestamp": (frame / self._fps).astype(np.float32),
            "frame_index": frame,
            "episode_index": np.full_like(frame, len(self._episodes)),
            "index": index,
            "task_index": np.full_like(frame, task_index),
        }
        counted = {key: values[:, np.newaxis] for key, values in counters.items()}
        columns = {**columns, **counted}
        table = pyarrow.table({key: _as_column(one) for key, one in columns.items()})
        if self._writer is None:
            name = FILE_NAME.format(chunk_index=0, file_index=self._file_number)
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
        self._frames += len(table)

        for key, values in columns.items():
            if isinstance(values, list):
                # A few pixels of one image suffice for the statistics of colours. Decoding every
                # image would be slow.
                pixels: AnyArray = decode(values[0])
                shape = pixels.shape
                names: Sequence[str] | None = IMAGE_AXES
                few = pixels[::PIXEL_STRIDE, ::PIXEL_STRIDE]
                # LeRobot normalises images of the shape (bands, height, width), to which statistics
                # of the shape (bands, 1, 1) are broadcast.
                rows: AnyArray = few.reshape(-1, shape[2], 1, 1)
            else:
                shape = values.shape[1:]
                names = AXES[: len(shape)] if len(shape) > 1 else self._names.get(key)
                rows = values.reshape(-1, 1 if key == RESIDUAL else shape[-1])
            dtype = "image" if isinstance(values, list) else values.dtype.name
            self._features[key] = {
                "dtype": dtype,
                "shape": shape,
                "names": names,
            }
            # Integers beside the stress (stamps, status bits) have no statistics, because policies
            # do not normalise them.
            if key in (TACTILE, RESIDUAL) or not key.startswith(TACTILE):
                expected_rows = len(rows) * self._total_frames / len(table)
                is_chosen = self._random.random(len(rows)) < MAX_SAMPLE_ROWS / expected_rows
                self._parts[key].append(describe(rows, is_chosen))

    def close_file(self) -> None:
        """Complete the current Parquet file; frames that follow get a new file."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None
            self._file_number += 1

    def end_episode(self, episode: Episode, bag: str) -> None:
        """Add an episode, whose frames have all been written, to the table of episodes.

        Args:
            episode: The episode.
            bag: Name of its bag.
        """
        frames = len(episode.frames)
        described: dict[str, object] = {
            "episode_index": len(self._episodes),
            "tasks": [episode.task],
            "length": frames,
            "data/chunk_index": 0,
            "data/file_index": self._file_number,
            "dataset_from_index": self._first_frame,
            "dataset_to_index": self._frames,
            # The descriptions of all episodes are in one file, because each takes only some kB.
            "meta/episodes/chunk_index": 0,
            "meta/episodes/file_index": 0,
            "bag": bag,
            "begin_ns": episode.begin_ns,
        }
        for key, parts in self._parts.items():
            statistics = summarise(parts[self._first_part :], frames)
            described |= {f"stats/{key}/{name}": value for name, value in statistics.items()}
        self._episodes.append(described)
        self._first_frame = self._frames
        self._first_part = len(self._parts[TACTILE])

    def write_meta(self) -> None:
        """Write episodes, tasks, features and statistics into the folder meta/ of the data set.

        It is called once, after the last episode.
        """
        meta = self._folder / "meta"
        path = meta / "episodes" / FILE_NAME.format(chunk_index=0, file_index=0)
        path.parent.mkdir(parents=True)
        pyarrow.parquet.write_table(pyarrow.Table.from_pylist(self._episodes), path)
        _write_tasks(list(self._tasks), meta / "tasks.parquet")
        # LeRobot's tools keep the key "info" of a feature when they copy or merge data sets.
        about = _describe_skin(self._skin)
        self._features[TACTILE]["info"] = about | {"calibrations": self.calibrations}
        info = {
            "codebase_version": VERSION,
            "robot_type": self._skin.name,
            "total_episodes": len(self._episodes),
            "total_frames": self._frames,
            "total_tasks": len(self._tasks),
            "chunks_size": FILES_PER_CHUNK,
            "data_files_size_in_mb": FILE_MB,
            "video_files_size_in_mb": FILE_MB,
            "fps": self._fps,
            "splits": {"train": f"0:{len(self._episodes)}"},
            "data_path": f"data/{FILE_NAME}",
            "video_path": None,
            "features": self._features,
        }
        statistics = {key: summarise(parts, self._frames) for key, parts in self._parts.items()}
        for name, value in (("info", info), ("stats", statistics)):
            text = json.dumps(
                value,
                indent=4,
                ensure_ascii=False,
            )
            (meta / f"{name}.json").write_text(text + "\n", encoding="utf-8")


def _as_column(values: AnyArray | list[bytes]) -> pyarrow.Array:
    """Return the values of a feature as a column of the Parquet file."""
    if isinstance(values, list):
        # LeRobot reads an image from the bytes if it has no path to an image file.
        return pyarrow.array([{"bytes": image, "path": None} for image in values], _IMAGE)
    # LeRobot stores a feature of one number as this number, and not as a list of it.
    is_one_number = values.shape[1:] == (1,)
    return as_column(values[:, 0] if is_one_number else values)


def _write_tasks(tasks: list[str], path: Path) -> None:
    """Write the table of tasks: the index of each task, and its text as the row label in pandas."""
    # This metadata makes the texts the row labels in pandas. Its format is described in
    # https://pandas.pydata.org/docs/development/developer.html
    label = {
        "name": "task",
        "field_name": "task",
        "pandas_type": "unicode",
        "numpy_type": "object",
    }
    described = json.dumps({"index_columns": ["task"], "columns": [label]})
    table = pyarrow.table({"task_index": range(len(tasks)), "task": tasks})
    table = table.replace_schema_metadata({"pandas": described})
    pyarrow.parquet.write_table(table, path)


def _describe_skin(skin: Skin) -> dict[str, object]:
    """Describe the feature `observation.tactile` (stress): components, units, and cubes' poses."""
    cubes = [
        {
            "name": cube.name,
            "frame": skin.frame(cube),
            "xyz": cube.xyz,
            "rpy": cube.rpy,
            "half_side": cube.calibration.half_side,
            "uid": cube.uid,
        }
        for cube in skin.cubes
    ]
    return {
        "components": COMPONENTS,
        "units": ["Pa" if name in STRESS else "Pa/m" for name in COMPONENTS],
        "sign": "tension is positive",
        "frame": "each cube's own: right-handed, z out of the skin",
        "unknown": "NaN: not observed, or in front of the first sample of a window",
        "parent_frame": skin.parent_frame,
        "pose_units": "m, rad (fixed axes x y z)",
        "cubes": cubes,
    }
