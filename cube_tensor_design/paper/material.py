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
    """lam, mu: Lamé's constants, Pa, of shapes that broadcast against F without its last axes."""

    lam: Array
    mu: Array
    finite: bool

    def energy(self, f: Array) -> Array:
        """W (...), Pa."""
        if not self.finite:
            e = _strain(f)
            squares = np.sum(e * e, axis=(-2, -1))
            return np.asarray(self.lam / 2 * _trace(e) ** 2 + self.mu * squares)
        log = np.log(determinant(f))
        squares = np.sum(f * f, axis=(-2, -1))
        return np.asarray(self.mu / 2 * (squares - 2 - 2 * log) + self.lam / 2 * log**2)

    def stress(self, f: Array) -> Array:
        """First Piola-Kirchhoff stress P = dW/dF (..., 2, 2), Pa: force over undeformed area."""
        lam, mu = self.lam[..., None, None], self.mu[..., None, None]
        if not self.finite:
            e = _strain(f)
            return np.asarray(lam * _trace(e)[..., None, None] * _ONE + 2 * mu * e)
        g = _inverse_transposed(f)
        return np.asarray(mu * (f - g) + lam * np.log(determinant(f))[..., None, None] * g)

    def cauchy(self, f: Array) -> Array:
        """True stress P Fᵀ / J (..., 2, 2), Pa: force over deformed area; P itself if linear."""
        p = self.stress(f)
        if not self.finite:
            return p
        return np.asarray(p @ np.swapaxes(f, -2, -1) / determinant(f)[..., None, None])

    def moduli(self, f: Array) -> Array:
        """dP_ij/dF_kl (..., 2, 2, 2, 2), Pa."""
        lam, mu = (x[..., None, None, None, None] for x in (self.lam, self.mu))
        same = np.einsum("ik,jl->ijkl", _ONE, _ONE)
        if not self.finite:
            crossed = np.einsum("il,jk->ijkl", _ONE, _ONE)
            return np.asarray(lam * np.einsum("ij,kl->ijkl", _ONE, _ONE) + mu * (same + crossed))
        g = _inverse_transposed(f)
        log = np.log(determinant(f))[..., None, None, None, None]
        outer = g[..., :, :, None, None] * g[..., None, None, :, :]  # g_ij g_kl
        crossed = np.swapaxes(outer, -3, -1)  # g_il g_kj
        return np.asarray(mu * same + (mu - lam * log) * crossed + lam * outer)


def determinant(f: Array) -> Array:
    """det F (...)."""
    return np.asarray(f[..., 0, 0] * f[..., 1, 1] - f[..., 0, 1] * f[..., 1, 0])


def _inverse_transposed(f: Array) -> Array:
    entries = [f[..., 1, 1], -f[..., 1, 0], -f[..., 0, 1], f[..., 0, 0]]
    cofactors = np.stack(entries, axis=-1).reshape(f.shape)
    return np.asarray(cofactors / determinant(f)[..., None, None])


def _strain(f: Array) -> Array:
    return np.asarray((f + np.swapaxes(f, -2, -1)) / 2 - _ONE)


def _trace(e: Array) -> Array:
    return np.asarray(e[..., 0, 0] + e[..., 1, 1])
