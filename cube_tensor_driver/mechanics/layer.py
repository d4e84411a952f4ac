# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Stress in an elastic layer under traction on its surface, in wavenumber space.

The layer fills -thickness < z < 0. The traction t acts on its surface z = 0, and its bottom is
bonded to rigid ground; an infinite thickness is a half space. A wave of traction t exp(i k.x) with
the wavenumber k = |k| causes plane strain in the plane of k and z (axis L along k), and shear
perpendicular to this plane (axis T). With zeta = k z, h = k thickness, eta = zeta + h, Poisson's
ratio nu, shear modulus mu, displacements u and an Airy function psi / k^2, the stress sigma is::

    psi = (A + B zeta) exp(zeta) + (C + D eta) exp(-eta)
    sigma_zz = -psi,  sigma_Lz = -i psi',  sigma_LL = psi'',  sigma_TT = nu (psi'' - psi)
    2 mu k (i u_L, u_z) = (1 - nu) psi'' + nu psi,  (1 - nu) psi''' - (2 - nu) psi'
    sigma_Tz = t_T cosh(eta) / cosh(h),  sigma_LT = i t_T sinh(eta) / cosh(h)

The constants A to D follow from the traction, psi(0) = -t_z and psi'(0) = i t_L, and from the bond
to the ground, u_L = u_z = 0 at zeta = -h.

Source: I. N. Sneddon, Fourier Transforms (1951), 45-47 and 52; K. L. Johnson, Contact Mechanics
(1985), 2.2 and 5.8. The tests compare the layer with the point forces of contact.py and with finite
elements.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import Array, Complex
from ..core.defaults import POISSONS_RATIO
from ..core.errors import ElasticError
from ..core.modes import COMPONENTS, STRESS

FIELD = STRESS + tuple(f"{name}_{axis}" for name in STRESS for axis in "xyz")
"""Names of the 24 quantities of a stress field at a point: six stresses in Pa, then the derivatives
of each of them along x, y and z in Pa/m."""

MEASURED = [FIELD.index(name) for name in COMPONENTS]
"""Indices (15) in `FIELD` of the `COMPONENTS` that cubes measure: six stresses and the nine
gradients of the normal stresses."""

_Wave = NDArray[np.complexfloating]
"""Complex amplitudes of one quantity in a wave, at several wavenumbers."""
_WaveStress = dict[str, tuple[_Wave, _Wave]]
"""Stress under a wave of traction on the surface, and the derivative of this stress along z. A key
such as "LzT" names the stress component Lz and the direction T of the traction, in the axes of the
wave: L along its wave vector, T across it."""


@dataclass(frozen=True)
class Layer:
    """An elastic layer on rigid ground. Young's modulus does not influence the stress.

    Attributes:
        thickness: Thickness in m; infinite for a half space.
        poisson: Poisson's ratio, 0 to 0.5.

    Raises:
        ElasticError: A value is out of range.
    """

    thickness: float = np.inf
    poisson: float = POISSONS_RATIO

    def __post_init__(self) -> None:
        if not self.thickness > 0:
            raise ElasticError(
                f"the layer's thickness is {self.thickness} m; it must be above 0 (inf: half space)"
            )
        if not 0 <= self.poisson <= 0.5:
            raise ElasticError(
                f"Poisson's ratio is {self.poisson}; it must lie in [0, 0.5], for rubber near 0.48"
            )

    def check_depth(self, depth: float) -> None:
        """Check that a depth in m lies within the layer.

        Raises:
            ElasticError: The depth is not between 0 and the thickness.
        """
        if not 0 < depth < self.thickness:
            raise ElasticError(
                f"depth is {depth} m in a layer of {self.thickness} m; it must lie between 0 and "
                "the thickness"
            )

    def compute_transfer(
        self,
        kx: Array,
        ky: Array,
        depth: float,
    ) -> Complex:
        """Compute stress and gradient at one depth under a traction exp(i k.x) on the surface.

        In a half space, sigma_xx and sigma_yy have no limit for k -> 0 (uniform traction), because
        they depend on the direction of k. At k = 0, their mean over all directions is returned.

        Args:
            kx: Wavenumber along x (...) in 1/m.
            ky: Wavenumber along y (...) in 1/m.
            depth: Distance below the surface in m.

        Returns:
            `FIELD` (..., 24, 3) at z = -depth, in Pa and Pa/m per Pa of the traction along x, y and
            z. Tension is positive, so that pressing is a negative traction along z.

        Raises:
            ElasticError: The layer does not contain this depth.
        """
        self.check_depth(depth)
        kx = np.asarray(kx, float)
        ky = np.asarray(ky, float)
        kx, ky = np.broadcast_arrays(kx, ky)
        # L = (cosine, sine, 0) is the unit vector along the wave vector (kx, ky). Where k is 0, its
        # direction is arbitrary, because `_solve_uniform` replaces the result there.
        k = np.hypot(kx, ky)
        is_zero = k == 0
        k_safe = np.where(is_zero, 1.0, k)
        cosine = np.where(is_zero, 1.0, kx / k_safe)
        sine = ky / k_safe

        stress = np.zeros((*k.shape, 6, 3), complex)
        slope = np.zeros_like(stress)
        waves = self._solve_plane_strain(k_safe, depth) | self._solve_twist(k_safe, depth)
        for name, (value, derivative) in waves.items():
            _add_rotated(stress, cosine, sine, name, value)
            _add_rotated(slope, cosine, sine, name, derivative)
        stress[is_zero] = self._solve_uniform()
        slope[is_zero] = 0.0

        # All stresses vary as exp(i k.x), so that a derivative along x is a product with i kx.
        by_x = 1j * kx[..., None, None] * stress
        by_y = 1j * ky[..., None, None] * stress
        gradient = np.stack([by_x, by_y, slope], axis=-2)
        gradient = gradient.reshape(*k.shape, 18, 3)
        return np.concatenate([stress, gradient], axis=-2)

    def _solve_plane_strain(self, k: Array, depth: float) -> _WaveStress:
        """Return the stress under waves of traction with amplitude 1 Pa along z and along L.

        L is the horizontal axis along the wave vector; both tractions cause plane strain.

        Args:
            k: Wavenumbers (...) in 1/m, greater than 0.
            depth: Distance below the surface in m.
        """
        # The first axis of `psi` is for the function psi and its first three derivatives by
        # zeta = k z. The last axis is for the boundary conditions at the surface: psi = 1 and
        # psi' = 0 (normal traction), then psi = 0 and psi' = 1 (shear traction).
        psi = self._solve_airy(k, -k * depth)
        by_normal, by_shear = np.moveaxis(psi, -1, 0)
        by_load = {"L": 1j * by_shear, "z": -by_normal}

        nu = self.poisson
        waves: _WaveStress = {}
        for load, (p, p1, p2, p3) in by_load.items():
            # Each pair is a stress component, from the formulas at the head of this file, and its
            # derivative by zeta = k z.
            parts = {
                "zz": (-p, -p1),
                "Lz": (-1j * p1, -1j * p2),
                "LL": (p2, p3),
                "TT": (nu * (p2 - p), nu * (p3 - p1)),
            }
            for name, (value, slope) in parts.items():
                waves[name + load] = (value, k * slope)
        return waves

    def _solve_airy(self, k: Array, zeta: Array) -> Array:
        """Return the amplitude psi of the Airy function of a wave, and its first three derivatives.

        The Airy function of the plane strain is psi / k^2, so that psi = -sigma_zz. The derivatives
        are by zeta = k z.

        Args:
            k: Wavenumbers (...) in 1/m.
            zeta: Height z (...) multiplied by the wavenumber; negative below the surface.

        Returns:
            psi and its derivatives (4, ..., 2). The last axis is for two boundary conditions at the
            surface: psi = 1, psi' = 0, then psi = 0, psi' = 1.
        """
        if np.isinf(self.thickness):
            return self._solve_airy_half_space(zeta)
        h = k * self.thickness

        def differentiate(n: int, zeta: Array) -> Array:
            """Return the n-th derivatives (..., 4) of the four solutions of which psi is a sum."""
            eta = zeta + h
            rise = np.exp(zeta)
            fall = (-1) ** n * np.exp(-eta)
            return np.stack(
                [
                    rise,
                    (n + zeta) * rise,
                    fall,
                    (eta - n) * fall,
                ],
                axis=-1,
            )

        # The four constants follow from four boundary conditions: psi and psi' at the surface, and
        # the displacements u_L and u_z, which are 0 at the bottom.
        nu = self.poisson
        psi, psi1, psi2, psi3 = (differentiate(n, -h) for n in range(4))
        conditions = [
            differentiate(0, 0 * h),
            differentiate(1, 0 * h),
            (1 - nu) * psi2 + nu * psi,
            (1 - nu) * psi3 - (2 - nu) * psi1,
        ]
        matrix = np.stack(conditions, axis=-2)
        constants = np.linalg.inv(matrix)[..., :2]
        derivatives = []
        for n in range(4):
            solutions = differentiate(n, zeta)
            derivative = np.einsum("...c,...cl->...l", solutions, constants)
            derivatives.append(derivative)
        return np.stack(derivatives)

    @staticmethod
    def _solve_airy_half_space(zeta: Array) -> Array:
        """Return psi and its derivatives as `_solve_airy`, for a layer of infinite thickness.

        psi is a sum of four solutions. Two of them grow with the depth; their factors are 0 here.
        """
        decay = np.exp(zeta)[..., None]
        a = np.array([1.0, 0.0])
        b = np.array([-1.0, 1.0])  # because psi'(0) = a + b
        depth_factor = zeta[..., None]
        derivatives = []
        for n in range(4):
            factor = a + (n + depth_factor) * b
            derivatives.append(factor * decay)
        return np.stack(derivatives)

    def _solve_twist(self, k: Array, depth: float) -> _WaveStress:
        """Return the stress under a wave of traction with amplitude 1 Pa along the axis T.

        T is the horizontal axis across the wave vector; such a traction causes shear stress only.

        Args:
            k: Wavenumbers (...) in 1/m, greater than 0.
            depth: Distance below the surface in m.
        """
        decay = np.exp(-k * depth)
        cosh = sinh = decay
        if np.isfinite(self.thickness):
            # With the layer's thickness t, `cosh` is cosh(k (t - depth)) / cosh(k t), and `sinh` is
            # sinh(k (t - depth)) / cosh(k t). They are written with exponentials of negative
            # numbers, which cannot overflow for large k.
            reflected = np.exp(-2 * k * (self.thickness - depth))
            bottom = np.exp(-2 * k * self.thickness)
            base = decay / (1 + bottom)
            cosh = base * (1 + reflected)
            sinh = base * (1 - reflected)
        return {
            "TzT": (cosh + 0j, k * sinh + 0j),
            "LTT": (1j * sinh, 1j * k * cosh),
        }

    def _solve_uniform(self) -> Array:
        """Return the stress (6, 3) in Pa under a uniform traction of 1 Pa along x, y and z."""
        # `lateral` is the ratio of lateral to normal stress. In a half space, it depends on the
        # direction of the wave vector k, and the mean over all directions is taken. In a layer
        # under a uniform traction, there is no lateral strain, which determines the ratio.
        lateral = (1 + 2 * self.poisson) / 2
        if np.isfinite(self.thickness):
            lateral = self.poisson / (1 - self.poisson)

        stress = np.zeros((6, 3))
        stress[STRESS.index("xx"), 2] = lateral
        stress[STRESS.index("yy"), 2] = lateral
        stress[STRESS.index("zz"), 2] = 1.0
        stress[STRESS.index("zx"), 0] = 1.0
        stress[STRESS.index("yz"), 1] = 1.0
        return stress


def _add_rotated(
    out: Complex,
    cosine: Array,
    sine: Array,
    name: str,
    value: _Wave,
) -> None:
    """Rotate one stress component from the axes L, T, z of a wave to the axes x, y, z and add it.

    Args:
        out: Stress (..., 6, 3) under tractions along x, y and z, which is changed.
        cosine: First component (...) of the axis L = (cosine, sine, 0); T = (-sine, cosine, 0).
        sine: Second component (...) of L.
        name: Stress component and direction of the traction in the axes of the wave, such as "LzT".
        value: Amplitude (...) of the component in Pa.
    """
    c, s = cosine, sine
    cc = c * c
    ss = s * s
    cs = c * s
    # `stress_rows` has the factors with which a stress component in the wave's axes contributes to
    # the stresses xx, yy, zz, yz, zx and xy (indices 0 to 5).
    stress_rows: dict[str, dict[int, Array | float]] = {
        "LL": {0: cc, 1: ss, 5: cs},
        "TT": {0: ss, 1: cc, 5: -cs},
        "LT": {0: -2 * cs, 1: 2 * cs, 5: cc - ss},
        "zz": {2: 1.0},
        "Lz": {4: c, 3: s},
        "Tz": {4: -s, 3: c},
    }
    # `load_columns` has the components of unit tractions along x, y and z (indices 0 to 2) in the
    # wave's axes: L along its wave vector, T across it, and z.
    load_columns: dict[str, dict[int, Array | float]] = {
        "L": {0: c, 1: s},
        "T": {0: -s, 1: c},
        "z": {2: 1.0},
    }
    component, load = name[:2], name[2]
    for row, rotated in stress_rows[component].items():
        for column, share in load_columns[load].items():
            out[..., row, column] += rotated * share * value
