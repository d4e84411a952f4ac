"""Linear elasticity of a box with a bonded cube, solved in its positive part.

Where box and cube are symmetric under the mirrors x_k -> -x_k, every load splits into parts of one
*parity* (+1 even or -1 odd for each axis), and each part is solved where all coordinates are
positive. On the plane x_k = 0 an even field has u_k = 0; an odd one has the other components zero.
Along an axis without a mirror all of the box is solved, and the parity is 0.
Lengths are in units of d0. For all w::

    int sigma(u) : eps(w) dV = int_outer w . (sigma_load n) dS = int sigma_load : eps(w) dV

The last step holds because the load is in equilibrium; it also makes the loads balance to rounding.
Source: T. J. R. Hughes, The Finite Element Method (1987), chapters 2 and 4.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
import skfem
from numpy.typing import NDArray
from scipy.sparse.linalg import splu
from skfem.helpers import ddot, dot, sym_grad, trace

from cube_tensor_driver.core.arrays import Array

from .pads import face_weights, interval_weights

Parity = tuple[int, ...]

_SAME = 1e-13
"""Coordinates closer than this are the same: they are known to rounding, and the smallest element
has 1e-10."""


def _at(x: Array, value: float | Array) -> NDArray[np.bool_]:
    return np.asarray(np.abs(x - value) < _SAME)


def lame(young: float, poisson: float, plane: str = "strain") -> tuple[float, float]:
    """Lame's lambda and mu, Pa; for plane stress the lambda that makes sigma_yy vanish."""
    mu = young / (2.0 * (1.0 + poisson))
    lam = young * poisson / ((1.0 + poisson) * (1.0 - 2.0 * poisson))
    if plane == "stress":
        lam = 2.0 * lam * mu / (lam + 2.0 * mu)
    return lam, mu


def stiffness(basis: skfem.Basis, lame_: tuple[float, float]) -> sp.csr_matrix:
    """K_ij = int lambda div w_i div w_j + 2 mu eps(w_i) : eps(w_j) dV over a basis's elements."""
    return _virtual_work.assemble(basis, lam=lame_[0], mu=lame_[1]).tocsr()


def brick_stiffness(basis: skfem.Basis, lame_: tuple[float, float]) -> sp.csr_matrix:
    """The same where every element is a box along the axes, a stretched unit cube.

    With scaled coordinates X_a = x_a / h_a, int d_a f d_b g dV = V / (h_a h_b) int d_a f d_b g dX.
    """
    corners = basis.mesh.p[:, basis.mesh.t[:, basis.tind]]
    h = np.ptp(corners, axis=1)  # (dim, elements)
    ends = np.array([0.0, 1.0])
    cell = skfem.MeshHex.init_tensor(ends, ends, ends)  # its corners in the order of mesh.block's
    unit = skfem.Basis(cell, basis.elem.elem, quadrature=(basis.X, basis.W))
    # (nodes, dim, points)
    gradient = np.stack([unit.basis[m][0].grad[:, 0] for m in range(unit.Nbfun)])
    slopes = np.einsum("maq,nbq,q->abmn", gradient, gradient, unit.dx[0])
    stretch = np.prod(h, axis=0) / (h[:, None] * h[None])  # (dim, dim, elements)
    dim, (lam, mu) = len(h), lame_
    laplace = mu * np.einsum("aae,aamn->emn", stretch, slopes)
    total = sp.csr_matrix((basis.N, basis.N))
    for i, j in itertools.product(range(dim), repeat=2):  # of w, and of u
        block = np.einsum("e,mn->emn", stretch[i, j], lam * slopes[i, j] + mu * slopes[j, i])
        block += laplace if i == j else 0.0
        rows = np.broadcast_to(basis.element_dofs[i::dim].T[:, :, None], block.shape)
        columns = np.broadcast_to(basis.element_dofs[j::dim].T[:, None, :], block.shape)
        entries = (block.ravel(), (rows.ravel(), columns.ravel()))
        total += sp.csr_matrix(entries, total.shape)
    return total


@skfem.BilinearForm
def _virtual_work(u, w, p):
    e, d = sym_grad(u), sym_grad(w)
    return p.lam * trace(e) * trace(d) + 2.0 * p.mu * ddot(e, d)


@skfem.LinearForm
def _load_work(w, p):
    return ddot(p.sigma, sym_grad(w))


@skfem.LinearForm
def _traction_work(w, p):
    return dot(p.t, w)


