# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Search for the row of one table that is the same sample of a cube as a row of another table.

A sample is identified by its cube and its sequence number. A hub that restarts gives the same
numbers again; then the time stamps tell the samples apart.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from .arrays import Index, Integers, Times

NO_MATCH = -1
"""Index in the result of `match_rows` for a wanted row whose sample is in no known row."""

_SEQUENCE_BITS = 32
"""Number of bits of a sequence number.

The number of a cube and a sequence number fit one 64-bit integer, which is the key of a sample.
"""


class SampleRows(Protocol):
    """Table of N samples with the columns (N,) that identify them.

    `FrequencyRows`, `StressRows` and `SampleKeys` have these columns.
    """

    @property
    def cube(self) -> Integers:
        """Index (N,) of the cube of each sample."""

    @property
    def sequence(self) -> Integers:
        """Sequence number (N,) that the hub gave each sample."""

    @property
    def stamp_ns(self) -> Times:
        """Time of sampling (N,), in ns."""


class SampleKeys(NamedTuple):
    """Only the columns that identify N samples, for tables without frequencies or stress.

    Attributes:
        cube: Number of the cube (N,), or of the hub if each hub counts its samples.
        sequence: Sequence number of the sample (N,), which wraps at 2**32.
        stamp_ns: Time of the sample (N,), in ns since the epoch of the table's clock.
    """

    cube: Integers
    sequence: Integers
    stamp_ns: Times


def match_rows(known: SampleRows, wanted: SampleRows) -> Index:
    """Find, for each wanted row (sample of one cube), the known row of the same sample.

    Rows of the same sample have the same cube and the same sequence number.

    Args:
        known: M rows to search, in any order.
        wanted: N rows to find.

    Returns:
        Index (N,) into the known rows, or `NO_MATCH`. Where a cube has the same sequence number
        several times, the known row with the nearest time stamp is chosen. Time stamps need not be
        equal; a caller that needs equal ones compares them afterwards.
    """
    known_keys = _make_keys(known)
    wanted_keys = _make_keys(wanted)
    order = np.argsort(known_keys, kind="stable")
    sorted_keys = known_keys[order]
    begin = np.searchsorted(sorted_keys, wanted_keys, side="left")
    end = np.searchsorted(sorted_keys, wanted_keys, side="right")
    has_match = begin < end

    found = np.full(len(wanted_keys), NO_MATCH, np.intp)
    found[has_match] = order[begin[has_match]]
    # More than one known row has the same key only if a hub restarted and counted from 0 again.
    n_candidates = end - begin
    max_candidates = int(n_candidates.max(initial=0))
    for repeat in range(1, max_candidates):
        rows = np.flatnonzero(repeat < n_candidates)
        candidate = order[begin[rows] + repeat]
        stamp_ns = wanted.stamp_ns[rows]
        distance_ns = np.abs(known.stamp_ns[candidate] - stamp_ns)
        best_ns = np.abs(known.stamp_ns[found[rows]] - stamp_ns)
        nearer = distance_ns < best_ns
        found[rows[nearer]] = candidate[nearer]
    return found


def _make_keys(rows: SampleRows) -> Times:
    """Return keys (N,) of rows: integers that combine cube number and sequence number.

    Two rows have the same key if they have the same cube and the same sequence number.
    """
    cube = rows.cube.astype(np.int64) << _SEQUENCE_BITS
    return cube | rows.sequence.astype(np.int64)
