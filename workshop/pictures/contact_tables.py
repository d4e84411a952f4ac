# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The tables of docs/pictures/contacts.json: accuracy of contacts, from the studies of traction."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cube_tensor_design.studies.pads_study import FORMS, study_pads
from cube_tensor_design.studies.traction_study import (
    MAIN,
    PITCHES,
    WRONG,
    Errors,
    Setting,
    traction_study,
)
from cube_tensor_driver.config.output_files import atomic_write
from cube_tensor_driver.mechanics.influence import Influence

from ..bench.contacts import SCANS, Outcomes, summarise

Table = dict[str, Any]
"""A table: what it is about, its columns, its rows."""

WIDTHS = [2e-3, 5e-3, 10e-3, 20e-3]
"""Widths of the simulated contacts, in m; each table has one line for each width."""
WRONG_WIDTHS = [5e-3, 15e-3]
"""Widths, in m, of the contacts for the table about assumptions (such as depth) that are wrong."""
BALL_LOADS = 100
"""Number of random loads by a ball from which one line of a table is computed."""
PAD_LOADS = 40
"""Number of random loads from which one line of the table is computed that compares cubes modelled
as points and as pads."""
FEW_LOADS = 6
"""Number of random loads from which one line of the other tables is computed."""
SEED = 7031
"""Seed of the random loads. No setting of the methods was chosen by results with this seed."""

METHOD_COLUMNS = [
    "contact width, mm",
    "pressure field, relative rms error: interpolation, inverse, inverse with contacts",
    "normal force, relative rms error in %: interpolation, inverse",
    "position, 95th percentile of the error in mm: interpolation, inverse",
    "force, rms error / predicted deviation: interpolation, inverse",
    "position, rms error / predicted deviation: interpolation, inverse",
    "pressure field of the inverse with contacts, rms error / predicted deviation: at the depth of "
    "the cubes, on the surface",
]
"""Columns of the tables that compare methods: interpolation, inverse, inverse with contacts.

Each row of a table is one width of the contact.
"""
FORM_COLUMNS = [
    "contact width, mm",
    "pressure field, relative rms error: points, pads",
    "normal force, relative rms error in %: points, pads",
    "position, 95th percentile of the error in mm: points, pads",
    "force, rms error / predicted deviation: points, pads",
    "position, rms error / predicted deviation: points, pads",
]
"""Columns of the tables that compare two models of a cube: stress at a point, or the real pads.

Each row of a table is one width of the contact.
"""
FORM_DIGITS = (3, 1, 2, 2, 2)
"""Number of decimals of each quantity in `FORM_COLUMNS` after the width."""


def write_contact_tables(path: Path, true_pads: Influence, shapes: Outcomes) -> None:
    """Run the studies and write their tables; other tables of the file stay as they are.

    Args:
        path: The JSON file.
        true_pads: True influence functions of the pads in a layer.
        shapes: Outcomes of loads of each shape.
    """
    tables = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    tables |= contact_tables(true_pads)
    tables["shapes"] = shape_table(shapes)
    text = json.dumps(tables, indent=1, ensure_ascii=False)
    # Each row of a table is written on one line: line breaks within a row, which are followed by
    # more than three blanks, become single blanks.
    text = re.sub(r"\n(?: {4,}| {3}(?=\]))", " ", text)
    with atomic_write(path) as partial:
        partial.write_text(text + "\n", encoding="utf-8")


def contact_tables(true_pads: Influence) -> dict[str, Table]:
    """Run the studies and return their tables by name."""
    balls = traction_study((*MAIN, *PITCHES), WIDTHS, BALL_LOADS, SEED)
    wrong = traction_study(list(WRONG.values()), WRONG_WIDTHS, FEW_LOADS, SEED)
    forms = study_pads(true_pads, WIDTHS, PAD_LOADS, SEED)
    return {
        "balls, pitch 8 mm, depth 5 mm": {
            "about": f"3 N normal, 0.9 N tangential, {BALL_LOADS} loads for each line. A contact "
            "that was not found counts as 40 mm.",
            "columns": ["cubes", *METHOD_COLUMNS],
            "rows": _method_rows({setting.cubes: balls[setting] for setting in MAIN}),
        },
        "balls, pitches 12 and 24 mm, depth 4 mm": {
            "about": f"As above, {BALL_LOADS} loads for each line.",
            "columns": ["cubes and pitch", *METHOD_COLUMNS],
            "rows": _method_rows(
                {f"{one.cubes}, {1e3 * one.pitch:g} mm": balls[one] for one in PITCHES}
            ),
        },
        "wrong assumptions": {
            "about": f"24-pad cubes, pitch 8 mm, depth 5 mm, {FEW_LOADS} loads for each line.",
            "columns": ["assumption", *METHOD_COLUMNS],
            "rows": _method_rows({name: wrong[setting] for name, setting in WRONG.items()}),
        },
        "cubes as points and as pads": {
            "about": f"Layer of 11 mm, cubes in its middle, pitch 8 mm, {PAD_LOADS} loads for each "
            "line, inverse with contacts.",
            "columns": ["cubes", *FORM_COLUMNS],
            "rows": _form_rows(forms),
        },
    }


def shape_table(outcomes: Outcomes) -> Table:
    """Return the table of the errors of each shape on each skin."""
    summary = summarise(outcomes)
    loads = max(map(len, outcomes.values()))
    rows = []
    for name, figures in summary.items():
        rows.append([name, *(float(f"{value:.2g}") for value in figures.values())])
    return {
        "about": f"3 N normal, 0.9 N tangential, {loads} loads for each line, after {SCANS} scans. "
        "Contacts of one load count together. CPU times are those of one machine.",
        "columns": ["load, cubes and pitch", *next(iter(summary.values()))],
        "rows": rows,
    }


def _method_rows(results: Mapping[str, Sequence[Errors]]) -> list[list[Any]]:
    rows = []
    for name, all_widths in results.items():
        for one in all_widths:
            ratios = [[round(before, 1), round(now, 2)] for before, now in one.ratio.T.tolist()]
            rows.append(
                [
                    name,
                    round(1e3 * one.width),
                    one.field.round(3).tolist(),
                    (100 * one.force).round(1).tolist(),
                    (1e3 * one.position).round(2).tolist(),
                    *ratios,
                    one.field_ratio.round(2).tolist(),
                ]
            )
    return rows


def _form_rows(
    results: Mapping[tuple[Setting, str], Sequence[Errors]],
) -> list[list[Any]]:
    rows = []
    for setting in dict.fromkeys(setting for setting, _ in results):
        for both in zip(*(results[setting, form] for form in FORMS), strict=True):
            forms = [
                [one.field[2], 100 * one.force[1], 1e3 * one.position[1], *one.ratio[1]]
                for one in both
            ]
            # Each quantity is a column, with one number for each form.
            columns = zip(np.transpose(forms), FORM_DIGITS, strict=True)
            rounded = [column.round(digits).tolist() for column, digits in columns]
            rows.append([setting.cubes, round(1e3 * both[0].width), *rounded])
    return rows
