# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Arrow tables of frequencies, and the function that computes tables of stress from them.

Frameworks that process many recordings in parallel (Ray, Dask, Daft, DuckDB) pass Arrow tables
between their worker processes.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pyarrow
import pyarrow.compute

from ...core.arrays import Array
from ...core.errors import BagError, LayoutError
from ...core.reconstructor import CalibratedSkin, Reconstructor, RecordedHealth
from ...core.rows import FrequencyRows
from ..recording import reconstruct_rows
from ..source import BagSource
from ..tables import STRESS_SCHEMA, as_array, as_column, make_cube_column, make_stress_batch

COLUMNS = {
    "cube": "cube",
    "stamp_ns": "stamp_ns",
    "sequence": "sequence",
    "frequency_Hz": "frequency",
    "temperature_degC": "temperature",
    "pad_fault": "pad_fault",
    "status": "status",
    "specific_force_m_per_s2": "specific_force",
}
"""Column of a table of frequencies -> attribute of `FrequencyRows` that it contains.

Frequencies (one per pad) and specific forces (x, y, z) are lists. The column `cube` contains names.
"""

REQUIRED = {"stamp_ns", "cube", "frequency_Hz"}
"""Columns that a table of frequencies must have; the others may be missing or null."""

NUMBER_LIST = pyarrow.list_(pyarrow.float64())
"""Arrow type of the columns with one list of numbers per row."""


def read_frequency_table(source: BagSource) -> pyarrow.Table:
    """Read the frequencies of a whole bag into an Arrow table, one row per sample of a cube.

    Besides the columns of `COLUMNS`, the table has columns with everything else that determines the
    stress:

    - `part` (int32): number of the group of consecutive rows that are computed together.
    - `recorded_left_out`, `recorded_status`: pads that were left out and the conditions of the pads
      (bits of `status.py`) as the recorded stress states them; null where none was recorded.
    - `recorded_rest_frequency`: frequencies without load of all pads of all cubes, in Hz. The value
      is in the first row to which it applies; the rows after it are null.
    - `recorded_creep`, `recorded_thermal`: states of creep and of the lagging temperature before
      the row; null where no state was recorded. The table has them only if the recording
      compensated these effects.

    Args:
        source: An open bag from which no frequencies have been read yet.

    Raises:
        BagError: The bag is damaged, or the calibration of a cube changes within it.
    """
    recording = source.recording
    recording.check_calibrations_stay()
    cubes = pyarrow.array([*source.skin.names, "unknown"])
    number = -1
    # Values that apply from the next row on: rest frequencies, states of creep and temperature.
    changes: dict[str, Array] = {}
    parts: list[pyarrow.Table] = []
    for segment in source.read_segments(use_health=True):
        rows = segment.messages.rows
        changes |= segment.states
        if segment.number != number:
            number = segment.number
            changes["rest_frequency"] = recording.settings[number].rest_frequency
        # `changes` are written into the first row of a segment. If a segment has no rows, they are
        # kept for the next one.
        health = segment.health
        if not len(rows) or health is None:
            continue

        unknown = ~health.known
        part = np.full(len(rows), len(parts), np.int32)
        columns = {
            "part": pyarrow.array(part),
            "recorded_left_out": pyarrow.array(health.left_out, mask=unknown),
            "recorded_status": pyarrow.array(health.status, mask=unknown),
        }
        values = rows.collect_columns()
        for name, attribute in COLUMNS.items():
            if attribute in values:
                columns[name] = as_column(values[attribute])
        columns["cube"] = make_cube_column(rows, cubes)
        for name, change in changes.items():
            others = [None] * (len(rows) - 1)
            lists = pyarrow.array([change.ravel(), *others], NUMBER_LIST)
            columns[f"recorded_{name}"] = lists
        changes = {}
        parts.append(pyarrow.table(columns))
    if not parts:
        raise BagError(f"{source.bag.path}: no frequencies on {source.topic}; record them")
    # A part that lacks a column of the other parts gets null in it.
    return pyarrow.concat_tables(parts, promote_options="default")


