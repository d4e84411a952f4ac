"""What cubes at one depth see of tractions on the surface, and how that varies together.

The layer is the same everywhere and in all directions. So whatever depends on two places is known
from its values along one line: the offset p = r (cos phi, sin phi) turns them by phi. With the
transfer functions T(k) of layer.py and a prior of the traction with the spectrum S(k)::

    response(p) = int T exp(i k.p) B_a,     B_a = 3 (sin ka - ka cos ka) / (ka)^3
    cross(p)    = int T S exp(i k.p),       covariance(p) = int T S T* exp(i k.p)      [d2k / 4 pi2]

B_a is the spectrum of Hertz's pressure on a disc of radius a, of force 1. The prior is Gaussian
with mean zero; normal traction and both shears are independent. It has two lengths, because
contacts are narrow or wide: per unit of variance half of each::

    S = sum_l (1/2) 2 pi l^2 exp(-(k l)^2 / 2)        (shear: SHEAR^2 times that)
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import jv

from ..core.modes import COMPONENTS, STRESS
from .cache import cached
from .circular import BACK, ORDERS, circular_table
from .layer import FIELD, Layer

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

LENGTHS = (0.2, 0.8)
"""Of the prior over the depth: near the pair that explained contacts of 2 to 20 mm best, in a half
space at a depth of 5 mm."""
SHEAR = 0.5
"""Prior standard deviation of shear over that of pressure."""
SIZES = np.geomspace(0.1, 5.0, 44)
"""Radii of the discs of `response` over the depth. What lies between them is interpolated, to a
hundredth of the greatest value at the wide end."""
_GREATEST = 25.0
"""Wavenumber times depth at which integrals end: the field has decayed by exp(-25)."""
_WAVES, _ANGLES = 256, 32
"""Gauss points in k, which resolve the Bessel functions out to the tables' reach. Directions of k:
more than twice the order 8 of the covariance's dependence on them."""
PER_DEPTH = 32
"""Places of the tables per depth: cubic interpolation is then good to 1e-4 of the peak."""
REACH = 20
"""Of the tables, over the depth; beyond it everything counts as zero."""
_OBSERVED = np.array([FIELD.index(name) for name in COMPONENTS])
_ZZ = STRESS.index("zz")


