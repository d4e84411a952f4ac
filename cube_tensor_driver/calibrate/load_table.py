"""Tables (CSV) of known loads and the frequencies measured under them: the input of a fit."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..config.input_files import read_bounded
from ..config.yaml import MAX_BYTES
from ..core.errors import ConfigError, FitError
from ..core.layout import Layout
from ..core.modes import Modes
from ..core.symmetry import default_modes
from .fit import traction_loads

FORCE = ("fx", "fy", "fz")
TEMPERATURE = "temperature"


@dataclass(frozen=True, eq=False)
class Loads:
    """N loads of a cube with P pads and M modes.

    state: (N, M) Pa. frequency: (N, P) Hz. temperature: (N,) °C, or None if it is unknown.
    """

    state: NDArray[np.float64]
    frequency: NDArray[np.float64]
    temperature: NDArray[np.float64] | None


def read_loads(path: Path, layout: Layout, area: float | None = None) -> Loads:
    """Read a table with a line of column names, then one load per line.

    The columns are:

    - the frequency of each pad in Hz, named as the pad (`+z-x` …);
    - the load, either as amplitudes of modes in Pa (`zz`, `zz_x` …; gradients times the half side;
      a mode without a column is 0), or as the force `fx`, `fy`, `fz` in N of a reference sensor on
      the face +z, which acts on `area` in m²;
    - `temperature` in °C, if it is known.

    Raises FitError if the file cannot be read, a column is missing, unknown or there twice, a cell
    is no number, or forces are given without an area.
    """
    header, cells = _read_cells(path)
    modes = default_modes(layout)
    _check_columns(path, header, layout, modes)
    column = {name: cells[:, number] for number, name in enumerate(header)}
    frequency = np.stack([column[pad] for pad in layout.pads], axis=1)
    return Loads(_states(path, column, modes, area), frequency, column.get(TEMPERATURE))


def _check_columns(path: Path, header: list[str], layout: Layout, modes: Modes) -> None:
    allowed = {*layout.pads, *modes.names, *FORCE, TEMPERATURE}
    wrong = {
        "unknown": [name for name in header if name not in allowed],
        "twice": sorted({name for name in header if header.count(name) > 1}),
        "missing": [pad for pad in layout.pads if pad not in header],
    }
    for what, names in wrong.items():
        if names:
            raise FitError(
                f"{path}: columns {what}: {', '.join(map(repr, names))}; "
                f"needed are the pads {', '.join(layout.pads)} "
                f"and modes ({', '.join(modes.names)}) or forces ({', '.join(FORCE)})"
            )


def _states(
    path: Path, column: dict[str, NDArray[np.float64]], modes: Modes, area: float | None
) -> NDArray[np.float64]:
    """(N, M) Pa, from the columns of modes or of forces."""
    forces = [name for name in FORCE if name in column]
    amplitudes = [name for name in modes.names if name in column]
    if bool(forces) == bool(amplitudes):
        found = "both" if amplitudes else "neither"
        raise FitError(
            f"{path}: found {found} columns of modes and of forces; "
            "give the load in one of the two ways"
        )
    if amplitudes:
        zero = np.zeros(len(column[amplitudes[0]]))
        return np.stack([column.get(name, zero) for name in modes.names], axis=1)
    if area is None:
        raise FitError(f"{path}: the loads are forces; give the area they act on in m² (--area)")
    if len(forces) < len(FORCE):
        raise FitError(
            f"{path}: found forces {', '.join(forces)}; all of {', '.join(FORCE)} are needed"
        )
    return traction_loads(modes, np.stack([column[name] for name in FORCE], axis=1), area)


def _read_cells(path: Path) -> tuple[list[str], NDArray[np.float64]]:
    """The column names, and the numbers (lines, columns) below them."""
    lines = _read_lines(path)
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
        for column, cell in enumerate(row):
            try:
                values[number, column] = float(cell)
            except ValueError:
                raise FitError(
                    f"{path}: load {number + 1}, column {header[column]}: {cell!r} is no number"
                ) from None
    return header, values


def _read_lines(path: Path) -> list[list[str]]:
    """The cells of each line, without spaces around them; empty lines are left out."""
    try:
        text = read_bounded(path, MAX_BYTES, "table of loads").decode("utf-8-sig")
        lines = [
            [cell.strip() for cell in line] for line in csv.reader(io.StringIO(text, newline=""))
        ]
    except ConfigError as error:
        raise FitError(str(error)) from None
    except OSError as error:
        raise FitError(f"{path}: {error.strerror}; name a CSV file that can be read") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise FitError(f"{path}: not a CSV file ({error})") from None
    return [line for line in lines if any(line)]


def unloaded(loads: Loads) -> NDArray[np.float64] | None:
    """(P,) Hz: mean frequencies of the rows without load; None if there are no such rows."""
    at_rest = ~loads.state.any(axis=1)
    if not at_rest.any():
        return None
    mean: NDArray[np.float64] = loads.frequency[at_rest].mean(axis=0)
    return mean
