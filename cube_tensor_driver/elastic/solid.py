"""Linear elasticity of a box with a bonded cube in its middle, solved in its positive quarter or
eighth.

Box and cube are symmetric under the mirrors x_k -> -x_k, so every load splits into parts of one
*parity* (+1 even or -1 odd for each axis), and each part is solved where all coordinates are
positive. On the plane x_k = 0 an even field has u_k = 0; an odd one has the other components zero.
Lengths in units of d0.

    int sigma(u) : eps(w) dV = int_outer w . (sigma_load n) dS = int sigma_load : eps(w) dV   for
    all w

The last step holds because the load is in equilibrium; it also makes the loads balance to rounding.
Source: T. J. R. Hughes, The Finite Element Method (1987), chapters 2 and 4.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import scipy.sparse as sp
import skfem
from numpy.typing import NDArray
from scipy.sparse.linalg import splu
from skfem.helpers import ddot, dot, sym_grad, trace

from .pads import interval_weights

Array = NDArray[np.float64]
Parity = tuple[int, ...]

_SAME = 1e-13  # coordinates are known to rounding; the smallest element is 1e-10


def _at(x: Array, value: float | Array) -> NDArray[np.bool_]:
    return np.asarray(np.abs(x - value) < _SAME)


def lame(young: float, poisson: float, plane: str = "strain") -> tuple[float, float]:
    """Lame's lambda and mu, Pa; for plane stress the lambda that makes sigma_yy vanish."""
    mu = young / (2.0 * (1.0 + poisson))
    lam = young * poisson / ((1.0 + poisson) * (1.0 - 2.0 * poisson))
    return (2.0 * lam * mu / (lam + 2.0 * mu) if plane == "stress" else lam), mu


def stiffness(basis: skfem.Basis, lame_: tuple[float, float]) -> sp.csr_matrix:
    """K_ij = int lambda div w_i div w_j + 2 mu eps(w_i) : eps(w_j) dV over the elements of the
    basis."""
    return _virtual_work.assemble(basis, lam=lame_[0], mu=lame_[1]).tocsr()


