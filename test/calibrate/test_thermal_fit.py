# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""`./cube fit --rest` against a skin whose truth is the heat equation and finite elements."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="needs rosbags: pip install rosbags")

from bag_maker import START_NS, info_of

from conftest import encoded
from cube_tensor_driver.bags.metadata import describe_quality, make_typestore
from cube_tensor_driver.bags.write import BagWriter
from cube_tensor_driver.calibrate.block_means import find_lags
from cube_tensor_driver.calibrate.thermal import Warming, fit_thermal
from cube_tensor_driver.cli import main as cli
from cube_tensor_driver.config.calibration import find_shipped_calibration, read_calibration
from cube_tensor_driver.config.skin import Elastomer
from cube_tensor_driver.core.errors import FitError
from cube_tensor_driver.core.layout import LAYOUTS
from cube_tensor_driver.core.oscillator import TemperatureModel
from cube_tensor_driver.core.pipeline import Pipeline
from cube_tensor_driver.core.poses import CubePoses
from cube_tensor_driver.core.reconstructor import Reconstructor
from cube_tensor_driver.core.rows import FrequencyRows
from cube_tensor_driver.core.status import COMPENSATION, THERMAL
from cube_tensor_driver.messages.types import FREQUENCIES_TYPE, INFO_TYPE
from cube_tensor_driver.simulation.cubes import PadErrors, SimulatedCubes
from cube_tensor_driver.simulation.imperfections import Imperfections
from cube_tensor_driver.touch.contact_finder import ContactSettings, make_contact_finder

CUBE = find_shipped_calibration(LAYOUTS["cube"])
OSCILLATORS = TemperatureModel(np.array(25.0), np.full((24, 1), 1e-4))
"""The mean drift of the simulated oscillators, as it was measured before they were embedded."""
LOAD = np.array([-2e3, -1500.0, -5000.0, 0.0, 300.0, 0.0])  # Pa
N_CUBES = 2


def simulated(knots, faces: str, noise: float | None) -> SimulatedCubes:
    """Cubes in a layer whose ground warms, below still air or with the surface at the same
    temperature; drift differs by 20 % between the pads and the layer by 5 %."""
    both = {"air": knots, "heat_exchange": 1e4} if faces == "both" else {}
    wanted = Imperfections(
        temperature=knots, pad_drift_spread=0.2, layer_spread=0.05, seed=3, **both
    )
    return SimulatedCubes([CUBE] * N_CUBES, PadErrors(noise, imperfections=wanted))


def play(cubes: SimulatedCubes, seconds: np.ndarray, load: np.ndarray):
    """Rows of one scan after the other."""
    stress, gradient = np.tile(load, (N_CUBES, 1)), np.zeros((N_CUBES, 6, 3))
    for number, time in enumerate(seconds.tolist()):
        hertz = cubes.compute_frequency(stress, gradient, time) * 1e-3
        yield FrequencyRows.from_values(
            np.arange(N_CUBES, dtype=np.uint16),
            hertz.astype(np.float32),
            stamp_ns=START_NS + round(time * 1e9),
            sequence=number,
            temperature=cubes.compute_temperature(time),
        )


def make_bag(folder, knots, faces="both", seconds=600.0, measured=True, base=CUBE):
    names = [f"c{k}" for k in range(N_CUBES)]
    skin = SimpleNamespace(
        name="skin",
        elastomer=None,
        make_frame_id=lambda cube: cube.name,
        cubes=[
            SimpleNamespace(name=name, link="hub0", index=k, uid=0, calibration=base)
            for k, name in enumerate(names)
        ],
    )
    store = make_typestore()
    with BagWriter(folder) as writer:
        for topic, kind in (("info", INFO_TYPE), ("frequencies", FREQUENCIES_TYPE)):
            writer.add_topic(f"/{topic}", kind, [describe_quality(latched=topic == "info")])
        info = info_of(skin, Pipeline([base] * N_CUBES), START_NS)
        writer.write("/info", START_NS, bytes(store.serialize_cdr(info, INFO_TYPE)))
        times = np.arange(0.0, seconds, 0.5)
        cubes = simulated(knots, faces, None)
        for rows in play(cubes, times, np.zeros(6)):
            if not measured:
                rows = replace(rows, temperature=np.full(N_CUBES, np.nan, np.float32))
            stamp_ns = int(rows.stamp_ns[0])
            writer.write("/frequencies", stamp_ns, encoded(rows, b"base\0"))
    return folder


