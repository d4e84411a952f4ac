"""Newton's method for displacements u (dofs,) at which forces balance, some of them prescribed.

Each step lowers the energy (by Armijo's rule) or the forces out of balance. One linear combination
of the unknowns may be held at zero, row @ u = 0: the force that holds it is a multiple of the row.

Source: J. Nocedal, S. J. Wright, Numerical Optimization (2006), 3.1 and 18.1.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import SuperLU, splu

from cube_tensor_driver.core.arrays import Array

_TOLERANCE = 1e-9
"""Of the correction, over the largest displacement."""
_ITERATIONS = 60
"""A deep rod's tries converge at 32 to 54; given up at 30, they cost twice the corrections."""
_LONGEST = 0.3
"""Largest correction of any unknown in one step."""
_SHORTENINGS = 7
_ARMIJO = 1e-4


class Balance(NamedTuple):
    """Forces out of balance (dofs,) and energy at some displacements."""

    force: Array
    energy: float


@dataclass(frozen=True, eq=False)
class Constraints:
    """What the unknowns must fulfil.

    prescribed: (dofs,) values, NaN where free
    row: (dofs,) weights with row @ u = 0, or None
    """

    prescribed: Array
    row: Array | None = None


def find_balance(
    u: Array,
    constraints: Constraints,
    balance: Callable[[Array], Balance | None],
    tangents: Callable[[Array], Iterable[sp.csr_matrix]],
    linear: bool = False,
) -> Array | None:
    """u (dofs,) in balance from the guess u; None where the method does not converge.

    balance: gives None where u is not possible
    tangents: the derivative of the forces, then what to try where that one gives no descent
    linear: one step is enough
    """
    fixed = ~np.isnan(constraints.prescribed)
    free = np.flatnonzero(~fixed)
    jump = np.where(fixed, constraints.prescribed - u, 0.0)
    held = None if constraints.row is None else constraints.row[free]
    state = balance(u)
    for _ in range(_ITERATIONS):
        if state is None:
            return None
        tried = None
        for matrix in tangents(u):
            right = -(state.force + matrix @ jump)[free]
            product = 0.0 if constraints.row is None else -float(constraints.row @ u)
            change = jump.copy()
            change[free] = _correction(matrix[free][:, free], right, held, product)
            if linear or np.abs(change).max() < _TOLERANCE * np.abs(u).max():
                return np.asarray(u + change)
            if jump.any():  # prescribed displacements are not shortened
                tried = u + change, balance(u + change)
            else:
                tried = _search(u, change, state, balance, free, held)
            if tried is not None:
                break
        if tried is None:
            return None
        u, state = tried
        jump = np.zeros_like(u)
    return None


def factors(matrix: sp.spmatrix) -> SuperLU:
    """LU factors of a nearly symmetric matrix, in half the time of free pivoting."""
    return splu(
        matrix.tocsc(),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.01,
        options={"SymmetricMode": True},
    )


def _correction(matrix: sp.csr_matrix, right: Array, held: Array | None, product: float) -> Array:
    """x with matrix @ x = right. With `held`: plus a force along it, so that held @ x = product."""
    if held is None:
        return np.asarray(factors(matrix).solve(right))
    border = sp.csr_matrix(held)
    bordered = sp.bmat([[matrix, border.T], [border, None]])
    return np.asarray(factors(bordered).solve(np.append(right, product))[:-1])


def _search(
    u: Array,
    change: Array,
    state: Balance,
    balance: Callable[[Array], Balance | None],
    free: NDArray[np.int64],
    held: Array | None,
) -> tuple[Array, Balance] | None:
    """As much of a change of u as lowers the energy or the forces out of balance; None: nothing."""
    slope = float(state.force @ change)
    left = _unbalanced(state.force[free], held)
    size = min(1.0, _LONGEST / np.abs(change).max())
    for _ in range(_SHORTENINGS):
        there = balance(u + size * change)
        if there is not None:
            lower_force = _unbalanced(there.force[free], held) < left
            lower_energy = slope < 0 and there.energy <= state.energy + _ARMIJO * size * slope
            if lower_force or lower_energy:
                return u + size * change, there
        size /= 2
    return None


def _unbalanced(force: Array, held: Array | None) -> float:
    """Size of the forces that nothing holds."""
    if held is not None:
        force = force - held * (held @ force) / (held @ held)
    return float(np.linalg.norm(force))
