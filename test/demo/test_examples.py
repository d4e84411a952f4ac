# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The worked examples: their files; and that each runs and finds the loads of its script."""

from __future__ import annotations

import json
import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from conftest import ROOT
from cube_tensor_driver.config.package_data import find_package_data
from cube_tensor_driver.config.skin import read_skin
from cube_tensor_driver.core.tensor import rotation_from_rpy

FOLDER = find_package_data() / "config" / "examples"


def test_forearm_is_a_cylinder_of_mixed_cubes_that_look_outwards():
    skin = read_skin(FOLDER / "forearm.yaml")
    places = np.array([cube.xyz for cube in skin.cubes])
    out = np.array([rotation_from_rpy(*cube.rpy)[:, 2] for cube in skin.cubes])
    # the file gives tenths of a millimetre and of a milliradian
    np.testing.assert_allclose(places[:, 1:], 0.04 * out[:, 1:], atol=1e-4)
    np.testing.assert_allclose(out[:, 0], 0, atol=1e-12)
    assert len(np.unique(places, axis=0)) == 240
    assert Counter(cube.calibration.layout.name for cube in skin.cubes) == {
        "planar": 200,
        "cube": 40,
    }
    assert len(skin.links) == 6


def test_sole_is_flat_and_on_a_grid():
    places = np.array([cube.xyz for cube in read_skin(FOLDER / "sole.yaml").cubes])
    assert not places[:, 2].any() and len(np.unique(places, axis=0)) == len(places)
    np.testing.assert_allclose((places[:, 1] / 0.014) % 1, 0, atol=1e-9)
    assert places[:, 0].min() > 0 and places[:, 0].max() < 0.27


def demo(tmp_path: Path, skin: str, load: str, *arguments: str) -> dict:
    pytest.importorskip("rclpy", reason="needs rclpy: run this with ./cube test")
    path = tmp_path / "figures.json"
    command = [
        "demo",
        "--noise",
        "0",
        "--config",
        str(FOLDER / skin),
        "--load",
        str(FOLDER / load),
        "--headless",
        "--json",
        str(path),
    ]
    done = subprocess.run(
        [sys.executable, "-m", "cube_tensor_driver.cli", *command, *arguments],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=90,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return json.loads(path.read_text())


def test_sole_finds_the_ground_reaction_force_and_its_centre(domain, tmp_path):
    picture = tmp_path / "gait.png"
    result = demo(tmp_path, "sole.yaml", "gait.yaml", "--duration", "1.1", "--figure", str(picture))
    # float32 carries 6e-8, see test_end_to_end
    assert result["error_rel_rms"] < 1e-5
    error = np.divide(result["force_error_n"], result["force_peak_n"])
    # what the half space carries beyond the outline, 1 to 2 % of the pressure and 20 to 35 % of the
    # shear, and what the field sags between cubes, 3 %: docs/examples.md
    assert error[2] < 0.04 and error[0] < 0.3 and error[1] < 0.3
    assert result["centre_error_mm"] < 1.5
    assert picture.stat().st_size > 10_000


def test_forearm_runs_with_both_layouts(domain, tmp_path):
    result = demo(tmp_path, "forearm.yaml", "forearm_load.yaml", "--duration", "1")
    assert result["cubes"] == 240 and result["tensors_received"] > 0
    # float32 carries 6e-8, see test_end_to_end; measured 4e-7
    assert result["error_rel_rms"] < 1e-5
