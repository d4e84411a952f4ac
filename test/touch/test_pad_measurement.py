# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Cubes as pads in a thin layer: the tables against sums over the influence functions."""

from __future__ import annotations

import contextlib
import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cube_tensor_design.studies.pads_study import LayerBench
from cube_tensor_design.studies.traction_study import CUBES, Setting
from cube_tensor_driver.config.calibration import find_shipped_calibration
from cube_tensor_driver.config.influence import find_influence
from cube_tensor_driver.core.errors import ConfigError, ElasticError
from cube_tensor_driver.core.layout import LAYOUTS
from cube_tensor_driver.core.modes import COMPONENTS, STRESS
from cube_tensor_driver.core.pipeline import Pipeline
from cube_tensor_driver.mechanics import contact
from cube_tensor_driver.mechanics.contact_response import ContactResponse
from cube_tensor_driver.mechanics.influence import read_influence, write_influence
from cube_tensor_driver.mechanics.measurement_model import CubeMeasurement
from cube_tensor_driver.mechanics.traction_prior import PRIOR_LENGTHS, SHEAR_RATIO, TractionPrior
from cube_tensor_driver.touch.contact_finder import ContactSettings, make_contact_finder
from cube_tensor_driver.touch.pad_measurement import model_pads
from cube_tensor_driver.touch.pad_noise import compute_noise_by_pad
from cube_tensor_driver.touch.tracker.contact_tracker import ContactTracker

PLANAR, CUBE = (find_shipped_calibration(LAYOUTS[name]) for name in ("planar", "cube"))
SCALE = 2e-3
UNITS = np.where(np.arange(len(COMPONENTS)) < len(STRESS), 1.0, SCALE)
LEFT_OUT = 0.015
"""Largest error of a response, divided by its largest value.

The influence functions leave out components with small singular values (below a thousandth of the
largest), and these errors add up. They are largest for narrow contacts.
"""


@pytest.fixture(scope="module")
def influence():
    return read_influence(find_influence("cube_11mm"))


@pytest.fixture(scope="module")
def cubes(influence):
    """Of two cubes, the second one planar."""
    reading = model_pads(influence, [CUBE, PLANAR])
    assert reading.variant.tolist() == [0, 1]
    return CubeMeasurement(influence.layer, influence.depth, SCALE, reading)


def said(influence, number: int, place: np.ndarray, angle: float) -> np.ndarray:
    """(n, 15, 3) what a cube that is turned says of forces at places (n, 2) from it, by its pads'
    influence functions."""
    calibration = (CUBE, PLANAR)[number]
    pads = [LAYOUTS["cube"].pads.index(pad) for pad in calibration.layout.pads]
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    seen = influence.interpolate(place @ turn[:2, :2].T)[pads]
    matrix = np.nan_to_num(Pipeline([calibration]).find_matrix(0)) * UNITS[:, None]
    return np.einsum("cp,pni,ij->ncj", matrix, seen, turn)


@pytest.mark.parametrize("size", [1e-3, 5e-3])
def test_a_contact_is_the_sum_of_its_forces(influence, cubes, size):
    """Cubes of both kinds at any place, turned by any angle, under Hertz's point forces."""
    random = np.random.default_rng(3)
    place, angle = random.uniform(-0.012, 0.012, (12, 2)), random.uniform(-3, 3, 12)
    which = np.arange(12) % 2
    found = ContactResponse(cubes).compute_response(place, angle, which, size)
    sources, forces = contact.hertz(size, [0, 0, 1.0], order=8)
    expected = np.stack(
        [
            np.tensordot(forces[:, 2], said(influence, number, sources[:, :2] - at, turn), axes=1)
            for at, turn, number in zip(place, angle, which, strict=True)
        ]
    )
    largest = np.abs(expected).max(axis=(0, 2), keepdims=True)
    assert (np.abs(found - expected) <= LEFT_OUT * largest).all()


