# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Linear elasticity of a box with a bonded cube, solved in its positive part.

Where box and cube are symmetric under the mirrors x_k -> -x_k, every load splits into parts of one
*parity* (+1 even or -1 odd for each axis), and each part is solved where all coordinates are
positive. On the plane x_k = 0 an even field has u_k = 0; an odd one has the other components zero.
Along an axis without a mirror the whole box is solved, and the parity is 0.
Lengths are in units of d0, the half side of the cube. For all test functions w::

    int sigma(u) : eps(w) dV = int_outer w . (sigma_load n) dS

Source: T. J. R. Hughes, The Finite Element Method (1987), chapters 2 and 4.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
import skfem
from scipy.sparse.linalg import SuperLU, splu
from skfem.models.elasticity import lame_parameters

from cube_tensor_driver.core.arrays import Array, Index, Mask
from cube_tensor_driver.core.layout import Layout

from .pads import SAME_COORDINATE, compute_pad_weights

Parity = tuple[int, ...]
"""For each axis +1 where a field is even under the mirror x_k -> -x_k, -1 where the field is odd, 0
where the body has no such mirror."""

SMALLEST_DISSECTED = 60
"""Number of nodes below which nested dissection (an elimination order that cuts the grid in halves)
does not cut a part of the grid any more."""


def _is_at(x: Array, value: float | Array) -> Mask:
    return np.abs(x - value) < SAME_COORDINATE


def compute_lame_constants(
    young: float,
    poisson: float,
    plane: str = "strain",
) -> tuple[float, float]:
    """Return Lame's constants lambda and mu, in the unit of Young's modulus.

    For plane stress, lambda has the value with which a computation in plane strain gives the stress
    in the plane of a body that is free along y (sigma_yy = 0).
    """
    lam, mu = lame_parameters(young, poisson)
    if plane == "stress":
        lam = 2.0 * lam * mu / (lam + 2.0 * mu)
    return lam, mu


def assemble_stiffness(
    scalar: skfem.Basis,
    moduli: tuple[float, float],
) -> sp.csr_matrix:
    """Assemble the stiffness K_ij = int lambda div w_i div w_j + 2 mu eps(w_i) : eps(w_j) dV.

    w_i are the vector-valued nodal functions and eps their strain. The sparse matrix (dofs, dofs)
    is put together from integrals of df/dx_a dg/dx_b, where f and g are nodal functions of a single
    component. Assembling it with the vector-valued functions, most of whose components are zero,
    takes seven times as long.

    Args:
        scalar: The elements of one component; the components of one node are neighbours among the
            dofs.
        moduli: Lame's constants lambda and mu.
    """
    lam, mu = moduli
    dim = scalar.mesh.dim()
    blocks: list[sp.spmatrix] = []
    for a, b in itertools.product(range(dim), repeat=2):
        form = skfem.BilinearForm(lambda u, w, _, a=a, b=b: w.grad[a] * u.grad[b])
        slopes = form.assemble(scalar)
        # Components a of the test function and b of the displacement are coupled by this block.
        place = np.zeros((dim, dim))
        place[a, b] = 1.0
        coupling = lam * slopes + mu * slopes.T
        blocks.append(sp.kron(coupling, place))
        if a == b:
            # The part of mu grad u : grad w couples equal components only.
            blocks.append(sp.kron(mu * slopes, np.eye(dim)))
    return sum(blocks).tocsr()


def make_sample_matrix(basis: skfem.Basis, values: Array) -> sp.csr_matrix:
    """Return the sparse matrix (S, dofs) from unknowns to samples at the quadrature points.

    Args:
        basis: The elements, E in number, with Q points each.
        values: (n, ..., E, Q) samples of each of the n shape functions of an element; they make
            S = ... x E x Q rows of the matrix, row-major.
    """
    n_samples = values[0].size
    samples = np.arange(n_samples).reshape(values.shape[1:])
    rows = np.broadcast_to(samples, values.shape)
    point_axis = values.ndim - 1
    inner_axes = range(1, point_axis - 1)
    dofs = np.expand_dims(basis.element_dofs, (*inner_axes, point_axis))
    columns = np.broadcast_to(dofs, values.shape)
    places = (rows.ravel(), columns.ravel())
    matrix = sp.csr_matrix((values.ravel(), places), (n_samples, basis.N))
    matrix.eliminate_zeros()
    return matrix


