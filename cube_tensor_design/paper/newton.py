# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Newton's method for displacements u (dofs,) at which forces balance, some of them prescribed.

Each step lowers the energy (by Armijo's rule) or the forces out of balance. One linear combination
of the unknowns may be held at zero, row @ u = 0; the force that holds it is a multiple of the row.

Source: J. Nocedal, S. J. Wright, Numerical Optimization (2006), 3.1 and 18.1.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import SuperLU, splu

from cube_tensor_driver.core.arrays import Array, Index

TOLERANCE = 1e-9
"""Ratio of the largest correction to the largest displacement below which Newton's method has
converged."""
MAX_ITERATIONS = 60
"""Number of corrections after which the method counts as failed. For a deep rod it converges in 32
to 54; with a limit of 30 the load steps would be halved, at twice the number of corrections."""
MAX_CORRECTION = 0.3
"""Largest change of any unknown displacement in one step of Newton's method, in d0 (half the side
of the cube)."""
MAX_HALVINGS = 7
"""Maximum number of times that one correction is halved, before Newton's method gives up."""
ARMIJO = 1e-4
"""Share of the decrease of the energy in the linearised problem that a step must reach at least
(Armijo's rule)."""


class Balance(NamedTuple):
    """Nodal forces (dofs,) out of balance, and the energy, at given displacements."""

    force: Array
    energy: float


def find_balance(
    u: Array,
    prescribed: Array,
    rows: Array,
    balance: Callable[[Array], Balance | None],
    tangent: Callable[[Array], sp.csr_matrix],
    linear: bool = False,
) -> Array | None:
    """Find displacements at which the forces on the free unknowns balance.

    Args:
        u: (dofs,) the guess.
        prescribed: (dofs,) prescribed displacements; NaN where an unknown is free.
        rows: (k, dofs) weights of k combinations of the unknowns u that are held, rows @ u = 0.
        balance: Returns forces and energy, or None at displacements that are not possible.
        tangent: Returns the derivative of the forces by the displacements.
        linear: Whether the problem is linear, so that one step solves it.

    Returns:
        u (dofs,), or None where the method does not converge.
    """
    fixed = ~np.isnan(prescribed)
    # The first step moves the prescribed unknowns to their values, where they stay.
    jump = np.where(fixed, prescribed - u, 0.0)
    search = _Search(np.flatnonzero(~fixed), rows, balance)
    state = balance(u)
    for _ in range(MAX_ITERATIONS):
        if state is None:
            return None
        change = search.compute_correction(u, state, tangent(u), jump)
        is_small = np.abs(change).max() < TOLERANCE * np.abs(u).max()
        if linear or is_small:
            return u + change
        if jump.any():  # Prescribed displacements are taken as a whole.
            u = u + change
            state = balance(u)
            jump = np.zeros_like(u)
            continue
        reached = search.descend(u, state, change)
        if reached is None:
            return None
        u, state = reached
    return None


class _Search:
    """Computes corrections of the free unknowns `free` (m,), and how much of a correction is
    taken."""

    def __init__(
        self,
        free: Index,
        rows: Array,
        balance: Callable[[Array], Balance | None],
    ) -> None:
        self._free = free
        self._rows = rows
        self._balance = balance

    def compute_correction(
        self,
        u: Array,
        state: Balance,
        matrix: sp.csr_matrix,
        jump: Array,
    ) -> Array:
        """Return the change (dofs,) of u that balances the linearised forces.

        Args:
            u: (dofs,) displacements.
            state: Forces and energy at u.
            matrix: Derivative of the forces by the displacements.
            jump: (dofs,) change of the prescribed unknowns.
        """
        free = self._free
        right = -(state.force + matrix @ jump)[free]
        inner = matrix[free][:, free]
        # The border adds Lagrange multipliers, which are forces along the rows. They make rows @ (u
        # + change) = 0.
        border = sp.csr_matrix(self._rows[:, free])
        bordered = sp.bmat([[inner, border.T], [border, None]])
        right = np.append(right, -self._rows @ u)
        change = jump.copy()
        change[free] = factorise(bordered).solve(right)[: len(free)]
        return change

    def descend(
        self,
        u: Array,
        state: Balance,
        change: Array,
    ) -> tuple[Array, Balance] | None:
        """Return u plus as much of a change as lowers the energy or the forces out of balance, and
        the state there; None if no part of the change does so."""
        slope = float(state.force @ change)
        unbalanced = self._measure_unbalanced(state.force)
        # Linearised forces are valid near u only, so the step has a largest length.
        size = min(1.0, MAX_CORRECTION / np.abs(change).max())
        for _ in range(MAX_HALVINGS):
            reached = self._balance(u + size * change)
            if reached is not None:
                lower_force = self._measure_unbalanced(reached.force) < unbalanced
                allowed = state.energy + ARMIJO * size * slope
                lower_energy = slope < 0 and reached.energy <= allowed
                if lower_force or lower_energy:
                    return u + size * change, reached
            size /= 2
        return None

    def _measure_unbalanced(self, force: Array) -> float:
        """Return the norm of the forces that neither a prescribed unknown nor a held combination
        bears."""
        held = self._rows[:, self._free]
        # The part of the force along a row is the force that holds the combination.
        along_rows = np.linalg.lstsq(held.T, force[self._free])[0]
        return float(np.linalg.norm(force[self._free] - along_rows @ held))


def factorise(matrix: sp.spmatrix) -> SuperLU:
    """Return LU factors of a nearly symmetric matrix, in half the time of free pivoting."""
    return splu(
        matrix.tocsc(),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.01,
        options={"SymmetricMode": True},
    )
