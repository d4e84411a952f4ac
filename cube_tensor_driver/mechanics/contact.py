# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Stress and stress gradient in a half space under contact loads on its surface.

The skin is the half space z <= 0: z points out of the skin, its surface is z = 0 and a cube is at z
= -depth. A force acts *on* the skin, so that a force that presses has a negative z component.

A force F acts at a source on the surface. With d = point - source, ``R = |d|``, Z = -d_z and the
harmonic potential chi = Z ln(R + Z) - R, the solutions of Boussinesq (normal force) and Cerruti
(tangential force) for the stress sigma at the point are one expression; nu is Poisson's ratio, and
an index of chi and g is a derivative::

    sigma_ij = -3 / (2 pi) d_i d_j (F . d) / R^5  +  (1 - 2 nu) / (2 pi) C_ij
    C_xx = g_yy,  C_yy = g_xx,  C_xy = -g_xy,  C_zi = 0,   g = F_x chi_x + F_y chi_y - F_z chi_Z

An incompressible body has only the first term. The second term is a plane stress field with the
Airy function g: it is in equilibrium by itself and leaves every plane z = const free of traction.

Source: K. L. Johnson, Contact Mechanics (1985), 3.2 (normal) and 3.6 (tangential); A. E. H. Love,
Phil. Trans. R. Soc. A 228 (1929) 377. These sources give the components one by one. The form with g
was derived for this project; the tests compare it with the components of the sources.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from ..core.arrays import Array, Complex
from ..core.errors import ElasticError

_HERTZ_ORDER_PER_RADIUS = 5.5
"""Quadrature order (number of rings of point forces) that represents a Hertz contact accurately,
divided by the ratio of its radius to the depth at which the stress is computed. The value was found
by numerical tests."""

_MIN_HERTZ_ORDER = 6
"""Smallest quadrature order (number of rings of point forces) that represents a Hertz contact. It
suffices for contacts with radii that are small compared with the depth of the cubes."""

_STRESS_AXES = ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))
"""Indices of both axes (0: x, 1: y, 2: z) of the stress components xx, yy, zz, yz, zx, xy."""

_IN_PLANE = [0, 1, 5]
"""Indices of the stress components xx, yy and xy, which the Airy function g determines."""


def field(
    points: ArrayLike,
    sources: ArrayLike,
    forces: ArrayLike,
    poisson: float,
) -> tuple[Array, Array]:
    """Compute stress and its gradient at points under point forces on the surface.

    Leading axes of the arguments, such as time, follow NumPy's broadcasting rules. About 500 bytes
    of memory are used per pair of a point and a force.

    Args:
        points: Positions (..., N, 3) in m, z <= 0.
        sources: Positions (..., L, 3) of the forces in m, z = 0.
        forces: Forces (..., L, 3) in N on the skin.
        poisson: Poisson's ratio, -1 < nu <= 0.5. Young's modulus does not influence the stress.

    Returns:
        Stress (..., N, 6) in Pa, order xx yy zz yz zx xy, tension positive, and its gradient
        (..., N, 6, 3) in Pa/m, whose last axis is the direction of the derivative.

    Raises:
        ElasticError: A point lies above the surface or on a source, a source lies off the surface,
            or Poisson's ratio is out of range.
    """
    points = np.asarray(points, dtype=np.float64)
    sources = np.asarray(sources, dtype=np.float64)
    forces = np.asarray(forces, dtype=np.float64)
    _check(points, sources, forces, poisson)

    # d has one row per point and one column per force.
    rows = points[..., :, None, :]
    columns = sources[..., None, :, :]
    d = rows - columns
    forces = forces[..., None, :, :]
    distance = np.sqrt(np.einsum("...i,...i->...", d, d))
    if not np.all(distance > 0.0):
        raise ElasticError(
            "a point lies on a point force, where the stress is infinite; move it below the surface"
        )

    stress, gradient = _compute_radial(d, forces, distance)
    # The second term of the solution vanishes for an incompressible body.
    if poisson != 0.5:
        airy_stress, airy_gradient = _compute_airy(d, forces, distance)
        scale = (1.0 - 2.0 * poisson) / (2.0 * np.pi)
        stress += scale * airy_stress
        gradient += scale * airy_gradient
    return stress, gradient


