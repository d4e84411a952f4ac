"""Elastomer in plane strain or stress, for small and for finite strain; F is the gradient of the
deformation.

    linear      W = lambda/2 (tr e)^2 + mu e : e with e = (F + F')/2 - 1
    finite      compressible neo-Hookean, W = mu/2 (F : F - 2 - 2 ln J) + lambda/2 (ln J)^2 with J =
    det F > 0,
                the same lambda and mu at small strain

All take F (..., 2, 2). Source: J. Bonet, R. D. Wood, Nonlinear Continuum Mechanics for Finite
Element Analysis (2008), 6.4.3.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_ONE = np.eye(2)


@dataclass(frozen=True, eq=False)
class Material:
    """lam, mu: Lame's, Pa, of shapes that broadcast against F without its last two axes."""

    lam: Array
    mu: Array
    finite: bool

    def energy(self, f: Array) -> Array:
        """W (...), Pa."""
        if not self.finite:
            e = _strain(f)
            return np.asarray(
                self.lam / 2 * _trace(e) ** 2 + self.mu * np.sum(e * e, axis=(-2, -1))
            )
        log = np.log(determinant(f))
        return np.asarray(
            self.mu / 2 * (np.sum(f * f, axis=(-2, -1)) - 2 - 2 * log) + self.lam / 2 * log**2
        )

    def stress(self, f: Array) -> Array:
        """First Piola-Kirchhoff P = dW/dF (..., 2, 2), Pa: force over undeformed area."""
        lam, mu = self.lam[..., None, None], self.mu[..., None, None]
        if not self.finite:
            e = _strain(f)
            return np.asarray(lam * _trace(e)[..., None, None] * _ONE + 2 * mu * e)
        g = _inverse_transposed(f)
        return np.asarray(mu * (f - g) + lam * np.log(determinant(f))[..., None, None] * g)

    def cauchy(self, f: Array) -> Array:
        """True stress (..., 2, 2), Pa: P F' / J, force over deformed area; at small strain there is
        no difference."""
        p = self.stress(f)
        return p @ np.swapaxes(f, -2, -1) / determinant(f)[..., None, None] if self.finite else p

    def moduli(self, f: Array) -> Array:
        """dP_ij/dF_kl (..., 2, 2, 2, 2), Pa."""
        lam, mu = (x[..., None, None, None, None] for x in (self.lam, self.mu))
        same, crossed = np.einsum("ik,jl->ijkl", _ONE, _ONE), np.einsum("il,jk->ijkl", _ONE, _ONE)
        if not self.finite:
            return np.asarray(lam * np.einsum("ij,kl->ijkl", _ONE, _ONE) + mu * (same + crossed))
        g = _inverse_transposed(f)
        log = np.log(determinant(f))[..., None, None, None, None]
        outer = g[..., :, :, None, None] * g[..., None, None, :, :]  # g_ij g_kl
        turned = np.swapaxes(outer, -3, -1)  # g_il g_kj
        return np.asarray(mu * same + (mu - lam * log) * turned + lam * outer)


def determinant(f: Array) -> Array:
    return np.asarray(f[..., 0, 0] * f[..., 1, 1] - f[..., 0, 1] * f[..., 1, 0])


def _inverse_transposed(f: Array) -> Array:
    cofactors = np.stack(
        [f[..., 1, 1], -f[..., 1, 0], -f[..., 0, 1], f[..., 0, 0]], axis=-1
    ).reshape(f.shape)
    return np.asarray(cofactors / determinant(f)[..., None, None])


def _strain(f: Array) -> Array:
    return np.asarray((f + np.swapaxes(f, -2, -1)) / 2 - _ONE)


def _trace(e: Array) -> Array:
    return np.asarray(e[..., 0, 0] + e[..., 1, 1])
