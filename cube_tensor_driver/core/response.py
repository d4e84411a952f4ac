# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Response matrix A of a cube (pads x modes, Pa per Pa).

The stresses on the pads are v = A s, where s holds the amplitudes of the modes (linear stress
fields, see `modes.py`).

Source: Kiyota & Shinoda, eq. 1.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from .arguments import join_names
from .arrays import Array
from .errors import CalibrationError, LayoutError
from .layout import LAYOUTS
from .symmetry import Structure, find_largest_symmetry, find_structure

ILLUSTRATIVE = {
    "a": 1.4,
    "b": 0.3,
    "c_plus_d": 0.5,
    "e": 0.9,
    "f": 0.0,
    "g": -1.4,
    "h": 0.3,
}
"""Illustrative coefficients of the response matrix of the layouts quad and planar, in Pa per Pa.

The names are the letters of Kiyota & Shinoda, eq. 1. The values are chosen freely for
demonstrations; a real cube needs a calibration with fitted or computed values.
"""

_FREE_SHEAR_Z = 0.4
"""Illustrative response, in Pa per Pa, of the pad +z-x (face +z, on the side of -x) to the mode
zx_x-yz_y: σzx grows along x, and σyz falls along y by as much. The amplitude of the mode is this
gradient times half the side of the cube. The value is chosen freely: `ILLUSTRATIVE` does not
determine it."""
_FREE_SHEAR_X = 0.2
"""Illustrative response, in Pa per Pa, of the pad +z-x (face +z, on the side of -x) to the mode
xy_y-zx_z: σxy grows along y, and σzx falls along z by as much. The amplitude of the mode is this
gradient times half the side of the cube. The value is chosen freely: `ILLUSTRATIVE` does not
determine it."""

ILLUSTRATIVE_CUBE = {
    "+z-x:zz": 1.4,
    "+z-x:xx": -0.3,
    "+z-x:yy": -0.2,
    "+z-x:zx": -0.5,
    "+z-x:zz_x": -0.9,
    "+z-x:xx_z": 0.0,
    "+z-x:yy_x": 0.1,
    "+z-x:yy_z": -0.1,
    "+z-x:zz_z": 1.4 + _FREE_SHEAR_Z / 2,
    "+z-x:xx_x": 0.3 - _FREE_SHEAR_X / 2,
    "+z-x:zx_x-yz_y": _FREE_SHEAR_Z,
    "+z-x:xy_y-zx_z": _FREE_SHEAR_X,
}
"""Illustrative coefficients of the response matrix of the layout cube, in Pa per Pa.

Each key names a pad, always the first one, +z-x, and after the colon the mode to which it responds.
The responses to yy, yy_x, yy_z and the two shear gradients are chosen freely. The others are chosen
so that the pads in the plane z-x respond to the modes of this plane with the coefficients
`ILLUSTRATIVE`, like the pads of the layouts quad and planar.
"""

MAX_LISTED_NAMES = 6
"""Maximum number of names that an error message lists; of further names it states the number."""


def choose_illustrative_coefficients(structure: Structure) -> dict[str, float]:
    """Return illustrative coefficients of the response of a built-in layout.

    Args:
        structure: Built-in layout, and any symmetry that it has.

    Returns:
        Value of each coefficient of the structure, in Pa per Pa.

    Raises:
        LayoutError: The layout is none of quad, planar and cube.
    """
    layout = structure.layout
    if layout.name not in LAYOUTS:
        raise LayoutError(
            f"no illustrative response for layout {layout.name!r}; there is one for "
            "quad, planar and cube: fit a calibration for yours"
        )
    known = ILLUSTRATIVE_CUBE if layout.name == "cube" else ILLUSTRATIVE
    if set(structure.names) == set(known):
        return {name: known[name] for name in structure.names}

    # A smaller symmetry has more coefficients. They are computed from the response matrix of the
    # largest symmetry, whose coefficients are known.
    symmetric = find_structure(layout, find_largest_symmetry(layout))
    matrix = compute_response(symmetric, choose_illustrative_coefficients(symmetric))
    coefficients, _ = project(structure, matrix)
    return coefficients


def make_generic_response(structure: Structure) -> Array:
    """Return a response matrix (P, M) with random coefficients.

    Its rank is that of almost every response with this structure, so it shows which modes a layout
    can determine.
    """
    generator = np.random.default_rng(0)
    values = generator.uniform(0.5, 1.5, structure.n_coefficients)
    coefficients = dict(zip(structure.names, values.tolist(), strict=True))
    return compute_response(structure, coefficients)


def compute_response(
    structure: Structure,
    coefficients: Mapping[str, float],
) -> Array:
    """Compute the response matrix A = sum_k c_k B_k.

    Args:
        structure: Structure with the K basis matrices B_k (entries 0, 1 and -1).
        coefficients: Value c_k of each coefficient by its name, in Pa per Pa.

    Returns:
        Response (P, M), in Pa per Pa.

    Raises:
        CalibrationError: Coefficients are missing or unknown.
    """
    missing = sorted(set(structure.names) - set(coefficients))
    unknown = sorted(set(coefficients) - set(structure.names))
    if missing or unknown:
        raise CalibrationError(
            f"layout {structure.layout.name!r} with symmetry {structure.symmetry!r} has "
            f"{structure.n_coefficients} coefficients; "
            f"missing {join_names(missing, MAX_LISTED_NAMES) or 'none'}, "
            f"unknown {join_names(unknown, MAX_LISTED_NAMES) or 'none'}"
        )
    values = [coefficients[name] for name in structure.names]
    return np.tensordot(values, structure.basis, axes=1)


def project(
    structure: Structure,
    matrix: Array,
) -> tuple[dict[str, float], float]:
    """Find the symmetric response matrix that is nearest to a given one.

    Each coefficient is the mean of the entries that the symmetry makes equal, up to their signs.

    Args:
        structure: Structure with the symmetry.
        matrix: Response matrix A (P, M), in Pa per Pa.

    Returns:
        Coefficients of the nearest symmetric matrix A_sym by name, and the relative remainder
        |A - A_sym| / |A|, which is 0 for a matrix that has the symmetry.

    Raises:
        CalibrationError: The matrix has another shape.
    """
    basis = structure.basis
    if matrix.shape != basis.shape[1:]:
        raise CalibrationError(
            f"the response matrix has shape {matrix.shape}; layout {structure.layout.name!r} "
            f"with its modes needs {basis.shape[1:]}"
        )
    orbit_sizes = np.einsum("kpm,kpm->k", basis, basis)
    orbit_sums = np.einsum("kpm,pm->k", basis, matrix)
    values = orbit_sums / orbit_sizes
    coefficients = dict(zip(structure.names, values.tolist(), strict=True))
    nearest = np.tensordot(values, basis, axes=1)
    remainder = np.linalg.norm(matrix - nearest)
    size = np.linalg.norm(matrix)
    relative = float(remainder / size) if size else 0.0
    return coefficients, relative
