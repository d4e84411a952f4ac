"""Elastomer in plane strain or stress, for small and for finite strain.

F (..., 2, 2) is the gradient of the deformation, W the energy per volume of the undeformed body:

    linear    W = λ/2 (tr e)² + μ e : e            with e = (F + Fᵀ)/2 - 1
    finite    W = μ/2 (F : F - 2 - 2 ln J) + λ/2 (ln J)²   with J = det F > 0

The finite one is the compressible neo-Hookean material; at small strain both are the same.

Source: J. Bonet, R. D. Wood, Nonlinear Continuum Mechanics for Finite Element Analysis (2008),
6.4.3.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cube_tensor_driver.core.arrays import Array

_ONE = np.eye(2)


@dataclass(frozen=True, eq=False)
class Material:
    """A linear or a neo-Hookean material.

    Attributes:
        lam: Lamé's constant λ in Pa, of a shape that broadcasts against F without its last axes.
        mu: Lamé's constant μ, the same.
        finite: Whether the material is neo-Hookean.
    """

    lam: Array
    mu: Array
    finite: bool

    def energy(self, f: Array) -> Array:
        """Return W (...), in Pa."""
        if not self.finite:
            strain = _strain(f)
            squares = np.sum(strain * strain, axis=(-2, -1))
            dilation = _trace(strain)
            volume_part = self.lam / 2 * dilation**2
            return np.asarray(volume_part + self.mu * squares)
        log = np.log(np.linalg.det(f))
        squares = np.sum(f * f, axis=(-2, -1))
        distortion = self.mu / 2 * (squares - 2 - 2 * log)
        return np.asarray(distortion + self.lam / 2 * log**2)

    def stress(self, f: Array) -> Array:
        """Return the first Piola-Kirchhoff stress P = dW/dF (..., 2, 2), in Pa.

        It is the force over the undeformed area.
        """
        # Two more axes for the components i and j.
        two_axes = (..., None, None)
        lam = self.lam[two_axes]
        mu = self.mu[two_axes]
        if not self.finite:
            strain = _strain(f)
            dilation = _trace(strain)[two_axes]
            return lam * dilation * _ONE + 2 * mu * strain
        inverse = _inverse_transposed(f)
        log = np.log(np.linalg.det(f))[two_axes]
        return np.asarray(mu * (f - inverse) + lam * log * inverse)

    def cauchy(self, f: Array) -> Array:
        """Return the true stress P Fᵀ / J (..., 2, 2), in Pa: the force over the deformed area.

        A linear material does not distinguish it from P.
        """
        p = self.stress(f)
        if not self.finite:
            return p
        transposed = np.swapaxes(f, -2, -1)
        volume_ratio = np.linalg.det(f)[..., None, None]
        return np.asarray(p @ transposed / volume_ratio)

    def moduli(self, f: Array) -> Array:
        """Return dP_ij/dF_kl (..., 2, 2, 2, 2), in Pa."""
        four_axes = (..., None, None, None, None)
        lam = self.lam[four_axes]
        mu = self.mu[four_axes]
        identity = np.einsum("ik,jl->ijkl", _ONE, _ONE)
        if not self.finite:
            outer = np.einsum("ij,kl->ijkl", _ONE, _ONE)
            crossed = np.einsum("il,jk->ijkl", _ONE, _ONE)
            return np.asarray(lam * outer + mu * (identity + crossed))
        inverse = _inverse_transposed(f)
        log = np.log(np.linalg.det(f))[four_axes]
        # With g = F^-T, these are g_ij g_kl and g_il g_kj.
        outer = np.einsum("...ij,...kl->...ijkl", inverse, inverse)
        crossed = np.swapaxes(outer, -3, -1)
        # The derivative of F^-T by F is -crossed.
        shear_part = mu * identity + (mu - lam * log) * crossed
        return np.asarray(shear_part + lam * outer)


def _inverse_transposed(f: Array) -> Array:
    inverse = np.linalg.inv(f)
    return np.swapaxes(inverse, -2, -1)


def _strain(f: Array) -> Array:
    transposed = np.swapaxes(f, -2, -1)
    return (f + transposed) / 2 - _ONE


def _trace(e: Array) -> Array:
    return e[..., 0, 0] + e[..., 1, 1]
