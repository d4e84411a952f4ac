# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Inversion of a response by generalised least squares, and the residual that shows broken pads.

The pads measure the stresses v = A s, where A is the response (pads x modes) and s holds the
amplitudes of the modes. The estimated quantities are:

    components    H W v,   H = T (D W A)^+ D
    covariance    H H'
    chi-square    |N' D W v|^2

    W             diag(1 / noise)
    D             (1 + W c (W c)')^(-1/2), where c are the stresses on the pads by one standard
                  deviation of a drift that all pads have in common
    T             matrix from amplitudes to components, see Modes.components
    (D W A)^+     pseudo-inverse of D W A
    N             its columns are an orthonormal basis of the vectors that are orthogonal to all
                  columns of D W A; their number is the number of degrees of freedom

A column of D W A counts as a combination of the other columns if what remains after subtracting
such a combination is shorter than `RANK_TOLERANCE` times the longest column.

Source: Kiyota & Shinoda, eqs. 2 to 5, are the closed forms for one layout; docs/physics.md corrects
their eqs. 4 and 5.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TypedDict

import numpy as np

from .arrays import Array, Index, Mask, multiply
from .modes import Modes
from .symmetry import Structure

RANK_TOLERANCE = 1e-4
"""Smallest length of the independent part of a mode's response with which the mode's amplitude is
computed, relative to the strongest response of a mode.

The response of a mode is the vector of the stresses on the pads, divided by their noise. Its
independent part is the one that modes with a stronger response do not explain. With a smaller one,
the amplitude would be mostly noise.
"""

LEAK_TOLERANCE = 1e-3
"""Largest part of a component that may be invisible to the pads, relative to the whole component.

A component of stress or gradient is a sum of modes. Its part along combinations of modes to which
no pad responds cannot be measured. If this part is larger, the component is not observed (NaN).
"""

FALSE_ALARM = 1e-3
"""Probability that a row (sample of one cube) of a cube without fault is reported with a high
residual, only because of the noise of the pads that its calibration states.

The residual measures how far the stresses on the pads are from any linear stress field.
"""

SUSPECT_MARGIN = 2 * math.log(100)
"""Difference of two values of chi-square (sum of squared residuals divided by the noise) at which
one broken pad explains a sample 100 times as well as another pad: 2 ln(100).

A pad is not suspected to be broken if leaving out another pad lowers chi-square by this much more.
"""


@dataclass(frozen=True, eq=False)
class Estimator:
    """Linear maps from the stresses on the pads to the estimated quantities and to the residual.

    They hold for one response, one noise and one set of usable pads. The T targets are the
    quantities to estimate, usually the 15 components of stress and gradient.

    Attributes:
        matrix: Map (T, P) from pad stresses to targets. Rows of targets that the pads do not
            determine are NaN, columns of pads that are left out are 0.
        observed: Whether the pads determine each target (T,).
        covariance: Covariance of the targets by the noise of the pads (T, T), NaN in the rows and
            columns of targets that the pads do not determine.
        null: Map (D, P) from pad stresses to D combinations that only noise makes differ from 0,
            each with the standard deviation 1. Chi-square is the sum of their squares.
        limit: Chi-square that noise alone exceeds with probability `FALSE_ALARM`; NaN if there are
            no more pads than determined modes (D = 0).
        rank: Number of combinations of modes that the pads determine.
        noise: Standard deviation of the pads' stresses (P,), in Pa.
    """

    matrix: Array
    observed: Mask
    covariance: Array
    null: Array
    limit: float
    rank: int
    noise: Array

    @property
    def dof(self) -> int:
        """Number D of degrees of freedom of chi-square."""
        return len(self.null)

    def find_suspects(self, pad_stress: Array) -> Mask:
        """Find each pad that, as the only broken pad of a cube, would explain a high chi-square.

        Leaving out pad p lowers chi-square by (u_p . z)^2 / |u_p|^2. Here z = `null` v are the
        residuals, whose squares add up to chi-square, v the stresses on the pads, and u_p column p
        of `null` times the noise of pad p. A row (sample of one cube) has suspects if its
        chi-square is above the limit, and falls below the limit for one degree of freedom less when
        the best pad (the one that lowers it most) is left out. The suspects are the best pad and
        all pads that lower chi-square as much within `SUSPECT_MARGIN`. If these are all pads, none
        is a suspect.

        Two pads that are opposite each other through the centre of a symmetric cube are always
        suspects together, because a gradient absorbs their difference.

        Args:
            pad_stress: Stresses on the pads (N, P), in Pa.

        Returns:
            Whether each pad is a suspect (N, P).
        """
        v = np.atleast_2d(np.asarray(pad_stress, dtype=float))
        if self.dof < 2:
            return np.zeros(v.shape, dtype=bool)
        z = v @ self.null.T
        columns = self.null * self.noise
        size = np.sum(columns**2, axis=0)
        # If a pad is needed to determine the modes, any value of it leaves the residual unchanged,
        # so it cannot be checked.
        is_checked = size > LEAK_TOLERANCE**2
        safe_size = np.where(is_checked, size, 1)
        reduction = (z @ columns) ** 2 / safe_size
        drop = np.where(is_checked, reduction, -np.inf)

        chi2 = np.sum(z**2, axis=1)
        best = drop.max(axis=1)
        is_similar = drop > best[:, None] - SUSPECT_MARGIN
        # After leaving out the broken pad, chi-square is that of noise alone, with one degree of
        # freedom less because there is one pad less.
        limit_without = compute_chi2_limit(self.dof - 1)
        is_explained = (chi2 > self.limit) & (chi2 - best < limit_without)
        is_specific = is_similar.sum(axis=1) < is_checked.sum()
        has_suspects = is_explained & is_specific
        suspects: Mask = is_similar & has_suspects[:, None]
        return suspects


def make_estimator(
    response: Array,
    noise: Array,
    modes: Modes,
    missing: Sequence[int] | Index = (),
    neglect: Sequence[str] = (),
    targets: Array | None = None,
    drift: Array | float = 0.0,
) -> Estimator:
    """Construct the estimator of a response, by generalised least squares.

    Args:
        response: Response (P, M), in Pa per Pa.
        noise: Standard deviation of each pad's stress (P,), in Pa.
        modes: The M modes.
        missing: Numbers of pads that are not used.
        neglect: Names of modes whose amplitude is assumed to be zero. Components with a part along
            these modes count as not observed.
        targets: Map (T, M) from the amplitudes of the modes to the quantities to estimate; by
            default the 15 components of stress and gradient.
        drift: Stress on each pad, in Pa, by one standard deviation of a drift that all pads have in
            common (P,).
    """
    if targets is None:
        targets = modes.components
    n_pads = len(response)
    n_targets = len(targets)
    all_pads = np.arange(n_pads)
    all_modes = np.arange(modes.n_modes)
    present = np.setdiff1d(all_pads, np.asarray(missing, dtype=int))
    kept = np.setdiff1d(all_modes, modes.find_indices(neglect))

    # The stresses on the pads divided by the noise (standard deviation) of each pad, and multiplied
    # by the matrix D (`decorrelate`), are uncorrelated and have the standard deviation 1, so that
    # the sum of the squared residuals is chi-square.
    common = np.broadcast_to(drift, n_pads)[present] / noise[present]
    growth = np.sqrt(1 + (common**2).sum())
    decorrelate = np.eye(len(present)) - np.outer(common, common) / (growth + growth**2)
    used_response = response[np.ix_(present, kept)]
    whitened = multiply(decorrelate, used_response / noise[present, None])
    seen = _orthonormalise(whitened, len(present), RANK_TOLERANCE)
    rank = seen.shape[1]
    # The whitened response is Q R, with orthonormal columns Q. The rows of R are
    # orthonormalised to V', and the same operations on the rows of Q' yield G. V G is then the
    # pseudo-inverse of Q R.
    reduced = multiply(seen.T, whitened)
    stacked = np.concatenate([reduced.T, seen])
    n_kept = len(kept)
    both = _orthonormalise(stacked, n_kept)
    v = both[:n_kept]
    g = both[n_kept:].T

    kept_targets = targets[:, kept]
    on_seen = multiply(kept_targets, v)
    unseen_targets = kept_targets - multiply(on_seen, v.T)
    unseen = np.linalg.norm(unseen_targets, axis=1)
    # Neglected modes are assumed to be zero and not measured, so a target with a part along them
    # counts as not observed.
    neglected_targets = np.delete(targets, kept, axis=1)
    neglected = np.linalg.norm(neglected_targets, axis=1)
    size = np.linalg.norm(targets, axis=1)
    observed = (size > 0) & (unseen + neglected <= LEAK_TOLERANCE * size)

    # `half` maps pad stresses divided by their noise to targets. The noise of those stresses has
    # the variance 1, so half half' is the covariance of the targets by noise.
    half = multiply(multiply(on_seen, g), decorrelate)
    matrix = np.zeros((n_targets, n_pads))
    matrix[:, present] = half / noise[present]
    matrix[~observed] = np.nan
    covariance: Array = multiply(half, half.T)
    covariance[~observed] = np.nan
    covariance[:, ~observed] = np.nan
    # The residual is the part of the pad stresses that is orthogonal to the response of every mode
    # (linear stress field). Noise, faults and stress fields that are not linear cause it.
    n_present = len(present)
    explained = multiply(seen, seen.T)
    unexplained = np.eye(n_present) - explained
    null = np.zeros((n_present - rank, n_pads))
    residual = _orthonormalise(unexplained, n_present, count=len(null))
    null[:, present] = multiply(residual.T, decorrelate) / noise[present]
    return Estimator(
        matrix=matrix,
        observed=observed,
        covariance=covariance,
        null=null,
        limit=compute_chi2_limit(len(null)),
        rank=rank,
        noise=noise,
    )


def _orthonormalise(
    vectors: Array,
    length: int,
    tolerance: float = 0.0,
    count: int | None = None,
) -> Array:
    """Orthonormalise the columns of a matrix by the Gram-Schmidt process with column pivoting.

    The last bits of the decompositions of LAPACK depend on the processor. Here, sums have a fixed
    order, so the result has the same bits everywhere.

    Args:
        vectors: Matrix (n, m).
        length: Number of leading rows of the matrix in which the resulting columns are orthonormal.
            The same linear combinations are applied to the other rows.
        tolerance: Smallest length that a column may have after its projection on earlier results
            is subtracted, relative to the longest column. Shorter columns are not used.
        count: Maximum number of columns to return; by default the rank.

    Returns:
        Matrix (n, r) with r columns.
    """
    remainder = np.array(vectors)
    result = np.zeros((len(remainder), 0))
    limit = 0.0
    if count is None:
        count = min(length, remainder.shape[1])
    for _ in range(count):
        squares = remainder[:length] ** 2
        sizes = np.sqrt(squares.sum(axis=0))
        longest = int(np.argmax(sizes))
        limit = limit or tolerance * sizes[longest]
        if sizes[longest] <= limit:
            break
        chosen = remainder[:, longest]
        # The part along earlier results was already subtracted. What rounding errors left of it is
        # subtracted here.
        products = result[:length] * chosen[:length, None]
        overlap = products.sum(axis=0)
        chosen = chosen - (result * overlap).sum(axis=1)
        square = (chosen[:length] ** 2).sum()
        chosen = chosen / np.sqrt(square)
        products = remainder[:length] * chosen[:length, None]
        overlap = products.sum(axis=0)
        remainder = remainder - chosen[:, None] * overlap
        result = np.column_stack([result, chosen])
    return result


def estimate_modes(
    response: Array,
    modes: Modes,
    neglect: Sequence[str] = (),
) -> Estimator:
    """Construct the estimator of the amplitudes of all modes, for pads that have equal noise.

    Args:
        response: Response (P, M), in Pa per Pa.
        modes: The M modes.
        neglect: Names of modes whose amplitude is assumed to be zero.
    """
    return make_estimator(
        response,
        noise=np.ones(len(response)),
        modes=modes,
        neglect=neglect,
        targets=np.eye(modes.n_modes),
    )


class ResponseSummary(TypedDict):
    """Which modes a response determines, and how well, in types that JSON has.

    None stands for a value that does not exist.

    Attributes:
        pads: Names of the pads.
        modes: Names of the modes.
        n_coefficients: Number of coefficients of the response.
        rank_uniform: Rank of the columns of the response for modes of uniform stress.
        condition_uniform: Condition number of the same columns.
        rank_gradient: Rank of the columns of the response for modes with a gradient.
        condition_gradient: Condition number of the same columns.
        unobservable: Names of modes that the pads do not determine.
        noise: Standard deviation of each mode's amplitude if every pad's stress has the standard
            deviation 1.
    """

    pads: list[str]
    modes: list[str]
    n_coefficients: int
    rank_uniform: int
    condition_uniform: float | None
    rank_gradient: int
    condition_gradient: float | None
    unobservable: list[str]
    noise: dict[str, float | None]


def summarize_response(
    structure: Structure,
    response: Array,
    neglect: Sequence[str] = (),
) -> ResponseSummary:
    """Summarise which modes a response determines, and how well.

    Args:
        structure: Layout and modes of the response.
        response: Response (P, M), in Pa per Pa.
        neglect: Names of modes whose amplitude is assumed to be zero.
    """
    modes = structure.modes
    estimator = estimate_modes(response, modes, neglect)
    is_kept = ~np.isin(modes.names, neglect)
    is_uniform = np.any(modes.stress, axis=(1, 2))
    is_gradient = np.any(modes.gradient, axis=(1, 2, 3))
    rank_uniform, condition_uniform = _find_rank(response[:, is_uniform & is_kept])
    rank_gradient, condition_gradient = _find_rank(response[:, is_gradient & is_kept])

    deviations = np.sqrt(np.diag(estimator.covariance)).tolist()
    noise = {
        name: None if math.isnan(deviation) else deviation
        for name, deviation in zip(modes.names, deviations, strict=True)
    }
    return {
        "pads": list(structure.layout.pads),
        "modes": list(modes.names),
        "n_coefficients": structure.n_coefficients,
        "rank_uniform": rank_uniform,
        "condition_uniform": condition_uniform,
        "rank_gradient": rank_gradient,
        "condition_gradient": condition_gradient,
        "unobservable": [name for name, value in noise.items() if value is None],
        "noise": noise,
    }


def _find_rank(columns: Array) -> tuple[int, float | None]:
    """Return rank and condition number (None if the rank is 0) of columns of a response."""
    s = np.linalg.svd(columns, compute_uv=False)
    if s.size:
        s = s[s > RANK_TOLERANCE * s[0]]
    condition = float(s[0] / s[-1]) if s.size else None
    return len(s), condition


def compute_chi2_tail(x: float, dof: int) -> float:
    """Compute the probability that chi-square of `dof` degrees of freedom exceeds x.

    It is the regularised upper incomplete gamma function Q(dof/2, x/2), which follows from
    Q(1/2, h) = erfc(sqrt(h)) or Q(1, h) = exp(-h) by the recurrence
    Q(a + 1, h) = Q(a, h) + h^a exp(-h) / Gamma(a + 1).
    """
    if x <= 0:
        return 1.0
    h = x / 2
    if dof % 2:
        a = 0.5
        tail = math.erfc(math.sqrt(h))
    else:
        a = 1.0
        tail = math.exp(-h)
    while a < dof / 2:
        # The product h^a exp(-h) / Gamma(a + 1) is computed by logarithms, because h^a alone
        # overflows for many degrees of freedom.
        log_term = a * math.log(h) - h - math.lgamma(a + 1)
        tail += math.exp(log_term)
        a += 1
    return tail


@lru_cache
def compute_chi2_limit(dof: int) -> float:
    """Compute the value that chi-square exceeds with the probability `FALSE_ALARM`.

    Args:
        dof: Number of degrees of freedom; the result is NaN if it is 0.

    Returns:
        The value to 10 digits, because the last bits of logarithms depend on the processor.
    """
    if dof < 1:
        return math.nan
    low = 0.0
    high = 1.0
    while compute_chi2_tail(high, dof) > FALSE_ALARM:
        high *= 2
    # Each bisection halves the interval, and a float has 53 bits of precision.
    for _ in range(60):
        centre = (low + high) / 2
        if compute_chi2_tail(centre, dof) > FALSE_ALARM:
            low = centre
        else:
            high = centre
    return float(f"{high:.10g}")
