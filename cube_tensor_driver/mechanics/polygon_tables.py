"""Stress and gradient at cubes under polygons of traction, fast enough for every step of a robot.

Seen from a cube's foot on the surface, a polygon is the sum of the triangles between the foot and
its edges, negative where an edge is seen from outside. Such a triangle is the difference of two
right ones: one leg d goes to the edge's line in the direction beta, the other, t, along that line.
With q the place from the foot, the traction is (v_x, v_y, v_z) + w z x q. In the circular
components of circular.py, of order m, a right triangle then makes::

    c = exp(i m beta) (A v + B conj(v) + Z v_z + W w),     v = (v_x + i v_y) exp(-i beta)

The tables A, B, Z and W over d and t are integrals of a point force's R, T and Z. With polar
coordinates about the foot, alpha from the first leg on and the hypotenuse at r = d / cos(alpha)::

    A = -(-1)^m int exp(i (m-1) alpha) int (R + T) / 2 r dr dalpha
    B = -(-1)^m int exp(i (m+1) alpha) int (R - T) / 2 r dr dalpha
    Z =  (-1)^m int exp(i m alpha) int Z r dr dalpha
    W = -i (-1)^m int exp(i m alpha) int T r^2 dr dalpha
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline

from ..core.arrays import Array, Complex
from .cache import cached
from .circular import ORDERS, summed
from .kernels import PER_DEPTH, REACH
from .layer import Layer
from .spectra import bessel_functions, layer_spectra

STEP = 1 / 16
"""Of asinh(d) and of asinh(t / sqrt(1 + d^2)) in the tables, with lengths over the depth."""
LONGEST = 50.0
"""t / sqrt(1 + d^2) up to which the tables go; longer legs are cut there."""
_ROWS = int(np.ceil(np.arcsinh(REACH) / STEP)) + 2
_HALF = int(np.ceil(np.arcsinh(LONGEST) / STEP))
_COLUMNS = 2 * _HALF + 1


class PolygonTables:
    """Tables for cubes at one depth in a layer.

    Parameters: layer; depth: from the cubes' centres to the surface, m. Raises ElasticError where
    the layer has no such depth. Takes a second or two the first time (cache.py).
    """

    def __init__(self, layer: Layer, depth: float) -> None:
        layer.check_depth(depth)
        self.layer, self.depth = layer, depth
        key = [layer.thickness, layer.poisson, depth]
        table = cached("polygon_tables", key, self._tables)["table"]
        self._rows = table.reshape(-1, 4 * len(ORDERS)).view(np.float32)

    def _tables(self) -> dict[str, NDArray[np.complex64]]:
        """table (rows, columns, 4, 14): A, B, Z and W of each component; rows are of d, columns of
        t, from -LONGEST on."""
        spectra = layer_spectra(self.layer, self.depth)
        r = np.arange(REACH * PER_DEPTH + 2)[:, None] / PER_DEPTH
        everywhere = np.ones((1, len(spectra.k)))
        bessel = bessel_functions(spectra.k, r[:, 0] * self.depth)
        along, normal, across = spectra.radial(bessel, everywhere)[0].swapaxes(0, 1)
        columns = [(along + across) / 2, (along - across) / 2, normal, across * r]
        over_r = CubicSpline(r[:, 0], np.stack(columns, axis=1) * r[..., None]).antiderivative()

        eta = np.arange(-_HALF, _HALF + 1) * STEP
        d = np.sinh(np.arange(_ROWS) * STEP)[:, None]
        t = np.hypot(1.0, d) * np.sinh(eta)
        r = np.hypot(d, t)
        r_safe = np.where(r > 0, r, 1.0)
        turn = np.where(r > 0, (d + 1j * t) / r_safe, 1.0)
        angle_over_eta = d * np.hypot(1.0, d) * np.cosh(eta) / r_safe**2
        orders = np.stack([ORDERS - 1, ORDERS + 1, ORDERS, ORDERS])
        slope = over_r(np.minimum(r, REACH)) * turn[..., None, None] ** orders
        slope *= angle_over_eta[..., None, None]
        table = CubicSpline(eta, slope, axis=1).antiderivative()(eta)
        table -= table[:, _HALF : _HALF + 1]
        sign = (-1.0) ** ORDERS * np.array([-1.0, -1.0, 1.0, -1j])[:, None]
        unit = self.depth ** np.array([2.0, 2.0, 2.0, 3.0])[:, None]
        return {"table": (table * sign * unit).astype(np.complex64)}

    def field(
        self, start: ArrayLike, end: ArrayLike, traction: ArrayLike, twist: ArrayLike
    ) -> tuple[Array, Array]:
        """Stress (N, 6) in Pa and gradient (N, 6, 3) in Pa/m, each the sum over polygons with L
        edges in all.

        start, end: (N, L, 2) m, of the edges from the cube, in the cube's frame; polygons are
            counterclockwise as seen from outside
        traction: (N, L, 3) Pa on the skin at the cube's foot, of the edge's polygon; twist: (N, L)
            Pa/m: elsewhere it is more by twist z x q, with q the place from the foot

        Beyond REACH depths point forces count as zero. Order xx yy zz yz zx xy, tension positive,
        as in `contact.field`.
        """
        first, second = (_complex(np.asarray(one, float)) / self.depth for one in (start, end))
        along = second - first
        along /= np.maximum(np.abs(along), 1e-12)
        local = np.stack([first, second], axis=-1) * along.conj()[..., None]  # t - i d
        d = -local[..., 0].imag
        side = np.where(d < 0, -1.0, 1.0)
        beta = -1j * along * side  # as exp(i beta)
        d, t = np.abs(d), local.real * side[..., None]
        # Beyond REACH all that counts is the angle.
        near = np.minimum(1.0, REACH / np.maximum(d, REACH))
        weights, places = _around(d * near, t * near[..., None])
        tables = (weights[..., None, :] @ self._rows.take(places, axis=0)).view(np.complex64)
        tables = tables.reshape(*d.shape, 4, -1)
        load = np.asarray(traction, float)
        v = _complex(load) * beta.conj()
        loads = np.stack([v, v.conj(), load[..., 2], np.asarray(twist, float)], axis=-1)
        circular = loads[..., None, :].astype(np.complex64) @ tables
        return summed(circular[..., 0, :], beta)


def _complex(vectors: Array) -> Complex:
    """x + i y (...) of vectors (..., 2 or 3)."""
    result: Complex = vectors[..., 0] + 1j * vectors[..., 1]
    return result


def _around(d: Array, t: Array) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
    """Entries of the tables about d (...) and t (..., 2), both over the depth, and their weights,
    each (..., 8): those of the second t less those of the first."""
    column = np.arcsinh(t / np.hypot(1.0, d)[..., None]) / STEP + _HALF
    column = np.clip(column, 0, _COLUMNS - 1 - 1e-6)
    row = np.arcsinh(d) / STEP
    above, left = row.astype(np.intp), column.astype(np.intp)
    down, right = (row - above)[..., None], column - left
    around = np.array([0, 1, _COLUMNS, _COLUMNS + 1])
    places = (_COLUMNS * above[..., None] + left)[..., None] + around
    parts = [(1 - down) * (1 - right), (1 - down) * right, down * (1 - right), down * right]
    weights = np.stack(parts, axis=-1, dtype=np.float32)
    weights[..., 0, :] *= -1
    return weights.reshape(*d.shape, 8), places.reshape(*d.shape, 8)
