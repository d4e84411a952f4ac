# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Elastomer in plane strain or stress, for small and for finite strain.

F (2, 2, ...) is the gradient of the deformation, W the energy per volume of the undeformed body:

    linear    W = λ/2 (tr e)² + μ e : e            with e = (F + Fᵀ)/2 - 1
    finite    W = μ/2 (F : F - 2 - 2 ln J) + λ/2 (ln J)²   with J = det F > 0

The finite one is the compressible neo-Hookean material; at small strain both are the same.

Source: J. Bonet, R. D. Wood, Nonlinear Continuum Mechanics for Finite Element Analysis (2008),
6.4.3.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from skfem.helpers import ddot, det, inv, mul, trace, transpose

from cube_tensor_driver.core.arrays import Array

IDENTITY = np.eye(2)[:, :, None, None]
"""Unit tensor 1 (2, 2, 1, 1), for all elements and quadrature points."""


@dataclass(frozen=True, eq=False)
class Material:
    """A linear or a neo-Hookean material; E elements have Q quadrature points each.

    Attributes:
        lam: (E, 1) Lamé's constant λ, in Pa.
        mu: (E, 1) Lamé's constant μ, in Pa.
        finite: Whether the material is neo-Hookean.
    """

    lam: Array
    mu: Array
    finite: bool

    def compute_energy(self, f: Array) -> Array:
        """Return W (E, Q), in Pa, where the deformation is F (2, 2, E, Q)."""
        if not self.finite:
            return ddot(f - IDENTITY, self.compute_stress(f)) / 2
        log = np.log(det(f))
        square = ddot(f, f)
        distortion = self.mu / 2 * (square - 2 - 2 * log)
        return distortion + self.lam / 2 * log**2

    def compute_stress(self, f: Array) -> Array:
        """Return the first Piola-Kirchhoff stress P = dW/dF (2, 2, E, Q), in Pa.

        P is the force over the undeformed area.
        """
        if not self.finite:
            strain = (f + transpose(f)) / 2 - IDENTITY
            volume_part = self.lam * trace(strain) * IDENTITY
            return volume_part + 2 * self.mu * strain
        inverse = transpose(inv(f))
        log = np.log(det(f))
        pressure_part = self.lam * log * inverse
        return self.mu * (f - inverse) + pressure_part

    def compute_cauchy_stress(self, f: Array) -> Array:
        """Return the true stress P Fᵀ / J (2, 2, E, Q), in Pa: the force over the deformed area.

        In a linear material the true stress is P itself.
        """
        p = self.compute_stress(f)
        if not self.finite:
            return p
        return mul(p, transpose(f)) / det(f)

    def compute_moduli(self, f: Array) -> Array:
        """Return the moduli dP_ij/dF_kl (2, 2, 2, 2, E, Q), in Pa; Q is 1 for a linear material,
        which has the same moduli at all points."""
        inverse = IDENTITY
        log = 0.0
        if self.finite:
            inverse = transpose(inv(f))
            log = np.log(det(f))
        identity = np.einsum("ik...,jl...->ijkl...", IDENTITY, IDENTITY)
        # With g = F^-T (1 for a linear material), these are g_ij g_kl and g_il g_kj.
        outer = np.einsum("ij...,kl...->ijkl...", inverse, inverse)
        crossed = np.swapaxes(outer, 1, 3)
        # The derivative of F^-T by F is -crossed.
        shear_part = self.mu * identity + (self.mu - self.lam * log) * crossed
        return shear_part + self.lam * outer
