# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Modes: linear stress fields in equilibrium, whose amplitudes a cube recovers.

Mode m is the field ``sigma_ij(x) = S_ij + G_ijk x_k / d0``, where x is the position relative to the
centre of the cube and d0 its half side. Its amplitude is in Pa. The name of a mode tells its field:

    zz            uniform sigma_zz
    zz_x          sigma_zz that grows along x; the amplitude is d0 d(sigma_zz)/dx
    xy_y-zx_z     sigma_xy that grows along y, and sigma_zx that falls along z by as much

Sources: equilibrium, d(sigma_ij)/dx_j = 0; the plane modes are those of Kiyota & Shinoda, eq. 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from .arrays import Array
from .errors import SymmetryError
from .layout import AXES

STRESS = ("xx", "yy", "zz", "yz", "zx", "xy")
"""Names of the six components of stress, in Voigt order: normal stresses, then shear stresses."""

GRADIENT = tuple(f"{a}{a}_{b}" for a in AXES for b in AXES)
"""Names of the nine gradients of normal stresses: xx, yy and zz, each with its derivatives along x,
y and z, such as "zz_x"."""

COMPONENTS = STRESS + GRADIENT
"""Names of the 15 published components: six stresses, then nine gradients of normal stresses."""

FIELD_SIZE = 9 + 27
"""Number of entries of a linear stress field: the stress S at the centre (3, 3) and its gradient G
(3, 3, 3)."""

_ROWS = [AXES.index(name[0]) for name in STRESS]
"""Row in the stress tensor (3, 3) of each component xx, yy, zz, yz, zx, xy."""
_COLUMNS = [AXES.index(name[1]) for name in STRESS]
"""Column in the stress tensor (3, 3) of each component xx, yy, zz, yz, zx, xy."""
_COMPONENT_NUMBERS = [
    [0, 5, 4],
    [5, 1, 3],
    [4, 3, 2],
]
"""Number of the component, in the order xx, yy, zz, yz, zx, xy, at each place of the symmetric
stress tensor (3, 3)."""

Float = TypeVar("Float", bound=np.floating)


def to_matrix(stress: NDArray[Float]) -> NDArray[Float]:
    """Return stress tensors as symmetric matrices (..., 3, 3).

    Args:
        stress: Components xx, yy, zz, yz, zx, xy (..., 6).
    """
    s = np.asarray(stress)
    return s[..., _COMPONENT_NUMBERS]


def to_voigt(matrix: NDArray[Float]) -> NDArray[Float]:
    """Return the components xx, yy, zz, yz, zx, xy (..., 6) of stress tensors (..., 3, 3)."""
    m = np.asarray(matrix)
    return m[..., _ROWS, _COLUMNS]


def to_gradient_tensor(gradient: NDArray[Float]) -> NDArray[Float]:
    """Return gradients of stress tensors as G_ijk = d(sigma_ij)/dx_k (..., 3, 3, 3).

    Args:
        gradient: Derivatives (..., 6, 3) of xx, yy, zz, yz, zx, xy along x, y and z.
    """
    g = np.asarray(gradient)
    return g[..., _COMPONENT_NUMBERS, :]


