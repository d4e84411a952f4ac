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
from numpy.typing import NDArray

from .images import Encoded

VERSION = "v3.0"
CHUNK = 1000
"""Files in a folder at most."""
FILE_MB = 100
"""Size from which on an episode begins a new file; an episode is never divided."""
NAME = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
COUNTED = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}
"""What each frame of every data set has."""


def feature(dtype: str, shape: tuple[int, ...], names: Any = None, **more: Any) -> dict[str, Any]:
    """A feature as info.json describes it."""
    return {"dtype": dtype, "shape": list(shape), "names": names, **more}


def column(values: NDArray[Any] | list[Encoded]) -> pyarrow.Array:
    """(n, ...) as lists of lists; (n, 1) as n numbers; images as their bytes."""
    if isinstance(values, list):
        return pyarrow.array([{"bytes": image.data, "path": None} for image in values], IMAGE)
    array = pyarrow.array(np.ascontiguousarray(values).reshape(-1))
    inner = values.shape[1:]
    if inner == (1,):
        return array
    for size in reversed(inner):
        offsets = np.arange(0, len(array) + 1, size, dtype=np.int32)
        array = pyarrow.ListArray.from_arrays(offsets, array)
    return array


IMAGE = pyarrow.struct([("bytes", pyarrow.binary()), ("path", pyarrow.string())])


class DataFiles:
    """The frames of all episodes, in as many files as they need; a context."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._writer: Any = None
        self._path = folder
        self.number = -1

    def __enter__(self) -> DataFiles:
        return self

    def __exit__(self, *_: object) -> None:
        if self._writer is not None:
            self._writer.close()
            self._writer = None

    def begin_episode(self) -> dict[str, int]:
        """Where the next episode goes, by the names of its description."""
        if self._writer is None or self._path.stat().st_size >= FILE_MB << 20:
            self.__exit__()
            self.number += 1
        return {"data/chunk_index": self.number // CHUNK, "data/file_index": self.number % CHUNK}

    def write(self, columns: dict[str, NDArray[Any] | list[Encoded]]) -> None:
        """Frames that follow each other: one row group."""
        table = pyarrow.table({name: column(values) for name, values in columns.items()})
        if self._writer is None:
            place = {"chunk_index": self.number // CHUNK, "file_index": self.number % CHUNK}
            self._path = self._folder / "data" / NAME.format(**place)
            self._path.parent.mkdir(parents=True, exist_ok=True)
            # Measured numbers hardly repeat: a dictionary of them only costs time.
            self._writer = pyarrow.parquet.ParquetWriter(
                self._path, table.schema, compression="zstd", use_dictionary=False
            )
        self._writer.write_table(table)


def write_episodes(folder: Path, episodes: list[dict[str, Any]]) -> None:
    """One row for each episode."""
    place = {"chunk_index": 0, "file_index": 0}
    path = folder / "meta" / "episodes" / NAME.format(**place)
    path.parent.mkdir(parents=True, exist_ok=True)
    pyarrow.parquet.write_table(pyarrow.Table.from_pylist(episodes), path)


def write_tasks(folder: Path, tasks: list[str]) -> None:
    """task_index by task, which pandas reads as the index of the table."""
    table = pyarrow.table({"task_index": range(len(tasks)), "task": tasks})
    described = {
        "index_columns": ["task"],
        "column_indexes": [],
        "columns": [
            _pandas_column("task_index", "int64", "int64"),
            _pandas_column("task", "unicode", "object"),
        ],
        "pandas_version": "2.0.0",
    }
    table = table.replace_schema_metadata({"pandas": json.dumps(described)})
    pyarrow.parquet.write_table(table, folder / "meta" / "tasks.parquet")


def _pandas_column(name: str, kind: str, numpy_type: str) -> dict[str, Any]:
    return {
        "name": name,
        "field_name": name,
        "pandas_type": kind,
        "numpy_type": numpy_type,
        "metadata": None,
    }


def info(
    features: dict[str, Any], fps: int, robot: str, episodes: int, frames: int, tasks: int
) -> dict[str, Any]:
    """The content of info.json."""
    return {
        "codebase_version": VERSION,
        "robot_type": robot,
        "total_episodes": episodes,
        "total_frames": frames,
        "total_tasks": tasks,
        "chunks_size": CHUNK,
        "data_files_size_in_mb": FILE_MB,
        "video_files_size_in_mb": 2 * FILE_MB,
        "fps": fps,
        "splits": {"train": f"0:{episodes}"},
        "data_path": f"data/{NAME}",
        "video_path": None,
        "features": features,
    }


def write_json(path: Path, value: Any) -> None:
    """LeRobot's JSON files."""
    path.write_text(json.dumps(value, indent=4, ensure_ascii=False) + "\n", encoding="utf-8")
