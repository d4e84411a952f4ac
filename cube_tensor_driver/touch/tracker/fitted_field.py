# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Traction on the whole skin: that of the fitted regions, and of the residual field around them."""

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
"""Smallest number of concentric rings of point forces by which a Hertz contact is represented when
its force is distributed over the points of the surface."""

_RINGS_PER_SPACING = 16
"""Number of concentric rings of point forces, by which a Hertz contact is represented, within the
distance of neighbouring points of the surface. Each point force is moved to the nearest of these
points. With rings this narrow, the error of the pressure due to the moves is below the standard
deviation of the pressure."""


def add_fits(
    inverse: SurfaceInverse, residual: TractionField, fits: list[HertzFit | NodeFit]
) -> TractionField:
    """Add the traction of fits of regions to the residual field, which the fits do not explain.

    The traction of a fit is averaged over the square that each point represents, so that the sum
    over all points times the area of a square is the force.

    Args:
        inverse: Points and kernels of the skin.
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
        traction[points] += local_forces / inverse.area
        pressure[points] += below @ contacts.forces.ravel()
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
        on_surface = share @ contacts.root[2] / inverse.area
        at_depth = below @ contacts.root.reshape(-1, contacts.root.shape[2])
        total[points, 0] += (on_surface**2).sum(axis=1)
        total[points, 1] += (at_depth**2).sum(axis=1)
    return total


def _distribute(
    inverse: SurfaceInverse, fit: HertzFit | NodeFit, contacts: ContactSum
) -> tuple[Index, Array, Array, Array]:
    """Return the effect of the q contacts of a fit at the m points of the surface around it.

    Returns:
        Indices (m,) of the points; shares (m, q) of the force of each contact that act on the
        square of each point; pressure (m, 3 q) in Pa/N at the cubes' depth, for forces along x of
        all contacts, then y, then z; and rotations (m, 3, 3) from the frame of the home cube
        (around which the skin is laid flat) to that of the cube below each point.
    """
    points = np.flatnonzero(np.isin(inverse.cube, fit.values.cubes))
    place = unroll_points(inverse, fit.values.home, points)
    count = len(contacts.places)
    rings = math.ceil(_RINGS_PER_SPACING * contacts.sizes.max() / inverse.spacing)
    offsets, weights = hertz(1.0, (0, 0, 1), order=max(_MIN_RINGS, rings))
    shifts = contacts.sizes[:, None, None] * offsets[:, :2]
    samples = (contacts.places[:, None] + shifts).reshape(-1, 2)
    # Point forces beyond the border of the skin (at an infinite distance) act on no point.
    distance, nearest = cKDTree(place).query(samples, distance_upper_bound=inverse.spacing)
    contact = np.repeat(np.arange(count), len(offsets))
    weight = np.tile(weights[:, 2], count)
    is_on_skin = np.isfinite(distance)
    entries = nearest[is_on_skin], contact[is_on_skin]
    share = np.zeros((len(points), count))
    np.add.at(share, entries, weight[is_on_skin])

    below = np.zeros((len(points), 3, count))
    for size in np.unique(contacts.sizes):
        of_this_size = np.flatnonzero(contacts.sizes == size)
        from_contacts = place[:, None] - contacts.places[of_this_size]
        stress = inverse.contact_response.field(from_contacts.reshape(-1, 2), size)
        pressure = -stress[:, FIELD.index("zz")]
        by_contact = pressure.reshape(len(points), -1, 3)
        below[:, :, of_this_size] = by_contact.swapaxes(1, 2)

    _, angle = inverse.unroll(fit.values.home, inverse.cube[points])
    rotation = rotations_about_normal(angle)
    return points, share, below.reshape(len(points), -1), rotation
