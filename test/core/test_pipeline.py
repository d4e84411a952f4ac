# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Rows in, rows out: exact where it can be, marked where it cannot, fast."""

import dataclasses
import sys
from collections.abc import Callable

import numpy as np
import pytest

from conftest import samples
from cube_tensor_driver.core.calibration import make_illustrative_calibration
from cube_tensor_driver.core.errors import CalibrationError, CubeError, LayoutError
from cube_tensor_driver.core.estimator import make_estimator
from cube_tensor_driver.core.oscillator import (
    TemperatureModel,
    compute_pad_frequency,
    compute_pad_stress,
)
from cube_tensor_driver.core.pipeline import Pipeline
from cube_tensor_driver.core.rows import StressRows
from cube_tensor_driver.core.status import INVALID, PAD_FAULT, RESIDUAL, TEMPERATURE

DTYPES = [(np.float64, 1e-9), (np.float32, 3e-5)]
QUAD_NEGLECT = ("xx", "xx_z", "xx_x")


def individual(layout: str, seed: int, **changes):
    """An illustrative calibration whose pads all differ."""
    rng, c = (
        np.random.default_rng(seed),
        make_illustrative_calibration(layout, QUAD_NEGLECT if layout == "quad" else ()),
    )
    n = c.layout.n_pads
    return dataclasses.replace(
        c,
        gain=1 + 0.05 * rng.normal(size=n),
        beta=0.3 + 0.05 * rng.normal(size=n),
        noise=3 * rng.uniform(1, 2, size=n),
        rest_frequency=1e5 + 100 * rng.normal(size=n),
        modulus=3e5 * (1 + 0.1 * rng.normal(size=n)),
        **changes,
    )


def frequencies(calibration, states):
    return compute_pad_frequency(
        states @ calibration.response.T,
        calibration.rest_frequency,
        calibration.beta,
        calibration.modulus,
    )


def truth(calibration, states):
    return states @ calibration.modes.components.T / np.repeat([1, calibration.half_side], [6, 9])


def states_of(calibration, count, seed=0):
    states = 1e3 * np.random.default_rng(seed).normal(size=(count, calibration.modes.n_modes))
    states[:, calibration.modes.find_indices(calibration.neglect)] = 0
    return states


def joined(rows):
    return np.concatenate([rows.stress, rows.gradient], axis=1)


def check_rows(rows, expected, tolerance):
    got, seen = joined(rows), (rows.observed[:, None] >> np.arange(15)) & 1 > 0
    np.testing.assert_array_equal(np.isnan(got), ~seen)
    scale = np.abs(expected).max(axis=0)
    np.testing.assert_allclose(
        np.where(seen, got, 0) / scale.clip(1),
        np.where(seen, expected, 0) / scale.clip(1),
        rtol=0,
        atol=tolerance,
    )


@pytest.mark.parametrize("dtype, tolerance", DTYPES)
@pytest.mark.parametrize("layout", ["quad", "planar", "cube"])
@pytest.mark.parametrize("make", [make_illustrative_calibration, individual])
def test_recovers_the_applied_fields(layout, make, dtype, tolerance):
    c = (
        make(layout, 3)
        if make is individual
        else make_illustrative_calibration(layout, QUAD_NEGLECT if layout == "quad" else ())
    )
    states = states_of(c, 50)
    rows = Pipeline([c] * 50, dtype).process(
        samples(np.arange(50), frequencies(c, states), np.zeros(50, np.uint32))
    )
    check_rows(rows, truth(c, states), tolerance)
    assert rows.status.tolist() == [0] * 50
    assert rows.stress.dtype == rows.gradient.dtype == rows.residual.dtype == dtype
    assert rows.status.dtype == rows.observed.dtype == np.uint16
    if layout == "quad":
        assert np.isnan(rows.residual).all()
    else:
        assert np.all(rows.residual < 0.1)


@pytest.mark.parametrize("dtype, tolerance", DTYPES)
def test_cubes_of_all_kinds_in_one_batch(dtype, tolerance):
    kinds = [
        individual(name, seed)
        for seed, name in enumerate(["planar", "cube", "quad", "planar", "quad"])
    ]
    pipeline = Pipeline(kinds, dtype)
    cube = np.array([4, 0, 1, 3, 2, 0, 1, 4, 4])
    frequency, expected = np.full((9, 24), np.nan), np.zeros((9, 15))
    for i, k in enumerate(cube):
        states = states_of(kinds[k], 1, seed=i)
        frequency[i, : kinds[k].layout.n_pads] = frequencies(kinds[k], states)
        expected[i] = truth(kinds[k], states)
    for _ in range(2):  # the second time from what is kept
        rows = pipeline.process(samples(cube, frequency))
        check_rows(rows, expected, tolerance)
        assert not rows.status.any()
    assert np.isnan(rows.residual[cube == 4]).all() and np.all(
        rows.residual[cube != 4][[0, 1, 2, 4, 5]] < 0.1
    )
    pads = pipeline.compute_pad_stress(samples(cube, frequency))
    assert np.isnan(pads[0, 4:]).all() and np.isfinite(pads[2]).all()
    k = kinds[0]
    np.testing.assert_allclose(
        pads[1, :8],
        compute_pad_stress(frequency[1, :8], k.rest_frequency, k.beta, k.modulus),
        atol=0.2 if dtype == np.float32 else 1e-8,
    )


