# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""./cube fit and ./cube layout as a user runs them: tables in, calibrations and pictures out, one
line per mistake."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from conftest import ROOT
from cube_tensor_driver.calibrate.load_table import read_loads
from cube_tensor_driver.config.calibration import read_calibration
from cube_tensor_driver.core.calibration import make_illustrative_calibration
from cube_tensor_driver.core.errors import FitError
from cube_tensor_driver.core.layout import LAYOUTS
from cube_tensor_driver.core.oscillator import compute_pad_frequency

PLANAR = LAYOUTS["planar"]


def cube(*arguments: object) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", "cube_tensor_driver.cli", *map(str, arguments)]
    return subprocess.run(
        command, capture_output=True, text=True, cwd=ROOT, timeout=60, check=False
    )


def bench(seed: int, noise: float, loads: int, spread: float = 0.05, outliers: int = 0):
    """A simulated bench: a planar cube whose pads differ, under random loads of all modes; three
    rows without load."""
    rng = np.random.default_rng(seed)
    gain = 1 + spread * rng.standard_normal(8)
    truth = replace(
        make_illustrative_calibration("planar"),
        gain=gain / gain.mean(),
        rest_frequency=100e3 * rng.uniform(0.95, 1.05, 8),
    )
    amplitudes = np.vstack([np.zeros((3, 7)), rng.uniform(-10e3, 10e3, (loads, 7))])
    v = amplitudes @ truth.response.T
    f = compute_pad_frequency(v, truth.rest_frequency, truth.beta, truth.modulus)
    # noise is 0.1 % of the readings' range, as a change of frequency
    f = f + noise * np.ptp(f - truth.rest_frequency) * rng.standard_normal(f.shape)
    for row in range(outliers):
        f[5 + row, row % 8] *= 1.2
    return truth, amplitudes, f


def write(path: Path, amplitudes: np.ndarray, frequency: np.ndarray, **change) -> Path:
    header = [*make_illustrative_calibration("planar").modes.names, *PLANAR.pads]
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows(np.hstack([amplitudes, frequency]).tolist())
    return path


def test_the_example_of_the_page_scatters_as_its_calibration_states(tmp_path):
    output, figures = tmp_path / "mine.yaml", tmp_path / "fit.json"
    table = ROOT / "docs" / "example_loads.csv"
    done = cube("fit", table, "--layout", "planar", "-o", output, "--json", figures)
    assert done.returncode == 0, done.stderr
    result = json.loads(figures.read_text())
    # five standard deviations of a chi-square
    assert abs(result["chi2"] - result["dof"]) < 5 * np.sqrt(2 * result["dof"])
    assert "0.00000" not in done.stdout
    fitted = read_calibration(output)
    np.testing.assert_allclose(fitted.noise, 3.12, rtol=0.2)


def test_a_bench_is_recovered_with_its_deviations(tmp_path):
    truth, amplitudes, frequency = bench(0, noise=0.001, loads=20, outliers=2)
    table = write(tmp_path / "loads.csv", amplitudes, frequency)
    done = cube(
        "fit",
        table,
        "--layout",
        "planar",
        "-o",
        tmp_path / "cal.yaml",
        "--json",
        tmp_path / "fit.json",
        "--uid",
        "0x2a",
    )
    assert done.returncode == 0, done.stderr
    calibration = read_calibration(tmp_path / "cal.yaml")
    assert (
        calibration.uid == 0x2A
        and calibration.symmetry == "full"
        and "loads.csv" in calibration.source
    )
    result = json.loads((tmp_path / "fit.json").read_text())
    # 4 standard deviations: one of 15 values fails by chance in a thousand seeds; this seed is
    # fixed
    for name, value in truth.coefficients.items():
        assert abs(result["coefficients"][name] - value) < 4 * result["deviations"][name]
    np.testing.assert_allclose(
        calibration.gain, truth.gain, rtol=5e-3
    )  # what the issue asks at 0.1 % noise
    # rest frequencies are means of three rows of that noise
    np.testing.assert_allclose(calibration.rest_frequency, truth.rest_frequency, rtol=1e-3)
    assert {tuple(place) for place in result["outliers"]} >= {
        (2, 0),
        (3, 1),
    }  # rows without load are not counted
    # unseen loads are predicted to about the noise: 0.1 % of the range is 0.5 % of the rms;
    # outliers do not count
    assert result["held_out"] < 0.02
    assert (tmp_path / "cal.png").stat().st_size > 10_000


def test_loads_that_say_too_little_name_what_to_add(tmp_path):
    _, amplitudes, frequency = bench(1, noise=0.001, loads=20)
    amplitudes[:, 3:] = 0
    truth = make_illustrative_calibration("planar")
    frequency = compute_pad_frequency(
        amplitudes @ truth.response.T, truth.rest_frequency, truth.beta, truth.modulus
    )
    done = cube(
        "fit",
        write(tmp_path / "l.csv", amplitudes, frequency),
        "--layout",
        "planar",
        "-o",
        tmp_path / "c.yaml",
    )
    assert done.returncode == 1 and "Traceback" not in done.stderr
    assert (
        "no calibration" in done.stderr
        and "do not determine" in done.stderr
        and "add a load of zz_x" in done.stderr
    )
    assert not (tmp_path / "c.yaml").exists()