WARM = ((30.0, 25.0), (60.0, 40.0))


def fit(folder, faces, base=CUBE, knots=WARM):
    """Calibrations that the command fits to one bag of 10 minutes."""
    bag = make_bag(folder / "bag", knots, faces, base=base)
    assert cli.main(["fit", "--rest", str(bag), "-o", str(folder / "warm.yaml")]) == 0
    assert (folder / "warm_c0.png").stat().st_size > 20_000
    return [read_calibration(folder / f"warm_c{k}.yaml") for k in range(N_CUBES)]


@pytest.fixture(scope="module", params=["both", "ground"])
def fitted(request, tmp_path_factory):
    return request.param, fit(tmp_path_factory.mktemp(request.param), request.param)


def errors_under_load(calibrations, faces, ramp, load=LOAD, ends=(25.0, 40.0)):
    """Times, errors of stresses and gradients times d0 under a load, and the status of the rows."""
    warm = ((30.0, ends[0]), (30.0 + ramp, ends[1]))
    reconstruct = Reconstructor(calibrations, np.float64)
    times = np.arange(0.0, ramp + 600.0, 2.0)
    errors, bits = [], []
    for rows in play(simulated(warm, faces, 0.0), times, load):
        found = reconstruct.process(rows)
        errors.append(np.hstack([found.stress - load, found.gradient * CUBE.half_side]))
        bits.append(found.status)
    return times, np.abs(errors), np.array(bits)


# Measured: zz 13, 13, 12 Pa of "both" and 9, 9, 8 Pa of "ground"; xx and yy 12 Pa, gradients 10 Pa.
@pytest.mark.parametrize(("ramp", "zz"), [(60.0, 16.0), (300.0, 15.0), (900.0, 15.0)])
def test_15_kelvin_under_a_lasting_load_leave_little(fitted, ramp, zz):
    faces, calibrations = fitted
    times, errors, bits = errors_under_load(calibrations, faces, ramp)
    worst = errors.max(axis=(0, 1))
    assert worst[2] < zz and worst[:6].max() < 16 and worst[6:].max() < 14
    plain = [replace(one, thermal=None) for one in calibrations]
    assert errors_under_load(plain, faces, ramp)[1].max(axis=(0, 1))[:3].min() > 900
    # The fastest ramp is stated as uncertain while it lasts; long after it, nothing is.
    if ramp == 60.0:
        assert (bits[(times > 40) & (times < 90)] & COMPENSATION).all()
    if faces == "both":
        assert (bits[-10:] & (COMPENSATION | THERMAL) == THERMAL).all()


@pytest.mark.parametrize(("faces", "zz"), [("both", 4.0), ("ground", 11.0)])
def test_oscillators_that_are_known_do_not_multiply_a_load(tmp_path, faces, zz):
    """Measured: 2.5 and 9.0 Pa, where 12 Pa would be 100 ppm/K times 15 K times the load."""
    calibrations = fit(tmp_path, faces, replace(CUBE, temperature=OSCILLATORS))
    _, errors, _ = errors_under_load(calibrations, faces, 900.0)
    assert errors.max(axis=(0, 1))[2] < zz


def test_a_recording_may_begin_in_a_warm_skin(tmp_path):
    """Then the new rest frequencies contain the thermal stress of 15 K.

    Measured: 2.2 Pa within the recorded temperatures, and 7.2 Pa at 15 °C.
    """
    calibrations = fit(tmp_path, "both", knots=((30.0, 40.0), (90.0, 30.0)))
    for ends, limit in (((39.0, 31.0), 3.0), ((25.0, 15.0), 9.0)):
        _, errors, _ = errors_under_load(calibrations, "both", 480.0, np.zeros(6), ends)
        assert errors.max() < limit, (ends, errors.max(axis=(0, 1)))


