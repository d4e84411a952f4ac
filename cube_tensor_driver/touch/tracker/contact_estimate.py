# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Force, position, moment and area of a contact, with standard deviations.

These quantities are integrals of the traction, or follow from such integrals. The integrals are
sums over the grid contacts (small Hertz contacts, grid_fit.py) of a contact, so their variances
follow from the covariance of the forces of the grid contacts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ...core.arrays import Array

_MIN_NORMAL_FORCE = 1e-12
"""Smallest normal force, in N, by which the first moment of the pressure is divided to find the
position of a contact. It replaces any smaller force, which avoids a division by 0."""

_HERTZ_MOMENT = 0.2
"""Second moment of the pressure of a Hertz contact about its centre along one axis, divided by the
force and the square of the radius: 1/5 for the pressure sqrt(1 - r^2 / a^2)."""

N_MOMENTS = 6
"""Number of moments of each component of the traction: integrals of the traction times 1, x, y,
x^2, x y and y^2."""


class ContactEstimate(NamedTuple):
    """Estimate of one contact on the flattened skin (skin laid out in the plane z = 0 for the fit).

    Attributes:
        force: Force (3,) in N on the skin, along x, y and z.
        force_covariance: Covariance (3, 3) of the force in N^2.
        place: Position (2,) in m, where the line of action of the normal force meets the surface.
        place_variance: Variance (2,) of the position in m^2.
        moment: Moment of the traction about the normal (z) through this position, in N m.
        moment_variance: Variance of the moment in N^2 m^2.
        area: Area in m^2 of the elliptic Hertz contact with the same second moments of pressure.
        area_variance: Variance of the area in m^4.
        aspect: Length of this ellipse divided by its width.
    """

    force: Array
    force_covariance: Array
    place: Array
    place_variance: Array
    moment: float
    moment_variance: float
    area: float
    area_variance: float
    aspect: float


class ContactSum(NamedTuple):
    """Traction of a region as the sum of q Hertz contacts on the skin laid flat.

    Attributes:
        places: Centres (q, 2) in m.
        sizes: Radii (q,) in m.
        forces: Forces (3, q) in N, along x, y and z.
        root: Square root R (3, q, n) of the covariance of the forces, in N. With its first two axes
            joined, R R' is the covariance (3 q, 3 q).
    """

    places: Array
    sizes: Array
    forces: Array
    root: Array


class Discs(NamedTuple):
    """Parameters of J Hertz contacts on the flattened skin.

    For a fit, the skin is laid flat around one cube, the home cube, whose frame is used here: x and
    y along the surface, z out of the skin.

    Attributes:
        forces: Forces (J, 3) on the skin, along x, y and z, in N.
        centres: Centres (J, 2) along x and y, in m from the home cube.
        log_sizes: Natural logarithms (J,) of the radii in m.
    """

    forces: Array
    centres: Array
    log_sizes: Array


def make_discs(estimates: Sequence[ContactEstimate]) -> Discs:
    """Return round Hertz contacts with the force, position and area of the estimates."""
    forces = np.array([one.force for one in estimates])
    centres = np.array([one.place for one in estimates])
    areas = np.array([one.area for one in estimates])
    log_squares = np.log(areas / np.pi)
    return Discs(forces, centres, log_squares / 2)


def compute_moment_polynomials(places: Array) -> Array:
    """Return 1, x, y, x^2, x y and y^2 (q, `N_MOMENTS`) at positions (q, 2).

    Their sums over the grid contacts of a contact, weighted with the forces, are the moments.
    """
    x, y = places.T
    return np.stack([np.ones(len(x)), x, y, x**2, x * y, y**2], axis=1)


def estimate_contact(
    centre: Array,
    moments: Array,
    root: Array,
    size: float,
) -> ContactEstimate:
    """Estimate one contact from the moments of the forces of its grid contacts (grid_fit.py).

    Args:
        centre: Position (2,) in m about which the moments are taken.
        moments: Sums (3, `N_MOMENTS`) of the forces along x, y and z of the grid contacts, each
            force multiplied by 1, x, y, x^2, x y or y^2 of its grid contact.
        root: Square root R (3, `N_MOMENTS`, k) of the covariance of the moments: with the first two
            axes of R joined, R R' is this covariance.
        size: Radius of a grid contact in m.
    """
    force = moments[:, 0]
    force_x, force_y, force_z = force.tolist()
    normal_force = min(force_z, -_MIN_NORMAL_FORCE)
    x, y, xx, xy, yy = (moments[2, 1:] / normal_force).tolist()
    moment = float(moments[1, 1] - moments[0, 2]) - x * force_y + y * force_x

    # The second moment of the pressure is that of the forces at the grid points, plus that of the
    # pressure of one grid contact about its own centre. Its eigenvectors are the axes of the
    # ellipse.
    own_moment = _HERTZ_MOMENT * size**2
    xx, xy, yy = xx - x * x, xy - x * y, yy - y * y
    mean, half_difference = (xx + yy) / 2, (xx - yy) / 2
    radius = math.hypot(half_difference, xy)
    larger_moment = max(mean + radius, 0.0) + own_moment
    smaller_moment = max(mean - radius, 0.0) + own_moment
    area = math.pi / _HERTZ_MOMENT * math.sqrt(larger_moment * smaller_moment)
    direction = math.atan2(xy, half_difference) / 2
    cosine, sine = math.cos(direction), math.sin(direction)
    by_larger, by_smaller = 1 / larger_moment, 1 / smaller_moment
    by_xx = cosine**2 * by_larger + sine**2 * by_smaller
    by_xy = cosine * sine * (by_larger - by_smaller)
    by_yy = sine**2 * by_larger + cosine**2 * by_smaller

    # `slopes` are the derivatives (4, 3, 6) of the position (x, y), the moment and the area by the
    # moments of the forces along x, y and z. All derivatives by moments of forces along z contain a
    # division by the normal force, which comes last.
    by_x = [-x, 1.0, 0.0, 0.0, 0.0, 0.0]
    by_y = [-y, 0.0, 1.0, 0.0, 0.0, 0.0]
    along, across = by_xx * x + by_xy * y, by_xy * x + by_yy * y
    constant = x * along + y * across + own_moment * (by_xx + by_yy) - 2
    by_area = [constant, -2 * along, -2 * across, by_xx, 2 * by_xy, by_yy]
    slopes = np.zeros((4, 3, N_MOMENTS))
    slopes[:, 2] = by_x, by_y, np.zeros(N_MOMENTS), by_area
    slopes[2, 0, [0, 2]] = y, -1
    slopes[2, 1, :2] = -x, 1
    slopes[2, 2] = force_x * slopes[1, 2] - force_y * slopes[0, 2]
    slopes[3, 2] *= area / 2
    slopes[:, 2] /= normal_force

    propagated_root = slopes.reshape(4, -1) @ root.reshape(-1, root.shape[2])
    variance = (propagated_root**2).sum(axis=1)
    force_root = root[:, 0]
    return ContactEstimate(
        force=force,
        force_covariance=force_root @ force_root.T,
        place=centre + np.array([x, y]),
        place_variance=variance[:2],
        moment=moment,
        moment_variance=float(variance[2]),
        area=area,
        area_variance=float(variance[3]),
        aspect=math.sqrt(larger_moment / smaller_moment),
    )