def reprocess_table(
    frequencies: pyarrow.Table,
    skin: CalibratedSkin,
) -> pyarrow.Table:
    """Compute the stress of one recording of one skin, from an Arrow table to an Arrow table.

    The result depends on the arguments only, so frameworks such as Ray or Dask can call this
    function in any process. With a table of `read_frequency_table` and the skin of the bag, the
    values equal those of `./cube reprocess` bit by bit. For a skin with other calibrations, leave
    out the columns of recorded health and rest frequencies (frequencies without load): then faulty
    pads are detected from the frequencies, and the rest frequencies are those of the skin.

    The table must be a whole recording in the order of time, because the stress of a row depends on
    the rows before it through the health of the pads, the last tare, creep and temperature lag. A
    table that begins within a recording is computed as after a restart of the node: with the rest
    frequencies of the calibrations, healthy pads and no creep.

    Args:
        frequencies: Rows (samples of cubes) with the columns that `read_frequency_table` states, of
            which only those of `REQUIRED` must be there.
        skin: The skin with the names and calibrations of the cubes.

    Returns:
        One row per row of frequencies, with the columns of `./cube reprocess --format parquet`.

    Raises:
        LayoutError: Columns are missing, or rows have cubes or pads that the skin does not have.
    """
    reconstructor = Reconstructor(skin)
    if not len(frequencies):
        return STRESS_SCHEMA.empty_table()
    bounds = [0, len(frequencies)]
    if "part" in frequencies.column_names:
        part = frequencies["part"].to_numpy()
        begins = np.flatnonzero(np.diff(part)) + 1
        bounds[1:1] = begins.tolist()

    known_names = pyarrow.array(skin.names, pyarrow.string())
    cubes = pyarrow.array([*skin.names, "unknown"])
    batches = []
    for begin, end in pairwise(bounds):
        piece = frequencies.slice(begin, end - begin)
        columns = {
            name: piece[name].combine_chunks()
            for name in piece.column_names
            if piece[name].null_count < len(piece)
        }
        missing = REQUIRED - columns.keys()
        if missing:
            names = ", ".join(sorted(missing))
            raise LayoutError(f"no {names} in the table; read_frequency_table makes one of a bag")
        cube = columns["cube"]
        if not pyarrow.types.is_dictionary(cube.type):
            cube = cube.dictionary_encode()
        names = cube.dictionary.cast(pyarrow.string())
        found = pyarrow.compute.index_in(names, value_set=known_names)
        number = found.take(cube.indices).fill_null(len(known_names))
        columns["cube"] = number.cast(pyarrow.uint16())
        _restore(reconstructor, columns)
        attributes = {
            attribute: as_array(columns[name])
            for name, attribute in COLUMNS.items()
            if name in columns
        }
        rows = FrequencyRows.from_values(**attributes)
        health = _read_recorded_health(columns)
        stress = reconstruct_rows(reconstructor, rows, health)
        batches.append(make_stress_batch(stress, cubes))
    return pyarrow.Table.from_batches(batches, STRESS_SCHEMA)


def _read_recorded_health(columns: dict[str, pyarrow.Array]) -> RecordedHealth | None:
    """Return the recorded health of the pads from Arrow columns; None if they are missing."""
    if not columns.keys() >= {"recorded_left_out", "recorded_status"}:
        return None
    left_out = columns["recorded_left_out"]
    status = columns["recorded_status"]
    return RecordedHealth(
        known=as_array(left_out.is_valid()).astype(bool),
        left_out=as_array(left_out.fill_null(0)).astype(np.uint32),
        status=as_array(status.fill_null(0)).astype(np.uint16),
    )


def _restore(
    reconstructor: Reconstructor,
    columns: dict[str, pyarrow.Array],
) -> None:
    """Set recorded rest frequencies and states of creep and temperature in a reconstructor.

    Args:
        reconstructor: The reconstructor that will process the rows.
        columns: Arrow columns of one part of a table, with these values in the first row only.

    Raises:
        LayoutError: A later row has such values, or they do not fit the skin.
    """
    for name, column in columns.items():
        key = name.removeprefix("recorded_")
        if key == name or not pyarrow.types.is_nested(column.type):
            continue
        if column[1:].null_count < len(column) - 1:
            raise LayoutError(f"{name} changes within a part; keep the column part of its table")
        value = as_array(column)[0]
        if key != "rest_frequency":
            reconstructor.compensation.restore({key: value})
        elif value.size == reconstructor.rest_frequency.size:
            reconstructor.rest_frequency = value.reshape(reconstructor.rest_frequency.shape)
        else:
            raise LayoutError(f"{name} has {value.size} numbers; use the skin of its bag")