def disc(
    radius: float,
    force: ArrayLike,
    centre: ArrayLike = (0.0, 0.0),
    order: int = 6,
) -> tuple[Array, Array]:
    """Return point forces that represent a uniform traction on a disc.

    The point forces lie on rings, at Gauss points in r^2 and at equally spaced angles. The error of
    the stress at depths larger than their spacing decreases exponentially with `order`.

    Args:
        radius: Radius of the disc in m.
        force: Total force (3,) in N.
        centre: Centre (2,) of the disc in m.
        order: Number of rings of point forces.

    Returns:
        Sources (L, 3) in m and forces (L, 3) in N, with L = 4 order^2.

    Raises:
        ElasticError: `radius` is not positive or `order` is below 1.
    """
    points, weights = _compute_gauss_points(order)
    return _place_rings(
        radius,
        np.sqrt(points),
        weights,
        force,
        centre,
    )


def hertz(
    radius: float,
    force: ArrayLike,
    centre: ArrayLike = (0.0, 0.0),
    order: int = 12,
) -> tuple[Array, Array]:
    """Return point forces that represent the traction below a sphere that presses or slides.

    The traction at the distance r from the centre is 3 F / (2 pi a^2) sqrt(1 - r^2 / a^2), with the
    force F and the radius a (Johnson, Contact Mechanics, 4.2 for pressing and 7.1 for sliding).
    Arguments, result and exceptions are those of `disc`. The default order is accurate at depths of
    at least half the radius; `choose_hertz_order` returns the order for any depth.
    """
    points, weights = _compute_gauss_points(order)
    # The Gauss points are placed in t = sqrt(1 - r^2) instead of r. The integrand p r dr = t^2 dt
    # is then smooth at the rim, where the pressure p as a function of r has a vertical slope.
    radii = np.sqrt(1.0 - points**2)
    fractions = 3.0 * weights * points**2
    return _place_rings(
        radius,
        radii,
        fractions,
        force,
        centre,
    )


def choose_hertz_order(radius: float, depth: float) -> int:
    """Return the quadrature order with which the point forces of `hertz` are accurate at a depth.

    The order is the number of rings on which the point forces lie.

    The errors of stress and gradient at this depth are then at most 1e-3 of their largest values,
    for radii of up to four depths. They decrease exponentially with order * depth / radius.

    Args:
        radius: Radius of the contact in m.
        depth: Smallest depth below the surface at which the stress is computed, in m.

    Raises:
        ElasticError: An argument is not positive.
    """
    if not (radius > 0.0 and depth > 0.0):
        raise ElasticError(
            f"radius is {radius} m and depth {depth} m; a contact has a radius above 0, and its "
            "stress is asked for below the surface"
        )
    order = math.ceil(_HERTZ_ORDER_PER_RADIUS * radius / depth)
    return max(_MIN_HERTZ_ORDER, order)


def _check(
    points: Array,
    sources: Array,
    forces: Array,
    poisson: float,
) -> None:
    """Check the arguments of `field`.

    Raises:
        ElasticError: An array has a wrong shape or is not finite, numbers of sources and forces
            differ, Poisson's ratio is out of range, a point lies above the surface z = 0, or a
            source lies off it.
    """
    for name, array in (
        ("points", points),
        ("sources", sources),
        ("forces", forces),
    ):
        has_shape = array.ndim >= 2 and array.shape[-1] == 3
        if not has_shape or not np.all(np.isfinite(array)):
            raise ElasticError(
                f"{name} have shape {array.shape}; give finite numbers of shape (..., n, 3)"
            )
    if sources.shape[-2] != forces.shape[-2]:
        raise ElasticError(
            f"{sources.shape[-2]} sources but {forces.shape[-2]} forces; give one force per source"
        )
    if not -1.0 < poisson <= 0.5:
        raise ElasticError(f"Poisson's ratio is {poisson}; it must lie in (-1, 0.5]")
    if np.any(points[..., 2] > 0.0):
        raise ElasticError(
            f"a point is at z = {points[..., 2].max():g} m; the skin is z <= 0, depths are "
            "negative z"
        )
    if np.any(sources[..., 2] != 0.0):
        raise ElasticError("a force acts off the surface; sources must have z = 0")