def test_covariances_of_the_prior_are_sums_over_the_surface(influence, cubes):
    """sum g S g' and S g on a square grid of forces, without waves and circular components."""
    place, angle = np.array([[2e-3, 1e-3], [-3e-3, 4e-3]]), np.array([0.4, -1.0])
    step = influence.depth / 4  # resolves the shorter length of the prior
    line = np.arange(-24, 25) * step
    points = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    square = ((points[:, None] - points) ** 2).sum(axis=2) / influence.depth**2
    prior = np.mean([np.exp(-square / (2 * length**2)) for length in PRIOR_LENGTHS], axis=0)
    seen = [said(influence, k, points - place[k], angle[k]) * step**2 for k in (0, 1)]
    cross = np.einsum("nm,mci->nci", prior, seen[0]) * [SHEAR_RATIO**2, SHEAR_RATIO**2, 1.0]
    expected = np.einsum("nci,ndi->cd", cross, seen[1])
    first, second = np.array([0]), np.array([1])
    covariances = TractionPrior(cubes)
    found = covariances.compute_covariance(
        place[:1] - place[1:], angle[:1], first, angle[1:], second
    )[0]
    own = [
        np.diag(covariances.compute_covariance(np.zeros((1, 2)), angle[:1], k, angle[:1], k)[0])
        for k in (first, second)
    ]
    observed = np.outer(*own) > 0
    # the grid ends where pads see a thousandth of what they see above
    assert (np.abs(found - expected) <= 4e-3 * np.sqrt(np.outer(*own)))[observed].all()
    assert not found[~observed].any()
    (here,) = np.flatnonzero((np.abs(points - [0.0, 2 * step]) < 1e-9).all(axis=1))
    found = covariances.compute_surface_covariance(place[:1] - points[here], angle[:1], first)[0]
    assert np.abs(found[:, :3] - cross[here]).max() < 2e-3 * np.abs(cross[here]).max()


def test_a_contact_on_a_thin_layer(influence):
    """Its force and place through the whole chain; cubes that count as points are 10 % off."""
    setting = Setting(cubes=CUBES[2], depth=influence.depth, thickness=11e-3, known_thickness=11e-3)
    load, centre = np.array([0.6, 0.3, -3.0]), np.array([1e-3, -2e-3])
    forces = []
    for known in (None, influence):
        bench = LayerBench(setting, influence, known, side=2)
        values = bench.compute_values(5e-3, load, centre, np.random.default_rng(1))
        (touch,) = ContactTracker(bench.inverse, 300.0).update(values)
        forces.append(touch.force)
    # 1 % of the gains is 0.1 to 0.3 % of the force (docs/contacts.md)
    assert np.linalg.norm(touch.position[:2] - centre) < 1e-4
    assert abs(touch.normal_force / 3 - 1) < 0.01
    assert np.abs(touch.force - load).max() < 0.03
    assert abs(forces[0][2] / 3 + 1) > 0.05


@pytest.mark.parametrize(("cubes", "calibration"), [(CUBES[0], CUBE), (CUBES[1], PLANAR)])
def test_pads_that_are_left_out_change_what_a_cube_says_and_the_contact_stays(
    influence, cubes, calibration
):
    """Beside the contact, one or two pads of each cube: a cube without a pad says something else in
    a thin layer, up to half of the force, and noise counts more."""
    setting = Setting(cubes=cubes, depth=influence.depth, thickness=11e-3, known_thickness=11e-3)
    load, centre = np.array([0.6, 0.3, -3.0]), np.array([1e-3, -2e-3])
    bench, random = LayerBench(setting, influence, side=1), np.random.default_rng(4)
    settings = ContactSettings(method="inverse", influence="cube_11mm")
    n = len(bench.poses.position)
    finder = make_contact_finder(settings, bench.poses, [calibration] * n)
    pads, left_out = bench.compute_pads_under(5e-3, load, centre), np.zeros(n, np.uint32)
    near = np.argsort(np.linalg.norm(bench.poses.position[:, :2] - centre, axis=1))[:4]
    for bits in (0, [1, 2, 4, 8], [3, 0, 8, 0], 0):
        left_out[near] = bits
        values = bench.measure(pads, random, left_out)
        finder.update(0.0, values, left_out, np.zeros(n, np.uint16))
        (touch,) = finder.contacts
        assert abs(touch.normal_force - 3) < min(0.05, 4 * touch.force_uncertainty)
        assert np.linalg.norm(touch.position[:2] - centre) < 1e-4


