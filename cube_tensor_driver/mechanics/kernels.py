"""What cubes at one depth see of tractions on the surface, and how that varies together.

The layer is the same everywhere and in all directions. So whatever depends on two places is known
from its values along one line: the offset p = r (cos phi, sin phi) turns them by phi. With the
spectra c(k) of spectra.py and a prior of the traction with the spectrum S(k)::

    response(p) = int c exp(i k.p) B_a,     B_a = 3 (sin ka - ka cos ka) / (ka)^3
    cross(p)    = int c S exp(i k.p),       covariance(p) = int c S c* exp(i k.p)      [d2k / 4 pi2]

B_a is the spectrum of Hertz's pressure on a disc of radius a, of force 1. The prior is Gaussian
with mean zero; normal traction and both shears are independent. It has two lengths, because
contacts are narrow or wide: per unit of variance half of each::

    S = sum_l (1/2) 2 pi l^2 exp(-(k l)^2 / 2)        (shear: SHEAR^2 times that)
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import Array, Index
from ..core.modes import COMPONENTS, STRESS
from .cache import cached
from .circular import BACK, CIRCULAR, ORDERS
from .layer import FIELD, Layer
from .spectra import Bessel, Spectra, bessel_functions, layer_spectra

LENGTHS = (0.2, 0.8)
"""Of the prior over the depth: near the pair that explained contacts of 2 to 20 mm best, in a half
space at a depth of 5 mm."""
SHEAR = 0.5
"""Prior standard deviation of shear over that of pressure."""
SIZES = np.geomspace(0.1, 5.0, 44)
"""Radii of the discs of `response` over the depth. What lies between them is interpolated, to a
hundredth of the greatest value at the wide end."""
PER_DEPTH = 32
"""Places of the tables per depth: cubic interpolation is then good to 1e-4 of the peak."""
REACH = 20
"""Of the tables, over the depth; beyond it everything counts as zero."""
_OBSERVED = np.array([FIELD.index(name) for name in COMPONENTS])
_GRADIENT = np.arange(len(COMPONENTS)) >= len(STRESS)
_ZZ = int(np.argmax(CIRCULAR[:, FIELD.index("zz")].real))


class Reading(NamedTuple):
    """What cubes see, and what they say of it.

    spectra: of the n circular components that they see
    said: (readings, 2 n, 15) COMPONENTS from the real parts and the imaginary parts, in the cube's
    frame, Pa and Pa/m
    of_cube: (cubes,) which of these readings each cube has
    of_pads: (readings, 2 n, P) what pads see, over their noise; None: cubes count as points
    """

    spectra: Spectra
    said: Array
    of_cube: Index
    of_pads: Array | None = None


def read_points(layer: Layer, depth: float, cubes: int) -> Reading:
    """Of cubes that count as points: they say the stress and the gradient at their middles. Raises
    ElasticError where the layer has no such depth."""
    spectra = layer_spectra(layer, depth)
    return Reading(spectra, BACK[None, :, _OBSERVED], np.zeros(cubes, np.intp))


class Kernels:
    """Tables for cubes at one depth in a layer; lengths in m.

    Places are (N, 2) m. Components are COMPONENTS with gradients times `scale` (m), all in Pa, in
    the frame of a cube that is turned about z by `angle` (N,) rad and has the reading of this
    number, `reading` (N,). Tractions are along x, y, z.

    made_from: arrays and numbers that say what the tables hold

    Parameters: reading: how cubes see; by default as points. Raises ElasticError where the layer
    has no such depth. Takes a few seconds the first time (cache.py).
    """

    def __init__(
        self, layer: Layer, depth: float, scale: float, reading: Reading | None = None
    ) -> None:
        at_points = read_points(layer, depth, 1)
        self.layer, self.depth, self.scale = layer, depth, scale
        self.step, self._last = depth / PER_DEPTH, REACH * PER_DEPTH
        # (-1, 0, ...) steps: cubic interpolation needs one more on the left.
        r = np.arange(-1.0, self._last + 3) * self.step
        spectra, said, *_ = reading or at_points
        bessel = bessel_functions(spectra.k, r)
        self.readings = said * np.where(_GRADIENT, scale, 1.0)
        self._order = spectra.order
        self.variance = np.array([SHEAR**2, SHEAR**2, 1.0])
        seen = [layer.thickness, layer.poisson, depth, *vars(spectra).values()]
        self.made_from = [*seen, self.readings]
        self._field = self._discs(at_points.spectra, bessel)
        self._response = self._field if reading is None else self._discs(spectra, bessel)
        tables = cached("kernels", seen, lambda: self._tables(spectra, at_points.spectra, bessel))
        self._cross, self._pressure = tables["cross"], tables["pressure"]
        self._even, self._odd = tables["even"], tables["odd"]
        self.pressure_variance = float(tables["own"])

    def add_reading(self, said: Array) -> int:
        """The number of one more reading (2 n, 15), as those of `Reading`, or of the same one."""
        own = said * np.where(_GRADIENT, self.scale, 1.0)
        same = np.flatnonzero((self.readings == own).all(axis=(1, 2)))
        if not len(same):
            self.readings = np.concatenate([self.readings, own[None]])
        return int(same[0]) if len(same) else len(self.readings) - 1

    def _discs(self, spectra: Spectra, bessel: Bessel) -> Array:
        """(sizes, places, 3, n) R, Z and T of the discs of SIZES."""
        factors = np.stack([disc_spectrum(spectra.k * size) for size in SIZES * self.depth])
        key = [self.depth, *vars(spectra).values()]
        return cached("discs", key, lambda: {"discs": spectra.radial(bessel, factors)})["discs"]

    def _tables(self, spectra: Spectra, at_points: Spectra, bessel: Bessel) -> dict[str, Array]:
        """cross (places, 3, n): R, Z, T; even, odd (places, n, n): covariance of real and of
        imaginary parts; pressure (places, n): of real parts with the pressure at a point; own:
        its variance."""
        prior = _prior(spectra.k * self.depth) * self.depth**2
        cross = spectra.radial(bessel, prior[None])[0] * np.array([SHEAR**2, 1, SHEAR**2])[:, None]
        even, odd = spectra.covariance(spectra, bessel, prior, SHEAR)
        pressure = -spectra.covariance(at_points, bessel, prior, SHEAR)[0][:, :, _ZZ]
        here = bessel_functions(spectra.k, np.zeros(1))
        own = at_points.covariance(at_points, here, prior, SHEAR)[0][0, _ZZ, _ZZ]
        return {"cross": cross, "even": even, "odd": odd, "pressure": pressure, "own": own}

    def response(self, place: Array, angle: Array, reading: Index, size: float) -> Array:
        """(N, 15, 3) of cubes at `place` from the middle of a disc with force 1 N; size: m."""
        table = self._disc_table(self._response, size, place)
        return self._said(self._under(table, place, angle, self._order), reading)

    def field(self, place: Array, size: float) -> Array:
        """(N, 24, 3) FIELD in Pa and Pa/m at `place` from the middle of such a disc."""
        table = self._disc_table(self._field, size, place)
        circular = self._under(table, place, np.zeros(len(place)), ORDERS)
        return np.asarray((circular @ BACK).swapaxes(1, 2))

    def cross(self, place: Array, angle: Array, reading: Index) -> Array:
        """(N, 15, 3) covariance of cubes at `place` from a point with the point's traction."""
        return self._said(self._under(self._cross, place, angle, self._order), reading)

    def covariance(
        self, place: Array, angle: Array, reading: Index, other: Array, other_reading: Index
    ) -> Array:
        """(N, 15, 15) of cubes at `place` from other cubes, turned by `angle` and `other`."""
        r, direction = _polar(place)
        of_one, of_other = (
            self._turned(direction - turn, which)
            for turn, which in ((angle, reading), (other, other_reading))
        )
        total = np.zeros((len(place), len(COMPONENTS), len(COMPONENTS)))
        for one, table, two in zip(of_one, (self._even, self._odd), of_other, strict=True):
            total += one @ _at(table, r / self.step, self._last) @ two.swapaxes(1, 2)
        return total

    def pressure(self, place: Array, angle: Array, reading: Index) -> Array:
        """(N, 15) covariance of cubes at `place` from a point with the pressure at the cubes' depth
        below the point."""
        r, direction = _polar(place)
        table = _at(self._pressure, r / self.step, self._last)
        rows, _ = self._turned(direction - angle, reading)
        return np.asarray((rows @ table[:, :, None])[:, :, 0])

    def disc_pressure(self, place: Array, size: float, force: Array) -> Array:
        """(N,) pressure at the cubes' depth at `place` from the middle of a disc; force (3,) N."""
        return -self.field(place, size)[:, FIELD.index("zz")] @ force

    def _under(self, table: Array, place: Array, angle: Array, order: NDArray[np.int64]) -> Array:
        """(N, 3, 2 n) real and imaginary parts in turned frames under a force along x, y and z.

        table: (places, 3, n) R, Z and T of components of these orders (n,)
        """
        r, direction = _polar(place)
        parts = _at(table, r / self.step, self._last)
        radial, normal, across = parts[:, 0], parts[:, 1], 1j * parts[:, 2]
        c, s = np.cos(direction)[:, None], np.sin(direction)[:, None]
        forces = np.stack([c * radial - s * across, s * radial + c * across, normal], axis=1)
        turned = _powers(direction - angle, order)[:, None] * forces
        return np.concatenate([turned.real, turned.imag], axis=2)

    def _said(self, circular: Array, reading: Index) -> Array:
        """(N, 15, 3) what cubes say that see (N, 3, 2 n)."""
        # One product for all rows is faster than one for each.
        said = self.readings[0] if len(self.readings) == 1 else self.readings[reading]
        return np.asarray((circular @ said).swapaxes(1, 2))

    def _turned(self, angle: Array, reading: Index) -> tuple[Array, Array]:
        """(N, 15, n) what cubes in frames that are turned by -angle say of real parts, and of
        imaginary parts."""
        powers = _powers(angle, self._order)[:, None]
        real, imaginary = np.split(self.readings.swapaxes(1, 2), 2, axis=2)
        said = (real - 1j * imaginary)[reading] * powers
        return said.real, -said.imag

    def _disc_table(self, discs: Array, size: float, place: Array) -> Array:
        """(places, 3, n) of a disc of this radius, m, as far as it is needed."""
        farthest = np.hypot(*place.T).max(initial=0.0) / self.step
        places = int(min(farthest, self._last)) + 4
        position = np.log(size / self.depth / SIZES[0]) / np.log(SIZES[1] / SIZES[0])
        first, weight = _cubic(np.clip(position, 1.0, len(SIZES) - 2.001))
        near = discs[int(first) - 1 : int(first) + 3, :places]
        return np.asarray(np.tensordot(weight, near, axes=1))


