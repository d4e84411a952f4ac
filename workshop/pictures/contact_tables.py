# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The tables of docs/pictures/contacts.json: accuracy of contacts, from the studies of traction."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from cube_tensor_design.studies.pads_study import study_pads
from cube_tensor_design.studies.traction_study import (
    MAIN,
    PITCHES,
    WRONG,
    Errors,
    study_tractions,
)
from cube_tensor_driver.config.output_files import write_json
from cube_tensor_driver.mechanics.influence import Influence

from ..bench.contacts import SCANS, TrackingResults, summarise

WIDTHS = [2e-3, 5e-3, 10e-3, 20e-3]
"""Widths of the simulated contacts, in m; each table has one row for each width."""
WRONG_WIDTHS = [5e-3, 15e-3]
"""Widths, in m, of the contacts for the table about assumptions (such as depth) that are wrong."""
BALL_LOADS = 100
"""Number of random loads by a ball from which one row of a table is computed."""
PAD_LOADS = 40
"""Number of random loads from which one row of the table is computed that compares cubes modelled
as points and as pads."""
FEW_LOADS = 6
"""Number of random loads from which one row of the other tables is computed."""
SEED = 7031
"""Seed of the random loads. No setting of the methods was chosen by results with this seed."""

QUANTITIES = {
    "field": "rms error of the pressure over its rms: interpolation, inverse, inverse with "
    "contacts",
    "force": "rms error of the normal force over the force: interpolation, inverse with contacts",
    "position": "95th percentile of the position's error in m: interpolation, inverse with "
    "contacts; 0.04 for a contact that was not found",
    "ratio": "rms error over predicted deviation of force and position: of interpolation, of the "
    "inverse with contacts",
    "field_ratio": "rms error over predicted deviation of the pressure of the inverse with "
    "contacts: at the depth of the cubes, on the surface",
}
"""Quantities of each row: name, which is that of the attribute of `Errors`, and meaning."""


def write_contact_tables(
    path: Path,
    true_pads: Influence,
    shapes: TrackingResults,
) -> None:
    """Run the studies and write their tables.

    Args:
        path: The JSON file.
        true_pads: True influence functions of the pads in a layer.
        shapes: Results of loads of each shape.
    """
    tables = compute_contact_tables(true_pads)
    tables["shapes"] = {
        "loads in each row": max(map(len, shapes.values())),
        "scans of each load": SCANS,
        "rows": {
            name: {key: _round(value) for key, value in figures.items()}
            for name, figures in summarise(shapes).items()
        },
    }
    write_json(path, tables)


def compute_contact_tables(true_pads: Influence) -> dict[str, object]:
    """Run the studies and return their tables by name: 3 N press and 0.9 N rub."""
    balls = study_tractions((*MAIN, *PITCHES), WIDTHS, BALL_LOADS, SEED)
    by_pitch = {
        f"{setting.cubes}, pitch {1e3 * setting.pitch:g} mm": errors
        for setting, errors in balls.items()
    }
    wrong = study_tractions(
        list(WRONG.values()),
        WRONG_WIDTHS,
        FEW_LOADS,
        SEED,
    )
    by_assumption = {name: wrong[setting] for name, setting in WRONG.items()}
    forms = study_pads(true_pads, WIDTHS, PAD_LOADS, SEED)
    by_form = {f"{setting.cubes} as {form}": errors for (setting, form), errors in forms.items()}
    return {
        "quantities": QUANTITIES,
        "balls": _make_table(by_pitch, BALL_LOADS),
        "wrong assumptions": _make_table(by_assumption, FEW_LOADS),
        "cubes as points and as pads in a layer of 11 mm": _make_table(by_form, PAD_LOADS),
    }


def _make_table(
    results: Mapping[str, Sequence[Errors]],
    loads: int,
) -> dict[str, object]:
    """Return the table of the errors of each skin and width, from a number of loads for each."""
    rows = {}
    for name, all_widths in results.items():
        for errors in all_widths:
            row = {quantity: _round(getattr(errors, quantity)) for quantity in QUANTITIES}
            rows[f"{name}, contact width {1e3 * errors.width:g} mm"] = row
    return {"loads in each row": loads, "rows": rows}


def _round(values: ArrayLike) -> object:
    """Return a number, or an array as nested lists, with three significant digits."""
    rounded = [float(f"{value:.3g}") for value in np.ravel(values)]
    return np.reshape(rounded, np.shape(values)).tolist()
