# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Tables (CSV) of known loads and the frequencies measured under them, the input of a fit."""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..config.input_files import read_bounded
from ..core.arrays import Array
from ..core.errors import ConfigError, FitError
from ..core.layout import Layout
from ..core.modes import Modes
from ..core.symmetry import choose_default_modes
from .fit import loads_from_forces

FORCE = ("fx", "fy", "fz")
"""Names of the columns of a table of loads that hold the force on the cube, in N."""

TEMPERATURE = "temperature"
"""Name of the column of a table of loads that holds the temperature, in °C."""


@dataclass(frozen=True, eq=False)
class Loads:
    """N known loads of a cube with P pads and M modes, and what was measured under them.

    Attributes:
        amplitudes: Amplitudes (N, M) of the modes (linear stress fields) that each load causes, in
            Pa.
        frequency: Frequencies of the pads under each load (N, P), in Hz.
        temperature: Temperature during each load (N,), in °C; None if it is unknown.
    """

    amplitudes: Array
    frequency: Array
    temperature: Array | None

    def average_unloaded_frequency(self) -> Array | None:
        """Return the mean frequencies of the pads in the rows without load (P,), in Hz.

        The result is None if the table has no row without load.
        """
        is_unloaded = ~self.amplitudes.any(axis=1)
        if not is_unloaded.any():
            return None
        unloaded = self.frequency[is_unloaded]
        mean: Array = unloaded.mean(axis=0)
        return mean


def read_loads(
    path: Path,
    layout: Layout,
    area: float | None = None,
) -> Loads:
    """Read a table (CSV) with a line of column names, then one load per line.

    The columns are:

    - the frequency of each pad in Hz, with the name of the pad (`+z-x` …);
    - the load: either amplitudes of modes (linear stress fields) in Pa (`zz`, `zz_x` …; gradients
      are multiplied by half the side of the cube; a mode without a column is 0), or the force `fx`,
      `fy`, `fz` in N that a reference sensor measured on the face +z;
    - `temperature` in °C, if it is known.

    Args:
        path: Path of the table.
        layout: Layout of the cube's pads.
        area: Area on the face +z that the force acts on, in m². It is needed if the table has
            forces.

    Raises:
        FitError: The file cannot be read, a column is missing, unknown or present twice, a cell is
            no number, or the table has forces and no area is given.
    """
    header, cells = _read_cells(path)
    modes = choose_default_modes(layout)
    _check_columns(path, header, layout, modes)
    columns = dict(zip(header, cells.T, strict=True))
    by_pad = [columns[pad] for pad in layout.pads]
    frequency = np.stack(by_pad, axis=1)
    amplitudes = _read_amplitudes(path, columns, modes, area)
    return Loads(amplitudes, frequency, columns.get(TEMPERATURE))


def _check_columns(
    path: Path,
    header: list[str],
    layout: Layout,
    modes: Modes,
) -> None:
    """Check the names of the columns of a table of loads.

    Args:
        path: Path of the table, for the error message.
        header: Names of the columns.
        layout: Layout of the cube's pads; each pad needs a column.
        modes: Modes (linear stress fields) that a column may hold.

    Raises:
        FitError: A column is unknown, present twice or missing.
    """
    allowed = {*layout.pads, *modes.names, *FORCE, TEMPERATURE}
    # One error message names all columns with the same mistake, so that a user can correct them at
    # once.
    counts = Counter(header)
    mistakes = {
        "unknown": [name for name in header if name not in allowed],
        "twice": [name for name in counts if counts[name] > 1],
        "missing": [pad for pad in layout.pads if pad not in header],
    }
    for mistake, names in mistakes.items():
        if names:
            raise FitError(
                f"{path}: columns {mistake}: {', '.join(map(repr, names))}; "
                f"needed are the pads {', '.join(layout.pads)} "
                f"and modes ({', '.join(modes.names)}) or forces ({', '.join(FORCE)})"
            )


def _read_amplitudes(
    path: Path,
    columns: Mapping[str, Array],
    modes: Modes,
    area: float | None,
) -> Array:
    """Return the amplitudes of the modes (N, M), in Pa, from the columns of modes or of forces.

    Args:
        path: Path of the table, for error messages.
        columns: Numbers (N,) in each column by its name.
        modes: The M modes (linear stress fields).
        area: Area that a force acts on, in m²; None if it is not known.

    Raises:
        FitError: The table has both kinds of columns or none, not all forces, or forces without an
            area.
    """
    forces = [name for name in FORCE if name in columns]
    given_modes = [name for name in modes.names if name in columns]
    # Amplitudes of modes and forces both state the load, so they could contradict each other.
    if bool(forces) == bool(given_modes):
        found = "both" if given_modes else "neither"
        raise FitError(
            f"{path}: found {found} columns of modes and of forces; "
            "give the load in one of the two ways"
        )
    if given_modes:
        zero = np.zeros_like(columns[given_modes[0]])
        by_mode = [columns.get(name, zero) for name in modes.names]
        return np.stack(by_mode, axis=1)
    if area is None:
        raise FitError(f"{path}: the loads are forces; give the area they act on in m² (--area)")
    if len(forces) < len(FORCE):
        raise FitError(
            f"{path}: found forces {', '.join(forces)}; all of {', '.join(FORCE)} are needed"
        )
    by_axis = [columns[name] for name in FORCE]
    force = np.stack(by_axis, axis=1)
    return loads_from_forces(modes, force, area)


def _read_cells(path: Path) -> tuple[list[str], Array]:
    """Return the names of the columns, and the numbers below them (loads, columns).

    Lines without text are ignored.

    Raises:
        FitError: The file cannot be read or is no CSV file in UTF-8, a line has the wrong number of
            cells, or a cell is no number.
    """
    try:
        # Spreadsheet programs begin a file with a byte order mark, which this encoding removes.
        text = read_bounded(path, "table of loads").decode("utf-8-sig")
        # The csv module must get the ends of lines unchanged, because a cell in quotation marks may
        # contain ends of lines.
        file = io.StringIO(text, newline="")
        stripped = [[cell.strip() for cell in line] for line in csv.reader(file)]
    except ConfigError as error:
        raise FitError(str(error)) from None
    except OSError as error:
        raise FitError(f"{path}: {error.strerror}; name a CSV file that can be read") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise FitError(f"{path}: not a CSV file ({error})") from None
    lines = [cells for cells in stripped if any(cells)]
    if len(lines) < 2:
        raise FitError(
            f"{path}: found {len(lines)} lines; needed are one with column names and one per load"
        )
    header, *rows = lines
    shape = (len(rows), len(header))
    values = np.empty(shape)
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
