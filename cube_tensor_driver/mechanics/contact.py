"""Stress and stress gradient in a half space under contact loads on its surface.

The skin is the half space z <= 0: z points out of the skin, its surface is z = 0 and a cube sits at
z = -depth. A force acts *on* the skin, so pressing has a negative z component.

With d = point - source, R = |d|, Z = -d_z and the harmonic potential chi = Z ln(R + Z) - R, the
solutions of Boussinesq (normal force) and Cerruti (tangential force) are one expression::

    sigma_ij = -3 / (2 pi) d_i d_j (F . d) / R^5  +  (1 - 2 nu) / (2 pi) C_ij
    C_xx = g_yy,  C_yy = g_xx,  C_xy = -g_xy,  C_zi = 0,   g = F_x chi_x + F_y chi_y - F_z chi_Z

The first term is all there is in an incompressible body. The second is a plane stress field with
the Airy function g: it balances by itself and leaves every plane z = const free of traction.

Source: K. L. Johnson, Contact Mechanics (1985), 3.2 (normal) and 3.6 (tangential); A. E. H. Love,
Phil. Trans. R. Soc. A 228 (1929) 377. They print the components. The form with g is ours; the tests
compare it with their components.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from ..core.arrays import Array
from ..core.errors import ElasticError

_ORDER_PER_RADIUS = 5.5
"""Order of a Hertz contact over its radius in depths, measured (`hertz_order`)."""
_PAIRS = ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))  # xx, yy, zz, yz, zx, xy


def field(
    points: ArrayLike, sources: ArrayLike, forces: ArrayLike, poisson: float
) -> tuple[Array, Array]:
    """Stress and its gradient at points under point forces on the surface.

    points: (..., N, 3) m, z <= 0
    sources: (..., L, 3) m, z = 0
    forces: (..., L, 3) N on the skin
    poisson: Poisson's ratio, -1 < nu <= 0.5; Young's modulus does not matter

    Returns stress (..., N, 6) in Pa, order xx yy zz yz zx xy, tension positive, and its gradient
    (..., N, 6, 3) in Pa/m, whose last axis is the direction of the derivative. Leading axes, such
    as time, broadcast. Memory: about 500 bytes per pair of point and force.

    Raises ElasticError for a point above the surface or on a source, a source off the surface, or a
    Poisson's ratio out of range.
    """
    p, s, f = (np.asarray(a, dtype=np.float64) for a in (points, sources, forces))
    _check(p, s, f, poisson)
    d = p[..., :, None, :] - s[..., None, :, :]
    f = f[..., None, :, :]
    radius = np.sqrt(np.einsum("...i,...i->...", d, d))
    if not np.all(radius > 0.0):
        raise ElasticError(
            "a point lies on a point force, where the stress is infinite; move it below the surface"
        )
    stress, gradient = _radial(d, f, radius)
    if poisson != 0.5:
        airy_stress, airy_gradient = _airy(d, f, radius)
        scale = (1.0 - 2.0 * poisson) / (2.0 * np.pi)
        stress += scale * airy_stress
        gradient += scale * airy_gradient
    return stress, gradient


def disc(
    radius: float, force: ArrayLike, centre: ArrayLike = (0.0, 0.0), order: int = 6
) -> tuple[Array, Array]:
    """Uniform traction on a disc, as point forces: sources (L, 3) m, forces (L, 3) N.

    radius m; force (3,) N; centre (2,) m; L = 4 order^2. The points are Gauss points in r^2 at
    equally spaced angles: the error falls exponentially with `order` at points deeper than the
    spacing. Raises ElasticError unless radius > 0 and order >= 1.
    """
    t, weight = _gauss(order)
    return _rings(radius, np.sqrt(t), weight, force, centre)


def hertz(
    radius: float, force: ArrayLike, centre: ArrayLike = (0.0, 0.0), order: int = 12
) -> tuple[Array, Array]:
    """Traction 3 F / (2 pi a^2) sqrt(1 - r^2 / a^2) on a disc: a sphere that presses or slides.

    Parameters, result and errors as for `disc`; Johnson 4.2 (normal) and 7.1 (sliding). The default
    order is good from a depth of half the radius on; `hertz_order` gives that for any depth.
    """
    t, weight = _gauss(order)  # with t = sqrt(1 - r^2): p r dr = t^2 dt, smooth at the rim
    return _rings(radius, np.sqrt(1.0 - t**2), 3.0 * weight * t**2, force, centre)


def hertz_order(radius: float, depth: float) -> int:
    """The order with which `hertz` is good from this depth on, both in m.

    Stress and gradient are then within 1e-3 of their greatest value at that depth, for radii of up
    to four depths: the error falls exponentially with order * depth / radius.
    """
    if not (radius > 0.0 and depth > 0.0):
        raise ElasticError(
            f"radius is {radius} m and depth {depth} m; a contact has a radius above 0, and its "
            "stress is asked for below the surface"
        )
    return max(6, math.ceil(_ORDER_PER_RADIUS * radius / depth))


def rectangle(
    sides: ArrayLike, force: ArrayLike, centre: ArrayLike = (0.0, 0.0), order: int = 8
) -> tuple[Array, Array]:
    """Uniform traction on a rectangle, as point forces; see `disc`. sides (2,) m; L = order^2."""
    length = np.asarray(sides, dtype=np.float64)
    if length.shape != (2,) or not np.all(length > 0.0):
        raise ElasticError(f"rectangle sides are {sides!r}; give two positive lengths in m")
    t, weight = _gauss(order)
    x, y = np.meshgrid((t - 0.5) * length[0], (t - 0.5) * length[1], indexing="ij")
    return _patch(x.ravel(), y.ravel(), np.outer(weight, weight).ravel(), force, centre)


def _check(points: Array, sources: Array, forces: Array, poisson: float) -> None:
    for name, a in (("points", points), ("sources", sources), ("forces", forces)):
        if a.ndim < 2 or a.shape[-1] != 3 or not np.all(np.isfinite(a)):
            raise ElasticError(
                f"{name} have shape {a.shape}; give finite numbers of shape (..., n, 3)"
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


def _radial(d: Array, f: Array, radius: Array) -> tuple[Array, Array]:
    """The first term of the module head and its gradient, summed over forces."""
    k = -3.0 / (2.0 * np.pi)
    pair = np.stack([d[..., i] * d[..., j] for i, j in _PAIRS], axis=-2)  # (..., N, 6, L)
    weight = k * np.einsum("...i,...i->...", d, f) / radius**5
    stress = np.einsum("...cl,...l->...c", pair, weight)
    slope = k * f / radius[..., None] ** 5 - 5.0 * (weight / radius**2)[..., None] * d
    gradient = pair @ slope
    arm = np.einsum("...l,...li->...i", weight, d)
    for c, (i, j) in enumerate(_PAIRS):
        gradient[..., c, i] += arm[..., j]
        gradient[..., c, j] += arm[..., i]
    return stress, gradient


def _airy(d: Array, f: Array, radius: Array) -> tuple[Array, Array]:
    """The field C_ij of the module head and its gradient, summed over forces.

    In a plane Z = const a function h of r has the derivatives h_ab = delta_ab h1 + d_a d_b h2 and
    so on, with h1 = h'/r, h2 = h1'/r, ... Below they are those of chi (chi2, chi3, chi4), of
    chi_Z = ln(R + Z) (log1, log2, log3) and of chi_ZZ = 1/R (inv1, inv2).
    """
    x, y, z = np.moveaxis(d, -1, 0)
    fx, fy, fz = np.moveaxis(np.broadcast_to(f, d.shape), -1, 0)
    u, v = 1.0 / radius, 1.0 / (radius - z)  # v = 1 / (R + Z) is finite: Z >= 0
    chi2, chi3 = u * v**2, -(u**3) * v**2 - 2 * u**2 * v**3
    chi4 = 3 * u**5 * v**2 + 6 * u**4 * v**3 + 6 * u**3 * v**4
    log1, log2 = u * v, -(u**3) * v - u**2 * v**2
    log3 = 3 * u**5 * v + 3 * u**4 * v**2 + 2 * u**3 * v**3
    inv1, inv2 = -(u**3), 3 * u**5
    q = fx * x + fy * y

    def second(c2: Array, c3: Array, l1: Array, l2: Array) -> list[Array]:
        """g_xx, g_xy, g_yy from the derivatives of its tangential and its normal potential."""
        a, b, c = q * c2 - fz * l1, q * c3 - fz * l2, 2 * c2
        gxx, gyy = a + c * fx * x + b * x * x, a + c * fy * y + b * y * y
        return [_sum(gxx), _sum(c2 * (fx * y + fy * x) + b * x * y), _sum(gyy)]

    gxx, gxy, gyy = second(chi2, chi3, log1, log2)
    gxxz, gxyz, gyyz = (-g for g in second(log2, log3, inv1, inv2))  # d/dz = -d/dZ
    a, b = q * chi3 - fz * log2, q * chi4 - fz * log3
    gxxx = _sum(3 * (chi2 * fx + a * x + chi3 * x * x * fx) + b * x**3)
    gyyy = _sum(3 * (chi2 * fy + a * y + chi3 * y * y * fy) + b * y**3)
    gxxy = _sum(chi2 * fy + a * y + chi3 * x * (x * fy + 2 * y * fx) + b * x * x * y)
    gxyy = _sum(chi2 * fx + a * x + chi3 * y * (y * fx + 2 * x * fy) + b * x * y * y)
    zero = np.zeros_like(gxx)
    stress = np.stack([gyy, gxx, zero, zero, zero, -gxy], axis=-1)
    rows = [
        [gxyy, gyyy, gyyz],
        [gxxx, gxxy, gxxz],
        [zero] * 3,
        [zero] * 3,
        [zero] * 3,
        [-gxxy, -gxyy, -gxyz],
    ]
    return stress, np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _sum(a: Array) -> Array:
    return np.asarray(a.sum(axis=-1))


def _gauss(order: int) -> tuple[Array, Array]:
    """Gauss-Legendre points and weights on (0, 1)."""
    if order < 1:
        raise ElasticError(f"quadrature order is {order}; it must be at least 1")
    t, weight = np.polynomial.legendre.leggauss(order)
    return (t + 1.0) / 2.0, weight / 2.0


def _rings(
    radius: float, r: Array, weight: Array, force: ArrayLike, centre: ArrayLike
) -> tuple[Array, Array]:
    """Point forces on rings of radii r (n,) times the patch's, each with its part of the force."""
    if not radius > 0.0:
        raise ElasticError(f"patch radius is {radius} m; it must be positive")
    n = 4 * len(r)
    angle = 2.0 * np.pi * (np.arange(n) + 0.5) / n
    x, y = np.outer(r, np.cos(angle)), np.outer(r, np.sin(angle))
    return _patch(radius * x.ravel(), radius * y.ravel(), np.repeat(weight / n, n), force, centre)


def _patch(
    x: Array, y: Array, fraction: Array, force: ArrayLike, centre: ArrayLike
) -> tuple[Array, Array]:
    """Point forces at x, y (L,) about the centre; fraction (L,): of the force that each carries."""
    cx, cy = np.asarray(centre, dtype=np.float64)[:2]
    sources = np.stack([cx + x, cy + y, np.zeros_like(x)], axis=-1)
    return sources, fraction[:, None] * np.asarray(force, dtype=np.float64)
