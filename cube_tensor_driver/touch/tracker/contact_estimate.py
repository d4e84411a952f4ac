"""Force, position and moment of a fitted contact, with standard deviations.

They are linear functionals L (integrals) of the whole traction near the contact: of the fitted
Hertz contact and of the residual field, the traction that the contacts do not explain. Their
variance is the variance of universal kriging. Let k_LL be the prior variance of the functional of
the residual field, k its covariance with the values y, W the inverse covariance of the values
(contact_fit.py), and J and b the derivatives of y and of the functional by the parameters (force f,
centre c, logarithm of the radius ln a) of the contacts. Then::

    var = k_LL - k' W k + (b - J' W k)' (J' W J + prior)^-1 (b - J' W k)

Source: N. A. C. Cressie, Statistics for Spatial Data (1993), 3.4 (universal kriging).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_solve

from ...core.arrays import Array
from ...mechanics.kernels import PRIOR_LENGTHS, SHEAR_RATIO
from ..prior import AMPLITUDE
from .contact_fit import ContactFit, Observations

NEGLIGIBLE_RESIDUAL = 2.5e-4
"""Residual scale below which the residual field is left out of the estimate of a contact.

The residual field is the pressure that the contacts do not explain; its scale is its standard
deviation divided by that of the prior (`AMPLITUDE`, in Pa). Below this scale it adds less than 1 %
to the variances of force and position, and an estimate without it takes half the time.
"""

_MIN_NORMAL_FORCE = 1e-12
"""Smallest absolute value, in N, of a normal force by which moments are divided to get a position.
It avoids a division by 0."""


class ContactEstimate(NamedTuple):
    """Estimate of one contact on the flattened skin (skin laid out in the plane z = 0 for the fit).

    Attributes:
        force: Force (3,) in N on the skin, along x, y and z.
        force_variance: Variance (3,) of the force in N^2.
        place: Position (2,) in m, where the line of action of the normal force meets the surface.
        place_variance: Variance (2,) of the position in m^2.
        moment: Moment of the traction about the normal (z) through this position, in N m.
        moment_variance: Variance of the moment in N^2 m^2.
        area: Area of the fitted Hertz contact in m^2.
        area_uncertainty: Standard deviation of the area in m^2.
    """

    force: Array
    force_variance: Array
    place: Array
    place_variance: Array
    moment: float
    moment_variance: float
    area: float
    area_uncertainty: float


def estimate_contact(
    observations: Observations,
    fit: ContactFit,
    j: int,
) -> ContactEstimate:
    """Compute force, position and moment of a contact from its fit and the residual field.

    Args:
        observations: Known values of the cubes, their noise and prior covariance.
        fit: Fit of one or several contacts to these values.
        j: Index in the fit of the contact to estimate.
    """
    depth = observations.kernels.depth
    centre = fit.centres[j]
    size = float(fit.sizes[j])
    contact_force = fit.forces[j]

    # The residual field is integrated over a disc around the contact, which ends halfway to the
    # nearest other contact.
    distances = np.linalg.norm(
        np.delete(fit.centres, j, axis=0) - centre,
        axis=1,
    )
    half_gap = float(distances.min(initial=np.inf)) / 2
    radius = min(size + depth, half_gap)
    offset, weight = _disc_quadrature(radius)
    cross = np.zeros((len(offset), 3, observations.size))
    if fit.residual_scale > NEGLIGIBLE_RESIDUAL * AMPLITUDE:
        covariance = observations.cross(centre + offset)
        cross = fit.residual_scale**2 * covariance * weight[:, None, None]

    # The position of a contact is the point about which the first moment of the pressure is 0.
    total = cross.sum(axis=0)  # (3, D)
    force = contact_force + total @ fit.weighted_residual
    normal_force = force[2] if abs(force[2]) > _MIN_NORMAL_FORCE else -_MIN_NORMAL_FORCE
    first_moment = np.einsum("pa,pd->ad", offset, cross[:, 2])
    shift = first_moment @ fit.weighted_residual / normal_force
    lever = (first_moment - np.outer(shift, total[2])) / normal_force

    # Moment of the shear traction about the normal through the position of the contact
    arm = offset - shift
    twist = arm[:, 0] @ cross[:, 1] - arm[:, 1] @ cross[:, 0]
    contact_moment = shift[1] * contact_force[0] - shift[0] * contact_force[1]
    moment = contact_moment + twist @ fit.weighted_residual

    # Derivatives b (6, parameters) of force (3), position (2) and moment by the parameters of all
    # contacts: force, centre, ln a.
    functionals = np.concatenate([total, lever, twist[None]])  # (6, D)
    first = 6 * j
    slopes = np.zeros((6, fit.jacobian.shape[1]))
    slopes[:3, first : first + 3] = np.eye(3)
    slopes[3:5, first + 2] = -shift / normal_force
    share = contact_force[2] / normal_force
    slopes[3:5, first + 3 : first + 5] = share * np.eye(2)
    slopes[5, first : first + 2] = shift[1], -shift[0]

    inverse = np.linalg.inv(fit.normal_matrix)
    weighted = cho_solve(fit.factor, functionals.T)
    explained = np.einsum("fd,df->f", functionals, weighted)
    prior = _functional_variance(fit.residual_scale, depth, radius, normal_force)
    open_slopes = slopes - weighted.T @ fit.jacobian
    variance = np.maximum(prior - explained, 0)
    variance += np.einsum("fp,pq,fq->f", open_slopes, inverse, open_slopes)

    area = np.pi * size**2
    log_size_deviation = float(np.sqrt(inverse[first + 5, first + 5]))
    return ContactEstimate(
        force=force,
        force_variance=variance[:3],
        place=centre + shift,
        place_variance=variance[3:5],
        moment=float(moment),
        moment_variance=float(variance[5]),
        area=area,
        area_uncertainty=2 * area * log_size_deviation,
    )


def _functional_variance(
    residual_scale: float,
    depth: float,
    radius: float,
    normal_force: float,
) -> Array:
    """Return the prior variances k_LL (6,) of force (3), position (2) and moment.

    The force, position and moment of a contact include the residual field (traction that the
    contacts do not explain) on a disc around it. The prior variances are those that this field
    causes before any value is measured.

    Args:
        residual_scale: Standard deviation of the pressure of the residual field, in Pa.
        depth: Distance from the centres of the cubes to the surface, in m.
        radius: Radius of the disc over which the residual field is integrated, in m.
        normal_force: Normal force of the contact in N.
    """
    # Variance of the integral of the pressure over an area, per m^2 of this area. The formula
    # holds for areas that are wider than the correlation lengths of the prior.
    lengths = np.array(PRIOR_LENGTHS) * depth
    density = residual_scale**2 * np.mean(2 * np.pi * lengths**2)

    shear = SHEAR_RATIO**2
    mean_square_x = radius**2 / 4
    lever = mean_square_x / normal_force**2
    polar = radius**2 / 2
    factors = np.array(
        [
            shear,
            shear,
            1.0,
            lever,
            lever,
            shear * polar,
        ]
    )
    return np.asarray(density * np.pi * radius**2 * factors)


def _disc_quadrature(radius: float) -> tuple[Array, Array]:
    """Return quadrature points on a disc: Gauss points in r^2, equally spaced in the angle.

    Args:
        radius: Radius of the disc in m.

    Returns:
        Positions (Q, 2) from the centre in m, and weights (Q,) in m^2 whose sum is the area.
    """
    nodes, weights = np.polynomial.legendre.leggauss(5)
    r = radius * np.sqrt((nodes + 1) / 2)
    n_angles = 10
    angle = 2 * np.pi * (np.arange(n_angles) + 0.5) / n_angles
    x = np.outer(r, np.cos(angle))
    y = np.outer(r, np.sin(angle))
    areas = np.repeat(weights / 2, n_angles) * np.pi * radius**2 / n_angles
    points = np.stack([x.ravel(), y.ravel()], axis=1)
    return points, areas
