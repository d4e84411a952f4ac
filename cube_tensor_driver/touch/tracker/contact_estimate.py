# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Force, position, moment and area of a contact, with standard deviations.

All are integrals of the traction over the nodes (small contacts) of a contact, or quotients of such
integrals. Their variances follow from the covariance of the nodes' forces.
"""

from __future__ import annotations

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
            joined, R R' is the covariance (3 q, 3 q); n is at most 3 q.
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


def discs_of(estimates: Sequence[ContactEstimate]) -> Discs:
    """Return round Hertz contacts with the force, position and area of the estimates."""
    forces = np.array([one.force for one in estimates])
    centres = np.array([one.place for one in estimates])
    areas = np.array([one.area for one in estimates])
    log_squares = np.log(areas / np.pi)
    return Discs(forces, centres, log_squares / 2)


def estimate_contact(
    nodes: Array,
    forces: Array,
    root: Array,
    size: float,
) -> ContactEstimate:
    """Integrate the traction on nodes (small Hertz contacts on a grid) over one contact.

    Args:
        nodes: Positions (q, 2) of the nodes in m, on the skin laid flat.
        forces: Forces (3, q) of the nodes along x, y and z, in N.
        root: Square root R (3, q, n) of their covariance, in N: with its first two axes joined,
            R R' is the covariance (3 q, 3 q).
        size: Radius of a node in m.
    """
    force = forces.sum(axis=1)
    normal_force = min(float(force[2]), -_MIN_NORMAL_FORCE)
    place = forces[2] @ nodes / normal_force
    arm = nodes - place
    arm_x, arm_y = arm.T
    moment = arm_x @ forces[1] - arm_y @ forces[0]

    # `slopes` are the derivatives (4, 3, q) of the position (x, y), the moment and the area by the
    # 3 components of the force of each of q nodes.
    slopes = np.zeros((4, 3, len(nodes)))
    slopes[:2, 2] = arm.T / normal_force
    slopes[2, 0] = -arm_y
    slopes[2, 1] = arm_x
    ratio_x, ratio_y = force[:2] / normal_force
    slopes[2, 2] = ratio_x * arm_y - ratio_y * arm_x

    # The second moment of the pressure is that of the forces at the nodes, plus that of the Hertz
    # pressure of one node about its own centre. Its eigenvectors are the axes of the ellipse.
    node_moment = _HERTZ_MOMENT * size**2
    weighted_arm = arm * forces[2][:, None]
    moment_of_forces = weighted_arm.T @ arm / normal_force
    second_moment = moment_of_forces + node_moment * np.eye(2)
    principal_moments, axes = np.linalg.eigh(second_moment)
    principal_moments = np.maximum(principal_moments, node_moment)
    mean_moment = float(np.sqrt(principal_moments.prod()))
    area = np.pi / _HERTZ_MOMENT * mean_moment
    principal_arm = arm @ axes
    excess = principal_arm**2 + node_moment - principal_moments
    relative_excess = (excess / principal_moments).sum(axis=1)
    slopes[3, 2] = area * relative_excess / (2 * normal_force)

    propagated_root = np.einsum("kan,anm->km", slopes, root)
    variance = (propagated_root**2).sum(axis=1)
    force_root = root.sum(axis=1)
    smaller_moment, larger_moment = principal_moments
    aspect = np.sqrt(larger_moment / smaller_moment)
    return ContactEstimate(
        force=force,
        force_covariance=force_root @ force_root.T,
        place=place,
        place_variance=variance[:2],
        moment=float(moment),
        moment_variance=float(variance[2]),
        area=area,
        area_variance=float(variance[3]),
        aspect=float(aspect),
    )
