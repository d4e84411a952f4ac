# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Traction on the whole skin: the sum of the fits of all regions of contact and a residual field.

The residual field is the traction that explains the residuals: the cubes' values minus the values
that the fits predict.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial import cKDTree

from ...core.arrays import Array, Index
from ...mechanics.contact import hertz
from ...mechanics.layer import FIELD
from ..inverse import FieldDeviation, SurfaceInverse, TractionField
from .contact_estimate import ContactSum
from .grid_fit import GridFit
from .hertz_fit import HertzFit
from .local_values import LocalValues, make_rotations_about_normal, unroll_points

_MIN_RINGS = 4
"""Smallest number of concentric rings of point forces that represent a Hertz contact when its force
is distributed over the points of the surface."""

_RINGS_PER_SPACING = 16
"""Number of concentric rings of point forces that represent a Hertz contact, divided by the ratio
of its radius to the distance of neighbouring points of the surface.

Each point force is moved to the nearest point of the surface. With this number, the error of the
pressure due to these moves is below the standard deviation of the pressure.
"""


def add_fits(
    inverse: SurfaceInverse,
    fits: list[HertzFit | GridFit],
) -> tuple[TractionField, FieldDeviation]:
    """Add up the traction of the fits of all regions of contact, and compute its deviations.

    The traction of a fit is averaged over the square that each point represents, so that the sum
    over all points times the area of a square is the force.

    Args:
        inverse: Points and responses of the skin.
        fits: Fits of all regions of contact.
    """
    n = len(inverse.points)
    traction = np.zeros((n, 3))
    pressure = np.zeros(n)
    variance = np.zeros((2, n))
    for fit in fits:
        contacts = fit.to_contacts(inverse.spacing)
        points, share, below, rotation = _distribute(
            inverse,
            fit.values,
            contacts,
        )
        point_forces = contacts.forces @ share.T
        traction[points] += np.einsum("mab,bm->ma", rotation, point_forces) / inverse.area
        pressure[points] += below @ contacts.forces.ravel()
        surface_root = share @ contacts.root[2] / inverse.area
        depth_root = below @ np.concatenate(contacts.root)
        variance[0, points] += (surface_root**2).sum(axis=1)
        variance[1, points] += (depth_root**2).sum(axis=1)
    return TractionField(traction, pressure), FieldDeviation(*np.sqrt(variance))


def _distribute(
    inverse: SurfaceInverse,
    values: LocalValues,
    contacts: ContactSum,
) -> tuple[Index, Array, Array, Array]:
    """Return the forces and pressures that q contacts cause at m points of the surface.

    The points are those above the cubes of a fit.

    Args:
        inverse: Points and responses of the skin.
        values: Cubes of the fit, and their home cube.
        contacts: The contacts.

    Returns:
        Indices (m,) of the points; shares (m, q) of the force of each contact that act on the
        square of each point; pressure (m, 3 q) in Pa/N at the cubes' depth, for forces along x of
        all contacts, then y, then z; and rotations (m, 3, 3) from the frame of the home cube
        (around which the skin is laid flat) to that of the cube below each point.
    """
    points = np.flatnonzero(np.isin(inverse.cube, values.cubes))
    n_points = len(points)
    place = unroll_points(inverse, values.home, points)

    sizes = contacts.sizes
    count = len(sizes)
    rings = math.ceil(_RINGS_PER_SPACING * sizes.max() / inverse.spacing)
    offsets, weights = hertz(1.0, (0, 0, 1), order=max(_MIN_RINGS, rings))
    samples = contacts.places[:, None] + sizes[:, None, None] * offsets[:, :2]
    tree = cKDTree(place)
    distance, nearest = tree.query(samples, distance_upper_bound=inverse.spacing)

    # Point forces on rings represent each contact (`_RINGS_PER_SPACING`). Point forces beyond the
    # border of the skin are left out; cKDTree.query returns an infinite distance for them.
    contact, sample = np.nonzero(np.isfinite(distance))
    share = np.zeros((n_points, count))
    np.add.at(share, (nearest[contact, sample], contact), weights[sample, 2])

    below = np.zeros((n_points, 3, count))
    zz = FIELD.index("zz")
    for size in np.unique(sizes):
        of_this_size = np.flatnonzero(sizes == size)
        from_contacts = place[:, None] - contacts.places[of_this_size]
        stress = inverse.contact_response.compute_field(from_contacts.reshape(-1, 2), size)
        by_contact = -stress[:, zz].reshape(n_points, -1, 3)
        below[:, :, of_this_size] = by_contact.swapaxes(1, 2)
    below_by_force = below.reshape(n_points, -1)

    _, angle = inverse.unroll(values.home, inverse.cube[points])
    rotation = make_rotations_about_normal(angle)
    return points, share, below_by_force, rotation
