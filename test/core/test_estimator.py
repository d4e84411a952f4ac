# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Inversion: what was put in comes out, with the stated scatter, residual and suspects."""

import json

import numpy as np
import pytest
from scipy.stats import chi2 as chi2_truth

from cube_tensor_driver.core.calibration import make_illustrative_calibration
from cube_tensor_driver.core.errors import SymmetryError
from cube_tensor_driver.core.estimator import (
    FALSE_ALARM,
    compute_chi2_limit,
    compute_chi2_tail,
    make_estimator,
    summarize_response,
)
from cube_tensor_driver.core.layout import LAYOUTS
from cube_tensor_driver.core.modes import COMPONENTS, PLANE, SPACE
from cube_tensor_driver.core.response import compute_response
from cube_tensor_driver.core.symmetry import find_structure

PAIRS = [
    (layout, g)
    for layout in ("quad", "planar", "cube")
    for g in ("full", "slab", "mirrors", "none")
][1:]


def chi2_of(estimator, pad_stress):
    """Chi-square (N,) of pad stresses (N, P)."""
    return np.sum((pad_stress @ estimator.null.T) ** 2, axis=-1)


def random_case(layout: str, symmetry: str, seed: int = 0):
    structure = find_structure(LAYOUTS[layout], symmetry)
    rng = np.random.default_rng(seed)
    values = dict(zip(structure.names, rng.normal(size=structure.n_coefficients), strict=True))
    return structure.modes, compute_response(structure, values), rng


def components_seen(estimator) -> set[str]:
    return {c for c, seen in zip(COMPONENTS, estimator.observed, strict=True) if seen}


@pytest.mark.parametrize("layout, symmetry", PAIRS)
def test_recovers_what_was_put_in(layout, symmetry):
    modes, a, rng = random_case(layout, symmetry)
    estimator = make_estimator(a, rng.uniform(0.5, 2, len(a)), modes)
    states = rng.normal(size=(50, modes.n_modes))
    truth, got = states @ modes.components.T, states @ a.T @ estimator.matrix.T
    seen = estimator.observed
    assert np.all(np.isnan(got[:, ~seen])) and np.all(np.isfinite(got[:, seen]))
    np.testing.assert_allclose(
        got[:, seen], truth[:, seen], rtol=0, atol=1e-10 * np.abs(truth).max()
    )
    assert np.all(chi2_of(estimator, states @ a.T) < 1e-18)
    assert estimator.dof == len(a) - np.linalg.matrix_rank(a)
    # exactly the components that no hidden combination of modes can change are observed
    hidden = np.linalg.svd(a)[2][np.linalg.matrix_rank(a) :]
    nonzero = np.any(modes.components, axis=1)
    np.testing.assert_array_equal(
        seen, nonzero & (np.abs(modes.components @ hidden.T).max(axis=1, initial=0) < 1e-9)
    )


@pytest.mark.parametrize(
    "layout, symmetry", [p for p in PAIRS if p != ("quad", "none")]
)  # which sees nothing alone
def test_scatter_is_as_stated(layout, symmetry):
    modes, a, rng = random_case(layout, symmetry, 1)
    noise = rng.uniform(0.5, 2, len(a))
    estimator = make_estimator(a, noise, modes)
    seen = estimator.observed
    assert seen.any()
    state = rng.normal(size=modes.n_modes)
    v = a @ state + noise * rng.normal(size=(10_000, len(a)))
    got, stated = (v @ estimator.matrix.T)[:, seen], estimator.covariance[np.ix_(seen, seen)]
    sizes = np.sqrt(np.diag(stated))
    scatter = np.atleast_2d(np.cov(got.T))
    np.testing.assert_allclose(np.sqrt(np.diag(scatter)), sizes, rtol=0.03)
    np.testing.assert_allclose(
        scatter / np.outer(sizes, sizes), stated / np.outer(sizes, sizes), atol=0.05
    )
    np.testing.assert_allclose(
        got.mean(axis=0), (modes.components @ state)[seen], atol=5 * sizes.max() / 100
    )
    if estimator.dof:
        chi2 = chi2_of(estimator, v)
        assert chi2.mean() == pytest.approx(estimator.dof, rel=0.06)
        assert np.mean(chi2 > estimator.limit) == pytest.approx(
            FALSE_ALARM, abs=5 * np.sqrt(FALSE_ALARM / 1e4)
        )


def test_unequal_noise_weighs_the_pads():
    """Against the textbook formula (A' W^2 A)^-1 A' W^2."""
    modes, a, rng = random_case("planar", "full", 2)
    w2 = np.diag(rng.uniform(0.5, 2, 8) ** -2)
    estimator = make_estimator(a, np.diag(w2) ** -0.5, modes, targets=np.eye(7))
    inverse = np.linalg.inv(a.T @ w2 @ a)
    np.testing.assert_allclose(estimator.matrix, inverse @ a.T @ w2, atol=1e-11)
    np.testing.assert_allclose(estimator.covariance, inverse, atol=1e-11)


def test_what_the_layouts_see():
    quad, planar, cube = (make_illustrative_calibration(n) for n in ("quad", "planar", "cube"))
    see = {
        c.layout.name: components_seen(make_estimator(c.response, c.noise, c.modes))
        for c in (quad, planar, cube)
    }
    assert see["quad"] == {"zx", "zz_z"}  # zz_z only because the illustrative f is 0
    assert see["planar"] == set(PLANE.names)
    assert see["cube"] == set(COMPONENTS)
    alone = make_estimator(quad.response, quad.noise, quad.modes, neglect=("xx", "xx_z", "xx_x"))
    assert components_seen(alone) == {"zz", "zx", "zz_x", "zz_z"} and alone.dof == 0
    hidden = make_estimator(cube.response, cube.noise, SPACE, targets=np.eye(21)).observed
    assert {n for n, seen in zip(SPACE.names, hidden, strict=True) if not seen} == {
        "yz_x",
        "zx_y",
        "xy_z",
    }
    with pytest.raises(SymmetryError, match="'zy'"):
        make_estimator(quad.response, quad.noise, quad.modes, neglect=("zy",))