def _prior(wave: Array) -> Array:
    """Spectrum of the prior over its depth squared, at wavenumbers times the depth."""
    parts = [2 * np.pi * l**2 * np.exp(-((wave * l) ** 2) / 2) for l in LENGTHS]
    return np.mean(parts, axis=0)


def hertz_pressure(distance: Array, size: float) -> Array:
    """Pressure of a disc of radius `size` with force 1 N at its distances from the middle, Pa."""
    inside = np.clip(1 - (distance / size) ** 2, 0, None)
    return 3 / (2 * np.pi * size**2) * np.sqrt(inside)


def disc_spectrum(x: Array) -> Array:
    """Spectrum of Hertz's pressure over x = k a."""
    safe = np.maximum(x, 1e-2)
    exact = 3 * (np.sin(safe) - safe * np.cos(safe)) / safe**3
    return np.where(x < 1e-2, 1 - x**2 / 10, exact)


class _Polar(NamedTuple):
    r: Array
    direction: Array


def _polar(place: Array) -> _Polar:
    return _Polar(np.hypot(place[:, 0], place[:, 1]), np.arctan2(place[:, 1], place[:, 0]))


def _powers(angle: Array, order: NDArray[np.int64]) -> NDArray[np.complex128]:
    """(N, n) exp(i m angle) of angles (N,) and orders m (n,)."""
    powers: NDArray[np.complex128] = np.exp(1j * angle[:, None] * order)
    return powers


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