@pytest.mark.parametrize("dtype, tolerance", DTYPES)
def test_pads_without_parasitic_capacitance(dtype, tolerance):
    c = dataclasses.replace(make_illustrative_calibration("planar"), beta=np.array(0.0))
    states = states_of(c, 20)
    frequency = frequencies(c, states)
    frequency[19, 0] = np.inf
    rows = Pipeline([c] * 20, dtype).process(samples(np.arange(20), frequency))
    check_rows(rows, truth(c, states), tolerance)
    assert rows.status.tolist() == [0] * 19 + [PAD_FAULT]


@pytest.mark.parametrize("dtype, tolerance", DTYPES)
def test_bad_pads_are_left_out(dtype, tolerance):
    c = individual("cube", 1)
    states = states_of(c, 8)
    frequency = frequencies(c, states)
    frequency[0, 3], frequency[1, 4], frequency[2, 5], frequency[3, 6], frequency[4, 7] = (
        np.nan,
        np.inf,
        0,
        -5,
        1e9,
    )
    fault = np.zeros(8, np.uint32)
    fault[5], fault[6] = 0b11, 0xFFFFFFFF
    rows = Pipeline([c] * 8, dtype).process(samples(np.arange(8), frequency, fault))
    check_rows(rows, truth(c, states), tolerance * 10)
    assert rows.status.tolist() == [PAD_FAULT] * 6 + [PAD_FAULT | INVALID, 0]
    assert rows.observed.tolist() == [0x7FFF] * 6 + [0, 0x7FFF]
    assert np.isnan(rows.residual[6])


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 0.0, -1e5, 1e5 * 1.3 / 0.3, 5e5])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_one_bad_frequency_alone_is_found(value, dtype):
    c = make_illustrative_calibration("cube")
    frequency = np.full((3, 24), 1e5)
    frequency[1, 2] = value
    rows = Pipeline([c] * 3, dtype).process(samples(np.arange(3), frequency))
    assert rows.status.tolist() == [0, PAD_FAULT, 0]
    np.testing.assert_allclose(joined(rows), 0, atol=1e-6)


def test_what_the_remaining_pads_cannot_see_is_not_invented():
    c = make_illustrative_calibration("planar")
    frequency = frequencies(c, states_of(c, 1))
    for bits in range(256):
        rows = Pipeline([c]).process(samples(np.array([0]), frequency, np.array([bits])))
        missing = [p for p in range(8) if bits >> p & 1]
        alone = make_estimator(c.response, c.noise, c.modes, missing)
        assert rows.observed[0] == sum(1 << i for i in range(15) if alone.observed[i])
        assert np.isnan(rows.residual[0]) == (alone.dof == 0)
        assert (rows.observed[0] == 0) == bool(rows.status[0] & INVALID)


def test_strange_rows_end_in_their_status_never_in_an_error():
    c = make_illustrative_calibration("planar")
    pipeline = Pipeline([c] * 3)
    good = frequencies(c, states_of(c, 1))[0]
    rows = pipeline.process(samples(np.array([0, -1, 3, 2]), np.tile(good, (4, 1))))
    assert rows.status.tolist() == [0, INVALID, INVALID, 0] and np.isnan(joined(rows)[1:3]).all()
    rng = np.random.default_rng(0)
    wild = rng.choice([0, -1, np.nan, np.inf, -np.inf, 1e300, 1e-300, 1e5, 4.4e5], size=(500, 8))
    with np.errstate(all="raise"):
        for dtype in (np.float32, np.float64):
            rows = Pipeline([c] * 3, dtype).process(
                samples(rng.integers(-5, 9, 500), wild, rng.integers(0, 2**32, 500))
            )
            assert not np.isinf(joined(rows)).any()
    empty = pipeline.process(samples(np.empty(0, int), np.empty((0, 8)), np.empty(0, np.uint32)))
    assert (
        empty.stress.shape == (0, 6)
        and empty.gradient.shape == (0, 9)
        and empty.status.shape == (0,)
    )