def test_the_summary_of_a_layout():
    c = make_illustrative_calibration("cube")
    s = summarize_response(c.structure, c.response)
    keys = (
        "pads modes n_coefficients rank_uniform condition_uniform rank_gradient condition_gradient"
    )
    assert list(s) == [*keys.split(), "unobservable", "noise"]
    assert (s["n_coefficients"], s["rank_uniform"], s["rank_gradient"]) == (12, 6, 12)
    assert s["unobservable"] == ["yz_x", "zx_y", "xy_z"] and s["noise"]["yz_x"] is None
    whole = make_estimator(c.response, np.ones(24), SPACE)
    assert s["noise"]["zz_z"] == pytest.approx(np.sqrt(whole.covariance[14, 14]))
    singular = np.linalg.svd(c.response[:, :6], compute_uv=False)
    assert s["condition_uniform"] == pytest.approx(singular[0] / singular[-1])
    quad = make_illustrative_calibration("quad", ("xx", "xx_z", "xx_x"))
    s = summarize_response(quad.structure, quad.response, quad.neglect)
    assert s["rank_uniform"] == s["rank_gradient"] == 2 and s["unobservable"] == [
        "xx",
        "xx_z",
        "xx_x",
    ]
    json.dumps(s, allow_nan=False)


def test_missing_pads_cost_what_they_must():
    c = make_illustrative_calibration("planar")
    one = make_estimator(c.response, c.noise, c.modes, missing=[2])
    assert components_seen(one) == set(PLANE.names) and one.dof == 0 and np.isnan(one.limit)
    assert np.all(one.matrix[one.observed, 2] == 0)
    whole = make_estimator(c.response, c.noise, c.modes)
    assert np.all(
        np.diag(one.covariance)[one.observed]
        >= np.diag(whole.covariance)[one.observed] * (1 - 1e-12)
    )
    none = make_estimator(c.response, c.noise, c.modes, missing=np.arange(8))
    assert not none.observed.any() and none.dof == 0 and none.rank == 0


def test_a_nearly_hidden_mode_is_not_invented():
    a = make_illustrative_calibration("planar").response.copy()
    a[:, PLANE.names.index("zx")] *= 1e-6
    estimator = make_estimator(a, np.ones(8), PLANE)
    assert components_seen(estimator) == set(PLANE.names) - {"zx"}


@pytest.mark.parametrize("dof", range(1, 25))
def test_chi_square_limits(dof):
    assert compute_chi2_limit(dof) == pytest.approx(chi2_truth.isf(FALSE_ALARM, dof), rel=1e-9)
    assert compute_chi2_tail(7.0, dof) == pytest.approx(chi2_truth.sf(7.0, dof), rel=1e-12)
    assert compute_chi2_tail(0.0, dof) == 1 and np.isnan(compute_chi2_limit(0))


def opposite(layout) -> np.ndarray:
    return np.array(
        [np.argmin(np.linalg.norm(layout.positions + x, axis=1)) for x in layout.positions]
    )


def suspects_after(sigmas: float, draws: int = 2000):
    """How often the residual rings, the suspects are exactly the broken pad and its opposite, miss
    the broken pad."""
    rng = np.random.default_rng(7)
    c = make_illustrative_calibration("cube")
    estimator = make_estimator(c.response, c.noise, c.modes)
    v = rng.normal(size=(draws, 21)) * 1e3 @ c.response.T + c.noise * rng.normal(size=(draws, 24))
    pad, row = rng.integers(24, size=draws), np.arange(draws)
    v[row, pad] += sigmas * c.noise[pad]
    marked = estimator.find_suspects(v)
    pair = marked[row, pad] & marked[row, opposite(c.layout)[pad]] & (marked.sum(axis=1) == 2)
    return (
        np.mean(chi2_of(estimator, v) > estimator.limit),
        np.mean(pair),
        np.mean(marked.any(axis=1) & ~marked[row, pad]),
    )


def test_on_the_cube_a_broken_pad_is_named_up_to_its_opposite():
    rings, _, _ = suspects_after(0)
    assert rings < 3 * FALSE_ALARM
    rings, pair, missed = suspects_after(50)
    assert rings == 1 and pair > 0.99 and missed < 0.001, (rings, pair, missed)
    assert suspects_after(10)[2] < 0.02


def test_a_pad_cannot_be_told_from_its_opposite():
    """Their columns of U2' are equal: the difference of the two is a combination of gradients."""
    c = make_illustrative_calibration("cube")
    null = make_estimator(c.response, c.noise, c.modes).null
    np.testing.assert_allclose(null, null[:, opposite(c.layout)], atol=1e-12)
    assert len(np.unique(null.round(9), axis=1).T) == 12


def test_on_the_planar_layout_the_residual_rings_but_names_nobody():
    c = make_illustrative_calibration("planar")
    estimator = make_estimator(c.response, c.noise, c.modes)
    broken = np.outer(50 * c.noise, np.ones(8)) * np.eye(8)
    assert np.all(chi2_of(estimator, broken) > estimator.limit)
    assert not estimator.find_suspects(broken).any()
