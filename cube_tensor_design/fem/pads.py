# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Mean stress on a pad from the nodal reactions of a finite element solution.

A bonded interface transmits to node i the reaction r_i = int phi_i t ds, with the nodal function
phi_i and the traction t. Finite elements give r as accurately as they give the energy, while the
traction t = sigma n evaluated at the interface is poor, worst at the corner of the cube where it is
infinite. Here t is recovered from r:

    find t in T with  int phi_i t ds = r_i  for every node i except the corner's,

where T contains the element's own polynomials, continued in the last element to the corner (whose
reaction also holds the shear of the neighbour face). The integral of t over a pad is then w . r
with weights w that depend on the nodes alone. On a face with two tangential directions the weights
are products of those along each. Linear tractions are returned exactly.

Source: M. F. Wheeler, Comp. Meth. Appl. Mech. Eng. 2 (1973) 123 (consistent fluxes); the treatment
of the corner is ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import comb

import numpy as np

from cube_tensor_driver.core.arrays import Array
from cube_tensor_driver.core.layout import Layout

from .body import choose_field_axes

SAME_COORDINATE = 1e-13
"""Distance, in d0 (half the side of the cube), below which two coordinates of nodes are equal.
Coordinates are exact to rounding, and the smallest element has a size of 1e-10."""
SAME_PLACE = 1e-9
"""Distance, in d0 (half the side of the cube), below which a pad's centre counts as on the centre
line of its face."""


def compute_pad_weights(
    positions: Array,
    order: int,
    layout: Layout,
    parity: Sequence[int],
    rotation: Array | None = None,
) -> Array:
    """Return weights (P, dofs) from nodal forces on the cube to the mean normal stress of P pads.

    Args:
        positions: (dim, dofs) position of each unknown displacement, in d0 (half the side of the
            cube); the components of one node are
            neighbours among the unknowns. Elements end where pads end.
        order: Order of the elements.
        layout: Pads of the cube.
        parity: +1 where the field is even under the mirror of an axis, -1 where it is odd, 0 where
            there is no mirror.
        rotation: Rotation matrix (dim, dim) of the cube in a deformed body; None: the cube has not
            rotated.
    """
    axes = list(choose_field_axes(layout))
    dim, n_dofs = positions.shape
    half = layout.pad_size / 2
    component = np.arange(n_dofs) % dim
    weights = np.zeros((layout.n_pads, n_dofs))
    centres = layout.positions[:, axes]
    normals = layout.normals[:, axes]
    pads = zip(centres, normals, strict=True)
    for pad, (centre, normal) in enumerate(pads):
        axis = int(np.argmax(np.abs(normal)))
        others = [k for k in range(dim) if k != axis]
        # A field that is odd about the pad's centre has a mean of zero.
        if any(parity[k] < 0 and abs(centre[k]) < SAME_PLACE for k in others):
            continue
        # Only one side of a mirror is meshed, so a pad on the other side is read on this one.
        face = normal[axis] if parity[axis] == 0 else 1.0
        direction = normal if face == normal[axis] else -parity[axis] * normal
        if rotation is not None:
            direction = rotation @ direction
        in_plane = np.abs(positions[axis] - face) < SAME_COORDINATE
        beside_edges = np.abs(positions[others]) < 1.0 + SAME_COORDINATE
        on_face = in_plane & np.all(beside_edges, axis=0)
        for along in np.flatnonzero(direction):
            dofs = np.flatnonzero(on_face & (component == along))
            product = np.full(len(dofs), direction[along])
            for k in others:
                # Rounding may put the edge of a pad beyond that of the face.
                start = max(centre[k] - half, -1.0)
                stop = min(centre[k] + half, 1.0)
                rounded = np.round(positions[k, dofs], 14)
                nodes, index = np.unique(rounded, return_inverse=True)
                integral = compute_interval_weights(
                    nodes,
                    order,
                    parity[k],
                    start,
                    stop,
                )
                product *= integral[index] / (stop - start)
            weights[pad, dofs] = product
    return weights


def compute_interval_weights(
    nodes: Array,
    order: int,
    parity: int,
    start: float,
    stop: float,
) -> Array:
    """Return weights w (n,) for nodal reactions r: w . r is the integral of the traction from start
    to stop.

    Args:
        nodes: (n,) positions on half a face, from its centre 0 to its corner 1, or on a whole face
            from -1 to 1, symmetric about the centre. Each element has `order` equal steps.
        order: Order of the elements.
        parity: +1 when the traction is even about the centre, -1 when it is odd, 0 on a whole face.
        start: Start of the interval, -1 <= start < stop; the end of an element.
        stop: End of the interval, at most 1; the end of an element.
    """
    if parity:
        # The whole face has the same tractions as its half and their mirror images.
        whole = np.concatenate([-nodes[:0:-1], nodes])
        weights = compute_interval_weights(whole, order, 0, start, stop)
        centre = len(nodes) - 1
        return weights[centre:] + parity * weights[centre::-1]

    # The weights solve (int phi_i t_j)^T w = int_start^stop t_j for all trial functions t_j of the
    # traction, with the nodal functions phi_i.
    n = len(nodes)
    mass = np.zeros((n, n))
    integral = np.zeros(n)
    element_mass, element_integral = _make_line_element(order)
    for first in range(0, n - 1, order):
        own = slice(first, first + order + 1)
        begin, end = nodes[[first, first + order]]
        length = end - begin
        middle = (begin + end) / 2
        mass[own, own] += length * element_mass
        if start <= middle <= stop:
            integral[own] += length * element_integral

    # The corner has no trial function of its own. The polynomials of the element beside it continue
    # up to the corner.
    trial = np.eye(n)[:, 1:-1]
    trial[-1, -order:] = _continue_polynomials(order)
    trial[0, :order] = _continue_polynomials(order)[::-1]
    matrix = mass @ trial
    right = trial.T @ integral
    weights = np.zeros(n)
    weights[1:-1] = np.linalg.solve(matrix[1:-1].T, right)
    return weights


def _make_line_element(order: int) -> tuple[Array, Array]:
    """Return integrals int phi_i phi_j and int phi_i on [0, 1] of the polynomials phi_i that are 1
    at one of order + 1 equally spaced nodes and 0 at the others."""
    powers = np.arange(order + 1)
    to_nodal = np.linalg.inv(np.vander(powers / order, increasing=True))
    # The integral of x^i x^j on [0, 1] is 1 / (i + j + 1).
    products = 1 / (powers[:, None] + powers + 1)
    return to_nodal.T @ products @ to_nodal, products[0] @ to_nodal


def _continue_polynomials(order: int) -> Array:
    """Return the values (order,) at the end 1 of an element [0, 1] of the polynomials that are 1 at
    one of its other nodes and 0 at the rest: binomial coefficients of alternating sign."""
    return np.array([(-1.0) ** (order - 1 - k) * comb(order, k) for k in range(order)])