def brick_stiffness(basis: skfem.Basis, lame_: tuple[float, float]) -> sp.csr_matrix:
    """The same where every element is a box along the axes: all of them are the unit cube's,
    stretched.

    With scaled coordinates X_a = x_a / h_a:  int d_a f d_b g dV = V / (h_a h_b) int d_a f d_b g dX.
    """
    corners = basis.mesh.p[:, basis.mesh.t[:, basis.tind]]
    h = np.ptp(corners, axis=1)  # (dim, elements)
    cell = skfem.MeshHex.init_tensor(
        *[np.array([0.0, 1.0])] * 3
    )  # its corners in the order of mesh.block's
    unit = skfem.Basis(cell, basis.elem.elem, quadrature=(basis.X, basis.W))
    gradient = np.stack(
        [unit.basis[m][0].grad[:, 0] for m in range(unit.Nbfun)]
    )  # (nodes, dim, points)
    slopes = np.einsum("maq,nbq,q->abmn", gradient, gradient, unit.dx[0])
    stretch = np.prod(h, axis=0) / (h[:, None] * h[None])  # (dim, dim, elements)
    dim, (lam, mu) = len(h), lame_
    laplace = mu * np.einsum("aae,aamn->emn", stretch, slopes)
    total = sp.csr_matrix((basis.N, basis.N))
    for i, j in itertools.product(range(dim), repeat=2):  # of w, and of u
        block = np.einsum("e,mn->emn", stretch[i, j], lam * slopes[i, j] + mu * slopes[j, i])
        block += laplace if i == j else 0.0
        rows, columns = (
            basis.element_dofs[i::dim].T[:, :, None],
            basis.element_dofs[j::dim].T[:, None, :],
        )
        place = (
            np.broadcast_to(rows, block.shape).ravel(),
            np.broadcast_to(columns, block.shape).ravel(),
        )
        total += sp.csr_matrix((block.ravel(), place), total.shape)
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

    mesh  from elastic.mesh: the positive part of the box, lengths in d0
    body  Lame's lambda and mu of the body
    cube  the same of the cube, in the same unit, or None for a rigid one
    """

    def __init__(
        self, mesh: skfem.Mesh, body: tuple[float, float], cube: tuple[float, float] | None
    ) -> None:
        self.dim = int(mesh.dim())
        self.order = 4 if self.dim == 2 else 2
        element = skfem.ElementVector(
            skfem.ElementTriP4() if self.dim == 2 else skfem.ElementHex2()
        )
        inside = np.all(mesh.p[:, mesh.t].mean(axis=1) < 1.0, axis=0)
        self.basis = skfem.Basis(mesh, element, intorder=2 * self.order)
        self.place = self.basis.doflocs  # (dim, dofs)
        self.component = np.zeros(self.basis.N, dtype=int)
        for k in range(self.dim):
            self.component[self.basis.get_dofs(elements=True).all(f"u^{k + 1}")] = k
        self.rigid = cube is None
        # lines of the product grid of bricks on which each dof lies, and of each axis the first
        # axis like it
        lines = [np.unique(np.round(x, 9), return_inverse=True) for x in self.place]
        self._grid = np.stack([index for _, index in lines])
        self._kind = [
            next(
                m
                for m in range(k + 1)
                if len(lines[m][0]) == len(line) and np.allclose(lines[m][0], line)
            )
            for k, (line, _) in enumerate(lines)
        ]
        self._kept: tuple[Parity, NDArray[np.int64], Any] | None = (
            None  # parity, free dofs, factors of the last solve
        )
        assemble = stiffness if self.dim == 2 else brick_stiffness
        self.body = assemble(self._part(~inside), body)
        self.total = self.body if cube is None else self.body + assemble(self._part(inside), cube)

    def linear_forces(self, stress: Array, gradient: Array) -> Array:
        """Nodal forces (dofs,) of the field sigma_ij = S_ij + G_ijk x_k: S (dim, dim), G (dim, dim,
        dim)."""
        x = self.basis.default_parameters()["x"]
        sigma = stress[:, :, None, None] + np.einsum("ijk,kep->ijep", gradient, np.asarray(x))
        return _load_work.assemble(self.basis, sigma=sigma)

    def outer_forces(self, parity: Parity, field: Callable[[Array], Array]) -> Array:
        """Nodal forces (dofs, n) of the part of one parity of any n fields, as tractions on the
        outer faces.

        field: from points (q, dim) to stress (q, n, dim, dim); it should be in equilibrium.
        """
        mesh = self.basis.mesh
        edges = mesh.boundary_facets()
        middle = mesh.p[:, mesh.facets[:, edges]].mean(axis=1)
        total: Array | float = 0.0
        for axis in range(self.dim):
            face = skfem.FacetBasis(
                mesh,
                self.basis.elem,
                facets=edges[_at(middle[axis], mesh.p[axis].max())],
                intorder=6,
            )
            x = np.asarray(face.default_parameters()["x"])
            traction = _parity_part(field, x.reshape(self.dim, -1).T, parity)[
                ..., axis
            ]  # (q, n, dim)
            loads = np.moveaxis(traction, (1, 2), (0, 1)).reshape(-1, *x.shape)
            total = total + np.stack([_traction_work.assemble(face, t=t) for t in loads], axis=1)
        return np.asarray(total)

    def solve(self, parity: Parity, forces: Array) -> Array:
        """Displacements (dofs, n) under nodal forces (dofs, n) of one parity."""
        like, swap = self.alike(parity)
        if self._kept is None or self._kept[0] != like:
            self._kept = None  # gives its memory back first
            free = np.flatnonzero(~self._held(like))
            order = {"permc_spec": "MMD_AT_PLUS_A"}
            if self.dim == 3:  # five times faster and half the memory of SuperLU's own ordering
                free = free[nested_dissection(self._grid[:, free])]
                order = {"permc_spec": "NATURAL"}
            matrix = self.total[free][:, free].tocsc()
            self._kept = (
                like,
                free,
                splu(matrix, diag_pivot_thresh=0.0, options={"SymmetricMode": True}, **order),
            )
        _, free, factor = self._kept
        u = np.zeros_like(forces)
        u[swap[free]] = factor.solve(forces[swap[free]])
        return u

    def alike(self, parity: Parity) -> tuple[Parity, NDArray[np.int64]]:
        """The parity that this one becomes when equal axes of a product grid trade places, and the
        dofs that do.

        u(swap) is the field with traded axes. Parities that become the same one share their
        factors.
        """
        if self.dim == 2:  # triangles are on no product grid
            return parity, np.arange(self.basis.N)
        axes = np.arange(self.dim)
        for kind in set(self._kind):
            same = np.flatnonzero(np.array(self._kind) == kind)
            axes[same] = sorted(same, key=lambda k: parity[k])
        # component k at x is, before the trade, component axes[k] at y with y[axes[k]] = x[k]
        ends = [*(self._grid.max(axis=1) + 1), self.dim]
        here = np.ravel_multi_index((*self._grid, self.component), ends)
        there = np.ravel_multi_index((*self._grid[np.argsort(axes)], axes[self.component]), ends)
        order = np.argsort(here)
        return tuple(parity[k] for k in axes), order[np.searchsorted(here, there, sorter=order)]

    def reactions(self, u: Array) -> Array:
        """Nodal forces (dofs, n) on the body by whatever holds it: on the cube's surface, by the
        cube."""
        return np.asarray(self.body @ u)

    def mean_stress(
        self, reactions: Array, parity: Parity, axis: int, intervals: Sequence[tuple[float, float]]
    ) -> Array:
        """Mean normal stress (n,) on a pad of the face x_axis = 1, one interval in [-1, 1] per
        other axis."""
        others = [k for k in range(self.dim) if k != axis]
        x = self.place
        on_face = _at(x[axis], 1.0) & np.all(x[others] < 1.0 + _SAME, axis=0)
        dofs = np.flatnonzero(on_face & (self.component == axis))
        weights = np.ones(len(dofs))
        for k, (start, stop) in zip(others, intervals, strict=True):
            nodes, index = np.unique(np.round(x[k, dofs], 14), return_inverse=True)
            w = interval_weights(nodes, self.order, parity[k], start, stop)
            weights *= w[index] / (stop - start)
        return np.asarray(-weights @ reactions[dofs])

    def _part(self, elements: NDArray[np.bool_]) -> skfem.Basis:
        whole = self.basis
        return skfem.Basis(
            whole.mesh, whole.elem, elements=np.flatnonzero(elements), intorder=2 * self.order
        )

    def _held(self, parity: Parity) -> NDArray[np.bool_]:
        """Which dofs are zero: by the mirrors, in a rigid cube, or to stop the one rigid motion
        that is left.

        A rigid cube can be held altogether: the one motion that its parity leaves is free for the
        body too.
        """
        x, c = self.place, self.component
        held = np.zeros(len(c), dtype=bool)
        for k, sign in enumerate(parity):
            held |= _at(x[k], 0.0) & ((c == k) == (sign > 0))
        if self.rigid:
            return held | np.all(x < 1.0 + _SAME, axis=0)
        odd = [k for k, sign in enumerate(parity) if sign < 0]
        if len(odd) == 1:  # translation along the odd axis
            held |= (c == odd[0]) & np.all(_at(x, 0.0), axis=0)
        elif len(odd) == 2:  # rotation in the plane of the two
            at = np.zeros(self.dim)
            at[odd[1]] = 1.0
            held |= (c == odd[0]) & np.all(_at(x, at[:, None]), axis=0)
        return held


def _parity_part(field: Callable[[Array], Array], x: Array, parity: Parity) -> Array:
    """The part of one parity of a field of stress at x (q, dim), by averaging over the mirrored
    points."""
    signs = list(itertools.product((1.0, -1.0), repeat=len(parity)))
    part = np.zeros(())
    for mirror in map(np.array, signs):
        weight = np.prod(np.where(mirror < 0, parity, 1)) / len(signs)
        part = part + weight * np.outer(mirror, mirror) * field(x * mirror)
    return part


def nested_dissection(grid: NDArray[np.int64]) -> NDArray[np.int64]:
    """Elimination order (n,) of nodes on lines (dim, n) of a product grid of quadratic elements:
    halves, then the cut.

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
