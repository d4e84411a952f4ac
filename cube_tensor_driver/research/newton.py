"""Newton's method for displacements u (dofs,) at which forces balance, some of them prescribed.

Each step lowers the energy (by Armijo's rule) or the forces out of balance. A row may hold one
product of the unknowns, row @ u = 0: its force is a multiple of the row. Source: J. Nocedal, S. J.
Wright, Numerical Optimization (2006), 3.1 and 18.1.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import SuperLU, splu

Array = NDArray[np.float64]
State = tuple[Array, float]  # forces out of balance (dofs,), energy

_TOLERANCE = 1e-9  # of the correction over the largest displacement
_ITERATIONS = 30
_LONGEST = 0.3  # correction of any unknown at once
_SHORTENINGS = 7


def find_balance(
    u: Array,
    prescribed: Array,
    row: Array | None,
    balance: Callable[[Array], State | None],
    tangents: Callable[[Array], Iterable[sp.csr_matrix]],
    linear: bool = False,
) -> Array | None:
    """u (dofs,) in balance from the guess u; None where the method does not get there.

    prescribed: (dofs,), NaN where free; row: (dofs,) or None
    balance: None where u is not possible; tangents: the derivative of the forces, then what may be
    taken in its place where it leads nowhere; linear: the first step is the last
    """
    free, jump = (
        np.flatnonzero(np.isnan(prescribed)),
        np.where(np.isnan(prescribed), 0.0, prescribed - u),
    )
    held = None if row is None else row[free]
    state = balance(u)
    for _ in range(_ITERATIONS):
        if state is None:
            return None
        tried = None
        for matrix in tangents(u):
            right = -(state[0] + matrix @ jump)[free]
            change = jump.copy()
            change[free] = _correction(
                matrix[free][:, free], right, held, 0.0 if row is None else -float(row @ u)
            )
            if linear or np.abs(change).max() < _TOLERANCE * np.abs(u).max():
                return np.asarray(u + change)
            # prescribed displacements are taken over whole
            whole = jump.any()
            tried = (
                (u + change, balance(u + change))
                if whole
                else _search(u, change, state, balance, free, held)
            )
            if tried is not None:
                break
        if tried is None:
            return None
        (u, state), jump = tried, np.zeros_like(u)
    return None


def factors(matrix: sp.spmatrix) -> SuperLU:
    """Of a nearly symmetric matrix: half the time of free pivoting."""
    return splu(
        matrix.tocsc(),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.01,
        options={"SymmetricMode": True},
    )


def _correction(matrix: sp.csr_matrix, right: Array, held: Array | None, product: float) -> Array:
    """x with matrix @ x = right, or with a force along `held` besides, and held @ x = product."""
    if held is None:
        return np.asarray(factors(matrix).solve(right))
    border = sp.csr_matrix(held)
    whole = sp.bmat([[matrix, border.T], [border, None]])
    return np.asarray(factors(whole).solve(np.append(right, product))[:-1])


def _search(
    u: Array,
    change: Array,
    state: State,
    balance: Callable[[Array], State | None],
    free: NDArray[np.int64],
    held: Array | None,
) -> tuple[Array, State] | None:
    """As much of a change of u as lowers the energy or the forces out of balance."""
    force, energy = state
    slope, size = float(force @ change), min(1.0, _LONGEST / np.abs(change).max())
    for _ in range(_SHORTENINGS):
        there = balance(u + size * change)
        if there is not None and (
            _left(there[0][free], held) < _left(force[free], held)
            or (slope < 0 and there[1] <= energy + 1e-4 * size * slope)
        ):
            return u + size * change, there
        size /= 2
    return None


def _left(force: Array, held: Array | None) -> float:
    """Size of the forces that nothing holds."""
    if held is not None:
        force = force - held * (held @ force) / (held @ held)
    return float(np.linalg.norm(force))
