"""Force, place and moment of a fitted contact, and how sure they are.

They are functionals L of the whole traction within reach of the contact, disc and rest alike. Their
variance is that of universal kriging, with k = cov(rest's part, y), J = the derivatives of y and b
those of the functional by (f, c, ln a)::

    k_LL - k' W k + (b - J' W k)' (J' W J + prior)^-1 (b - J' W k)

Source: N. A. C. Cressie, Statistics for Spatial Data (1993), 3.4 (universal kriging).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_solve

from ...core.arrays import Array
from ...mechanics.kernels import PRIOR_LENGTHS, SHEAR_RATIO
from ..prior import AMPLITUDE
from .disc_fit import Fitted, Scan

LITTLE_LEFT = 2.5e-4
"""Alpha over AMPLITUDE below which what is left adds less than a hundredth to any variance: the
half of the time that its share takes is saved."""


class Load(NamedTuple):
    """What one contact does, laid flat: units and meaning as in TrackedContact."""

    force: Array
    force_variance: Array
    place: Array
    place_variance: Array
    moment: float
    moment_variance: float
    area: float
    area_uncertainty: float


def load_of(scan: Scan, fitted: Fitted, j: int) -> Load:
    """Of the contact at disc j."""
    depth = scan.kernels.depth
    middle, size, disc_force = fitted.middles[j], float(fitted.sizes[j]), fitted.forces[j]
    apart = np.linalg.norm(np.delete(fitted.middles, j, axis=0) - middle, axis=1)
    radius = min(size + depth, float(apart.min(initial=np.inf)) / 2)
    offset, weight = _quadrature(radius)
    cross = np.zeros((len(offset), 3, scan.size))
    if fitted.alpha > LITTLE_LEFT * AMPLITUDE:
        cross = fitted.alpha**2 * scan.cross(middle + offset) * weight[:, None, None]
    total = cross.sum(axis=0)  # (3, D)
    force = disc_force + total @ fitted.rest
    pressing = force[2] if abs(force[2]) > 1e-12 else -1e-12
    of_rest = np.einsum("pa,pd->ad", offset, cross[:, 2])
    shift = of_rest @ fitted.rest / pressing
    lever = (of_rest - np.outer(shift, total[2])) / pressing
    around = offset - shift
    twist = around[:, 0] @ cross[:, 1] - around[:, 1] @ cross[:, 0]
    moment = shift[1] * disc_force[0] - shift[0] * disc_force[1] + twist @ fitted.rest
    functionals = np.concatenate([total, lever, twist[None]])  # (6, D)
    first = 6 * j
    slopes = np.zeros((6, fitted.jacobian.shape[1]))
    slopes[:3, first : first + 3] = np.eye(3)
    slopes[3:5, first + 2] = -shift / pressing
    slopes[3:5, first + 3 : first + 5] = np.eye(2) * (disc_force[2] / pressing)
    slopes[5, first : first + 2] = shift[1], -shift[0]
    # Variance of an integral of what is left, of pressure, per area.
    density = fitted.alpha**2 * np.mean([2 * np.pi * (l * depth) ** 2 for l in PRIOR_LENGTHS])
    levers = [radius**2 / 4 / pressing**2] * 2
    shape = np.array([SHEAR_RATIO**2, SHEAR_RATIO**2, 1.0, *levers, SHEAR_RATIO**2 * radius**2 / 2])
    own = density * np.pi * radius**2 * shape
    weighted = cho_solve(fitted.factor, functionals.T)
    known = np.einsum("fd,df->f", functionals, weighted)
    open_ = slopes - weighted.T @ fitted.jacobian
    inverse = np.linalg.inv(fitted.normal)
    variance = np.maximum(own - known, 0) + np.einsum("fp,pq,fq->f", open_, inverse, open_)
    area = np.pi * size**2
    return Load(
        force=force,
        force_variance=variance[:3],
        place=middle + shift,
        place_variance=variance[3:5],
        moment=float(moment),
        moment_variance=float(variance[5]),
        area=area,
        area_uncertainty=2 * area * float(np.sqrt(inverse[first + 5, first + 5])),
    )


def _quadrature(radius: float) -> tuple[Array, Array]:
    """Points (Q, 2) on a disc and their areas (Q,): Gauss points in r^2 times angles."""
    t, weight = np.polynomial.legendre.leggauss(5)
    r, count = radius * np.sqrt((t + 1) / 2), 10
    angle = 2 * np.pi * (np.arange(count) + 0.5) / count
    points = np.stack([np.outer(r, np.cos(angle)).ravel(), np.outer(r, np.sin(angle)).ravel()], 1)
    return points, np.repeat(weight / 2, count) * np.pi * radius**2 / count