class Solid:
    """A meshed body with a cube; triangles of order 4 in the plane, 27-node bricks in space.

    basis: the elements; its dofs are the unknown displacements
    positions: (dim, dofs) of each of them, d0; component: (dofs,) the axis that it is along
    body: stiffness of the body without the cube; total: of both (dofs, dofs)
    parities: of the fields that make up any field

    Parameters: mesh: from elastic.mesh, lengths in d0; an axis has a mirror where the mesh is
    positive. body: Lame's lambda and mu of the body. cube: the same of the cube in the same unit,
    or None for a rigid one. ground: the lower face is held; then the cube is elastic.
    """

    def __init__(
        self,
        mesh: skfem.Mesh,
        body: tuple[float, float],
        cube: tuple[float, float] | None,
        ground: bool = False,
    ) -> None:
        self.dim = int(mesh.dim())
        self.order = 4 if self.dim == 2 else 2
        scalar = skfem.ElementTriP4() if self.dim == 2 else skfem.ElementHex2()
        element = skfem.ElementVector(scalar)
        inside = np.all(np.abs(mesh.p[:, mesh.t].mean(axis=1)) < 1.0, axis=0)
        signs = [(0,) if low < -_SAME else (1, -1) for low in mesh.p.min(axis=1)]
        self.parities: list[Parity] = list(itertools.product(*signs))
        self._ground = ground
        self.basis = skfem.Basis(mesh, element, intorder=2 * self.order)
        self.positions = self.basis.doflocs
        self.component = np.zeros(self.basis.N, dtype=int)
        for k in range(self.dim):
            self.component[self.basis.get_dofs(elements=True).all(f"u^{k + 1}")] = k
        self.rigid = cube is None
        # (dim, dofs): on which lines of the product grid of bricks each dof lies
        lines = [np.unique(np.round(x, 9), return_inverse=True) for x in self.positions]
        self._grid = np.stack([index for _, index in lines])
        self._first_equal_axis = _first_equal([line for line, _ in lines])
        self._last_solve: _Factors | None = None
        assemble = stiffness if self.dim == 2 else brick_stiffness
        self.body = assemble(self._part(~inside), body)
        self.total = self.body if cube is None else self.body + assemble(self._part(inside), cube)

    def linear_forces(self, stress: Array, gradient: Array) -> Array:
        """Nodal forces (dofs,) of the field sigma_ij = S_ij + G_ijk x_k.

        stress: S (dim, dim); gradient: G (dim, dim, dim)
        """
        x = self.basis.default_parameters()["x"]
        sigma = stress[:, :, None, None] + np.einsum("ijk,kep->ijep", gradient, np.asarray(x))
        return _load_work.assemble(self.basis, sigma=sigma)

    def outer_forces(self, parity: Parity, field: Callable[[Array], Array]) -> Array:
        """Nodal forces (dofs, n) of the part of one parity of n fields, tractions on outer faces.

        field: from points (q, dim) to stress (q, n, dim, dim); it should be in equilibrium
        """
        mesh = self.basis.mesh
        edges = mesh.boundary_facets()
        middle = mesh.p[:, mesh.facets[:, edges]].mean(axis=1)
        total: Array | float = 0.0
        for axis in range(self.dim):
            outer = edges[_at(middle[axis], mesh.p[axis].max())]
            face = skfem.FacetBasis(mesh, self.basis.elem, facets=outer, intorder=6)
            x = np.asarray(face.default_parameters()["x"])
            stress = _parity_part(field, x.reshape(self.dim, -1).T, parity)
            traction = stress[..., axis]  # (q, n, dim)
            loads = np.moveaxis(traction, (1, 2), (0, 1)).reshape(-1, *x.shape)
            total = total + np.stack([_traction_work.assemble(face, t=t) for t in loads], axis=1)
        return np.asarray(total)

    def solve(self, parity: Parity, forces: Array) -> Array:
        """Displacements (dofs, n) under nodal forces (dofs, n) of one parity."""
        sorted_parity, swap = self.with_sorted_axes(parity)
        if self._last_solve is None or self._last_solve.parity != sorted_parity:
            self._last_solve = None  # gives its memory back first
            self._last_solve = self._factors(sorted_parity)
        rows = swap[self._last_solve.free]
        u = np.zeros_like(forces)
        u[rows] = self._last_solve.factors.solve(forces[rows])
        return u

    def _factors(self, parity: Parity) -> _Factors:
        free = np.flatnonzero(~self._held(parity))
        ordering = "MMD_AT_PLUS_A"
        if self.dim == 3:  # five times faster and half the memory of SuperLU's own ordering
            free = free[nested_dissection(self._grid[:, free])]
            ordering = "NATURAL"
        matrix = self.total[free][:, free].tocsc()
        symmetric = {"SymmetricMode": True}
        factors = splu(matrix, permc_spec=ordering, diag_pivot_thresh=0.0, options=symmetric)
        return _Factors(parity, free, factors)

    def with_sorted_axes(self, parity: Parity) -> tuple[Parity, NDArray[np.int64]]:
        """This parity with equal axes of the product grid sorted by it, and the dofs that swap.

        u[swap] is the field u with its axes exchanged in this way. Parities that become the same
        one share their factors.
        """
        if self.dim == 2:  # triangles are on no product grid
            return parity, np.arange(self.basis.N)
        axes = np.arange(self.dim)
        for first in set(self._first_equal_axis):
            equal = np.flatnonzero(np.array(self._first_equal_axis) == first)
            axes[equal] = sorted(equal, key=lambda k: parity[k])
        # Component k at x is, before the exchange, component axes[k] at y with y[axes[k]] = x[k].
        ends = [*(self._grid.max(axis=1) + 1), self.dim]
        here = np.ravel_multi_index((*self._grid, self.component), ends)
        there = np.ravel_multi_index((*self._grid[np.argsort(axes)], axes[self.component]), ends)
        order = np.argsort(here)
        return tuple(parity[k] for k in axes), order[np.searchsorted(here, there, sorter=order)]

    def reactions(self, u: Array) -> Array:
        """Nodal forces (dofs, n) on the body by what holds it: on the cube's surface, the cube."""
        return np.asarray(self.body @ u)

    def pad_weights(
        self, parity: Parity, axis: int, side: float, intervals: Sequence[tuple[float, float]]
    ) -> tuple[NDArray[np.int64], Array]:
        """Dofs (m,) and weights (m,): weights @ reactions[dofs] is the mean normal stress of a pad
        on the face x_axis = side, which is 1 or -1.

        intervals: of the pad, in [-1, 1], one per other axis
        """
        others = [k for k in range(self.dim) if k != axis]
        # What is on the other side of a mirror is read on this one.
        face = side if parity[axis] == 0 else 1.0
        sign = -face if side == face else -parity[axis]
        x = self.positions
        on_face = _at(x[axis], face) & np.all(np.abs(x[others]) < 1.0 + _SAME, axis=0)
        dofs = np.flatnonzero(on_face & (self.component == axis))
        weights = np.full(len(dofs), float(sign))
        for k, (start, stop) in zip(others, intervals, strict=True):
            nodes, index = np.unique(np.round(x[k, dofs], 14), return_inverse=True)
            if parity[k] == 0:
                w = face_weights(nodes, self.order, start, stop)
            else:
                w = interval_weights(nodes, self.order, parity[k], start, stop)
            weights *= w[index] / (stop - start)
        return dofs, weights

    def _part(self, elements: NDArray[np.bool_]) -> skfem.Basis:
        """The basis on some of the elements."""
        return skfem.Basis(
            self.basis.mesh,
            self.basis.elem,
            elements=np.flatnonzero(elements),
            intorder=2 * self.order,
        )

    def _held(self, parity: Parity) -> NDArray[np.bool_]:
        """(dofs,) which are zero: by mirrors and ground, in a rigid cube, or to stop rigid motions.

        A translation is odd along its axis, a rotation along both axes of its plane. A rigid cube
        can be held altogether, since these motions are free for the body, too.
        """
        x, c = self.positions, self.component
        held = np.zeros(len(c), dtype=bool)
        for k, sign in enumerate(parity):
            if sign != 0:
                held |= _at(x[k], 0.0) & ((c == k) == (sign > 0))
        if self._ground:
            return held | _at(x[-1], x[-1].min())
        if self.rigid:
            return held | np.all(np.abs(x) < 1.0 + _SAME, axis=0)

        def has(*odd: int) -> bool:
            return all(sign == 0 or (sign < 0) == (k in odd) for k, sign in enumerate(parity))

        for k in range(self.dim):
            if has(k):  # translation
                held |= (c == k) & np.all(_at(x, 0.0), axis=0)
        for i, j in itertools.combinations(range(self.dim), 2):
            if has(i, j):  # rotation
                at = np.zeros(self.dim)
                at[j] = 1.0
                held |= (c == i) & np.all(_at(x, at[:, None]), axis=0)
        return held


