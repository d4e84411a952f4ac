# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Layouts, modes and the response that symmetry leaves: against the paper's matrix and
characters."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cube_tensor_driver.core.errors import CalibrationError, LayoutError, SymmetryError
from cube_tensor_driver.core.estimator import make_estimator
from cube_tensor_driver.core.layout import LAYOUTS, Layout, find_layout
from cube_tensor_driver.core.modes import COMPONENTS, PAPER, PLANE, SPACE, to_matrix, to_voigt
from cube_tensor_driver.core.response import (
    ILLUSTRATIVE_CUBE,
    choose_illustrative_coefficients,
    compute_response,
    project,
)
from cube_tensor_driver.core.symmetry import (
    GENERATORS,
    Structure,
    choose_default_modes,
    find_group,
    find_layout_group,
    find_structure,
    generate_group,
    map_pads,
)

# Eq. 1 of the paper, typed in here and nowhere else; columns zz zx xx xz zz_x zz_z xx_z xx_x.
PAPER_ROWS = """
     a -c -b -d -e -g  f  h
     a  c -b  d  e -g  f -h
     a  c -b  d -e  g -f  h
     a -c -b -d  e  g -f -h
    -b -d  a -c  f  h -e -g
    -b  d  a  c  f -h  e -g
    -b  d  a  c -f  h -e  g
    -b -d  a -c -f -h  e  g
"""
# Number of coefficients by layout and group, with PLANE or SPACE modes.
COUNTS = {
    ("quad", "slab"): 7,
    ("quad", "mirrors"): 7,
    ("quad", "none"): 28,
    ("planar", "full"): 7,
    ("planar", "slab"): 14,
    ("planar", "mirrors"): 14,
    ("planar", "none"): 56,
    ("cube", "full"): 12,
    ("cube", "slab"): 36,
    ("cube", "mirrors"): 72,
    ("cube", "none"): 504,
}
PAIRS = sorted(COUNTS)


def pad_action(layout: Layout, rotation: np.ndarray) -> np.ndarray:
    """(P, P) permutation matrix of the pads: rotated pad stresses are pad_action @ pad stresses."""
    action = np.zeros((layout.n_pads, layout.n_pads))
    action[map_pads(layout, rotation), np.arange(layout.n_pads)] = 1
    return action


def count_by_characters(layout: Layout, symmetry: str) -> int:
    """Number of coefficients as the mean over the group of (pads kept) x (trace on modes)."""
    modes, elements = choose_default_modes(layout), find_layout_group(layout, symmetry)
    total = sum(
        np.trace(pad_action(layout, r)) * np.trace(modes.compute_action(r)) for r in elements
    )
    return round(total / len(elements))


def paper_matrix(**letters: float) -> np.ndarray:
    def value(text: str) -> float:
        return -letters[text[1:]] if text[0] == "-" else letters[text]

    return np.array(
        [[value(t) for t in row.split()] for row in PAPER_ROWS.split("\n") if row.strip()]
    )


def random_response(structure: Structure, seed: int = 0) -> np.ndarray:
    values = np.random.default_rng(seed).normal(size=structure.n_coefficients)
    return compute_response(structure, dict(zip(structure.names, values, strict=True)))


def test_the_pads_of_the_built_in_layouts():
    assert LAYOUTS["planar"].pads == (
        "+z-x",
        "+z+x",
        "-z-x",
        "-z+x",
        "+x-z",
        "+x+z",
        "-x-z",
        "-x+z",
    )
    assert LAYOUTS["quad"].pads == LAYOUTS["planar"].pads[:4]
    cube = LAYOUTS["cube"]
    assert cube.pads[:8] == LAYOUTS["planar"].pads and len(set(cube.pads)) == 24
    for face in ("+x", "-x", "+y", "-y", "+z", "-z"):
        others = [a for a in "xyz" if a not in face]
        assert {p[2:] for p in cube.pads if p[:2] == face} == {s + a for s in "+-" for a in others}
    assert [LAYOUTS[n].planar for n in ("quad", "planar", "cube")] == [True, True, False]


def test_a_layout_survives_plain_types():
    for layout in LAYOUTS.values():
        assert Layout.from_dict(layout.to_dict()).has_same_pads(layout)
    assert not LAYOUTS["quad"].has_same_pads(LAYOUTS["planar"])


