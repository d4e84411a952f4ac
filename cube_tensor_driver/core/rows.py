"""What the program hands on from step to step: rows of frequencies, and rows of stress.

One row is one sample: all pads of one cube at one instant. Rows of one scan come together, and so
do the rows of several scans: then all rows of the first, all of the second, and so on.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray


class _Rows:
    """What both kinds have: their number, and a choice of them. All fields are arrays (N, ...)."""

    __slots__ = ()
    cube: NDArray[np.uint16]

    def __len__(self) -> int:
        return len(self.cube)

    def select(self: _Kind, chosen: Any) -> _Kind:
        """The rows that an index, a slice or a mask chooses, as numpy indexes arrays."""
        return type(self)(*(getattr(self, field.name)[chosen] for field in fields(self)))  # type: ignore[arg-type]


_Kind = TypeVar("_Kind", bound=_Rows)


@dataclass(frozen=True, slots=True, eq=False)
class FrequencyRows(_Rows):
    """What the pads measured: N rows of P pads.

    cube: (N,) index of the cube in the skin
    sequence: (N,) number that the hub gave the sample; it wraps
    stamp_ns: (N,) when the pads were read, ns, in the clock of the source
    frequency: (N, P) Hz; NaN where nothing was measured and where the cube has no such pad
    temperature: (N,) °C; NaN where it is unknown
    pad_fault: (N,) bit p: the device reports that pad p is broken
    status: (N,) bits of `status.py`; only STAMP, which says that stamp_ns is in doubt
    """

    cube: NDArray[np.uint16]
    sequence: NDArray[np.uint32]
    stamp_ns: NDArray[np.int64]
    frequency: NDArray[np.float32]
    temperature: NDArray[np.float32]
    pad_fault: NDArray[np.uint32]
    status: NDArray[np.uint16]

    @classmethod
    def of(
        cls,
        cube: Any,
        frequency: Any,
        *,
        stamp_ns: Any = 0,
        sequence: Any = 0,
        temperature: Any = np.nan,
        pad_fault: Any = 0,
        status: Any = 0,
    ) -> FrequencyRows:
        """Rows from plain numbers: cube (N,), frequency (N, P), the others (N,) or one for all."""
        cube = np.asarray(cube)
        return cls(
            cube=cube,
            sequence=_column(cube, sequence, np.uint32),
            stamp_ns=_column(cube, stamp_ns, np.int64),
            frequency=np.asarray(frequency),
            temperature=_column(cube, temperature, np.float32),
            pad_fault=_column(cube, pad_fault, np.uint32),
            status=_column(cube, status, np.uint16),
        )


@dataclass(frozen=True, slots=True, eq=False)
class StressRows(_Rows):
    """What was reconstructed: N rows, in the frame of each cube, tension positive.

    cube, sequence, stamp_ns: (N,) of the frequencies that each row was made from
    stress: (N, 6) Pa, order xx yy zz yz zx xy; NaN where a component is not observed
    gradient: (N, 9) Pa/m, rows xx yy zz, columns d/dx d/dy d/dz; NaN where it is not observed
    residual: (N,) sqrt(chi-square / degrees of freedom), about 1 for noise alone; NaN where there
        is no redundancy
    status: (N,) bits of `status.py`
    observed: (N,) bit i: component i of `modes.COMPONENTS` was recovered
    left_out: (N,) bit p: pad p was not used
    """

    cube: NDArray[np.uint16]
    sequence: NDArray[np.uint32]
    stamp_ns: NDArray[np.int64]
    stress: NDArray[np.floating]
    gradient: NDArray[np.floating]
    residual: NDArray[np.floating]
    status: NDArray[np.uint16]
    observed: NDArray[np.uint16]
    left_out: NDArray[np.uint32]

    @classmethod
    def of(
        cls,
        cube: Any,
        stress: Any,
        gradient: Any,
        *,
        residual: Any = np.nan,
        status: Any = 0,
        observed: Any = 0,
        stamp_ns: Any = 0,
        sequence: Any = 0,
        left_out: Any = 0,
    ) -> StressRows:
        """Rows from plain numbers: cube (N,), stress (N, 6), gradient (N, 9), the others (N,) or
        one for all."""
        cube = np.asarray(cube)
        return cls(
            cube=cube,
            sequence=_column(cube, sequence, np.uint32),
            stamp_ns=_column(cube, stamp_ns, np.int64),
            stress=np.asarray(stress),
            gradient=np.asarray(gradient),
            residual=_column(cube, residual, np.float32),
            status=_column(cube, status, np.uint16),
            observed=_column(cube, observed, np.uint16),
            left_out=_column(cube, left_out, np.uint32),
        )


def concatenate(parts: Sequence[_Kind]) -> _Kind:
    """All rows of one or more parts, in order."""
    kind = type(parts[0])
    columns = (
        np.concatenate([getattr(part, field.name) for part in parts])
        for field in fields(kind)  # type: ignore[arg-type]
    )
    return kind(*columns)


def _column(cube: NDArray[Any], values: Any, dtype: type) -> NDArray[Any]:
    """(N,) of values, or of one value for all rows."""
    return np.array(np.broadcast_to(values, cube.shape), dtype)


class Source(Protocol):
    """Where frequencies come from: live links, a bag, a simulated skin. A context manager.

    skin: which cubes `FrequencyRows.cube` counts. is_live: whether rows come as they are measured,
    so that waiting for the next one takes time.
    """

    @property
    def skin(self) -> Any: ...

    @property
    def is_live(self) -> bool: ...

    def statistics(self) -> dict[str, object]:
        """What was delivered and what was not, by name."""

    def __iter__(self) -> Iterator[FrequencyRows]: ...

    def __enter__(self) -> Source: ...

    def __exit__(self, *error: object) -> None: ...