class Kernels:
    """Tables for cubes at one depth in a layer; lengths in m.

    Places are (N, 2) m. Components are COMPONENTS with gradients times `scale` (m), all in Pa, in
    the frame of a cube that is turned about z by `angle` (N,) rad. Tractions are along x, y, z.
    """

    def __init__(self, layer: Layer, depth: float, scale: float) -> None:
        """Raises ElasticError where the layer has no such depth. Takes a few seconds the first time
        (cache.py)."""
        layer.check_depth(depth)
        self.layer, self.depth, self.scale = layer, depth, scale
        self._row_scale = np.where(np.arange(len(COMPONENTS)) < len(STRESS), 1.0, scale)
        self.step, self._last = depth / PER_DEPTH, REACH * PER_DEPTH
        key = [layer.thickness, layer.poisson, depth]
        tables = cached("kernels", key, self._tables)
        self._cross, self._covariance = tables["cross"], tables["covariance"]
        self._response = tables["response"]
        self.variance = np.array([SHEAR**2, SHEAR**2, 1.0])
        self.pressure_variance = float(self._covariance[1, _ZZ, _ZZ])

    def _tables(self) -> dict[str, Array]:
        """cross (places, 24, 3), covariance (places, 24, 24), response (sizes, places, 3, 14) as
        in circular.py."""
        waves = Waves(self.layer, self.depth)
        transfer = waves.transfer
        weighted = transfer * (self._prior(waves.k)[:, None, None, None] * [SHEAR**2, SHEAR**2, 1])
        return {
            "cross": waves.line(weighted),
            "covariance": waves.line(weighted @ transfer.conj().swapaxes(2, 3)),
            "response": circular_table(waves.discs(SIZES * self.depth)),
        }

    def response(self, place: Array, angle: Array, size: float) -> Array:
        """(N, 15, 3) of cubes at `place` from the middle of a disc with force 1 N; size: m."""
        return self._disc(place, angle, size, BACK[:, _OBSERVED] * self._row_scale)

    def field(self, place: Array, size: float) -> Array:
        """(N, 24, 3) FIELD in Pa and Pa/m at `place` from the middle of such a disc."""
        return self._disc(place, np.zeros(len(place)), size, BACK)

    def cross(self, place: Array, angle: Array) -> Array:
        """(N, 15, 3) covariance of cubes at `place` from a point with the point's traction."""
        r, direction = _polar(place)
        return self._turned(_at(self._cross, r / self.step, self._last), direction, angle)

    def covariance(self, place: Array, angle: Array, other: Array) -> Array:
        """(N, 15, 15) of cubes at `place` from other cubes, turned by `angle` and `other`."""
        r, direction = _polar(place)
        table = _at(self._covariance, r / self.step, self._last)
        return self._rows(direction - angle) @ table @ self._rows(direction - other).swapaxes(1, 2)

    def pressure(self, place: Array, angle: Array) -> Array:
        """(N, 15) covariance of cubes at `place` from a point with the pressure at the cubes' depth
        below the point."""
        r, direction = _polar(place)
        table = _at(self._covariance[:, :, _ZZ], r / self.step, self._last)
        return -np.einsum("naf,nf->na", self._rows(direction - angle), table)

    def disc_pressure(self, place: Array, size: float, force: Array) -> Array:
        """(N,) pressure at the cubes' depth at `place` from the middle of a disc; force (3,) N."""
        zero = np.zeros(len(place))
        return -self.response(place, zero, size)[:, _ZZ] @ force

    def _disc(self, place: Array, angle: Array, size: float, back: Array) -> Array:
        """(N, rows, 3) under a disc, in frames turned by `angle`; back: (28, rows) as BACK."""
        r, direction = _polar(place)
        position = r / self.step
        needed = int(min(position.max(initial=0.0), self._last)) + 4
        parts = _at(self._disc_table(size, needed), position, self._last)
        radial, normal, across = parts[:, 0], parts[:, 1], 1j * parts[:, 2]
        c, s = np.cos(direction)[:, None], np.sin(direction)[:, None]
        forces = np.stack([c * radial - s * across, s * radial + c * across, normal], axis=1)
        turn = np.exp(1j * (direction - angle))
        powers = np.stack([np.ones_like(turn), turn, turn**2, turn**3], axis=1)
        circular = powers[:, None, ORDERS] * forces
        rows = np.concatenate([circular.real, circular.imag], axis=2) @ back
        return np.asarray(rows.swapaxes(1, 2))

    def _disc_table(self, size: float, places: int) -> Array:
        """(places, 3, 14) of a disc of this radius, m, as far as it is needed."""
        position = np.log(size / self.depth / SIZES[0]) / np.log(SIZES[1] / SIZES[0])
        first, weight = _cubic(np.clip(position, 1.0, len(SIZES) - 2.001))
        near = self._response[int(first) - 1 : int(first) + 3, :places]
        return np.asarray(np.tensordot(weight, near, axes=1))

    def _prior(self, wave: Array) -> Array:
        lengths = np.array(LENGTHS) * self.depth
        parts = [2 * np.pi * l**2 * np.exp(-((wave * l) ** 2) / 2) for l in lengths]
        return np.mean(parts, axis=0)

    def _turned(self, table: Array, direction: Array, angle: Array) -> Array:
        turn = _vector_rotation(direction).swapaxes(1, 2)
        return self._rows(direction - angle) @ (table @ turn)

    def _rows(self, angle: Array) -> Array:
        """(N, 15, 24) components in a frame turned by -angle against that of the field."""
        turned = field_rotation(angle)[:, _OBSERVED]
        turned *= self._row_scale[:, None]
        return turned