@pytest.mark.parametrize(
    "change, words",
    [
        ({"normals": [[0, 0, 2]]}, "normal"),
        ({"positions": [[0, 0, 1], [0, 0, 1]], "normals": [[0, 0, 1], [0, 0, 0]]}, "dummy pad"),
        ({"positions": [[0, 0, 0]], "normals": [[0, 0, 0]]}, "add pads on faces"),
        ({"positions": [[0, 0, 0.9]]}, "not on the face"),
        ({"positions": [[0.9, 0, 1]]}, "face ends at 1"),
        ({"positions": [[0, 0, 1], [0, 0, 1]], "normals": [[0, 0, 1], [0, 0, 1]]}, "coincide"),
        ({"positions": [[0, 0]]}, "x, y, z"),
        ({"positions": "left"}, "x, y, z"),
        ({"positions": [[0, 0, float("nan")]]}, "finite"),
        ({"pad_size": 0}, "pad_size"),
        ({"pad_size": "big"}, "pad_size"),
        ({"colour": "red"}, "colour"),
        ({"positions": [], "normals": []}, "x, y, z"),
        ({"positions": [[0, 0, 1], [0.5, 0, 1]]}, r"normals.* shape \(1, 3\); it must be \(2, 3\)"),
    ],
)
def test_a_bad_layout_is_refused_with_the_reason(change, words):
    good = {"name": "mine", "positions": [[0, 0, 1]], "normals": [[0, 0, 1]], "pad_size": 0.4}
    assert Layout.from_dict(good).pads == ("+z",)
    with pytest.raises(LayoutError, match=words):
        Layout.from_dict(good | change)


def test_an_unknown_layout_is_named():
    with pytest.raises(LayoutError, match=r"'ring'.*quad, planar, cube"):
        find_layout("ring")
    assert LAYOUTS["planar"].pads.index("-x+z") == 7


@pytest.mark.parametrize("modes, count", [(PLANE, 7), (PAPER, 8), (SPACE, 21)])
def test_modes_are_independent_and_in_equilibrium(modes, count):
    assert modes.n_modes == count == len(set(modes.names))
    assert np.linalg.matrix_rank(modes.fields) == count
    assert not np.any(np.einsum("mijj->mi", modes.gradient))  # d(sigma_ij)/dx_j = 0
    np.testing.assert_allclose(modes.reading @ modes.fields, np.eye(count), atol=1e-15)
    if modes is not PAPER:
        np.testing.assert_array_equal(modes.stress, modes.stress.transpose(0, 2, 1))
        np.testing.assert_array_equal(modes.gradient, modes.gradient.transpose(0, 2, 1, 3))


def test_space_modes_are_all_linear_fields_in_equilibrium():
    # 6 + 18 symmetric linear fields less 3 equations of equilibrium
    equations = np.zeros((3, 6, 3))
    for i in range(3):
        for c in range(6):
            unit = to_matrix(np.eye(6)[c])
            equations[i, c] = unit[i]
    assert SPACE.n_modes == 6 + 18 - np.linalg.matrix_rank(equations.reshape(3, 18))


def test_a_field_becomes_a_state_and_back():
    state = np.random.default_rng(1).normal(size=(5, 21))
    stress = np.einsum("nm,mij->nij", state, SPACE.stress)
    gradient = np.einsum("nm,mijk->nijk", state, SPACE.gradient)
    np.testing.assert_allclose(SPACE.compute_amplitudes(stress, gradient), state, atol=1e-14)
    read = np.concatenate(
        [to_voigt(stress), np.einsum("niij->nij", gradient).reshape(5, 9)], axis=1
    )
    np.testing.assert_allclose(state @ SPACE.components.T, read, atol=1e-14)
    np.testing.assert_array_equal(
        PLANE.compute_amplitudes(np.array([[3, 9, 1, 9, 2, 9.0]])), [[1, 2, 3, 0, 0, 0, 0]]
    )
    np.testing.assert_array_equal(to_voigt(to_matrix(np.arange(6.0))), np.arange(6.0))


@pytest.mark.parametrize("name, order", [("full", 48), ("slab", 16), ("mirrors", 8), ("none", 1)])
def test_groups_are_groups(name, order):
    elements = find_group(name)
    keys = {r.tobytes() for r in elements}
    assert len(elements) == len(keys) == order
    assert all((a @ b).tobytes() in keys for a in elements for b in elements)
    assert all(np.ascontiguousarray(r.T).tobytes() in keys for r in elements)


@given(st.lists(st.sampled_from(find_group("full").tolist()), max_size=3))
def test_closure_of_any_generators_is_a_group(generators):
    elements = generate_group(generators)
    keys = {r.tobytes() for r in elements}
    assert 48 % len(elements) == 0  # Lagrange
    assert all((a @ b).tobytes() in keys for a in elements for b in elements)


