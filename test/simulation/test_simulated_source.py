# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""A simulated skin in this process: exact frequencies, and the load comes out again."""

from __future__ import annotations

import re
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
import yaml

from conftest import ROOT
from cube_tensor_driver.config.calibration import find_calibration, read_calibration
from cube_tensor_driver.config.package_data import find_package_data
from cube_tensor_driver.config.skin import read_skin
from cube_tensor_driver.core.errors import ConfigError
from cube_tensor_driver.core.estimator import make_estimator
from cube_tensor_driver.core.modes import COMPONENTS
from cube_tensor_driver.core.oscillator import compute_pad_frequency
from cube_tensor_driver.core.reconstructor import Reconstructor
from cube_tensor_driver.core.rows import FrequencyRows, concatenate
from cube_tensor_driver.demo.load_verification import compute_component_noise
from cube_tensor_driver.device.live import open_links
from cube_tensor_driver.device.wire.decoder import Decoder
from cube_tensor_driver.device.wire.protocol import Sample
from cube_tensor_driver.simulation.cubes import (
    PadErrors,
    SimulatedCubes,
    compute_skin_components,
    compute_true_amplitudes,
    make_hub_cubes,
)
from cube_tensor_driver.simulation.hub import SimulatedHub
from cube_tensor_driver.simulation.load import Load, read_default_script
from cube_tensor_driver.simulation.sample_log import SampleLog
from cube_tensor_driver.simulation.source import simulate

FILE = find_package_data() / "config" / "skin_demo.yaml"
SKIN = read_skin(FILE)


def test_the_load_comes_out_again():
    """To what rounding leaves: half a mHz, and half of the last of 24 bits, of a pad's frequency;
    each pad's error passes its law and the matrix from pads to components."""
    load = Load(SKIN, read_default_script())
    reconstruct = Reconstructor(SKIN, np.float64)
    calibration = SKIN.cubes[0].calibration
    rest, beta, modulus = law = (
        calibration.rest_frequency,
        calibration.beta,
        calibration.modulus,
    )
    matrix = make_estimator(calibration.response, calibration.noise, calibration.modes).matrix
    unit = np.where(np.arange(len(COMPONENTS)) < 6, 1.0, calibration.half_side)
    scans = 0
    for rows in simulate(SKIN, load, rate=50.0, duration=1.0):
        found = reconstruct(rows)
        stress, gradient = load.compute_stress_field(1e-9 * rows.stamp_ns[0])
        frequency = compute_pad_frequency(
            compute_true_amplitudes(calibration, stress, gradient) @ calibration.response.T, *law
        )
        rounding = 0.5e-3 + 2.0**-24 * frequency
        slope = modulus * (1 + beta) / (rest * (1 - beta * (frequency / rest - 1)) ** 2)
        pad_error = slope * rounding
        # 1e-6 of the bound: the law is not straight over a rounding.
        bound = (pad_error @ np.abs(matrix).T) * (1 + 1e-6) / unit
        components = np.concatenate([found.stress, found.gradient], axis=1)
        error = np.abs(components - compute_skin_components(SKIN, stress, gradient))
        seen = np.isfinite(components)
        assert (error[seen] <= bound[seen]).all()
        assert seen.any(axis=0).sum() == 7 and not found.status.any()
        scans += 1
    assert scans == 50


def test_values_are_those_that_a_hub_sends():
    hubs = make_hub_cubes(SKIN, PadErrors(1e-5, 1e-4))
    load = Load(SKIN, read_default_script())
    source = simulate(SKIN, load, rate=100.0, noise=1e-5, drift=1e-4)
    for number, rows in enumerate(islice(source, 20)):
        sent = []
        for hub in hubs:
            millihertz = hub.compute_frequency(
                *load.compute_stress_field(0.01 * number), 0.01 * number
            )
            device = SimulatedHub(
                uid=1, cube_uids=list(range(len(hub.members))), n_pads=hub.cubes.n_pads
            )
            (frame,) = Decoder().feed(device.sample(millihertz))
            assert isinstance(frame, Sample)
            sent.append(frame.frequency)
        # In double precision, then rounded once, as `device.scan` does.
        expected = (np.concatenate(sent) * 1e-3).astype(np.float32)
        np.testing.assert_array_equal(rows.frequency, expected)
        assert rows.frequency.dtype == np.float32
        assert rows.cube.tolist() == list(range(16))
        assert set(rows.sequence.tolist()) == {number}
        assert set(rows.stamp_ns.tolist()) == {number * 10_000_000}
        assert np.isnan(rows.temperature).all() and not rows.pad_fault.any()


