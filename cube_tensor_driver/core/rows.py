# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Rows: the tables of frequencies and of stress that the steps of the program pass on.

One row is one sample: all pads of one cube at one instant. A scan has at most one row per cube, all
read at about the same time. A table holds the rows of one scan, or of several scans one after the
other.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .arrays import AnyArray, Index, Mask, PadMasks, Real, Single, StatusBits, Times

COUNTER_RANGE = 1 << 32
"""Number of values of a hub's counters, which have 32 bits. After the largest one, the numbers of
samples and the counts of lost samples continue at 0."""

COLUMN_TYPES: dict[str, type] = {
    "sequence": np.uint32,
    "stamp_ns": np.int64,
    "temperature": np.float32,
    "pad_fault": np.uint32,
    "residual": np.float32,
    "status": np.uint16,
    "observed": np.uint16,
    "left_out": np.uint32,
}
"""Type of each column of rows that has one number per row, the same as in the ROS messages."""


class _Rows:
    """Base class of tables of N rows (samples of one cube), whose fields are arrays (N, ...)."""

    __slots__ = ()
    cube: NDArray[np.uint16]
    stamp_ns: Times

    def __len__(self) -> int:
        return len(self.cube)

    def __repr__(self) -> str:
        name = type(self).__name__
        if not len(self):
            return f"{name}(no rows)"
        cubes = len(np.unique(self.cube))
        duration_s = float(np.ptp(self.stamp_ns)) * 1e-9
        return f"{name}({len(self)} rows of {cubes} cubes over {duration_s:.3g} s)"

    def select(self: _Kind, chosen: Mask | Index | slice) -> _Kind:
        """Return some of the rows.

        Args:
            chosen: Row numbers, a slice or a mask (N,), with which numpy indexes an array.
        """
        columns = self.collect_columns()
        selected = {name: column[chosen] for name, column in columns.items()}
        return self.from_columns(selected)

    @classmethod
    def from_columns(cls: type[_Kind], columns: Mapping[str, AnyArray]) -> _Kind:
        """Return a table with these columns, by name."""
        return cls(**columns)

    def collect_columns(self) -> dict[str, AnyArray]:
        """Return the columns that the table has, by name."""
        names = (field.name for field in fields(self))  # type: ignore[arg-type]
        columns = {name: getattr(self, name) for name in names}
        return {name: column for name, column in columns.items() if column is not None}


_Kind = TypeVar("_Kind", bound=_Rows)


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class FrequencyRows(_Rows):
    """Measured frequencies: N rows (samples of one cube) of P pads.

    Attributes:
        cube: Number of the cube in the skin (N,).
        sequence: Number that the hub gave the sample (N,); it wraps to 0 at 2**32.
        stamp_ns: Time at which the pads were read (N,), in ns of the source's clock.
        frequency: Frequency of each pad (N, P), in Hz. NaN where nothing was measured, and where
            the cube has no such pad.
        temperature: Temperature of the cube (N,), in °C; NaN where it is unknown.
        pad_fault: Bit masks (N,); bit p is set if the device reports that pad p is broken.
        status: Bits of `status.py` (N,), of which only STAMP (doubtful time stamp) is used.
        specific_force: Specific force at each cube in the cube's frame (N, 3), in m/s²: what an
            accelerometer there measures, acceleration minus gravity. NaN where it is unknown. None:
            weight and inertia are not compensated.
    """

    cube: NDArray[np.uint16]
    sequence: NDArray[np.uint32]
    stamp_ns: Times
    frequency: Single
    temperature: Single
    pad_fault: PadMasks
    status: StatusBits
    specific_force: Single | None = None

    @classmethod
    def from_values(
        cls,
        cube: ArrayLike,
        frequency: ArrayLike,
        *,
        stamp_ns: ArrayLike = 0,
        sequence: ArrayLike = 0,
        temperature: ArrayLike = np.nan,
        pad_fault: ArrayLike = 0,
        status: ArrayLike = 0,
        specific_force: ArrayLike | None = None,
    ) -> FrequencyRows:
        """Construct N rows from numbers, lists or arrays.

        Args:
            cube: Numbers of the cubes (N,).
            frequency: Frequencies (N, P), in Hz.
            stamp_ns, sequence, temperature, pad_fault, status: The other attributes, each with N
                values or with one value for all rows.
            specific_force: Specific forces (N, 3) or (3,), in m/s²; None: there is no such column.
        """
        columns = _fill_columns(
            cube,
            stamp_ns=stamp_ns,
            sequence=sequence,
            temperature=temperature,
            pad_fault=pad_fault,
            status=status,
        )
        if specific_force is not None:
            shape = len(columns["cube"]), 3
            columns["specific_force"] = np.array(np.broadcast_to(specific_force, shape), np.float32)
        columns["frequency"] = np.asarray(frequency)
        return cls.from_columns(columns)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False, repr=False)
