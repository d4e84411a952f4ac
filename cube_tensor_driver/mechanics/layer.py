"""Stress in an elastic layer under traction on its surface, in wavenumber space.

The layer fills -thickness < z < 0. Its surface z = 0 carries the traction t, its bottom is bonded
to rigid ground; an infinite thickness is a half space. A traction t exp(i k.x) with k = |k| makes
plane strain in the plane of k and z (L along k, T across) and a twist across it. With zeta = k z,
h = k thickness, eta = zeta + h and an Airy function psi / k^2::

    psi = (A + B zeta) exp(zeta) + (C + D eta) exp(-eta)
    sigma_zz = -psi,  sigma_Lz = -i psi',  sigma_LL = psi'',  sigma_TT = nu (psi'' - psi)
    2 mu k (i u_L, u_z) = (1 - nu) psi'' + nu psi,  (1 - nu) psi''' - (2 - nu) psi'
    sigma_Tz = t_T cosh(eta) / cosh(h),  sigma_LT = i t_T sinh(eta) / cosh(h)

The traction fixes psi(0) = -t_z and psi'(0) = i t_L, the bond u_L = u_z = 0 at zeta = -h.

Source: I. N. Sneddon, Fourier Transforms (1951), 45-47 and 52; K. L. Johnson, Contact Mechanics
(1985), 2.2 and 5.8. The tests compare it with the point forces of contact.py and with finite
elements.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..core.arrays import Array, Complex
from ..core.defaults import POISSONS_RATIO
from ..core.errors import ElasticError
from ..core.modes import STRESS

FIELD = STRESS + tuple(f"{name}_{axis}" for name in STRESS for axis in "xyz")
"""What `Layer.transfer` gives: six stresses, then the three derivatives of each of them."""


@dataclass(frozen=True)
class Layer:
    """An elastic layer on rigid ground. thickness: m, inf for a half space; poisson: its ratio.

    Young's modulus does not matter for stress. Raises ElasticError unless thickness > 0 and
    0 <= poisson <= 0.5.
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
        """Raises ElasticError unless the layer has this depth, m."""
        if not 0 < depth < self.thickness:
            raise ElasticError(
                f"depth is {depth} m in a layer of {self.thickness} m; it must lie between 0 and "
                "the thickness"
            )

    def transfer(self, kx: Array, ky: Array, depth: float) -> Complex:
        """FIELD at z = -depth under unit traction exp(i k.x).

        kx, ky: (...) 1/m; depth: m, above 0 and above the ground
        Returns (..., 24, 3): Pa and Pa/m per Pa of the traction along x, y and z. Tension is
        positive, so pressing is a negative traction along z. The mean traction (k = 0) of a half
        space has no limit of sigma_xx and sigma_yy; their mean over directions stands for it.
        Raises ElasticError where there is no such depth.
        """
        self.check_depth(depth)
        kx, ky = np.broadcast_arrays(np.asarray(kx, float), np.asarray(ky, float))
        k = np.hypot(kx, ky)
        zero = k == 0
        safe = np.where(zero, 1.0, k)
        c, s = np.where(zero, 1.0, kx / safe), ky / safe
        along, across = self._plane(safe, depth), self._twist(safe, depth)
        # (..., 24, 3) first in the axes L, T, z of the wave, then turned to x, y, z
        out = np.zeros((*k.shape, 6, 3), complex)
        slope = np.zeros_like(out)
        for source, part in ((along, 0), (across, 0), (along, 1), (across, 1)):
            _turn(out if part == 0 else slope, c, s, {key: v[part] for key, v in source.items()})
        out[zero] = self._uniform()
        slope[zero] = 0.0
        gradient = np.stack([1j * kx[..., None, None] * out, 1j * ky[..., None, None] * out, slope])
        gradient = np.moveaxis(gradient, 0, -2).reshape(*k.shape, 18, 3)
        return np.concatenate([out, gradient], axis=-2)

    def _plane(self, k: Array, depth: float) -> dict[str, tuple[Any, Any]]:
        """Stress and its derivative along z under traction along L ("?L") and z ("?z")."""
        zeta = -k * depth
        psi = self._airy(k, zeta)  # (4 derivatives, ..., 2 loads)
        found = {}
        for load, column in (("L", 1), ("z", 0)):
            p = psi[..., column] * (1j if load == "L" else -1.0)
            parts = {
                "zz": (-p[0], -p[1]),
                "Lz": (-1j * p[1], -1j * p[2]),
                "LL": (p[2], p[3]),
                "TT": (self.poisson * (p[2] - p[0]), self.poisson * (p[3] - p[1])),
            }
            for name, (value, slope) in parts.items():
                found[name + load] = (value, k * slope)
        return found

    def _airy(self, k: Array, zeta: Array) -> Array:
        """psi and its first three derivatives by zeta (4, ..., 2) for psi(0) = 1 and psi'(0) = 1,
        the other one zero."""
        up = np.exp(zeta)
        if np.isinf(self.thickness):
            a = np.stack([np.ones_like(k), np.zeros_like(k)], axis=-1)
            b = np.stack([-np.ones_like(k), np.ones_like(k)], axis=-1)
            return np.stack([(a + (n + zeta[..., None]) * b) * up[..., None] for n in range(4)])
        h = k * self.thickness

        def terms(n: int, zeta: Array) -> Array:
            """(..., 4) of the n-th derivative by A, B, C, D."""
            eta = zeta + h
            rise, fall = np.exp(zeta), (-1) ** n * np.exp(-eta)
            return np.stack([rise, (n + zeta) * rise, fall, (eta - n) * fall], axis=-1)

        nu, bottom = self.poisson, -h
        rows = [
            terms(0, 0 * h),
            terms(1, 0 * h),
            (1 - nu) * terms(2, bottom) + nu * terms(0, bottom),
            (1 - nu) * terms(3, bottom) - (2 - nu) * terms(1, bottom),
        ]
        constants = np.linalg.inv(np.stack(rows, axis=-2))[..., :2]
        return np.stack(
            [np.einsum("...c,...cl->...l", terms(n, zeta), constants) for n in range(4)]
        )

    def _twist(self, k: Array, depth: float) -> dict[str, tuple[Any, Any]]:
        """The same under traction along T."""
        fall = np.exp(-k * depth)
        if np.isinf(self.thickness):
            cosh, sinh = fall, fall
        else:  # cosh(eta) / cosh(h) without overflow
            echo = np.exp(-2 * k * (self.thickness - depth))
            base = fall / (1 + np.exp(-2 * k * self.thickness))
            cosh, sinh = base * (1 + echo), base * (1 - echo)
        return {"TzT": (cosh + 0j, k * sinh + 0j), "LTT": (1j * sinh, 1j * k * cosh)}

    def _uniform(self) -> Array:
        """Stress (6, 3) under uniform traction."""
        side = (1 + 2 * self.poisson) / 2
        if np.isfinite(self.thickness):
            side = self.poisson / (1 - self.poisson)
        stress = np.zeros((6, 3))
        stress[[0, 1, 2], 2] = side, side, 1.0
        stress[4, 0] = stress[3, 1] = 1.0
        return stress


def _turn(out: Complex, c: Array, s: Array, wave: dict[str, Complex]) -> None:
    """Add a wave's stress, named by component and load in its axes L, T, z, to `out` (..., 6, 3).

    c, s: (...) L = (c, s, 0), T = (-s, c, 0)
    """
    stress: dict[str, dict[int, Any]] = {
        "LL": {0: c * c, 1: s * s, 5: c * s},
        "TT": {0: s * s, 1: c * c, 5: -c * s},
        "LT": {0: -2 * c * s, 1: 2 * c * s, 5: c * c - s * s},
        "zz": {2: 1.0},
        "Lz": {4: c, 3: s},
        "Tz": {4: -s, 3: c},
    }
    load: dict[str, dict[int, Any]] = {"L": {0: c, 1: s}, "T": {0: -s, 1: c}, "z": {2: 1.0}}
    for name, value in wave.items():
        for row, turned in stress[name[:2]].items():
            for column, share in load[name[2]].items():
                out[..., row, column] += turned * share * value