class _Factors(NamedTuple):
    """LU factors of the stiffness of the unknowns `free` (m,) that nothing holds in fields of one
    parity (+1 even or -1 odd under the mirror of each axis)."""

    parity: Parity
    free: Index
    factors: SuperLU


class Solid:
    """A meshed body with a cube: triangles of order 4 in a plane, 27-node bricks in space.

    Attributes:
        basis: The elements of one component. The components of the displacement of one node are
            neighbours among the unknowns (dofs).
        positions: (dim, dofs) position of each unknown, in d0 (half the side of the cube).
        component: (dofs,) number of the axis along which each unknown displacement is.
        moduli: Lame's constants of the body, and those of a cube that is not rigid.
        body: (dofs, dofs) stiffness of the body without the cube.
        total: (dofs, dofs) stiffness of body and cube.
        parities: All parities of the body (+1 even or -1 odd under the mirror of each axis, 0
            without mirror). Any field is a sum of one part for each of them.
    """

    def __init__(
        self,
        mesh: skfem.Mesh,
        body: tuple[float, float],
        cube: tuple[float, float] | None,
        ground: bool = False,
        confined: bool = False,
    ) -> None:
        """Assemble the stiffness.

        Args:
            mesh: Mesh by mesh.py, with lengths in d0 (half the side of the cube). An axis along
                which all coordinates are positive has a mirror at 0.
            body: Lame's constants lambda and mu of the body.
            cube: Lame's constants of the cube in the same unit; None: the cube is rigid.
            ground: Whether the lower face is held at rest; then the cube must be elastic.
            confined: Whether the sides are mirrors, as between the equal cells of a skin without
                edges: they do not move along their normals in an even field, and only along these
                in an odd one.
        """
        self.dim = int(mesh.dim())
        self.order = 4 if self.dim == 2 else 2
        self.is_rigid = cube is None
        self.moduli = [body] if cube is None else [body, cube]
        self._ground = ground
        self._confined = confined
        # Without a mirror, an axis has the parity 0 alone.
        has_mirror = mesh.p.min(axis=1) > -SAME_COORDINATE
        signs = [(1, -1) if mirrored else (0,) for mirrored in has_mirror]
        self.parities: list[Parity] = list(itertools.product(*signs))

        element = skfem.ElementTriP4() if self.dim == 2 else skfem.ElementHex2()
        self.basis = skfem.Basis(mesh, element, intorder=2 * self.order)
        self.positions = np.repeat(self.basis.doflocs, self.dim, axis=1)
        self.component = np.arange(self.positions.shape[1]) % self.dim

        # In space the nodes lie on a product grid. `_grid` (dim, nodes) holds the number of each
        # node's coordinate among the coordinates that occur along an axis.
        rounded = np.round(self.basis.doflocs, 9)
        lines = [np.unique(x, return_inverse=True) for x in rounded]
        self._grid = np.stack([index for _, index in lines])
        # Axes with equal coordinates get equal numbers, and may be exchanged for each other.
        coordinates = [line.tolist() for line, _ in lines]
        self._axis_kind = [coordinates.index(line) for line in coordinates]
        self._last_solve: _Factors | None = None

        self.body = assemble_stiffness(self.select_elements(in_cube=False), body)
        self.total = self.body
        if cube is not None:
            self.total = self.body + assemble_stiffness(self.select_elements(in_cube=True), cube)

    def compute_outer_forces(
        self,
        parity: Parity,
        field: Callable[[Array], Array],
    ) -> Array:
        """Return the nodal forces (dofs, n) of n fields that act as tractions on the outer faces.

        Args:
            parity: Parity (even or odd under each mirror) of the part of the fields that acts.
            field: Function that returns the stresses (q, n, dim, dim) of the fields at points (q,
                dim). They should be in equilibrium.
        """
        mesh = self.basis.mesh
        edges = mesh.boundary_facets()
        corners = mesh.p[:, mesh.facets[:, edges]]
        centres = corners.mean(axis=1)
        total: Array | float = 0.0
        for axis, sign in itertools.product(range(self.dim), (1, -1)):
            end = (sign * mesh.p[axis]).max()
            if end < SAME_COORDINATE:
                continue  # a mirror
            outer = edges[_is_at(sign * centres[axis], end)]
            face = skfem.FacetBasis(
                mesh,
                self.basis.elem,
                facets=outer,
                intorder=6,
            )
            x = np.asarray(face.default_parameters()["x"])
            points = x.reshape(self.dim, -1).T
            stress = _select_parity_part(field, points, parity)
            traction = sign * stress[..., axis]  # (q, n, dim)
            by_point = traction.reshape(face.dx.size, -1)
            # A quadrature point loads the nodes whose functions are not zero there.
            values = [np.asarray(shape[0]) for shape in face.basis]
            samples = make_sample_matrix(face, np.stack(values) * face.dx)
            forces = samples.T @ by_point
            by_node = forces.reshape(face.N, -1, self.dim)
            by_dof = by_node.swapaxes(1, 2).reshape(len(self.component), -1)
            total = total + by_dof
        return np.asarray(total)

    def solve(self, parity: Parity, forces: Array) -> Array:
        """Return the displacements (dofs, n) under nodal forces (dofs, n) of one parity."""
        sorted_parity, swap = self.sort_axes(parity)
        if self._last_solve is None or self._last_solve.parity != sorted_parity:
            self._last_solve = None  # frees its memory before the next factorisation
            self._last_solve = self._factorise(sorted_parity)
        _, free, factors = self._last_solve
        rows = swap[free]
        u = np.zeros_like(forces)
        u[rows] = factors.solve(forces[rows])
        return u

    def _factorise(self, parity: Parity) -> _Factors:
        free = np.flatnonzero(~self._find_held(parity))
        ordering = "MMD_AT_PLUS_A"
        if self.dim == 3:
            # Five times faster, and half the memory, of SuperLU's own ordering.
            nodes = free // self.dim
            order = order_by_nested_dissection(self._grid[:, nodes])
            free = free[order]
            ordering = "NATURAL"
        matrix = self.total[free][:, free].tocsc()
        # The matrix is positive definite, so no pivoting is needed.
        symmetric = {"SymmetricMode": True}
        factors = splu(
            matrix,
            permc_spec=ordering,
            diag_pivot_thresh=0.0,
            options=symmetric,
        )
        return _Factors(parity, free, factors)

    def sort_axes(self, parity: Parity) -> tuple[Parity, Index]:
        """Exchange axes along which the grid is the same, so that their parities are in order.

        Parities that are the same after the exchange share one factorisation of the stiffness.

        Returns:
            The sorted parity, and an index `swap` (dofs,) such that u[swap] is the field u with its
            axes exchanged in this way.
        """
        if self.dim == 2:  # triangles are on no product grid
            return parity, np.arange(len(self.component))
        axes = np.arange(self.dim)
        kinds = np.array(self._axis_kind)
        for kind in set(self._axis_kind):
            equal = np.flatnonzero(kinds == kind)
            axes[equal] = sorted(equal, key=lambda k: parity[k])

        # Component k at x is, before the exchange, component axes[k] at y with y[axes[k]] = x[k].
        n_coordinates = self._grid.max(axis=1) + 1
        _, n_nodes = self._grid.shape
        node_at = np.empty(n_coordinates, dtype=int)
        node_at[tuple(self._grid)] = np.arange(n_nodes)
        exchanged = self._grid[np.argsort(axes)]
        before = node_at[tuple(exchanged)]
        swap = self.dim * before[:, None] + axes
        sorted_parity = tuple(parity[k] for k in axes)
        return sorted_parity, swap.ravel()

    def select_elements(self, in_cube: bool) -> skfem.Basis:
        """Return the scalar elements (of one displacement component) in the cube, or in the
        elastomer around it."""
        mesh = self.basis.mesh
        centres = mesh.p[:, mesh.t].mean(axis=1)
        is_cube = np.all(np.abs(centres) < 1.0, axis=0)
        elements = np.flatnonzero(is_cube == in_cube)
        return self.basis.with_elements(elements)

    def compute_pad_weights(self, layout: Layout, parity: Parity) -> Array:
        """Return weights (P, dofs) from nodal forces on the body to the mean stresses of the pads.

        These forces, `body` @ u on the surface of the cube, are those of the cube on the elastomer.
        """
        return -compute_pad_weights(self.positions, self.order, layout, parity)

    def _find_held(self, parity: Parity) -> Mask:
        """Return which unknowns (dofs,) are held at zero.

        Mirrors, the ground and a rigid cube hold some; others are held to stop rigid motions. A
        rigid cube can be held altogether, since these motions are free for the body, too.
        """
        x = self.positions
        component = self.component
        held = np.zeros(len(component), dtype=bool)
        for k, sign in enumerate(parity):
            if sign != 0:
                # Even: the normal component is zero on the mirror; odd: the other ones.
                is_normal = component == k
                is_even = sign > 0
                held |= _is_at(x[k], 0.0) & (is_normal == is_even)
        if self._confined:
            for k in range(self.dim - 1):
                at_end = _is_at(x[k], x[k].max())
                at_end |= _is_at(x[k], x[k].min())
                # The other end is a mirror if only the positive part is meshed.
                at_side = at_end & (np.abs(x[k]) > 1.0)
                is_normal = component == k
                is_even = parity[k] >= 0
                held |= at_side & (is_normal == is_even)
        if self._ground:
            return held | _is_at(x[-1], x[-1].min())
        if self.is_rigid:
            in_cube = np.all(np.abs(x) < 1.0 + SAME_COORDINATE, axis=0)
            return held | in_cube

        # Holding the centre stops translations. A field of a parity that no translation has is zero
        # at the centre anyway.
        held |= np.all(_is_at(x, 0.0), axis=0)
        for i, j in itertools.combinations(range(self.dim), 2):
            # Holding component i of a point on axis j stops the rotation in their plane. Where the
            # parity is even along j, there is no rotation; where it is even along i, the mirror
            # holds this component already.
            if parity[j] <= 0:
                point = np.eye(self.dim)[j]
                at_point = np.all(_is_at(x, point[:, None]), axis=0)
                held |= at_point & (component == i)
        return held