def _compute_radial(
    d: Array,
    forces: Array,
    distance: Array,
) -> tuple[Array, Array]:
    """Compute the stress in an incompressible half space and its gradient, summed over the forces.

    This is the first term of the solution at the head of this file. With w = -3 / (2 pi) (F . d) /
    R^5, sigma_ij = w d_i d_j, and its derivative along k is d_i d_j dw/dk + w (delta_ik d_j +
    delta_jk d_i).

    Args:
        d: Positions (..., N, L, 3) of N points from L forces, in m.
        forces: Forces (..., 1, L, 3) in N.
        distance: Lengths (..., N, L) of `d`, in m.

    Returns:
        Stress (..., N, 6) in Pa and gradient (..., N, 6, 3) in Pa/m.
    """
    constant = -3.0 / (2.0 * np.pi)
    pairs = [d[..., i] * d[..., j] for i, j in _STRESS_AXES]
    products = np.stack(pairs, axis=-2)
    f_dot_d = np.einsum("...i,...i->...", d, forces)
    w = constant * f_dot_d / distance**5
    stress = np.einsum("...cl,...l->...c", products, w)

    # dw/dk = constant F_k / R^5 - 5 w d_k / R^2
    by_force = constant * forces / distance[..., None] ** 5
    w_by_square = w / distance**2
    by_distance = 5.0 * w_by_square[..., None] * d
    gradient = products @ (by_force - by_distance)
    weighted_d = np.einsum("...l,...li->...i", w, d)
    for component, (i, j) in enumerate(_STRESS_AXES):
        gradient[..., component, i] += weighted_d[..., j]
        gradient[..., component, j] += weighted_d[..., i]
    return stress, gradient


def _compute_airy(
    d: Array,
    forces: Array,
    distance: Array,
) -> tuple[Array, Array]:
    """Compute the field C_ij at the head of this file and its gradient, summed over the forces.

    C is the part of the stress that depends on Poisson's ratio. It consists of derivatives of the
    potentials chi, chi_Z = ln(R + Z) and chi_ZZ = 1/R. In a plane Z = const, each potential is a
    function h of r^2 = x^2 + y^2. With the complex position c = x + i y and its conjugate c*, the
    derivatives of h consist of the functions h1 = h'/r, h2 = h1'/r and so on::

        dh/dc = c* h1 / 2,     dh1/dc = c* h2 / 2,     dr^2/dc = c*,     4 d^2/(dc dc*) = Laplace

    The trace T = g_xx + g_yy and the deviator D = g_xx - g_yy - 2 i g_xy of the second derivatives
    of g then are, with s = F_x x + F_y y and F = F_x + i F_y::

        T = 4 g_cc* = s (4 chi2 + r^2 chi3) - F_z (2 log1 + r^2 log2)
        D = 4 g_cc  = 2 F* c* chi2 + c*^2 (s chi3 - F_z log2)

    In the code, the numbered functions are called chi2 to chi4 for h = chi, log1 to log3 for
    h = chi_Z, and inv1 and inv2 for h = chi_ZZ.

    Args:
        d: Positions (..., N, L, 3) of N points from L forces, in m.
        forces: Forces (..., 1, L, 3) in N.
        distance: Lengths (..., N, L) of `d`, in m.

    Returns:
        Field C (..., N, 6) and its gradient (..., N, 6, 3), without the factor of Poisson's ratio.
    """
    x, y, z = np.moveaxis(d, -1, 0)
    forces_at_points = np.broadcast_to(forces, d.shape)
    fx, fy, fz = np.moveaxis(forces_at_points, -1, 0)
    f_dot_d = fx * x + fy * y
    r_square = x**2 + y**2
    position = x - 1j * y  # The conjugates c* and F* of the docstring.
    force = fx - 1j * fy

    # The derivatives of the potentials are polynomials in u = 1/R and v = 1/(R + Z).
    u = 1.0 / distance
    v = 1.0 / (distance - z)  # 1 / (R + Z), finite because Z >= 0
    chi2 = u * v**2
    chi3 = -(u**3) * v**2 - 2 * u**2 * v**3
    chi4 = 3 * u**5 * v**2 + 6 * u**4 * v**3 + 6 * u**3 * v**4
    log1 = u * v
    log2 = -(u**3) * v - u**2 * v**2
    log3 = 3 * u**5 * v + 3 * u**4 * v**2 + 2 * u**3 * v**3
    inv1 = -(u**3)
    inv2 = 3 * u**5

    def differentiate_twice(
        t2: Array,
        t3: Array,
        n1: Array,
        n2: Array,
    ) -> tuple[Array, Complex]:
        """Return trace T and deviator D of the second derivatives of the Airy function g.

        They determine the in-plane stress. With the distance R from a force and the depth Z below
        it, the potential h of a tangential force is chi = Z ln(R + Z) - R, and that of a normal
        force is dchi/dZ = ln(R + Z). T and D depend on the functions h1 = (dh/dr) / r,
        h2 = (dh1/dr) / r and h3 = (dh2/dr) / r, where r is the distance from the normal through the
        force, and Z is constant. With these functions of dh/dZ instead of h, the results are the
        derivatives of T and D by Z.

        Args:
            t2, t3: h2 and h3 for tangential forces.
            n1, n2: h1 and h2 for normal forces.
        """
        trace = f_dot_d * (4 * t2 + r_square * t3) - fz * (2 * n1 + r_square * n2)
        deviator = 2 * force * position * t2 + position**2 * (f_dot_d * t3 - fz * n2)
        return trace.sum(axis=-1), deviator.sum(axis=-1)

    trace, deviator = differentiate_twice(chi2, chi3, log1, log2)
    trace_z, deviator_z = differentiate_twice(log2, log3, inv1, inv2)
    # `mixed` becomes dT/dc, which equals dD/dc*; `pure` becomes dD/dc.
    tangential = f_dot_d * (3 * chi3 + r_square / 2 * chi4)
    normal = fz * (2 * log2 + r_square / 2 * log3)
    mixed = force / 2 * (4 * chi2 + r_square * chi3) + position * (tangential - normal)
    mixed = mixed.sum(axis=-1)
    pure = position**2 * (1.5 * force * chi3 + position / 2 * (f_dot_d * chi4 - fz * log3))
    pure = pure.sum(axis=-1)

    # Along x, d/dx = d/dc + d/dc*; along y, d/dy = i (d/dc - d/dc*). The depth Z below a force is
    # -z, so a derivative by z is the negative of the one by Z.
    traces = [2 * mixed.real, -2 * mixed.imag, -trace_z]
    deviators = [pure + mixed, 1j * (pure - mixed), -deviator_z]
    stress = np.zeros((*trace.shape, len(_STRESS_AXES)))
    gradient = np.zeros((*stress.shape, 3))
    stress[..., _IN_PLANE] = _combine(trace, deviator)
    for axis in range(3):
        gradient[..., _IN_PLANE, axis] = _combine(traces[axis], deviators[axis])
    return stress, gradient