@pytest.mark.parametrize("ramp", [60.0, 900.0])
def test_the_deviation_states_the_error_of_ramps(fitted, ramp):
    """After 20 minutes at rest, so that the unknown start is forgotten."""
    faces, calibrations = fitted
    warm = ((1200.0, 25.0), (1200.0 + ramp, 40.0))
    reconstruct = Reconstructor(calibrations, np.float64)
    times = np.arange(0.0, 1800.0 + ramp, 2.0)
    errors, stated = [], []
    for rows in play(simulated(warm, faces, 0.0), times, np.zeros(6)):
        stress = reconstruct.process(rows).stress
        if rows.stamp_ns[0] - START_NS > 1200e9:
            errors.append(stress[:, :3])
            grown = [
                reconstruct.compute_covariance(k) - reconstruct.pipeline.compute_covariance(k)
                for k in (0, 1)
            ]
            stated.append([np.diag(one)[:3] for one in grown])
    ratio = np.sqrt((np.array(errors) ** 2).mean(axis=(0, 1)) / np.mean(stated, axis=(0, 1)))
    # Measured: 0.57 to 0.79 of "both"; of "ground" 0.08 (60 s, errors of at most 2 Pa) and 0.43 to
    # 0.48 (900 s, 8 Pa), where the unknown start is stated.
    assert (ratio > (0.5 if faces == "both" else 0.06)).all() and (ratio < 0.9).all()


@pytest.mark.parametrize("tared", [False, True])
def test_a_fast_ramp_is_no_contact_and_hides_none(fitted, tared):
    """Nine cubes in a layer, with the rows of the two in turn; 1 N presses from 200 s on.

    A tare before the ramp, from 20 s on, measures the rest frequencies without the error of the
    fit, which else cancels a part of what the ramp leaves.
    """
    faces, calibrations = fitted
    which = np.arange(9) % N_CUBES
    x, y = 0.024 * (np.indices((3, 3)).reshape(2, 9) - 1)
    poses = CubePoses(np.stack([x, y, 0 * x], 1), np.tile(np.eye(3), (9, 1, 1)), np.full(9, 2e-3))
    nine, elastomer = [calibrations[k] for k in which], Elastomer(depth=5.5e-3, thickness=11e-3)
    finders = (make_contact_finder(ContactSettings(), poses, nine, elastomer) for _ in range(3))
    finder, blind, informed = finders
    centre, flat = np.array([4e-3, 2e-3]), np.zeros(9, np.intp)
    offset = poses.position[:, :2] - centre
    by_force = finder._inverse.contact_response.compute_response(offset, flat, flat, 2e-3)[:, :, 2]
    pressed = -by_force / np.where(np.arange(15) < 6, 1.0, 2e-3)  # 1 N, Pa and Pa/m
    reconstruct, times = Reconstructor(calibrations), np.arange(0.0, 260.0, 2.0)
    if tared:
        times = np.union1d(times, np.linspace(20, 30, 1001)[:-1])
    cubes = simulated(((30.0, 25.0), (90.0, 40.0)), faces, None)
    for time, rows in zip(times.tolist(), play(cubes, times, np.zeros(6)), strict=True):
        found = reconstruct.process(rows)
        if tared and time == 28.0:
            reconstruct.tare()
        if time % 2:
            continue
        values = np.hstack([found.stress, found.gradient])[which].astype(float)
        left_out, status = found.left_out[which], found.status[which]
        errors = reconstruct.errors(np.arange(N_CUBES), found.left_out)[which]
        if time < 200.0:
            blind.update(time, values, left_out, 0 * status)
            finder.update(time, values, left_out, status)
            informed.update(time, values, left_out, status, errors=errors)
            assert not blind.contacts and not finder.contacts and not informed.contacts
        else:
            finder.update(time, values + pressed, left_out, status)
            informed.update(time, values + pressed, left_out, status, errors=errors)
            assert len(finder.contacts) == len(informed.contacts) == 1
    # Measured: 0.994 to 1.019 N, and at most 0.07 mm off.
    (contact,) = finder.contacts
    assert contact.normal_force == pytest.approx(1.0, rel=0.03)
    assert np.linalg.norm(contact.position[:2] - centre) < 1.5e-4
    # With the errors of the compensation. Measured: at most 1.6 and 2.0 standard deviations, which
    # are up to 0.008 N and 0.016 mm.
    (contact,) = informed.contacts
    off = np.linalg.norm(contact.position[:2] - centre)
    assert abs(contact.normal_force - 1.0) < 3 * contact.force_uncertainty < 0.03
    assert off < 4 * contact.position_uncertainty < 1e-4