class StressRows(_Rows):
    """Reconstructed stress: N rows (samples of one cube), in the cube's frame, tension positive.

    Attributes:
        cube, sequence, stamp_ns: Cube number, sequence number and time stamp (N,), taken from the
            `FrequencyRows` that the stress was computed from.
        stress: Stress (N, 6), in Pa, in the order xx, yy, zz, yz, zx, xy. NaN where the pads do not
            determine a component.
        gradient: Gradients of the normal stresses (N, 9), in Pa/m: xx, yy and zz, each with its
            derivatives along x, y and z. NaN where the pads do not determine a component.
        residual: sqrt(chi-square / degrees of freedom) (N,), about 1 for noise alone. Chi-square
            measures how far the signals of the pads contradict each other. NaN where the pads are
            too few to contradict each other.
        status: Bits of `status.py` (N,).
        observed: Bit masks (N,); bit i is set if component i of `modes.COMPONENTS` was recovered.
        left_out: Bit masks (N,); bit p is set if pad p was not used.
    """

    cube: NDArray[np.uint16]
    sequence: NDArray[np.uint32]
    stamp_ns: Times
    stress: Real
    gradient: Real
    residual: Real
    status: StatusBits
    observed: NDArray[np.uint16]
    left_out: PadMasks

    @property
    def components(self) -> Real:
        """Stress, in Pa, and gradients, in Pa/m, in one array (N, 15), as `modes.COMPONENTS`."""
        return np.hstack([self.stress, self.gradient])

    @classmethod
    def from_values(
        cls,
        cube: ArrayLike,
        stress: ArrayLike,
        gradient: ArrayLike,
        *,
        residual: ArrayLike = np.nan,
        status: ArrayLike = 0,
        observed: ArrayLike = 0,
        stamp_ns: ArrayLike = 0,
        sequence: ArrayLike = 0,
        left_out: ArrayLike = 0,
    ) -> StressRows:
        """Construct N rows from numbers, lists or arrays.

        Args:
            cube: Numbers of the cubes (N,).
            stress: Stress (N, 6), in Pa.
            gradient: Gradients of the normal stresses (N, 9), in Pa/m.
            residual, status, observed, stamp_ns, sequence, left_out: The other attributes, each
                with N values or with one value for all rows.
        """
        columns = _fill_columns(
            cube,
            residual=residual,
            status=status,
            observed=observed,
            stamp_ns=stamp_ns,
            sequence=sequence,
            left_out=left_out,
        )
        columns |= {"stress": np.asarray(stress), "gradient": np.asarray(gradient)}
        return cls.from_columns(columns)


def concatenate(parts: Sequence[_Kind]) -> _Kind:
    """Return one table with the rows of one or more tables of the same class, in their order.

    A column that one of the tables lacks (None) is left out of the result.
    """
    columns = [part.collect_columns() for part in parts]
    common = [name for name in columns[0] if all(name in column for column in columns)]
    joined = {}
    for name in common:
        joined[name] = np.concatenate([column[name] for column in columns])
    return parts[0].from_columns(joined)


def _fill_columns(cube: ArrayLike, **columns: ArrayLike) -> dict[str, AnyArray]:
    """Return the columns (N,) of N rows by name, with the types of `COLUMN_TYPES`.

    Args:
        cube: Numbers of the cubes (N,).
        columns: Values of each other column, N or one for all rows.
    """
    filled = {"cube": np.asarray(cube)}
    shape = filled["cube"].shape
    for name, values in columns.items():
        # np.array copies, because a broadcast array is read-only.
        filled[name] = np.array(np.broadcast_to(values, shape), COLUMN_TYPES[name])
    return filled


class Source(Protocol):
    """A source of frequencies: the links to real hubs, a bag (recording), or a simulated skin.

    A source is a context manager; iterating over it yields `FrequencyRows`.
    """

    @property
    def skin(self) -> object:
        """The skin; `FrequencyRows.cube` is an index into its cubes."""

    @property
    def is_live(self) -> bool:
        """Whether rows arrive while they are measured, so that iterating waits for the next ones.

        A bag is not live: its rows are there at once.
        """

    def statistics(self) -> dict[str, object]:
        """Return counts of the data that were delivered or lost so far, by name of the count."""

    def __iter__(self) -> Iterator[FrequencyRows]: ...

    def __enter__(self) -> Source: ...

    def __exit__(self, *error: object) -> None: ...
