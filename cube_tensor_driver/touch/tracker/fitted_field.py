# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Traction on the whole skin: the sum of the fits of all regions of contact and a residual field.

The residual field is the traction that explains what the fits leave of the cubes' values.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial import cKDTree

from ...core.arrays import Array, Index
from ...mechanics.contact import hertz
from ...mechanics.layer import FIELD
from ..inverse import SurfaceInverse, TractionField
from .contact_estimate import ContactSum
from .hertz_fit import HertzFit
from .local_values import rotations_about_normal, unroll_points
from .node_fit import NodeFit

_MIN_RINGS = 4
"""Smallest number of concentric rings of point forces that represent a Hertz contact when its force
is distributed over the points of the surface."""

_RINGS_PER_SPACING = 16
"""Number of rings of point forces per distance of neighbouring points of the surface.

A Hertz contact is represented by point forces on concentric rings, and each point force is moved to
the nearest point of the surface. With this number, the error of the pressure due to the moves is
below the standard deviation of the pressure.
"""


def add_fits(
    inverse: SurfaceInverse,
    residual: TractionField,
    fits: list[HertzFit | NodeFit],
) -> TractionField:
    """Add the traction of fits of regions to the residual field, which the fits do not explain.

    The traction of a fit is averaged over the square that each point represents, so that the sum
    over all points times the area of a square is the force.

    Args:
        inverse: Points and responses of the skin.
        residual: Traction and pressure that explain the residual: the values minus the response of
            the cubes to all fits.
        fits: Fits of all regions of contact.

    Returns:
        Traction (M, 3) and pressure at the depth of the cubes' centres (M,), in Pa, at the M points
        of the surface.
    """
    traction = residual.traction.copy()
    pressure = residual.depth_pressure.copy()
    for fit in fits:
        contacts = fit.to_contacts(inverse.spacing)
        points, share, below, rotation = _distribute(inverse, fit, contacts)
        point_forces = contacts.forces @ share.T
        local_forces = np.einsum("mab,bm->ma", rotation, point_forces)
        all_forces = contacts.forces.ravel()
        traction[points] += local_forces / inverse.area
        pressure[points] += below @ all_forces
    return TractionField(traction, pressure)


def fit_variances(inverse: SurfaceInverse, fits: list[HertzFit | NodeFit]) -> Array:
    """Compute the variances of the pressure that the fits of regions of contact describe.

    Returns:
        Variances (M, 2) in Pa^2 at the points of the surface: of the pressure on the surface, and
        of the pressure at the depth of the cubes' centres.
    """
    total = np.zeros((len(inverse.points), 2))
    for fit in fits:
        contacts = fit.to_contacts(inverse.spacing)
        points, share, below, _ = _distribute(inverse, fit, contacts)
        normal_force_root = contacts.root[2]
        force_root = np.concatenate(contacts.root)
        surface_root = share @ normal_force_root / inverse.area
        depth_root = below @ force_root
        surface_variance = (surface_root**2).sum(axis=1)
        depth_variance = (depth_root**2).sum(axis=1)
        total[points, 0] += surface_variance
        total[points, 1] += depth_variance
    return total


def _distribute(
    inverse: SurfaceInverse,
    fit: HertzFit | NodeFit,
    contacts: ContactSum,
) -> tuple[Index, Array, Array, Array]:
    """Return the effect of the q contacts of a fit at the m points of the surface around it.

    Returns:
        Indices (m,) of the points; shares (m, q) of the force of each contact that act on the
        square of each point; pressure (m, 3 q) in Pa/N at the cubes' depth, for forces along x of
        all contacts, then y, then z; and rotations (m, 3, 3) from the frame of the home cube
        (around which the skin is laid flat) to that of the cube below each point.
    """
    home = fit.values.home
    is_around = np.isin(inverse.cube, fit.values.cubes)
    points = np.flatnonzero(is_around)
    n_points = len(points)
    place = unroll_points(inverse, home, points)

    sizes = contacts.sizes
    count = len(sizes)
    rings = math.ceil(_RINGS_PER_SPACING * sizes.max() / inverse.spacing)
    order = max(_MIN_RINGS, rings)
    offsets, weights = hertz(1.0, (0, 0, 1), order=order)
    in_plane = offsets[:, :2]
    shifts = sizes[:, None, None] * in_plane
    samples = contacts.places[:, None] + shifts
    samples = samples.reshape(-1, 2)
    tree = cKDTree(place)
    distance, nearest = tree.query(samples, distance_upper_bound=inverse.spacing)

    # Point forces beyond the border of the skin act on no point; cKDTree.query returns an infinite
    # distance for them.
    is_on_skin = np.isfinite(distance)
    contact = np.repeat(np.arange(count), len(offsets))
    normal_weight = weights[:, 2]
    weight = np.tile(normal_weight, count)
    rows = nearest[is_on_skin]
    columns = contact[is_on_skin]
    share = np.zeros((n_points, count))
    np.add.at(share, (rows, columns), weight[is_on_skin])

    below = np.zeros((n_points, 3, count))
    zz = FIELD.index("zz")
    for size in np.unique(sizes):
        of_this_size = np.flatnonzero(sizes == size)
        centres = contacts.places[of_this_size]
        from_contacts = place[:, None] - centres
        from_contacts = from_contacts.reshape(-1, 2)
        stress = inverse.contact_response.field(from_contacts, size)
        pressure = -stress[:, zz]
        by_contact = pressure.reshape(n_points, -1, 3)
        below[:, :, of_this_size] = by_contact.swapaxes(1, 2)
    below_by_force = below.reshape(n_points, -1)

    _, angle = inverse.unroll(home, inverse.cube[points])
    rotation = rotations_about_normal(angle)
    return points, share, below_by_force, rotation
