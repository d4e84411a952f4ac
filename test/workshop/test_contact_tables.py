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
from workshop.bench.contacts import SHAPES, SKINS, TrackingResult
from workshop.pictures import contact_tables

FORMS_TABLE = "cubes as points and as pads in a layer of 11 mm"
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

    monkeypatch.setattr(contact_tables, "study_tractions", traction)
    monkeypatch.setattr(contact_tables, "study_pads", pads)


def test_tables_are_those_of_the_shipped_file(studies, tmp_path):
    path = tmp_path / "contacts.json"
    result = TrackingResult(ContactErrors(0.03, 0.02, 1e-4, 2e-4), 1, 9.0, 2.0)
    results = {(skin, shape): [result] for skin in SKINS for shape in SHAPES}
    contact_tables.write_contact_tables(path, None, results)
    shipped, written = json.loads(SHIPPED.read_text()), json.loads(path.read_text())
    assert list(written) == list(shipped)
    assert written["quantities"] == shipped["quantities"]
    for name in ("balls", "wrong assumptions", "shapes", FORMS_TABLE):
        assert set(written[name]["rows"]) == set(shipped[name]["rows"])
        for row, quantities in written[name]["rows"].items():
            assert set(shipped[name]["rows"][row]) <= set(quantities), row
    assert written["balls"]["rows"]["24-pad, pitch 8 mm, contact width 2 mm"] == {
        "field": [0.2, 0.1, 0.0123],
        "force": [0.5, 0.0101],
        "position": [1e-3, 0.04e-3],
        "ratio": [[3.21, 1.27], [0.99, 1.01]],
        "field_ratio": [0.8, 0.7],
    }
    assert written["shapes"]["rows"]["ball 5 mm, 24-pad, pitch 8 mm"]["force_ratio"] == 1.5