class Waves:
    """The transfer functions of a layer at one depth, and integrals of them over all wavenumbers.

    k: (waves,) 1/m; transfer: (waves, angles, 24, 3) at k in each direction
    """

    def __init__(self, layer: Layer, depth: float) -> None:
        """Raises ElasticError where the layer has no such depth."""
        nodes, weights = np.polynomial.legendre.leggauss(_WAVES)
        self.k = np.asarray((nodes + 1) * _GREATEST / depth / 2)
        self._weight = np.asarray(weights * _GREATEST / depth / 2)
        angle = 2 * np.pi * np.arange(_ANGLES) / _ANGLES
        kx, ky = np.outer(self.k, np.cos(angle)), np.outer(self.k, np.sin(angle))
        self.transfer = layer.transfer(kx, ky, depth)
        # (-1, 0, ...) steps: cubic interpolation needs one more on the left.
        self._r: Array = np.arange(-1.0, REACH * PER_DEPTH + 3) * (depth / PER_DEPTH)
        self._kernels: dict[int, Array] = {}

    def line(self, spectrum: Complex) -> Array:
        """(places, ...) of a spectrum (waves, angles, ...), at places r on the x axis.

        A spectrum sum_m F_m(k) exp(i m phi) gives sum_m i^m int F_m J_m(k r) k dk / (2 pi).
        """
        return self.lines(spectrum, np.ones((1, len(self.k))))[0]

    def lines(self, spectrum: Complex, factors: Array) -> Array:
        """(factors, places, ...) of the spectrum times each of the factors (factors, waves)."""
        parts = np.fft.fft(spectrum, axis=1) / _ANGLES
        shape = parts.shape[2:]
        result = np.zeros((len(factors), len(self._r), int(np.prod(shape))))
        for m in range(_ANGLES // 4 + 1):
            both = parts[:, m] if m == 0 else parts[:, m] + parts[:, -m]
            share = (1j**m * both).real.reshape(len(both), -1)
            if np.abs(share).max() > 0:
                kernel = self._kernel(m)
                for total, factor in zip(result, factors, strict=True):
                    total += kernel @ (share * factor[:, None])
        return result.reshape(*result.shape[:2], *shape)

    def _kernel(self, m: int) -> Array:
        """(places, waves) J_m with what integrates it, made when it is needed: it takes long."""
        if m not in self._kernels:
            bessel = jv(m, self._r[:, None] * self.k)
            self._kernels[m] = bessel * (self._weight * self.k / (2 * np.pi))
        return self._kernels[m]

    def discs(self, sizes: Array) -> Array:
        """(sizes, places, 24, 3) FIELD under discs with force 1 N along x, y and z; sizes: their
        radii, m."""
        return self.lines(self.transfer, np.stack([_disc(self.k * size) for size in sizes]))


def hertz_pressure(distance: Array, size: float) -> Array:
    """Pressure of a disc of radius `size` with force 1 N at its distances from the middle, Pa."""
    inside = np.clip(1 - (distance / size) ** 2, 0, None)
    return 3 / (2 * np.pi * size**2) * np.sqrt(inside)


def field_rotation(angle: Array) -> Array:
    """(N, 24, 24) that turns FIELD by angles (N,) about z."""
    c, s = np.cos(angle), np.sin(angle)
    six = np.zeros((len(angle), 6, 6))
    six[:, 0, 0] = six[:, 1, 1] = c * c
    six[:, 0, 1] = six[:, 1, 0] = s * s
    six[:, 0, 5], six[:, 1, 5] = -2 * c * s, 2 * c * s
    six[:, 5, 0], six[:, 5, 1], six[:, 5, 5] = c * s, -c * s, c * c - s * s
    six[:, 2, 2] = 1.0
    six[:, 4, 4], six[:, 4, 3], six[:, 3, 4], six[:, 3, 3] = c, -s, s, c
    out = np.zeros((len(angle), 24, 24))
    out[:, :6, :6] = six
    turn = _vector_rotation(angle)
    gradient = six[:, :, None, :, None] * turn[:, None, :, None, :]
    out[:, 6:, 6:] = gradient.reshape(len(angle), 18, 18)
    return out


def _vector_rotation(angle: Array) -> Array:
    """(N, 3, 3) about z."""
    out = np.zeros((len(angle), 3, 3))
    out[:, 0, 0] = out[:, 1, 1] = np.cos(angle)
    out[:, 1, 0], out[:, 0, 1] = np.sin(angle), -np.sin(angle)
    out[:, 2, 2] = 1.0
    return out


def _disc(x: Array) -> Array:
    """Spectrum of Hertz's pressure over x = k a."""
    safe = np.maximum(x, 1e-2)
    exact = 3 * (np.sin(safe) - safe * np.cos(safe)) / safe**3
    return np.where(x < 1e-2, 1 - x**2 / 10, exact)


class _Polar(NamedTuple):
    r: Array
    direction: Array


def _polar(place: Array) -> _Polar:
    return _Polar(np.hypot(place[:, 0], place[:, 1]), np.arctan2(place[:, 1], place[:, 0]))


def _cubic(position: Array | float) -> tuple[NDArray[np.intp], Array]:
    """Lagrange's cubic between the two middle ones of four places: the second of them, and the
    weights (4, ...)."""
    first = np.floor(position).astype(np.intp)
    t = position - first
    weights = np.stack(
        [
            -t * (t - 1) * (t - 2) / 6,
            (t + 1) * (t - 1) * (t - 2) / 2,
            -(t + 1) * t * (t - 2) / 2,
            (t + 1) * t * (t - 1) / 6,
        ]
    )
    return first, weights


def _at(table: Array, position: Array, last: int) -> Array:
    """(N, ...) of a table whose entry 1 is at the position 0, zero beyond the last one."""
    first, weights = _cubic(np.minimum(position, last))
    weights = weights * (position <= last)
    shape = (len(position),) + (1,) * (table.ndim - 1)
    return sum(weights[j].reshape(shape) * table[first + j] for j in range(4))