def _select_parity_part(
    field: Callable[[Array], Array],
    x: Array,
    parity: Parity,
) -> Array:
    """Return the part of one parity (even or odd under each mirror) of a stress field at x (q,
    dim).

    This part is the mean of the field over all mirrored points, with the signs of the parity.
    """
    part = np.zeros(())
    images, weights = list_mirror_images(parity)
    for image, weight in zip(images, weights, strict=True):
        # A component sigma_ij changes its sign with each of its axes that is mirrored.
        signs = np.outer(image, image)
        mirrored = field(x * image)
        part = part + weight * signs * mirrored
    return part


def list_mirror_images(parity: Parity) -> tuple[Array, Array]:
    """Return the M images under mirrors of the meshed part, which together make the whole body.

    Returns:
        Signs (M, dim) of the coordinates in each image, relative to the meshed part; and weights
        (M,). The part of a field that has this parity is the sum over the images of the weight
        times the mirrored field.
    """
    # Along an axis without a mirror the body is meshed as a whole.
    signs = [(1.0, -1.0) if sign else (1.0,) for sign in parity]
    combinations = list(itertools.product(*signs))
    images = np.array(combinations)
    signs_by_axis = np.where(images < 0, parity, 1)
    weights = signs_by_axis.prod(axis=1) / len(images)
    return images, weights


def order_by_nested_dissection(grid: Index) -> Index:
    """Return an elimination order (n,) of nodes of a product grid of quadratic elements.

    Both halves of the grid come first, each in such an order, then the cut between them.

    Args:
        grid: (dim, n) numbers of the grid lines on which each node lies.

    Source: A. George, SIAM J. Numer. Anal. 10 (1973) 345.
    """

    def order(part: Index) -> Index:
        extent = np.ptp(grid[:, part], axis=1)
        axis = int(np.argmax(extent))
        along = grid[axis, part]
        # Even lines are planes between elements.
        is_plane = along % 2 == 0
        planes = np.unique(along[is_plane])[1:-1]
        if len(part) < SMALLEST_DISSECTED or len(planes) == 0:
            return part
        cut = planes[len(planes) // 2]
        lower = order(part[along < cut])
        upper = order(part[along > cut])
        on_cut = part[along == cut]
        return np.concatenate([lower, upper, on_cut])

    _, n_nodes = grid.shape
    return order(np.arange(n_nodes))