@given(st.integers(0, 47), st.integers(0, 47))
def test_the_action_on_modes_composes(i, j):
    a, b = find_group("full")[i], find_group("full")[j]
    np.testing.assert_allclose(
        SPACE.compute_action(a @ b), SPACE.compute_action(a) @ SPACE.compute_action(b), atol=1e-12
    )
    inverse = np.linalg.inv(a)
    np.testing.assert_allclose(
        SPACE.compute_action(inverse) @ SPACE.compute_action(a), np.eye(21), atol=1e-12
    )
    cube = LAYOUTS["cube"]
    np.testing.assert_array_equal(
        pad_action(cube, a @ b), pad_action(cube, a) @ pad_action(cube, b)
    )


@pytest.mark.parametrize("layout, symmetry", PAIRS)
def test_the_number_of_coefficients(layout, symmetry):
    structure = find_structure(LAYOUTS[layout], symmetry)
    assert (
        structure.n_coefficients
        == COUNTS[layout, symmetry]
        == count_by_characters(LAYOUTS[layout], symmetry)
    )
    flat = structure.basis.reshape(structure.n_coefficients, -1)
    assert np.linalg.matrix_rank(flat) == structure.n_coefficients
    assert set(np.unique(flat)) <= {-1.0, 0.0, 1.0}
    assert np.abs(flat).sum(axis=0).max() == 1  # an entry belongs to one coefficient at most
    assert len(set(structure.names)) == structure.n_coefficients


@pytest.mark.parametrize("layout, symmetry", PAIRS)
def test_turned_loads_are_seen_by_turned_pads(layout, symmetry):
    """A M(R) = P(R) A, and the recovered state turns with the load, for every element of every
    group."""
    structure = find_structure(LAYOUTS[layout], symmetry)
    modes, a = structure.modes, random_response(structure)
    state = np.random.default_rng(2).normal(size=modes.n_modes)
    estimator = make_estimator(a, np.ones(len(a)), modes, targets=np.eye(modes.n_modes))
    seen = estimator.observed
    pads = a @ state
    for r in find_layout_group(structure.layout, symmetry):
        turn, permute = modes.compute_action(r), pad_action(structure.layout, r)
        np.testing.assert_allclose(a @ turn, permute @ a, atol=1e-12)
        back = (estimator.matrix @ (permute @ pads))[seen]
        np.testing.assert_allclose(back, (turn @ np.where(seen, state, 0))[seen], atol=1e-9)


@pytest.mark.parametrize("layout, symmetry", PAIRS)
def test_projection_averages_over_the_group(layout, symmetry):
    structure = find_structure(LAYOUTS[layout], symmetry)
    a = np.random.default_rng(3).normal(size=structure.basis.shape[1:])
    elements = find_layout_group(structure.layout, symmetry)
    mean = np.mean(
        [
            pad_action(structure.layout, r).T @ a @ structure.modes.compute_action(r)
            for r in elements
        ],
        axis=0,
    )
    coefficients, unexplained = project(structure, a)
    np.testing.assert_allclose(compute_response(structure, coefficients), mean, atol=1e-12)
    assert unexplained == pytest.approx(np.linalg.norm(a - mean) / np.linalg.norm(a))
    assert project(structure, mean)[1] < 1e-12


def test_the_derived_basis_spans_the_papers_matrix():
    letters = dict(zip("abcdefgh", np.random.default_rng(4).normal(size=8), strict=True))
    structure = find_structure(LAYOUTS["planar"], "full", PAPER)
    assert structure.names == tuple("abcdefgh")
    np.testing.assert_allclose(
        compute_response(structure, letters), paper_matrix(**letters), atol=1e-15
    )
    assert find_structure(LAYOUTS["planar"], "mirrors", PAPER).n_coefficients == 16
    equilibrium = find_structure(LAYOUTS["planar"], "full")
    merged = {k: v for k, v in letters.items() if k not in "cd"} | {
        "c_plus_d": letters["c"] + letters["d"]
    }
    shear = np.zeros((8, 7))
    for column, mode in enumerate(PLANE.names):
        shear[PAPER.names.index(mode), column] = 1
    shear[PAPER.names.index("xz"), PLANE.names.index("zx")] = 1
    np.testing.assert_allclose(
        compute_response(equilibrium, merged), paper_matrix(**letters) @ shear, atol=1e-14
    )


