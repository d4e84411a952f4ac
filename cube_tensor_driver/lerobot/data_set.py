# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The files of a LeRobot data set, version 3.0: Parquet in data/ and meta/, and JSON in meta/.

Source of the format: `lerobot.datasets` in the package lerobot 0.4.4.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow
import pyarrow.parquet

from ..bags.tables import as_column
from ..config.skin import Skin
from ..core.arrays import AnyArray
from ..core.modes import COMPONENTS, STRESS
from .images import decode
from .plan import BagPlan, Episode
from .statistics import MAX_SAMPLE_ROWS, Part, describe, summarise
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

    It is written bag after bag.
    """

    def __init__(
        self,
        folder: Path,
        fps: int,
        names: Mapping[str, Sequence[str]],
        total_frames: int,
    ) -> None:
        """Begin an empty data set.

        Args:
            folder: Folder of the data set.
            fps: Frames per second.
            names: Names of the numbers in features (columns) of one dimension.
            total_frames: Number of frames that will be written.
        """
        self._folder = folder
        self._fps = fps
        self._names = names
        self._total_frames = total_frames
        self._features: dict[str, dict[str, object]] = {}
        self._tasks: dict[str, int] = {}
        self._episodes: list[dict[str, object]] = []
        self._files = self._frames = 0
        self._random = np.random.default_rng(0)
        # The statistics of each block of frames that has been written, for each feature.
        self._parts: dict[str, list[Part]] = defaultdict(list)

    def write_bag(self, plan: BagPlan, blocks: Iterator[Columns]) -> None:
        """Write the episodes (executions of a task) of a bag as one Parquet file.

        Args:
            plan: Episodes and frames of the bag.
            blocks: Values of the features in each block of frames, without time and indices (of
                frame, episode and task), which are added here.
        """
        path = self._folder / "data" / FILE_NAME.format(chunk_index=0, file_index=self._files)
        path.parent.mkdir(parents=True, exist_ok=True)
        writer = None
        for episode in plan.episodes:
            first_frame, first_part = self._frames, len(self._parts[TACTILE])
            task_index = self._tasks.setdefault(episode.task, len(self._tasks))
            for _ in episode.blocks:
                columns = dict(next(blocks))
                index = self._frames + np.arange(len(columns[TACTILE]))
                frame = index - first_frame
                columns |= {
                    "timestamp": (frame / self._fps).astype(np.float32),
                    "frame_index": frame,
                    "episode_index": np.full_like(frame, len(self._episodes)),
                    "index": index,
                    "task_index": np.full_like(frame, task_index),
                }
                table = pyarrow.table({key: _as_column(one) for key, one in columns.items()})
                # Dictionary encoding saves space only if values repeat. Measured ones rarely do.
                writer = writer or pyarrow.parquet.ParquetWriter(
                    path,
                    table.schema,
                    compression="zstd",
                    use_dictionary=False,
                )
                writer.write_table(table)
                self._frames += len(table)
                for key, values in columns.items():
                    self._describe(key, values)
            self._end_episode(plan, episode, first_frame, first_part)
        if writer is not None:
            writer.close()
            self._files += 1

    def _describe(self, key: str, values: AnyArray | list[bytes]) -> None:
        """Note type, shape and statistics of a block of values of a feature."""
        names: Sequence[str] | None
        rows: AnyArray
        if isinstance(values, list):
            # A few pixels of one image suffice for the statistics of colours. Decoding every image
            # would be slow.
            pixels = decode(values[0])
            dtype, shape, names = "image", pixels.shape, IMAGE_AXES
            # LeRobot normalises images of the shape (bands, height, width), to which statistics of
            # the shape (bands, 1, 1) are broadcast.
            rows = pixels[::PIXEL_STRIDE, ::PIXEL_STRIDE].reshape(
                -1,
                shape[2],
                1,
                1,
            )
        else:
            dtype, shape = values.dtype.name, values.shape[1:] or (1,)
            names = AXES[: len(shape)] if len(shape) > 1 else self._names.get(key)
            rows = values.reshape(-1, 1 if key == RESIDUAL else shape[-1])
        self._features[key] = {"dtype": dtype, "shape": shape, "names": names}
        # Integers beside the stress (stamps, status bits) have no statistics, because policies do
        # not normalise them.
        if key in (TACTILE, RESIDUAL) or not key.startswith(TACTILE):
            expected_rows = len(rows) * self._total_frames / len(values)
            is_chosen = self._random.random(len(rows)) < MAX_SAMPLE_ROWS / expected_rows
            self._parts[key].append(describe(rows, is_chosen))

    def _end_episode(
        self,
        plan: BagPlan,
        episode: Episode,
        first_frame: int,
        first_part: int,
    ) -> None:
        """Add an episode, whose frames have all been written, to the table of episodes."""
        frames = self._frames - first_frame
        described: dict[str, object] = {
            "episode_index": len(self._episodes),
            "tasks": [episode.task],
            "length": frames,
            "data/chunk_index": 0,
            "data/file_index": self._files,
            "dataset_from_index": first_frame,
            "dataset_to_index": self._frames,
            # The descriptions of all episodes are in one file, because each takes only some kB.
            "meta/episodes/chunk_index": 0,
            "meta/episodes/file_index": 0,
            "bag": plan.path.name,
            "begin_ns": episode.begin_ns,
        }
        for key, parts in self._parts.items():
            statistics = summarise(parts[first_part:], frames)
            described |= {f"stats/{key}/{name}": value for name, value in statistics.items()}
        self._episodes.append(described)

    def write_meta(
        self,
        skin: Skin,
        calibrations: list[dict[str, object]],
    ) -> None:
        """Write episodes, tasks, features and statistics into the folder meta/ of the data set.

        It is called once, after the last bag.

        Args:
            skin: Skin of all bags.
            calibrations: One entry for the first calibrations, and one for each change. An entry
                has the ids of the cubes' calibrations, and the bag and the stamp (ns since the Unix
                epoch) from which on they were used.
        """
        meta = self._folder / "meta"
        path = meta / "episodes" / FILE_NAME.format(chunk_index=0, file_index=0)
        path.parent.mkdir(parents=True)
        pyarrow.parquet.write_table(pyarrow.Table.from_pylist(self._episodes), path)
        _write_tasks(list(self._tasks), meta / "tasks.parquet")
        # LeRobot's tools keep the key "info" of a feature when they copy or merge data sets.
        about = _describe_skin(skin)
        self._features[TACTILE]["info"] = about | {"calibrations": calibrations}
        info = {
            "codebase_version": VERSION,
            "robot_type": skin.name,
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
            text = json.dumps(value, indent=4, ensure_ascii=False)
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
            "frame": skin.make_frame_id(cube),
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
