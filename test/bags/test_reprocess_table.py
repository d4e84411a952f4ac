# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Arrow tables of frequencies made into tables of stress: the same bits as `./cube reprocess`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pyarrow", reason="needs pyarrow: pip install pyarrow")
pytest.importorskip("rosbags", reason="needs rosbags: pip install rosbags")

import pyarrow
import pyarrow.parquet
from bag_maker import make_bag

import cube_tensor_driver as ctd
from conftest import ROOT
from cube_tensor_driver.bags.reprocess.job import Overrides, ReprocessJob, reprocess
from cube_tensor_driver.config.package_data import find_package_data

SKIN = find_package_data() / "config" / "skin_demo.yaml"
KEPT = ROOT / "test" / "data" / "bag"
"""A recording of hubs on a noisy line, which has lost messages and messages of few cubes."""


def stuck(k: int) -> np.ndarray:
    """Pad 2 of cube 3 in the first half, which the frequencies do not show."""
    return np.where(np.arange(16) == 3, 1 << 2, 0) * (k < 50)


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    path = tmp_path_factory.mktemp("table") / "bag"
    return make_bag(path, SKIN, 100, left_out=stuck, tare=(60, 1.001))


@pytest.fixture(scope="module")
def frequencies(bag):
    with ctd.open_bag(bag) as source:
        return ctd.read_frequency_table(source)


def assert_same(found: pyarrow.Table, expected: pyarrow.Table) -> None:
    assert found.schema == expected.schema and len(found) == len(expected) > 0
    for name in expected.column_names:
        one, other = (
            table[name].cast(pyarrow.string()).to_pylist()
            if name == "cube"
            else table[name].to_numpy().tobytes()
            for table in (found, expected)
        )
        assert one == other, name


def reprocessed(bag: Path, folder: Path, overrides: Overrides) -> pyarrow.Table:
    reprocess(ReprocessJob(bag, folder / "out.parquet", "parquet", overrides))
    return pyarrow.parquet.read_table(folder / "out.parquet")


@pytest.mark.parametrize("form", ["arrow", "pandas", "kept"])
def test_a_whole_bag_gives_the_values_of_reprocess(bag, tmp_path, form):
    """Rest frequencies and pads left out as recorded, also after engines that use pandas."""
    path = KEPT if form == "kept" else bag
    with ctd.open_bag(path) as source:
        table, skin = ctd.read_frequency_table(source), source.skin
    if form == "pandas":
        pytest.importorskip("pandas", reason="needs pandas: pip install pandas")
        table = pyarrow.Table.from_pandas(table.to_pandas())
    found = ctd.reprocess_table(table, skin)
    assert_same(found, reprocessed(path, tmp_path, Overrides()))
    if form == "arrow":
        left_out = found["left_out"].to_numpy().reshape(-1, 16)
        assert left_out[:, 3].tolist() == [4] * 50 + [0] * 50


def test_frequencies_alone_are_those_of_a_node_that_starts(bag, frequencies, tmp_path):
    """Rest frequencies of the calibrations, and pads assessed by a new reconstructor."""
    skin = ctd.read_skin(SKIN)
    found = ctd.reprocess_table(frequencies.select(["stamp_ns", "cube", "frequency_Hz"]), skin)
    reconstruct = ctd.Reconstructor(skin)
    with ctd.open_bag(bag) as source:
        expected = [reconstruct(rows) for rows in source]
    zz = np.concatenate([rows.stress[:, 2] for rows in expected])
    assert found["stress_zz_Pa"].to_numpy().tobytes() == zz.tobytes()
    assert not found["left_out"].to_numpy().any() and not found["sequence"].to_numpy().any()
    assert len(ctd.reprocess_table(frequencies[:0], skin)) == 0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            lambda table: table.drop_columns("stamp_ns"),
            "no stamp_ns in the table; read_frequency_table makes",
        ),
        (lambda table: table.drop_columns("part"), "keep the column part"),
        (
            lambda table: table.slice(0, 16).set_column(
                table.column_names.index("frequency_Hz"),
                "frequency_Hz",
                [[[1e6] * (8 - k % 2) for k in range(16)]],
            ),
            "lists of [8, 7] numbers",
        ),
        (
            lambda table: table.set_column(
                table.column_names.index("cube"), "cube", [["c99"] * len(table)]
            ).drop_columns("recorded_left_out"),
            "of cubes up to 16; this skin has 16 cubes",
        ),
        (
            lambda table: table.slice(0, 16).set_column(
                table.column_names.index("recorded_rest_frequency"),
                "recorded_rest_frequency",
                [[[1e6] * 100] + [None] * 15],
            ),
            "recorded_rest_frequency",
        ),
    ],
)
def test_a_table_that_does_not_fit_is_one_line(frequencies, change, words):
    with pytest.raises(ctd.CubeError) as refused:
        ctd.reprocess_table(change(frequencies), ctd.read_skin(SKIN))
    assert words in str(refused.value) and len(str(refused.value)) < 200