def test_the_printed_inverses_fail_and_the_corrected_ones_agree_with_least_squares():
    rng = np.random.default_rng(5)
    c = dict(zip("abcdefgh", [1.4, 0.3, 0.35, 0.15, 0.9, 0.1, -1.4, 0.3], strict=True))
    zz, zx, xx, zz_x, zz_z, xx_z, xx_x = state = rng.normal(size=7)
    v = paper_matrix(**c) @ np.array([zz, zx, xx, zx, zz_x, zz_z, xx_z, xx_x])
    v1, v2, v3, v4, v5, v6, v7, v8 = v
    sides, tops = v1 - v2 - v3 + v4, v5 - v6 - v7 + v8
    corrected_shear = -(sides + tops) / (8 * (c["c"] + c["d"]))
    printed_shear = sides / (8 * (c["c"] + c["d"]))  # eq. 4: one bracket, the other sign
    assert corrected_shear == pytest.approx(zx) and printed_shear == pytest.approx(-zx / 2)
    tilt, lift = -v1 + v2 - v3 + v4, v5 + v6 - v7 - v8
    bottom = 4 * (c["e"] * c["g"] - c["f"] * c["h"])
    assert (c["g"] * tilt - c["h"] * lift) / bottom == pytest.approx(zz_x)
    assert (
        abs((c["h"] * tilt - c["g"] * lift) / bottom - zz_x) > 0.1
    )  # eq. 5: g and h on the wrong brackets
    structure = find_structure(LAYOUTS["planar"])
    coefficients = {k: x for k, x in c.items() if k not in "cd"} | {"c_plus_d": c["c"] + c["d"]}
    estimator = make_estimator(
        compute_response(structure, coefficients), np.ones(8), PLANE, targets=np.eye(7)
    )
    np.testing.assert_allclose(estimator.matrix @ v, state, atol=1e-13)


def test_a_symmetry_that_the_layout_lacks_names_the_pad():
    with pytest.raises(SymmetryError, match=r"'quad' lacks.*'\+z-x'.*\[1\.0, 0\.0, -0\.5\]"):
        find_structure(LAYOUTS["quad"], "full")
    with pytest.raises(SymmetryError, match=r"'round'.*full, slab, mirrors, none"):
        find_structure(LAYOUTS["quad"], "round")
    with pytest.raises(SymmetryError, match="do not stay"):
        PLANE.compute_action(find_group("full")[[abs(r[1, 1]) != 1 for r in find_group("full")]][0])


def test_the_illustrative_responses_agree_with_each_other():
    whole = {"quad": "slab", "planar": "full", "cube": "full"}
    structures = {n: find_structure(LAYOUTS[n], g) for n, g in whole.items()}
    a = {n: compute_response(s, choose_illustrative_coefficients(s)) for n, s in structures.items()}
    np.testing.assert_array_equal(a["quad"], a["planar"][:4])
    plane_in_space = SPACE.compute_amplitudes(PLANE.stress, PLANE.gradient).T
    np.testing.assert_allclose(a["cube"][:8] @ plane_in_space, a["planar"], atol=1e-15)
    for name, symmetry in (("planar", "mirrors"), ("cube", "slab"), ("cube", "none")):
        structure = find_structure(LAYOUTS[name], symmetry)
        np.testing.assert_allclose(
            compute_response(structure, choose_illustrative_coefficients(structure)),
            a[name],
            atol=1e-15,
        )
    # as many combinations as any response of this symmetry has: only yz_x, zx_y and xy_z stay
    # hidden
    assert (
        np.linalg.matrix_rank(a["cube"])
        == np.linalg.matrix_rank(random_response(find_structure(LAYOUTS["cube"])))
        == 18
    )
    assert len(ILLUSTRATIVE_CUBE) == 12


def test_coefficients_that_do_not_fit_are_named():
    structure = find_structure(LAYOUTS["planar"])
    with pytest.raises(CalibrationError, match="missing h, unknown k"):
        compute_response(structure, {n: 1.0 for n in ("a", "b", "c_plus_d", "e", "f", "g", "k")})
    with pytest.raises(CalibrationError, match="shape"):
        project(structure, np.zeros((8, 8)))


def test_every_component_has_its_place():
    assert COMPONENTS[:6] == ("xx", "yy", "zz", "yz", "zx", "xy")
    assert COMPONENTS[6:] == (
        "xx_x",
        "xx_y",
        "xx_z",
        "yy_x",
        "yy_y",
        "yy_z",
        "zz_x",
        "zz_y",
        "zz_z",
    )
    assert (
        choose_default_modes(LAYOUTS["quad"]) is PLANE
        and choose_default_modes(LAYOUTS["cube"]) is SPACE
    )
    assert set(GENERATORS) == {"full", "slab", "mirrors", "none"}
    np.testing.assert_array_equal(PAPER.components[4], [0, 0.5, 0, 0.5, 0, 0, 0, 0])