@dataclass(frozen=True, eq=False)
class Modes:
    """A set of M modes: linear stress fields sigma_ij(x) = S_ij + G_ijk x_k / d0.

    Attributes:
        names: Names of the modes.
        stress: Stress S at the centre of the cube, per unit amplitude (M, 3, 3).
        gradient: G_ijk = d0 d(sigma_ij)/dx_k, with d0 half the side of the cube, per unit amplitude
            (M, 3, 3, 3).
    """

    names: tuple[str, ...]
    stress: Array
    gradient: Array

    @property
    def n_modes(self) -> int:
        """Number of modes."""
        return len(self.names)

    @property
    def fields(self) -> Array:
        """Fields of the modes as columns (36, M): 9 entries of S, then 27 of G, both row-major."""
        stress = self.stress.reshape(self.n_modes, 9)
        gradient = self.gradient.reshape(self.n_modes, 27)
        columns: Array = np.concatenate([stress, gradient], axis=1).T
        return columns

    @cached_property
    def reading(self) -> Array:
        """Matrix (M, 36) from a linear stress field to the amplitudes of the modes.

        It is a left inverse of `fields`: reading @ fields is the identity.
        """
        rows = np.zeros((self.n_modes, FIELD_SIZE))
        for row, name in zip(rows, self.names, strict=True):
            terms = _parse_terms(name)
            for sign, place in terms:
                row[place] = sign / len(terms)
        rows.flags.writeable = False
        return rows

    @property
    def components(self) -> Array:
        """Matrix T (15, M) from the amplitudes of the modes to the published components.

        The components are in Pa; gradients are multiplied by d0 (half the side of the cube).
        """
        rows = np.zeros((len(COMPONENTS), FIELD_SIZE))
        for row, name in zip(rows, COMPONENTS, strict=True):
            # The modes of Kiyota & Shinoda (`PAPER`) have separate amplitudes for sigma_zx and
            # sigma_xz. The driver's component zx, in its messages, is the mean of the two.
            transposed = name[1::-1] + name[2:]
            for entry in {name, transposed}:
                _, place = _parse_terms(entry)[0]
                row[place] = 1.0
            row /= row.sum()
        return rows @ self.fields

    def compute_amplitudes(
        self,
        stress: Array,
        gradient: Array | None = None,
    ) -> Array:
        """Compute the amplitudes of the modes in given stress fields.

        A part of a field that no mode expresses is ignored: one that violates equilibrium or, for
        plane modes, one outside the plane.

        Args:
            stress: Stress at the centre of the cube, (N, 6) or (N, 3, 3), in Pa.
            gradient: Gradient d(sigma_ij)/dx_k times d0 (half the side of the cube),
                (N, 3, 3, 3), in Pa. None means zero.

        Returns:
            Amplitudes (N, M), in Pa.
        """
        s = np.asarray(stress, dtype=float)
        if s.shape[-1] == 6:
            s = to_matrix(s)
        s = s.reshape(-1, 9)
        if gradient is None:
            gradient = np.zeros((len(s), 3, 3, 3))
        g = np.asarray(gradient, dtype=float)
        g = g.reshape(-1, 27)
        fields = np.concatenate([s, g], axis=1)
        amplitudes: Array = fields @ self.reading.T
        return amplitudes

    def compute_action(self, rotation: Array) -> Array:
        """Compute the matrix that transforms amplitudes when the field is rotated or mirrored.

        The field transforms as S'_ij = R_ia R_jb S_ab and G'_ijk = R_ia R_jb R_kc G_abc.

        Args:
            rotation: Rotation or mirror R (3, 3).

        Returns:
            Matrix (M, M) with amplitudes' = action @ amplitudes.

        Raises:
            SymmetryError: The rotated modes are not combinations of the modes, for example plane
                modes that are rotated out of their plane.
        """
        r = np.asarray(rotation, dtype=float)
        # A tensor stored row-major is rotated, in all its indices, by the Kronecker product of one
        # rotation matrix per index.
        on_stress = np.kron(r, r)
        on_gradient = np.kron(on_stress, r)
        rotated = self.fields.copy()
        rotated[:9] = on_stress @ rotated[:9]
        rotated[9:] = on_gradient @ rotated[9:]

        action: Array = self.reading @ rotated
        if not np.allclose(self.fields @ action, rotated, atol=1e-9):
            raise SymmetryError(
                f"the modes {', '.join(self.names)} do not stay among themselves under "
                f"{r.tolist()}; choose a smaller symmetry group"
            )
        return action

    def find_indices(self, names: Sequence[str]) -> list[int]:
        """Return the numbers (from 0) of the modes with these names.

        Raises:
            SymmetryError: A name is unknown.
        """
        for name in names:
            if name not in self.names:
                raise SymmetryError(f"unknown mode {name!r}; the modes are {', '.join(self.names)}")
        return [self.names.index(name) for name in names]


