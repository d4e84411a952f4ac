# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Creep from a press that is held, in simulated hours of foam that creeps by a power law.

The truth is the fractional element of the simulator (`simulation/imperfections.py`, which has its
own test against the closed form), through pads, counter and noise.
"""

from __future__ import annotations

from functools import lru_cache
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="needs rosbags: pip install rosbags")

from bag_maker import START_NS, info_of
from dummy_pad import with_dummy

from conftest import encoded
from cube_tensor_driver.bags.metadata import describe_quality, make_typestore
from cube_tensor_driver.bags.write import BagWriter
from cube_tensor_driver.calibrate.creep import CreepFit, add_creep, compute_step_reading, fit_creep
from cube_tensor_driver.calibrate.fit import compute_measured_stress
from cube_tensor_driver.cli import main as cli
from cube_tensor_driver.config.calibration import read_calibration
from cube_tensor_driver.core.calibration import make_illustrative_calibration
from cube_tensor_driver.core.compensation.models import CreepModel
from cube_tensor_driver.core.errors import FitError
from cube_tensor_driver.core.pipeline import Pipeline
from cube_tensor_driver.core.reconstructor import Reconstructor
from cube_tensor_driver.core.rows import FrequencyRows
from cube_tensor_driver.messages.types import FREQUENCIES_TYPE, INFO_TYPE
from cube_tensor_driver.simulation.cubes import PadErrors, SimulatedCubes
from cube_tensor_driver.simulation.imperfections import Imperfections

PLAIN = make_illustrative_calibration("planar")
PRESS = np.array([-8e3, 0, -20e3, 0, 2e3, 0])
"""Stress under the press, in Pa, order xx yy zz yz zx xy."""


def measured(time, scale, growth, exponent=0.2, seed=0, base=PLAIN):
    """Frequencies (N, P) of a cube under `scale` (N,) times `PRESS`, in Hz."""
    creep = Imperfections(creep_growth=growth, creep_exponent=exponent, creep_spread=0.2, seed=seed)
    cubes = SimulatedCubes([base], PadErrors(None, imperfections=creep), seed=seed)
    gradient = np.zeros((1, 6, 3))
    found = [
        cubes.compute_frequency(PRESS[None] * s, gradient, t)
        for t, s in zip(time, scale, strict=True)
    ]
    return np.concatenate(found) * 1e-3


def pressed(time, begin, end):
    """A press that comes on and goes within 0.3 s."""
    return np.interp(time, [begin, begin + 0.3, end, end + 0.3], [0, 1, 1, 0])


@lru_cache
def fitted(growth, exponent=0.2, seed=0) -> CreepFit:
    """The law from one recording of 10 min at 20 Hz: 10 s of rest, 9 min of load, recovery."""
    time = np.arange(0, 595, 0.05)
    frequency = measured(time, pressed(time, 10, 550), growth, exponent, seed)
    return fit_creep(
        time, compute_measured_stress(PLAIN, frequency), PLAIN.noise, PLAIN.layout.pads
    )


def held_times(hold):
    """Times, in s, of samples around a press from 5 s on for `hold` s, dense where it changes."""
    change = np.concatenate([np.arange(0, 8, 0.05), np.arange(8, 120, 1.0)])
    middle = np.arange(125, 5 + hold, 5.0)
    return np.concatenate([np.arange(0, 5, 0.25), 5 + change, middle, 5 + hold + change])


def reconstructed(time, scale, growth, exponent=0.2, seed=0, calibration=None, base=PLAIN):
    """Error of zz at each time, in Pa, and its stated deviation at the last one."""
    frequency = measured(time, scale, growth, exponent, seed, base)
    calibration = calibration or add_creep(PLAIN, fitted(growth, exponent, seed).model)
    reconstruct = Reconstructor([calibration])
    stamp_ns = 10**9 + np.rint(1e9 * time).astype(np.int64)
    rows = FrequencyRows.from_values(np.zeros(len(time), np.uint16), frequency, stamp_ns=stamp_ns)
    error = reconstruct.process(rows).stress[:, 2] - PRESS[2] * scale
    return error, np.sqrt(reconstruct.compute_covariance(0)[2, 2])


GROWTHS = [0.05, 0.1, 0.25]
"""Creep from 1 s to 10 min, divided by the load."""


@pytest.mark.parametrize("growth", GROWTHS)
def test_a_load_of_ten_minutes_and_of_an_hour_stays_what_it_is(growth):
    """In percent of 20 kPa: 0.5 from 3 to 600 s, and what is left after it at most 30 Pa.

    After an hour, the deviation that is stated is that of a law beyond its recording. Over nine
    laws (growths of 5, 10, 25 %, exponents of 0.1, 0.2, 0.35), two seeds each, the error divided by
    it was 0.99 (rms), and 2.6 at most.
    """
    time = held_times(600.0)
    error, stated = reconstructed(time, pressed(time, 5, 605), growth)
    plain, _ = reconstructed(time, pressed(time, 5, 605), growth, calibration=PLAIN)
    held = (time > 8) & (time < 604)
    assert np.abs(plain[held]).max() / 200 == pytest.approx(100 * growth, rel=0.1)
    assert np.abs(error[held]).max() / 200 < 0.5
    # Rows up to 5 s apart are no gap, after which earlier loads would be unknown.
    assert stated / 200 < 0.3
    for after in (10, 60):
        # Means of 3 s or more, because the noise of one row is 8 Pa.
        chosen = (time > 604 + after) & (time < 608 + after)
        assert abs(error[chosen].mean()) < 30 < abs(plain[chosen].mean())

    time = held_times(3600.0)
    time = time[time < 3604]
    error, stated = reconstructed(time, pressed(time, 5, 3605), growth)
    last = abs(error[-5:].mean())
    assert last < 1.5 * stated and stated / 200 < 0.3


@pytest.mark.parametrize("hertz", [0.1, 1.0])
def test_a_load_that_comes_and_goes_has_no_loop(hertz):
    """At most 1 % of full scale between loading and unloading and against the load itself."""
    time = np.arange(0, 2 + 4 / hertz, 0.01 / hertz)
    scale = 0.5 * (1 - np.cos(2 * np.pi * hertz * (time - 2).clip(0)))
    error, _ = reconstructed(time, scale, 0.25)
    plain, _ = reconstructed(time, scale, 0.25, calibration=PLAIN)
    assert np.abs(plain).max() / 200 > 3
    assert np.abs(error).max() / 200 < 1


def test_gains_are_those_of_loads_a_second_after_they_began():
    """A law with one term: 1 / (1 - a) is reached with the time tau / (1 - a)."""
    time, amplitude = 0.7, np.linspace(0.05, 0.4, 8)
    model = CreepModel(np.array([time]), amplitude[:, None])
    expected = (1 - amplitude * np.exp(-(1 - amplitude) / time)) / (1 - amplitude)
    np.testing.assert_allclose(compute_step_reading(model, 1.0), expected, rtol=1e-5)
    older = add_creep(PLAIN, model)
    np.testing.assert_allclose(older.gain, PLAIN.gain / expected, rtol=1e-5)
    again = add_creep(older, model)
    np.testing.assert_allclose(again.gain, older.gain, rtol=1e-12)


@pytest.mark.parametrize(
    ("end", "scale", "said"),
    [
        (30, (1, 10, 20, 25), r"held for 9\.\d s; hold it for 60 s or more"),
        (200, (1, 1.1, 190, 195), "begins 0 s after the recording; record 2 s or more without"),
        (200, (10, 150, 190, 195), "hold a constant load, such as a dead weight"),
    ],
)
def test_a_press_that_is_no_hold_is_refused_with_the_fix(end, scale, said):
    time = np.arange(0, end, 0.1)
    load = np.interp(time, scale, [0, 1, 1, 0])
    if scale[1] == 10:
        load = ((time > 10) & (time < 20)) * 1.0
    with pytest.raises(FitError, match=said):
        fit_creep(time, 1e3 * np.outer(load, np.ones(8)), np.ones(8), PLAIN.layout.pads)


def test_presses_that_come_and_go_or_miss_a_pad_are_refused():
    time = np.arange(0, 300, 0.1)
    twice = 1e3 * np.outer((time > 10) & (time % 100 > 5), np.ones(8))
    with pytest.raises(FitError, match="came and went; press once"):
        fit_creep(time, twice, np.ones(8), PLAIN.layout.pads)
    more = 1 + 0.05 * ((time > 100) & (time < 200))
    touched = 1e3 * np.outer(pressed(time, 10, 290) * more, np.ones(8))
    with pytest.raises(FitError, match="and hold a constant load, such as a dead weight"):
        fit_creep(time, touched, np.ones(8), PLAIN.layout.pads)
    uneven = 1e3 * np.outer((time > 10) & (time < 290), [1, 1, 1, 0.05, 1, 1, 1, 1])
    name = PLAIN.layout.pads[3].replace("+", r"\+")
    with pytest.raises(FitError, match=f"pad {name} got 50 Pa, needed are 100 Pa; press harder"):
        fit_creep(time, uneven, np.ones(8), PLAIN.layout.pads)


@pytest.mark.parametrize("base", [PLAIN, with_dummy("planar")])
def test_three_commands_lead_from_a_bag_to_a_calibration(tmp_path, capsys, base):
    """The law of the bag is in the file, and a press that is no hold is one line with the fix."""
    time = np.arange(0, 100, 0.1)
    frequency = measured(time, pressed(time, 5, 90), 0.1, base=base)
    cube = SimpleNamespace(name="c0", link="hub0", index=0, uid=0, calibration=base)
    skin = SimpleNamespace(
        name="skin", elastomer=None, make_frame_id=lambda cube: cube.name, cubes=[cube]
    )
    bag, saved = tmp_path / "press", tmp_path / "mine.yaml"
    with BagWriter(bag) as writer:
        for name, kind in {"info": INFO_TYPE, "frequencies": FREQUENCIES_TYPE}.items():
            writer.add_topic(f"/{name}", kind, [describe_quality(latched=name == "info")])
        info = info_of(skin, Pipeline([base]), START_NS)
        writer.write("/info", START_NS, bytes(make_typestore().serialize_cdr(info, INFO_TYPE)))
        for n, pads in enumerate(frequency.astype(np.float32)):
            stamp_ns = START_NS + n * 100_000_000
            number = np.zeros(1, np.uint16)
            rows = FrequencyRows.from_values(number, pads[None], stamp_ns=stamp_ns, sequence=n)
            writer.write("/frequencies", stamp_ns, encoded(rows, b"base\0"))
    assert cli.main(["fit", "--creep", str(bag), "-o", str(saved)]) == 0
    assert "relaxation times explain a hold of 85 s to 0.0" in capsys.readouterr().out
    assert saved.with_suffix(".png").stat().st_size > 20_000
    found = read_calibration(saved)
    assert found.creep.amplitude[:8].any(axis=1).all() and not found.creep.amplitude[8:].any()
    error, _ = reconstructed(time, pressed(time, 5, 90), 0.1, calibration=found, base=base)
    assert np.abs(error[60:880]).max() / 200 < 0.3
    assert cli.main(["fit", "--creep", str(bag), "--cube", "c9", "-o", str(saved)]) == 1
    assert "no cube 'c9'; there are c0" in capsys.readouterr().err
