"""Tables of known loads and measured frequencies (CSV), the input of a fit."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core.errors import FitError
from ..core.fit import traction_loads
from ..core.layout import Layout
from ..core.symmetry import default_modes
from .yaml import MAX_BYTES

FORCE = ("fx", "fy", "fz")
TEMPERATURE = "temperature"


@dataclass(frozen=True, eq=False)
class Loads:
    """state (N, M) in Pa; frequency (N, P) in Hz; temperature (N,) in °C or None."""

    state: NDArray[np.float64]
    frequency: NDArray[np.float64]
    temperature: NDArray[np.float64] | None


def read_loads(path: Path, layout: Layout, area: float | None = None) -> Loads:
    """Read a table with one load per row and a line of column names.

    Columns: each pad's name (`+z-x` …), frequency in Hz; the load either as amplitudes of modes
    (`zz`, `zz_x` …, Pa, gradients times the half side; modes without a column are 0), or as the
    force `fx`, `fy`, `fz` in N of a reference sensor on the face +z, over `area` in m²;
    `temperature` in °C if it is known.

    FitError: cannot be read, columns missing, unknown or twice, a cell that is no number, forces
    without area.
    """
    header, cells = _read(path)
    modes = default_modes(layout)
    allowed = {*layout.pads, *modes.names, *FORCE, TEMPERATURE}
    for what, names in (
        ("unknown", [name for name in header if name not in allowed]),
        ("twice", sorted({name for name in header if header.count(name) > 1})),
        ("missing", [pad for pad in layout.pads if pad not in header]),
    ):
        if names:
            raise FitError(
                f"{path}: columns {what}: {', '.join(map(repr, names))}; needed are the pads {', '.join(layout.pads)} "
                f"and modes ({', '.join(modes.names)}) or forces ({', '.join(FORCE)})"
            )
    column = {name: cells[:, header.index(name)] for name in header}
    by_force = [name for name in FORCE if name in header]
    by_mode = [name for name in modes.names if name in header]
    if bool(by_force) == bool(by_mode):
        found = "both" if by_mode else "neither"
        raise FitError(
            f"{path}: found {found} columns of modes and of forces; give the load in one of the two ways"
        )
    if by_mode:
        zero = np.zeros(len(cells))
        state = np.stack([column.get(name, zero) for name in modes.names], axis=1)
    else:
        if area is None:
            raise FitError(
                f"{path}: the loads are forces; give the area they act on in m² (--area)"
            )
        if len(by_force) < 3:
            raise FitError(
                f"{path}: found forces {', '.join(by_force)}; all of {', '.join(FORCE)} are needed"
            )
        state = traction_loads(modes, np.stack([column[name] for name in FORCE], axis=1), area)
    return Loads(
        state, np.stack([column[pad] for pad in layout.pads], axis=1), column.get(TEMPERATURE)
    )


def _read(path: Path) -> tuple[list[str], NDArray[np.float64]]:
    try:
        if path.stat().st_size > MAX_BYTES:
            raise FitError(f"{path}: larger than {MAX_BYTES} bytes: this is no table of loads")
        with path.open(newline="", encoding="utf-8-sig") as file:
            lines = [
                [cell.strip() for cell in line]
                for line in csv.reader(file)
                if any(cell.strip() for cell in line)
            ]
    except OSError as error:
        raise FitError(f"{path}: {error.strerror}; name a CSV file that can be read") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise FitError(f"{path}: not a CSV file ({error})") from None
    if len(lines) < 2:
        raise FitError(
            f"{path}: found {len(lines)} lines; needed are one with column names and one per load"
        )
    header, *rows = lines
    values = np.empty((len(rows), len(header)))
    for number, row in enumerate(rows):
        if len(row) != len(header):
            raise FitError(
                f"{path}: load {number + 1} has {len(row)} cells, the first line has {len(header)}"
            )
        for place, cell in enumerate(row):
            try:
                values[number, place] = float(cell)
            except ValueError:
                raise FitError(
                    f"{path}: load {number + 1}, column {header[place]}: {cell!r} is no number"
                ) from None
    return header, values


def unloaded(loads: Loads) -> NDArray[np.float64] | None:
    """Mean frequencies (P,) in Hz of the rows without load, None if there are none."""
    rest = ~loads.state.any(axis=1)
    mean: NDArray[np.float64] = loads.frequency[rest].mean(axis=0)
    return mean if rest.any() else None
