# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The tables of contacts.json, with errors that no study has computed."""

from __future__ import annotations

import json

import numpy as np
import pytest

pytest.importorskip("skfem", reason="needs skfem: pip install scikit-fem")

from conftest import ROOT
from cube_tensor_design.studies.pads_study import FORMS, THIN
from cube_tensor_design.studies.traction_study import ContactErrors, Errors
from workshop.bench.contacts import SHAPES, SKINS, Outcome
from workshop.pictures import contact_tables

SHIPPED = ROOT / "docs" / "pictures" / "contacts.json"


def made_up(width: float) -> Errors:
    return Errors(
        width=width,
        field=np.array([0.2, 0.1, 0.0123]),
        force=np.array([0.5, 0.0101]),
        position=np.array([1e-3, 0.04e-3]),
        ratio=np.array([[3.21, 1.27], [0.99, 1.01]]),
        field_ratio=np.array([0.8, 0.7]),
        found=0.5,
    )


@pytest.fixture
def studies(monkeypatch):
    def traction(settings, widths, *_):
        return {setting: [made_up(width) for width in widths] for setting in settings}

    def pads(_, widths, *__):
        results = [made_up(width) for width in widths]
        return {(setting, form): results for setting in THIN for form in FORMS}

    monkeypatch.setattr(contact_tables, "traction_study", traction)
    monkeypatch.setattr(contact_tables, "study_pads", pads)


def test_tables_are_those_of_the_shipped_file(studies, tmp_path):
    """Other tables of the file stay, and each row is one line."""
    path = tmp_path / "contacts.json"
    path.write_text(SHIPPED.read_text())
    outcome = Outcome(ContactErrors(0.03, 0.02, 1e-4, 2e-4), 1, 9.0, 2.0)
    outcomes = {(skin, shape): [outcome] for skin in SKINS for shape in SHAPES}
    contact_tables.write_contact_tables(path, None, outcomes)
    shipped, written = json.loads(SHIPPED.read_text()), json.loads(path.read_text())
    assert list(written) == list(shipped)
    for name, table in written.items():
        assert table["columns"] == shipped[name]["columns"], name
        n = 1 if name == "shapes" else 2
        assert [row[:n] for row in table["rows"]] == [row[:n] for row in shipped[name]["rows"]]
        assert all(len(row) == len(table["columns"]) for row in table["rows"])
    rows = sum(len(table["rows"]) for table in written.values())
    assert sum(line.startswith("   [") for line in path.read_text().splitlines()) == rows
    first = written["balls, pitch 8 mm, depth 5 mm"]["rows"][0]
    assert first[2:] == [
        [0.2, 0.1, 0.012],
        [50.0, 1.0],
        [1.0, 0.04],
        [3.2, 0.99],
        [1.3, 1.01],
        [0.8, 0.7],
    ]
    shape = written["shapes"]["rows"][0]
    assert shape == ["ball 5 mm, 24-pad, pitch 8 mm", 1.0, 1.5, 0.1, 0.5, 100.0, 9.0, 2.0]
    form = written["cubes as points and as pads"]["rows"][0]
    assert form[2:] == [[0.012] * 2, [1.0] * 2, [0.04] * 2, [0.99] * 2, [1.01] * 2]
