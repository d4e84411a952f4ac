"""Response matrix A (pads x modes, Pa per Pa): pad stresses v = A s. Source: the paper's eq. 1."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from .errors import CalibrationError, LayoutError
from .symmetry import Structure, find_structure

# Illustrative: neither computed nor measured; calibrations that are fitted or computed replace
# them.
ILLUSTRATIVE: dict[str, float] = {
    "a": 1.4,
    "b": 0.3,
    "c_plus_d": 0.5,
    "e": 0.9,
    "f": 0.0,
    "g": -1.4,
    "h": 0.3,
}

# Entries of row V1 for the cube. Those across the pad's section (yy, yy_x, yy_z) and the two free
# shears are illustrative too; the others make each section answer plane modes as ILLUSTRATIVE does.
_FREE_SHEAR_Z, _FREE_SHEAR_X = 0.4, 0.2
ILLUSTRATIVE_CUBE: dict[str, float] = {
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


def illustrative_coefficients(structure: Structure) -> dict[str, float]:
    """Illustrative coefficients of a built-in layout under any of its symmetries.

    LayoutError: another layout.
    """
    letters = structure.layout.name in ("quad", "planar")
    if not letters and structure.layout.name != "cube":
        raise LayoutError(
            f"no illustrative response for layout {structure.layout.name!r}; there is one for "
            "quad, planar and cube: fit a calibration for yours"
        )
    if set(structure.names) in (set(ILLUSTRATIVE), set(ILLUSTRATIVE_CUBE)):
        return {
            name: (ILLUSTRATIVE if letters else ILLUSTRATIVE_CUBE)[name] for name in structure.names
        }
    return project(structure, _illustrative_response(structure))[0]


def generic_response(structure: Structure) -> np.ndarray:
    """A response (P, M) with random coefficients: its ranks are those of almost all others."""
    names = structure.names
    values = np.random.default_rng(0).uniform(0.5, 1.5, len(names))
    return response(structure, dict(zip(names, values.tolist(), strict=True)))


def response(structure: Structure, coefficients: Mapping[str, float]) -> np.ndarray:
    """A = sum_k c_k B_k, shape (P, M).

    CalibrationError names the coefficients that are missing, unknown or not finite.
    """
    missing = set(structure.names) - set(coefficients)
    unknown = set(coefficients) - set(structure.names)
    if missing or unknown:
        raise CalibrationError(
            f"layout {structure.layout.name!r} with symmetry {structure.symmetry!r} has "
            f"{structure.n_coefficients} coefficients; missing {_some(missing)}, "
            f"unknown {_some(unknown)}"
        )
    values = np.array([coefficients[name] for name in structure.names], dtype=float)
    if not np.all(np.isfinite(values)):
        bad = [n for n, v in zip(structure.names, values, strict=True) if not np.isfinite(v)]
        raise CalibrationError(f"coefficients must be finite; {_some(bad)} are not")
    return np.tensordot(values, structure.basis, axes=1)


def project(structure: Structure, matrix: np.ndarray) -> tuple[dict[str, float], float]:
    """The nearest member of a structure to a response (P, M).

    Returns its coefficients (means over each orbit, as averaging P(R)^-1 A M(R) over the group
    gives) and the relative part left over, |A - A_sym| / |A|, 0 for a perfectly symmetric response.
    """
    matrix = np.asarray(matrix, dtype=float)
    if matrix.shape != structure.basis.shape[1:]:
        raise CalibrationError(
            f"the response matrix has shape {matrix.shape}; layout {structure.layout.name!r} "
            f"with its modes needs {structure.basis.shape[1:]}"
        )
    values = np.einsum("kpm,pm->k", structure.basis, matrix) / np.einsum(
        "kpm,kpm->k", structure.basis, structure.basis
    )
    left = matrix - np.tensordot(values, structure.basis, axes=1)
    size = np.linalg.norm(matrix)
    unexplained = float(np.linalg.norm(left) / size) if size else 0.0
    return dict(zip(structure.names, values.tolist(), strict=True)), unexplained


def prototype(shift: np.ndarray) -> np.ndarray:
    """Readings (N, 3) of the paper's prototype: normal, shear, gradient.

    shift: (N, 4) of the frequencies of V1 .. V4. These are the paper's eqs. 8 to 10 as they stand,
    in the unit of the shifts and uncalibrated. In terms of eq. 1 they are

        -4 (a zz - b xx),   4 (c + d) zx,   -4 (e zz_x - h xx_x)

    The normal reading holds sigma_xx too, and the third shows the true gradient only where that of
    sigma_xx is known.
    """
    return np.asarray(shift) @ np.array([[-1, -1, 1], [-1, 1, -1], [-1, 1, 1], [-1, -1, -1]])


def _illustrative_response(structure: Structure) -> np.ndarray:
    largest = {"quad": "slab", "planar": "full", "cube": "full"}[structure.layout.name]
    symmetric = find_structure(structure.layout, largest)
    return response(symmetric, illustrative_coefficients(symmetric))


def _some(names) -> str:
    """The first few names of a set."""
    if not names:
        return "none"
    more = f" and {len(names) - 6} more" if len(names) > 6 else ""
    return ", ".join(sorted(names)[:6]) + more
