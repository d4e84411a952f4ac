"""Inversion of a response by weighted least squares: what the pads see, how well, and the residual.

With W = diag(1 / noise) and W A = U1 S V1' (the singular values above RANK_TOLERANCE of the
largest):

    components    T V1 S^-1 U1' W v           T: components of a state, see Modes.components
    covariance    T V1 S^-2 V1' T'
    chi-square    |U2' W v|^2                 U2: the rest of U, with as many columns as there is
    redundancy

Source: the paper's eqs. 2 to 5 are the closed forms for one layout; docs/physics.md corrects 4 and
5.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from .modes import Modes
from .symmetry import Structure

RANK_TOLERANCE = 1e-4
"""The pads do not see a combination of modes whose response is below this part of the strongest."""
LEAK_TOLERANCE = 1e-3
"""A component is observed when at most this part of it lies along combinations not seen."""
FALSE_ALARM = 1e-3
"""Probability that pads with nothing but their stated noise set the residual bit."""
SUSPECT_MARGIN = 2 * math.log(100)
"""Of chi-square: a pad is cleared when another explains the residual with odds of 100 to 1."""


@dataclass(frozen=True, eq=False)
class Estimator:
    """Linear maps for one response, noise and set of present pads.

    matrix: (T, P) pad stresses to targets; rows of unobserved targets are NaN, columns of missing
        pads are 0
    observed: (T,) bool, which targets the pads see
    covariance: (T, T), NaN in rows and columns of unobserved targets
    null: (dof, P) whitened rows; chi-square is the sum of squares of null @ v
    limit: chi-square that noise alone exceeds with probability FALSE_ALARM; NaN without redundancy
    rank: number of combinations of modes that the pads see
    """

    matrix: np.ndarray
    observed: np.ndarray
    covariance: np.ndarray
    null: np.ndarray
    limit: float
    rank: int
    noise: np.ndarray

    @property
    def dof(self) -> int:
        return len(self.null)

    def chi2(self, pad_stress: np.ndarray) -> np.ndarray:
        """(N,) chi-square of pad stresses (N, P); missing pads must hold any finite number."""
        return np.sum((np.asarray(pad_stress) @ self.null.T) ** 2, axis=-1)

    def suspects(self, pad_stress: np.ndarray) -> np.ndarray:
        """(N, P) bool: pads that, broken alone, explain a bad chi-square of pad stresses (N, P).

        Leaving out pad p lowers chi-square by (u_p . z)^2 / |u_p|^2, with z = null v and u_p its
        column of U2'. A row has suspects when chi-square is above its limit, but below the limit of
        one degree less without the best pad. The best pad is one, and so are all that explain as
        much within SUSPECT_MARGIN; if that is every pad, none is. Pads that lie opposite each other
        through the centre of a symmetric cube always come as a pair: a gradient takes up their
        difference.
        """
        v = np.atleast_2d(np.asarray(pad_stress, dtype=float))
        if self.dof < 2:
            return np.zeros(v.shape, dtype=bool)
        z = v @ self.null.T
        columns = self.null * self.noise
        size = np.sum(columns**2, axis=0)
        checked = size > LEAK_TOLERANCE**2  # an unchecked pad could be anything without a residual
        drop = np.where(checked, (z @ columns) ** 2 / np.where(checked, size, 1), -np.inf)
        chi2, best = np.sum(z**2, axis=1), drop.max(axis=1)
        marked = drop > best[:, None] - SUSPECT_MARGIN
        explained = (chi2 > self.limit) & (chi2 - best < chi2_limit(self.dof - 1, FALSE_ALARM))
        return marked & (explained & (marked.sum(axis=1) < checked.sum()))[:, None]


def make_estimator(
    response: np.ndarray,
    noise: np.ndarray,
    modes: Modes,
    missing: Sequence[int] | np.ndarray = (),
    neglect: Sequence[str] = (),
    targets: np.ndarray | None = None,
) -> Estimator:
    """The estimator of the COMPONENTS (or of targets @ state) from the pads that are not missing.

    response: (P, M) in Pa per Pa
    noise: (P,) standard deviation of each pad's stress, Pa
    missing: indices of pads to leave out
    neglect: names of modes stated to be zero; they are unobserved themselves
    targets: (T, M), by default modes.components
    """
    response, noise = np.asarray(response, dtype=float), np.asarray(noise, dtype=float)
    targets = modes.components if targets is None else np.asarray(targets, dtype=float)
    present = np.setdiff1d(np.arange(len(response)), np.asarray(missing, dtype=int))
    kept = np.setdiff1d(np.arange(modes.n_modes), modes.index(neglect))
    whitened = response[np.ix_(present, kept)] / noise[present, None]
    u, s, vt = np.linalg.svd(whitened, full_matrices=True)
    rank = int(np.sum(s > RANK_TOLERANCE * s[0])) if s.size and s[0] > 0 else 0
    v1 = vt[:rank].T
    t = targets[:, kept]
    size = np.linalg.norm(targets, axis=1)
    leak = np.linalg.norm(t - (t @ v1) @ v1.T, axis=1) + np.linalg.norm(
        np.delete(targets, kept, axis=1), axis=1
    )
    observed = (size > 0) & (leak <= LEAK_TOLERANCE * size)

    half = t @ v1 / s[:rank]
    matrix = np.zeros((len(targets), len(response)))
    matrix[:, present] = half @ u[:, :rank].T / noise[present]
    matrix[~observed] = np.nan
    covariance = half @ half.T
    covariance[~observed] = covariance[:, ~observed] = np.nan
    null = np.zeros((len(present) - rank, len(response)))
    null[:, present] = u[:, rank:].T / noise[present]
    return Estimator(
        matrix, observed, covariance, null, chi2_limit(len(null), FALSE_ALARM), rank, noise
    )


def chi2_tail(x: float, dof: int) -> float:
    """Probability that a chi-square of dof degrees of freedom exceeds x: Q(dof/2, x/2) by
    recurrence."""
    if x <= 0:
        return 1.0
    h = x / 2
    a, tail = (0.5, math.erfc(math.sqrt(h))) if dof % 2 else (1.0, math.exp(-h))
    while a < dof / 2:
        tail += math.exp(a * math.log(h) - h - math.lgamma(a + 1))
        a += 1
    return tail


def summary(
    structure: Structure, response: np.ndarray, neglect: Sequence[str] = ()
) -> dict[str, Any]:
    """What a response (P, M) lets a layout see, in plain types.

    rank_uniform, rank_gradient: of the columns of uniform and of gradient modes
    condition_uniform, condition_gradient: their condition numbers
    unobservable: modes that the pads do not see
    noise: {mode: standard deviation per unit of pad noise}
    None stands for a value that does not exist.
    """
    modes, n_pads = structure.modes, structure.layout.n_pads
    estimator = make_estimator(
        response, np.ones(n_pads), modes, neglect=neglect, targets=np.eye(modes.n_modes)
    )
    deviations = np.sqrt(np.diag(estimator.covariance))
    result: dict[str, Any] = {
        "pads": list(structure.layout.pads),
        "modes": list(modes.names),
        "n_coefficients": structure.n_coefficients,
    }
    uniform = np.any(modes.stress, axis=(1, 2)) & ~np.isin(modes.names, neglect)
    gradient = np.any(modes.gradient, axis=(1, 2, 3)) & ~np.isin(modes.names, neglect)
    for part, columns in (("uniform", uniform), ("gradient", gradient)):
        s = np.linalg.svd(response[:, columns], compute_uv=False)
        s = s[s > RANK_TOLERANCE * s[0]] if s.size else s
        result[f"rank_{part}"] = len(s)
        result[f"condition_{part}"] = float(s[0] / s[-1]) if s.size else None
    result["unobservable"] = [
        name for name, seen in zip(modes.names, estimator.observed, strict=True) if not seen
    ]
    result["noise"] = {
        name: float(d) if seen else None
        for name, d, seen in zip(modes.names, deviations, estimator.observed, strict=True)
    }
    return result


@lru_cache
def chi2_limit(dof: int, probability: float) -> float:
    """The x that chi-square of dof degrees of freedom exceeds with this probability; NaN for
    dof = 0."""
    if dof < 1:
        return math.nan
    low, high = 0.0, 1.0
    while chi2_tail(high, dof) > probability:
        high *= 2
    for _ in range(100):
        middle = (low + high) / 2
        low, high = (middle, high) if chi2_tail(middle, dof) > probability else (low, middle)
    return high