@dataclass(frozen=True, eq=False)
class _Factors:
    """Factors of the stiffness of the free dofs under one parity."""

    parity: Parity
    free: NDArray[np.int64]
    factors: Any


def _first_equal(lines: Sequence[Array]) -> list[int]:
    """For each axis the first one that has the same lines."""

    def equal(a: Array, b: Array) -> bool:
        return len(a) == len(b) and bool(np.allclose(a, b))

    return [next(m for m in range(k + 1) if equal(lines[m], line)) for k, line in enumerate(lines)]


def _parity_part(field: Callable[[Array], Array], x: Array, parity: Parity) -> Array:
    """The part of one parity of a stress field at x (q, dim): the mean over mirrored points."""
    signs = list(itertools.product((1.0, -1.0), repeat=len(parity)))
    part = np.zeros(())
    for mirror in map(np.array, signs):
        weight = np.prod(np.where(mirror < 0, parity, 1)) / len(signs)
        part = part + weight * np.outer(mirror, mirror) * field(x * mirror)
    return part


def nested_dissection(grid: NDArray[np.int64]) -> NDArray[np.int64]:
    """Elimination order (n,) of nodes of a product grid of quadratic elements.

    grid: (dim, n) the lines on which each node lies. Both halves of the grid come first, each in
    such an order, then the cut between them.
    Source: A. George, SIAM J. Numer. Anal. 10 (1973) 345.
    """

    def order(part: NDArray[np.int64]) -> NDArray[np.int64]:
        axis = int(np.argmax(np.ptp(grid[:, part], axis=1)))
        along = grid[axis, part]
        ends = np.unique(along[along % 2 == 0])[1:-1]  # planes between elements
        if len(part) < 60 or len(ends) == 0:
            return part
        cut = ends[len(ends) // 2]
        return np.concatenate(
            [order(part[along < cut]), order(part[along > cut]), part[along == cut]]
        )

    return order(np.arange(grid.shape[1]))