@pytest.mark.parametrize("start", [0.0, 1.0])
def test_a_known_lag_and_slope_are_recovered(start):
    """One filter, exactly: u = r (t - lag (1 - exp(-t / lag))) while it warms by r per second.

    The elastomer may be warmer than the thermometer at the start, in K.
    """
    rate, lag, ramp = 0.25, 140.0, 60.0
    t = np.arange(600.0) + 0.5
    since = np.maximum(t - 30.0, 0)

    def rising(s):
        return rate * (s + lag * np.expm1(-s / lag))

    u = rising(since) - rising(np.maximum(since - ramp, 0)) + start * np.exp(-t / lag)
    temperature = 20 + rate * np.minimum(since, ramp)
    slope = np.linspace(-200.0, 180.0, 24)
    noise = 0.3
    stress = 5.0 + u[:, None] * slope + noise * np.random.default_rng(2).normal(size=(600, 24))
    fit = fit_thermal(Warming("bag: cube c0", t, (0,), temperature, stress, noise))
    # None of the filters has this lag, but their mixture does what it does. Measured: 1.9 Pa.
    np.testing.assert_allclose(fit.model.coefficient[:, 0], slope, rtol=0.005, atol=0.3)
    assert np.abs(fit.residual[60:]).max() < 2.5
    # The 30 s before the ramp tell the offset from the unknown start, which all pads share.
    np.testing.assert_allclose(fit.offset, 5.0, atol=1.0)


@pytest.mark.parametrize("curvature", [0.0, 0.005])
def test_three_temperatures_show_whether_the_effect_is_linear(curvature):
    t = np.arange(1800.0) + 0.5
    corners = [0, 30, 60, 600, 630, 1200, 1230], [20, 20, 35, 35, 27, 27, 40]
    temperature = np.interp(t, *corners)
    u = temperature - 20 - find_lags(t, temperature[:, None], np.array([140.0]))[:, 0, 0]
    slope = np.linspace(-200.0, 180.0, 24)
    stress = np.outer(u + curvature * u**2, slope)
    stress += 0.3 * np.random.default_rng(2).normal(size=stress.shape)
    found = fit_thermal(Warming("bag: cube c0", t, (0,), temperature, stress, 0.3))
    expected = np.outer(slope, [1.0, curvature][: 2 if curvature else 1])
    np.testing.assert_allclose(found.model.coefficient, expected, rtol=0.03, atol=0.5)


def test_a_ramp_that_does_not_tell_lag_from_slope_is_refused():
    """Early on, u = r t² / (2 lag): only slope over lag shows."""
    t = np.arange(200.0) + 0.5
    u = 0.05 * (t + 900.0 * np.expm1(-t / 900.0))
    noise = np.random.default_rng(3).normal(size=(200, 8))
    data = Warming("bag: cube c0", t, (0,), 20 + 0.05 * t, 150 * u[:, None] + noise, 1.0)
    with pytest.raises(FitError, match="until the skin is warm throughout"):
        fit_thermal(data)


def test_a_touch_is_noticed():
    t = np.arange(600.0) + 0.5
    temperature = np.interp(t, [30, 90], [20, 35])
    touched = np.outer((t > 300) & (t < 400), np.full(8, -1500.0))
    data = Warming(
        "bag: cube c0", t, (0,), temperature, 150 * (temperature - 20)[:, None] + touched, 1.0
    )
    with pytest.raises(FitError, match="let nothing touch the skin"):
        fit_thermal(data)


@pytest.mark.parametrize(
    ("changes", "name", "text"),
    [
        ({"measured": False}, None, "its rows state no temperature"),
        ({"knots": ((0.0, 25.0), (600.0, 26.0))}, None, "record while the skin warms or cools"),
        ({"seconds": 100.0}, None, "120 s and 3 K are needed"),
        ({"seconds": 300.0, "faces": "ground"}, None, "9 % of the largest lag are left at the end"),
        ({"knots": ((0.0, 25.0), (30.0, 40.0))}, None, "begin with half a minute at rest"),
        ({"seconds": 10.0}, "c9", "no cube 'c9'; there are c0, c1"),
    ],
)
def test_a_bag_that_does_not_suit_is_refused_in_one_line(tmp_path, capsys, changes, name, text):
    make_bag(tmp_path / "bag", **{"knots": WARM, **changes})
    options = ["fit", "--rest", str(tmp_path / "bag"), "-o", str(tmp_path / "mine.yaml")]
    assert cli.main(options + (["--cube", name] if name else [])) == 1
    message = capsys.readouterr().err
    assert message.count("\n") == 1 and text in message, message