def test_in_the_field_a_cube_without_a_pad_counts_as_missing(influence):
    """Matrices are those of all pads. With all pads back it is as before."""
    setting = Setting(depth=influence.depth, thickness=11e-3, known_thickness=11e-3)
    bench, random = LayerBench(setting, influence, influence, side=1), np.random.default_rng(5)
    inverse, n = bench.inverse, len(bench.poses.position)
    pads = bench.compute_pads_under(5e-3, np.array([0.6, 0.3, -3.0]), np.array([1e-3, -2e-3]))
    values, pipeline = bench.measure(pads, random), Pipeline([CUBE] * n)
    cube, lost = np.array([n // 2]), values.copy()
    lost[cube] = np.nan
    before, expected = inverse.field(values), inverse.field(lost)
    inverse.leave_out(cube, compute_noise_by_pad(pipeline, cube, np.array([1], np.uint32)))
    np.testing.assert_array_equal(inverse.field(values).traction, expected.traction)
    inverse.leave_out(cube, compute_noise_by_pad(pipeline, cube, np.array([0], np.uint32)))
    np.testing.assert_array_equal(inverse.field(values).traction, before.traction)


def test_influence_functions_of_other_cubes_are_refused(influence):
    with pytest.raises(ElasticError, match=r"cube of 4 mm and calibration .* of 3 mm.*side: 0.003"):
        model_pads(influence, [replace(CUBE, half_side=1.5e-3)])
    layout = replace(LAYOUTS["planar"], pad_size=0.3)
    with pytest.raises(ElasticError, match=r"no pad like .* of layout 'planar'"):
        model_pads(influence, [replace(PLANAR, layout=layout)])


def test_a_file_gives_back_what_is_written(influence, tmp_path):
    path = tmp_path / "one.npz"
    write_influence(path, influence, "./cube fem")
    read = read_influence(path)
    assert read.layout.has_same_pads(influence.layout) and read.layer == influence.layer
    assert (read.side, read.depth, read.reach) == (4e-3, 5.5e-3, influence.reach)
    np.testing.assert_array_equal(read.place, influence.place)
    # half of a rounding step each time
    assert np.abs(read.pads - influence.pads).max() < 2e-5 * np.abs(influence.pads).max()


def damaged(path: Path, **changes) -> bytes:
    with np.load(path) as file:
        arrays = {
            name: value for name, value in (dict(file) | changes).items() if value is not None
        }
    data = io.BytesIO()
    np.savez(data, **arrays)
    return data.getvalue()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (None, "not a zip file"),
        ({"pads": None}, "no 'pads"),
        ({"schema": 7}, "schema is 7"),
        ({"pads": np.zeros((3, 4, 3), np.int16)}, r"shape \(3, 4, 3\)"),
        ({"place": np.zeros((7225, 2))}, "no grid"),
        ({"step": np.nan}, "not finite"),
        ({"depth": 0.02}, "between 0 and"),
        ({"side": 0.012}, "below the surface"),
        ({"layout": np.array([{}])}, "allow_pickle"),
        ({"more": np.zeros(70 << 20, np.int8)}, "the limit is"),
        ({"side": np.full(3, 4e-3)}, "size 1"),
        ({"step": 1j}, "complex"),
        ({"normals": np.array(["x"])}, "'safe'"),
    ],
)
def test_a_file_that_is_none(changes, words, tmp_path):
    path = tmp_path / "bad.npz"
    whole = find_influence("cube_11mm")
    path.write_bytes(b"PK but no more" if changes is None else damaged(whole, **changes))
    with pytest.raises(ConfigError, match=words) as error:
        read_influence(path)
    assert str(path) in str(error.value) and "--load surface" in str(error.value)


def test_each_damaged_byte_names_file_and_fix(influence, tmp_path):
    """zipfile raises many kinds of errors, as that for an unknown method of compression."""
    path = tmp_path / "bad.npz"
    line = round(len(influence.place) ** 0.5)
    few = np.arange(line**2).reshape(line, line)[::7, ::7].ravel()
    small = replace(influence, place=influence.place[few], pads=influence.pads[:, few])
    write_influence(path, small, "./cube fem")
    whole = path.read_bytes()
    directory = whole.rindex(b"PK\1\2")
    places = [*range(0, 60, 3), *range(60, len(whole), 200), *range(directory, directory + 30)]
    for at in places:
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 0x15]) + whole[at + 1 :])
        with contextlib.suppress(ConfigError):
            read_influence(path)
            continue
        with pytest.raises(ConfigError, match=r"bad\.npz.*--load surface"):
            read_influence(path)


def test_a_name_that_is_none():
    with pytest.raises(ConfigError, match=r"'nothing'.*shipped: cube_11mm"):
        find_influence("nothing")