def test_wrong_shapes_and_settings_are_errors():
    c = make_illustrative_calibration("planar")
    pipeline = Pipeline([c] * 2)
    with pytest.raises(LayoutError, match=r"\(2, 4\).*\(N, 8\)"):
        pipeline.process(samples(np.arange(2), np.ones((2, 4))))
    with pytest.raises(CalibrationError, match="no calibrations"):
        Pipeline([])
    with pytest.raises(CubeError, match="float16"):
        Pipeline([c], np.float16)
    with pytest.raises(LayoutError, match=r"\(8,\).*\(2, 8\)"):
        pipeline.rest_frequency = np.full(8, 1e5)
    with pytest.raises(CubeError, match="above 0"):
        pipeline.rest_frequency = np.zeros((2, 8))


def test_the_residual_rings_for_what_no_field_explains():
    c = make_illustrative_calibration("planar")
    v = states_of(c, 2) @ c.response.T
    v[1, 0] += 30 * c.noise[0]
    frequency = compute_pad_frequency(v, 1e5, c.beta, c.modulus)
    rows = Pipeline([c]).process(samples(np.zeros(2, int), frequency))
    assert rows.status.tolist() == [0, RESIDUAL]
    assert rows.residual[1] == pytest.approx(30 / np.sqrt(8))  # all eight pads check it alike
    cube = make_illustrative_calibration("cube")
    v = states_of(cube, 2) @ cube.response.T
    v[1, 5] += 50 * cube.noise[5]
    pipeline = Pipeline([cube])
    marked = pipeline.find_suspects(
        samples(np.zeros(2, int), compute_pad_frequency(v, 1e5, cube.beta, cube.modulus))
    )
    assert not marked[0].any() and {cube.layout.pads[i] for i in np.flatnonzero(marked[1])} == {
        "+x+z",
        "-x-z",
    }


def test_false_alarms_are_as_stated():
    c = make_illustrative_calibration("planar")
    rng = np.random.default_rng(2)
    frequency = 1e5 * (1 + 8e-6 * rng.normal(size=(200_000, 8)))
    rows = Pipeline([c], np.float64).process(samples(np.zeros(200_000, int), frequency))
    assert np.mean(rows.status == RESIDUAL) == pytest.approx(1e-3, abs=4 * np.sqrt(1e-3 / 2e5))
    assert np.sqrt(np.mean(rows.residual**2)) == pytest.approx(1, rel=0.01)
    stated = np.sqrt(np.diag(Pipeline([c]).compute_covariance(0)))
    scatter = joined(rows).std(axis=0)
    seen = np.isfinite(stated)
    np.testing.assert_allclose(scatter[seen], stated[seen], rtol=0.03)


def test_tare_moves_the_rest_frequency():
    c = make_illustrative_calibration("planar")
    pipeline = Pipeline([c] * 2)
    drifted = np.array([[1e5] * 8, np.linspace(1.01e5, 1.02e5, 8)])
    assert np.abs(pipeline.process(samples(np.arange(2), drifted)).stress[1, 2]) > 1e3
    pipeline.rest_frequency = drifted
    np.testing.assert_array_equal(pipeline.rest_frequency, drifted)
    np.testing.assert_allclose(
        pipeline.process(samples(np.arange(2), drifted)).stress[:, 2], 0, atol=1e-9
    )


def test_the_temperature_model_is_taken_out():
    model = TemperatureModel(25, np.outer(np.linspace(-1, 1, 8), [1e-3, 1e-5]))
    c, plain = (
        dataclasses.replace(make_illustrative_calibration("planar"), temperature=model),
        make_illustrative_calibration("planar"),
    )
    states = states_of(c, 4)
    warm = np.array([40.0, np.nan, 25.0, 10.0])
    frequency = frequencies(c, states)
    frequency[[0, 3]] *= model.compute_factor(warm[[0, 3]])
    pipeline = Pipeline([c, plain])
    rows = pipeline.process(samples(np.array([0, 0, 0, 0]), frequency, None, warm))
    check_rows(rows, truth(c, states), 1e-9)
    assert rows.status.tolist() == [0, TEMPERATURE, 0, 0]
    mixed = pipeline.process(samples(np.array([1, 0]), frequencies(c, states[:2])))
    assert mixed.status.tolist() == [0, TEMPERATURE]
    factor = pipeline.compute_unloaded_factor(np.array([0, 1]), np.array([40.0, 40.0]))
    np.testing.assert_allclose(factor, [model.compute_factor([40.0])[0], np.ones(8)])


