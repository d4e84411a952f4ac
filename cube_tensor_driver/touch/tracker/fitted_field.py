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
from .local_values import unroll_points
from .node_fit import NodeFit

_MIN_RINGS = 4
"""Smallest number of rings of point forces that represent a Hertz contact when its force is shared
out among the points of the surface."""


def add_fits(
    inverse: SurfaceInverse, residual: TractionField, fits: list[HertzFit | NodeFit]
) -> TractionField:
    """Add the traction of fits of regions to the residual field, which the fits do not explain.

    The traction of a fit is averaged over the square that each point represents, so that the sum
    over all points times the area of a square is the force.

    Args:
        inverse: Points and kernels of the skin.
        residual: Traction and pressure that explain what the fits leave of the values.
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
        local = np.einsum("mab,bm->ma", rotation, contacts.forces @ share.T)
        traction[points] += local / inverse.area
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
    # The squares share the force of a contact by the rings within them, so rings must be narrow: at
    # a sixteenth of a spacing the error of the pressure is below its deviation.
    rings = max(_MIN_RINGS, math.ceil(16 * contacts.sizes.max() / inverse.spacing))
    offsets, weights = hertz(1.0, (0, 0, 1), order=rings)
    samples = contacts.places[:, None] + contacts.sizes[:, None, None] * offsets[:, :2]
    # Forces beyond the border of the skin act on no point.
    reach = inverse.spacing
    distance, nearest = cKDTree(place).query(samples.reshape(-1, 2), distance_upper_bound=reach)
    share = np.zeros((len(points), count))
    contact = np.repeat(np.arange(count), len(offsets))
    weight = np.tile(weights[:, 2], count)
    on_skin = np.isfinite(distance)
    np.add.at(share, (nearest[on_skin], contact[on_skin]), weight[on_skin])

    below = np.zeros((len(points), 3, count))
    for size in np.unique(contacts.sizes):
        alike = np.flatnonzero(contacts.sizes == size)
        from_contacts = (place[:, None] - contacts.places[alike]).reshape(-1, 2)
        pressure = -inverse.kernels.field(from_contacts, size)[:, FIELD.index("zz")]
        below[:, :, alike] = pressure.reshape(len(points), -1, 3).swapaxes(1, 2)

    _, angle = inverse.unroll(fit.values.home, inverse.cube[points])
    rotation = np.zeros((len(points), 3, 3))
    rotation[:, 0, 0] = rotation[:, 1, 1] = np.cos(angle)
    rotation[:, 0, 1] = np.sin(angle)
    rotation[:, 1, 0] = -rotation[:, 0, 1]
    rotation[:, 2, 2] = 1.0
    return points, share, below.reshape(len(points), -1), rotation