def test_values_are_those_of_a_live_link(tmp_path):
    """To the bit what `open_links` gives of the simulator in another process, at the same times."""
    ports, log = tmp_path / "ports", tmp_path / "log.json"
    command = [sys.executable, "-m", "cube_tensor_driver.simulation.main", "--config", str(FILE)]
    command += ["--ports", str(ports), "--log", str(log), "--noise", "0"]
    process = subprocess.Popen(command)
    try:
        with open_links(SKIN, port_directory=ports) as source:
            live = concatenate(list(islice(source, 100)))
        process.send_signal(signal.SIGINT)
        assert process.wait(20) == 0
    finally:
        process.kill()
    sampled = SampleLog.read(log)
    time_ns = sampled.table.time_ns[sampled.table.match(live)]
    number = (time_ns - sampled.start_time_ns) // 10_000_000
    scans = [rows.frequency for rows in islice(simulate(SKIN), int(number.max()) + 1)]
    np.testing.assert_array_equal(live.frequency, np.array(scans)[number, live.cube])
    assert set(live.cube.tolist()) == set(range(16))


def test_it_is_a_source_that_begins_anew_each_time(tmp_path):
    with simulate(SKIN, duration=0.05, noise=1e-5) as source:
        assert source.skin is SKIN and not source.is_live
        first, second = list(source), list(source)
    assert len(first) == 5
    given = {"rows given": 80, "scans given": 5, "simulated seconds": pytest.approx(0.05)}
    assert source.statistics() == given
    for one, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(one.frequency, other.frequency)
    script = tmp_path / "load.yaml"
    press = {"from": 0.0, "to": 1.0, "at": [0, 0, 0], "force": 2.0}
    indenter = {"name": "a", "shape": "disc", "radius": 0.005, "does": [{"press": press}]}
    script.write_text(yaml.safe_dump({"indenters": [indenter]}))
    rest = next(iter(simulate(SKIN, script)))
    np.testing.assert_allclose(rest.frequency, SKIN.cubes[0].calibration.rest_frequency[0])


def test_a_stopped_oscillator_and_pads_that_a_cube_does_not_have_are_nan(tmp_path):
    """Under a crushing load, and where a cube of 4 pads is beside one of 24."""
    skin = {
        "name": "mixed",
        "parent_frame": "base",
        "links": [{"name": name, "port": f"/dev/none_{name}"} for name in ("a", "b")],
        "cubes": [
            {
                "name": f"c{number}",
                "link": link,
                "index": 0,
                "pose": {"xyz": [0.02 * number, 0, 0], "rpy": [0, 0, 0]},
                "layout": layout,
                "calibration": layout,
            }
            for number, (link, layout) in enumerate((("a", "quad"), ("b", "cube")))
        ],
    }
    path = tmp_path / "skin.yaml"
    path.write_text(yaml.safe_dump(skin))
    mixed = read_skin(path)
    rows = next(iter(simulate(mixed)))
    assert rows.frequency.shape == (2, 24)
    assert np.isfinite(rows.frequency).sum(axis=1).tolist() == [4, 24]
    assert not Reconstructor(mixed)(rows).status.any()

    press = {"from": 0.0, "to": 1.0, "at": [0, 0, 0], "force": 5000.0}
    indenter = {"name": "a", "shape": "disc", "radius": 0.005, "does": [{"press": press}]}
    path = tmp_path / "load.yaml"
    path.write_text(yaml.safe_dump({"indenters": [indenter]}))
    crushed = list(simulate(mixed, path, rate=10.0, duration=0.6))[-1]
    assert np.isnan(crushed.frequency[0, :4]).any()


def test_the_program_of_the_page_runs(tmp_path, monkeypatch, capsys):
    page = (ROOT / "docs" / "simulation.md").read_text()
    program, imperfect, *_ = re.findall(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    shutil.copy(FILE, tmp_path / "skin.yaml")
    monkeypatch.chdir(tmp_path)
    exec(program + imperfect, {})
    assert re.fullmatch(r"largest pressure \d+\.\d kPa\n", capsys.readouterr().out)


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ({"rate": 0.01}, "rate is 0.01, allowed: 0.1 to 10000"),
        ({"rate": float("nan")}, "rate is nan"),
        ({"duration": 0.0}, "duration is 0.0"),
        ({"load": "none.yaml"}, "none.yaml"),
    ],
)
def test_what_cannot_be_simulated_is_refused(asked, words):
    with pytest.raises(ConfigError, match=words):
        simulate(SKIN, **asked)


@pytest.mark.parametrize("layout", ["planar", "cube"])
def test_noise_of_the_calibration_gives_a_residual_of_one_and_the_stated_deviations(layout):
    calibration = read_calibration(find_calibration(layout, Path()))
    n = 2000
    cubes = SimulatedCubes([calibration] * n, PadErrors(noise=None))
    millihertz = cubes.compute_frequency(np.zeros((n, 6)), np.zeros((n, 6, 3)), 0.0)
    rows = Reconstructor([calibration] * n).process(
        FrequencyRows.from_values(np.arange(n), (millihertz * 1e-3).astype(np.float32))
    )
    assert np.sqrt(np.mean(rows.residual**2)) == pytest.approx(1.0, abs=0.05)
    skin = replace(SKIN, cubes=(replace(SKIN.cubes[0], calibration=calibration),))
    components = np.hstack([rows.stress, rows.gradient])
    stated = compute_component_noise(skin)[0]
    np.testing.assert_array_equal(np.isnan(stated), np.isnan(components[0]))
    observed = np.isfinite(stated)
    np.testing.assert_allclose(components[:, observed].std(axis=0), stated[observed], rtol=0.1)