def test_covariance_of_a_cube_with_a_bad_pad():
    c = individual("planar", 5)
    pipeline = Pipeline([make_illustrative_calibration("quad"), c])
    whole, less = (
        np.diag(pipeline.compute_covariance(1)),
        np.diag(pipeline.compute_covariance(1, 1)),
    )
    seen = np.isfinite(whole)
    assert np.all(less[seen] >= whole[seen] * (1 - 1e-9)) and np.isnan(
        np.diag(pipeline.compute_covariance(0))[0]
    )
    alone = make_estimator(c.response, c.noise, c.modes).covariance
    np.testing.assert_allclose(whole[6:], np.diag(alone)[6:] / c.half_side**2)


def mixed_skin(kinds: int, count: int = 60):
    """Cubes of three layouts with so many calibrations, and frequencies of seven scans."""
    made = [individual(("planar", "cube", "quad")[seed % 3], seed) for seed in range(kinds)]
    pipeline = Pipeline([made[k % kinds] for k in range(count)], np.float32)
    random = np.random.default_rng(5)
    frequency = pipeline.rest_frequency * (1 - 0.01 * random.random((7, count, pipeline.n_pads)))
    return pipeline, np.arange(count, dtype=np.uint16), frequency.astype(np.float32)


@pytest.mark.parametrize("kinds", [3, 12])
@pytest.mark.parametrize("bad", [False, True])
def test_scans_at_once_are_the_scans_one_by_one_to_the_bit(kinds, bad):
    """With few and many calibrations, with and without bad pads."""
    pipeline, cube, frequency = mixed_skin(kinds)
    pad_fault = np.zeros(frequency.shape[:2], np.uint32)
    if bad:
        frequency[:, 7, 1], frequency[2, 30, 0], pad_fault[4:, 11] = np.nan, 1e9, 2
    singly = [
        pipeline.process(samples(cube, f, fault))
        for f, fault in zip(frequency, pad_fault, strict=True)
    ]
    at_once = pipeline.process(
        samples(np.tile(cube, 7), frequency.reshape(-1, pipeline.n_pads), pad_fault.ravel())
    )
    for field in dataclasses.fields(StressRows):
        expected = np.concatenate([getattr(rows, field.name) for rows in singly])
        np.testing.assert_array_equal(getattr(at_once, field.name), expected, err_msg=field.name)
    assert bool(np.any(at_once.status & PAD_FAULT)) == bad


def test_one_cube_alone_is_the_same_cube_among_many_scans():
    """numpy multiplies a single row by another routine."""
    for layout in ("quad", "planar", "cube"):
        pipeline = Pipeline([individual(layout, 1)], np.float32)
        load = 0.01 * np.random.default_rng(1).random((50, pipeline.n_pads))
        f = (pipeline.rest_frequency * (1 - load)).astype(np.float32)
        at_once = pipeline.process(samples(np.zeros(50, np.uint16), f))
        one = np.zeros(1, np.uint16)
        singly = [pipeline.process(samples(one, row[None])).stress[0] for row in f]
        np.testing.assert_array_equal(at_once.stress, singly)


def python_calls(function: Callable[[], object]) -> int:
    """How many calls of Python and C functions it makes: its work but for the length of arrays."""
    count = 0

    def counting(frame: object, event: str, argument: object) -> None:
        nonlocal count
        count += event in ("call", "c_call")

    sys.setprofile(counting)
    try:
        function()
    finally:
        sys.setprofile(None)
    return count


def test_absent_pads_are_no_bad_pads():
    """Planar cubes among cubes of 24 pads take one product more, not an estimator of their own."""

    def calls(layouts: list[str]) -> int:
        pipeline = Pipeline(
            [make_illustrative_calibration(layouts[k * len(layouts) // 1024]) for k in range(1024)],
            np.float32,
        )
        cube = np.arange(1024, dtype=np.uint16)
        f = (0.99 * pipeline.rest_frequency).astype(np.float32)
        assert not np.any(pipeline.process(samples(cube, f)).status & PAD_FAULT)
        return python_calls(lambda: pipeline.process(samples(cube, f)))

    assert calls(["planar", "cube"]) < 1.5 * calls(["cube"])


def test_no_loop_over_rows():
    """Ten times the rows, all kinds of them, make no more calls; ./cube bench pipeline times it.

    A few calls more or less come from what others in this process keep; a loop makes a thousand.
    """
    kinds = [individual("planar", seed) for seed in range(4)]
    pipeline = Pipeline(kinds)

    def calls(count: int) -> int:
        cube = np.arange(count) % 4
        f = np.full((count, 8), 1e5)
        f[::3, 0] = np.nan
        pipeline.process(samples(cube, f))
        return python_calls(lambda: pipeline.process(samples(cube, f)))

    assert calls(1200) < 1.1 * calls(120)