def _parse_terms(name: str) -> list[tuple[float, int]]:
    """Return the terms of the name of a mode (linear stress field): "xy_y-zx_z" has two terms.

    Returns:
        Sign of each term, and its index among the 36 entries of a field (9 of the stress, then 27
        of the gradient).
    """
    terms = []
    for number, part in enumerate(name.split("-")):
        i = AXES.index(part[0])
        j = AXES.index(part[1])
        place = 3 * i + j
        if "_" in part:
            k = AXES.index(part[3])
            place = 9 + 3 * place + k
        sign = -1.0 if number else 1.0
        terms.append((sign, place))
    return terms


def _make_modes(
    names: Sequence[str],
    axes: str,
    symmetric: bool = True,
) -> Modes:
    """Construct modes from their names.

    Args:
        names: Names of the modes.
        axes: Axes along which the stress may vary: "zx" for a plane, "xyz" for space. A normal
            stress that grows along its own axis is balanced by equal shear gradients along the
            other axes.
        symmetric: Whether sigma_ij and sigma_ji are equal.
    """
    flat = np.zeros((len(names), FIELD_SIZE))
    for row, name in zip(flat, names, strict=True):
        for sign, place in _parse_terms(name):
            row[place] = sign
    stress = flat[:, :9].reshape(-1, 3, 3)
    gradient = flat[:, 9:].reshape(-1, 3, 3, 3)

    if symmetric:
        # So far, only the entry of the stress tensor that stands in a mode's name is set, such as
        # xy (sigma_xy), and not the equal entry yx.
        transposed_stress = stress.transpose(0, 2, 1)
        transposed_gradient = gradient.transpose(0, 2, 1, 3)
        stress = np.where(stress == 0, transposed_stress, stress)
        gradient = np.where(gradient == 0, transposed_gradient, gradient)

    for g, name in zip(gradient, names, strict=True):
        if name not in GRADIENT or name[0] != name[3]:
            continue
        # The normal stress grows along its own axis, which equilibrium allows only if shears along
        # the other axes have the opposite divergence.
        i = AXES.index(name[0])
        for axis in axes.replace(name[0], ""):
            j = AXES.index(axis)
            balance = -1 / (len(axes) - 1)
            g[i, j, j] = balance
            g[j, i, j] = balance

    stress.flags.writeable = gradient.flags.writeable = False
    return Modes(tuple(names), stress, gradient)


_PLANE_GRADIENTS = ("zz_x", "zz_z", "xx_z", "xx_x")
"""Names of the modes in the plane z-x in which a normal stress varies along z or x."""

PLANE = _make_modes(("zz", "zx", "xx", *_PLANE_GRADIENTS), "zx")
"""The seven modes of the plane z-x.

Equilibrium requires that the mode zz_z (sigma_zz = z / d0) also has sigma_zx = -x / d0, and that
the mode xx_x (sigma_xx = x / d0) also has sigma_zx = -z / d0.
"""

PAPER = _make_modes(
    ("zz", "zx", "xx", "xz", *_PLANE_GRADIENTS),
    "zx",
    symmetric=False,
)
"""The eight modes of Kiyota & Shinoda, eq. 1, with separate amplitudes for sigma_zx and sigma_xz.

Moment equilibrium makes the two equal, so these modes serve only for comparison.
"""

_SHEAR_GRADIENTS = ("yz_x", "zx_y", "xy_z", "xy_y-zx_z", "yz_z-xy_x", "zx_x-yz_y")
"""Names of the modes of space in which only shear stresses vary. In each of the last three, two
shear gradients with opposite signs are in equilibrium."""

SPACE = _make_modes((*STRESS, *GRADIENT, *_SHEAR_GRADIENTS), "xyz")
"""The 21 modes of space: all linear stress fields in equilibrium.

In the mode zz_z, sigma_zz grows linearly along z, which alone would not be in equilibrium.
Gradients of sigma_zx along x and of sigma_yz along y balance it, each half of it, and likewise in
the other modes. With equal halves, every rotation or mirror image of a cube exchanges modes or
changes their signs, and does not mix them.
"""