def table(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "t.csv"
    path.write_text(text)
    return path


PADS = ",".join(PLANAR.pads)
ROW = ",".join(["100000"] * 8)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", ["0 lines"]),
        (f"zz,{PADS}\n", ["1 lines"]),
        (f"zz,{PADS},color\n1,{ROW},2\n", ["columns unknown: 'color'"]),
        (f"zz,zz,{PADS}\n1,1,{ROW}\n", ["columns twice: 'zz'"]),
        ("zz,+z-x\n1,100000\n", ["columns missing: '+z+x'"]),
        (f"{PADS}\n{ROW}\n", ["neither columns of modes and of forces"]),
        (f"zz,fz,{PADS}\n1,1,{ROW}\n", ["both columns of modes and of forces"]),
        (f"fx,fy,fz,{PADS}\n0,0,1,{ROW}\n", ["--area"]),
        (f"zz,{PADS}\n1,{ROW},7\n", ["load 1 has 10 cells"]),
        (f"zz,{PADS}\nx,{ROW}\n", ["load 1, column zz: 'x' is no number"]),
    ],
)
def test_a_wrong_table_is_named(tmp_path, text, words):
    with pytest.raises(FitError) as caught:
        read_loads(table(tmp_path, text), PLANAR)
    for word in words:
        assert word in str(caught.value)


@pytest.mark.parametrize("cell", ["nan", "inf", "-5", "0"])
def test_an_impossible_frequency_is_named(tmp_path, cell):
    path = table(tmp_path, f"zz,{PADS}\n0,{ROW}\n5000,{cell},{','.join(['100000'] * 7)}\n")
    done = cube("fit", path, "--layout", "planar", "-o", tmp_path / "c.yaml")
    assert done.returncode == 1 and "Traceback" not in done.stderr
    assert "load 1, pad +z-x" in done.stderr and not (tmp_path / "c.yaml").exists()


def test_forces_become_tractions(tmp_path):
    loads = read_loads(table(tmp_path, f"fx,fy,fz,{PADS}\n1,2,-3,{ROW}\n"), PLANAR, area=1e-4)
    # zz, zx from fz and fx over 1 cm²; a planar cube has no mode for fy
    np.testing.assert_allclose(loads.amplitudes, [[-30e3, 10e3, 0, 0, 0, 0, 0]])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["layout", "round"], ["unknown layout 'round'"]),
        (["layout", "quad", "--symmetry", "full"], ["lacks this symmetry", "+z-x"]),
        (["layout", "planar", "--symmetry", "round"], ["unknown symmetry 'round'"]),
        (["layout", "cube", "--calibration", "planar"], ["is for layout 'planar'"]),
        (["fit", "none.csv", "--layout", "planar", "-o", "x.yaml"], ["none.csv", "No such file"]),
    ],
)
def test_mistakes_on_the_command_line(tmp_path, arguments, words):
    done = cube(*arguments)
    assert done.returncode == 1 and "Traceback" not in done.stderr
    for word in words:
        assert word in done.stderr


def test_layout_figures(tmp_path):
    done = cube("layout", "cube", "--json", tmp_path / "l.json", "--figure", tmp_path / "l.png")
    assert done.returncode == 0, done.stderr
    written = f"wrote {tmp_path / 'l.png'} and {tmp_path / 'l.json'}"
    assert done.stdout.splitlines()[-1] == written
    result = json.loads((tmp_path / "l.json").read_text())
    assert set(result) == {
        "pads",
        "modes",
        "n_coefficients",
        "rank_uniform",
        "rank_gradient",
        "unobservable",
        "condition_uniform",
        "condition_gradient",
        "noise",
    }
    assert (len(result["pads"]), result["n_coefficients"], result["rank_uniform"]) == (24, 12, 6)
    assert result["noise"]["yz_x"] is None and "yz_x" in result["unobservable"]
    assert (tmp_path / "l.png").stat().st_size > 10_000


def test_a_layout_of_ones_own(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(
        "name: mine\npad_size: 0.4\npositions: [[0, 0, 1], [1, 0, 0], [-1, 0, 0], [0, 0, -1]]\n"
        "normals: [[0, 0, 1], [1, 0, 0], [-1, 0, 0], [0, 0, -1]]\n"
    )
    done = cube("layout", path, "--figure", tmp_path / "m.png", "--json", tmp_path / "m.json")
    assert done.returncode == 0, done.stderr
    # pads at the middle of the faces see both normal stresses, no shear, and two gradients each
    # along its own axis
    result = json.loads((tmp_path / "m.json").read_text())
    assert "zx" in result["unobservable"] and "zz" not in result["unobservable"]


@pytest.mark.parametrize("name", ["x.png", "x", "gone/x.yaml"])
def test_an_output_that_cannot_be_is_named_by_its_own_option(tmp_path, name):
    """The picture beside it, which nobody asked for by name, is not spoken of."""
    loads = ROOT / "docs" / "example_loads.csv"
    done = cube("fit", loads, "--layout", "planar", "-o", tmp_path / name)
    assert done.returncode == 1 and done.stderr.count("\n") == 1
    assert done.stderr.startswith(f"cube: -o {tmp_path / name}: ") and "--figure" not in done.stderr