def _combine(trace: Array, deviator: Complex) -> Array:
    """Return C_xx = g_yy, C_yy = g_xx and C_xy = -g_xy (..., 3) from the trace and the deviator of
    the second derivatives of g."""
    g_yy = (trace - deviator.real) / 2
    g_xx = (trace + deviator.real) / 2
    return np.stack([g_yy, g_xx, deviator.imag / 2], axis=-1)


def _compute_gauss_points(order: int) -> tuple[Array, Array]:
    """Return Gauss-Legendre points (order,) and weights (order,) on the interval from 0 to 1.

    Raises:
        ElasticError: `order` is below 1.
    """
    if order < 1:
        raise ElasticError(f"quadrature order is {order}; it must be at least 1")
    # NumPy's points and weights are for the interval from -1 to 1.
    points, weights = np.polynomial.legendre.leggauss(order)
    return (points + 1.0) / 2.0, weights / 2.0


def _place_rings(
    radius: float,
    rings: Array,
    fractions: Array,
    force: ArrayLike,
    centre: ArrayLike,
) -> tuple[Array, Array]:
    """Return point forces on n concentric rings, with 4 n equally spaced forces on each.

    Args:
        radius: Radius of the contact in m.
        rings: Radii (n,) of the rings, divided by the radius of the contact.
        fractions: Fraction (n,) of the force on each ring.
        force: Total force (3,) in N.
        centre: Centre (2,) of the contact in m.

    Returns:
        Sources (4 n^2, 3) in m and forces (4 n^2, 3) in N.
    """
    if not radius > 0.0:
        raise ElasticError(f"patch radius is {radius} m; it must be positive")
    # Each ring has four times as many forces as there are rings, so that neighbouring forces on the
    # outermost ring are about as far apart as neighbouring rings.
    n = 4 * len(rings)
    angle = 2.0 * np.pi * (np.arange(n) + 0.5) / n
    x = radius * np.outer(rings, np.cos(angle)).ravel()
    y = radius * np.outer(rings, np.sin(angle)).ravel()
    per_force = np.repeat(fractions / n, n)
    cx, cy = np.asarray(centre, dtype=np.float64)[:2]
    z = np.zeros_like(x)
    sources = np.stack([cx + x, cy + y, z], axis=-1)
    total = np.asarray(force, dtype=np.float64)
    return sources, per_force[:, None] * total
