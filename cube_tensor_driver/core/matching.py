"""Which row of one table is the same sample as a row of another.

A sample is identified by its cube and its sequence number. A hub that restarts gives the same
numbers again; then the time stamp tells which of them is meant.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from .arrays import AnyArray, Index

NO_MATCH = -1
"""Index that stands for a row without a partner."""

_SEQUENCE_BITS = 32
"""Width of a sequence number; cube and number together fit one 64-bit key."""


class SampleRows(Protocol):
    """Columns (N,) that identify samples: `FrequencyRows`, `StressRows` or `SampleKeys`."""

    @property
    def cube(self) -> AnyArray: ...

    @property
    def sequence(self) -> AnyArray: ...

    @property
    def stamp_ns(self) -> AnyArray: ...


class SampleKeys(NamedTuple):
    """The identifying columns alone, for tables that are no rows of frequencies or stress.

    Attributes:
        cube: (N,) index of the cube, or of whatever the numbers are counted for (such as a hub).
        sequence: (N,) sequence number, which wraps at 2**32.
        stamp_ns: (N,) time of the sample, in ns.
    """

    cube: AnyArray
    sequence: AnyArray
    stamp_ns: AnyArray


def match_rows(known: SampleRows, wanted: SampleRows) -> Index:
    """Find, for each wanted row, the known row of the same cube and sequence number.

    Args:
        known: M rows to search, in any order.
        wanted: N rows to find.

    Returns:
        (N,) index into the known rows, or `NO_MATCH`. Where a cube has the same number several
        times, the known row whose stamp is nearest is chosen. Compare the stamps afterwards if
        they must be equal.
    """
    known_keys, wanted_keys = _keys(known), _keys(wanted)
    order = np.argsort(known_keys, kind="stable")
    sorted_keys = known_keys[order]
    begin = np.searchsorted(sorted_keys, wanted_keys, side="left")
    end = np.searchsorted(sorted_keys, wanted_keys, side="right")
    has_match = begin < end

    found = np.full(len(wanted_keys), NO_MATCH, np.intp)
    found[has_match] = order[begin[has_match]]
    # Further candidates exist only where numbers were given again after a restart.
    for repeat in range(1, int((end - begin).max(initial=0))):
        rows = np.flatnonzero(begin + repeat < end)
        candidate = order[begin[rows] + repeat]
        distance_ns = np.abs(known.stamp_ns[candidate] - wanted.stamp_ns[rows])
        best_ns = np.abs(known.stamp_ns[found[rows]] - wanted.stamp_ns[rows])
        nearer = distance_ns < best_ns
        found[rows[nearer]] = candidate[nearer]
    return found


def _keys(rows: SampleRows) -> AnyArray:
    """Join cube and sequence number in one integer per row, (N,)."""
    cube = rows.cube.astype(np.int64) << _SEQUENCE_BITS
    keys: AnyArray = cube | rows.sequence.astype(np.int64)
    return keys
