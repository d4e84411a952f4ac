"""Stress and gradient at cubes under many discs of traction, fast enough for every step of a robot.

The field of a disc depends on the distance r, and turns with the direction phi = atan2(y, x) from
the disc to the cube. The tables are the R, T and Z of circular.py at each distance and radius.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.arrays import Array
from .cache import cached
from .circular import summed
from .kernels import PER_DEPTH, REACH, disc_spectrum
from .layer import Layer
from .spectra import bessel_functions, layer_spectra

SIZES = np.geomspace(0.1, 5.0, 23)
"""Radii of the discs in the tables over the depth; others are rounded, by 10 % at most."""


class DiscTables:
    """Tables for cubes at one depth in a layer.

    Parameters: layer; depth: from the cubes' centres to the surface, m. Raises ElasticError where
    the layer has no such depth. Takes a second or two the first time (cache.py).
    """

    def __init__(self, layer: Layer, depth: float) -> None:
        layer.check_depth(depth)
        self.layer, self.depth = layer, depth
        key = [layer.thickness, layer.poisson, depth]
        table = cached("disc_tables", key, self._tables)["table"]
        # Every place together with the next one: one look-up for an interpolation.
        self._table = np.concatenate([table[:, :-1], table[:, 1:]], axis=2)

    def _tables(self) -> dict[str, NDArray[np.float32]]:
        """table (sizes, places, 3, 14): R, Z and T of each component, from r = 0 on."""
        spectra = layer_spectra(self.layer, self.depth)
        discs = np.stack([disc_spectrum(spectra.k * size) for size in SIZES * self.depth])
        r = np.arange(REACH * PER_DEPTH + 2) * self.depth / PER_DEPTH
        return {"table": spectra.radial(bessel_functions(spectra.k, r), discs).astype(np.float32)}

    def field(self, place: ArrayLike, force: ArrayLike, radius: ArrayLike) -> tuple[Array, Array]:
        """Stress (N, 6) in Pa and gradient (N, 6, 3) in Pa/m, each the sum over L discs.

        place: (N, L, 2) m, of the cube from the middle of the disc, in the cube's frame
        force: (N, L, 3) N on the skin, in the cube's frame
        radius: (L,) m

        Each disc carries Hertz's traction, 3 F / (2 pi a^2) sqrt(1 - r^2 / a^2). Beyond REACH
        depths everything counts as zero. Order xx yy zz yz zx xy, tension positive, as in
        `contact.field`.
        """
        x, y = np.moveaxis(np.asarray(place, float), -1, 0)
        fx, fy, fz = np.moveaxis(np.asarray(force, float), -1, 0)
        r = np.hypot(x, y)
        turn = np.where(r > 0, (x + 1j * y) / np.where(r > 0, r, 1.0), 1.0)
        polar = (fx + 1j * fy) * turn.conj()
        position = r / self.depth * PER_DEPTH
        first = np.minimum(position, REACH * PER_DEPTH - 1).astype(np.intp)
        part = np.where(position < REACH * PER_DEPTH, position - first, 0.0)
        weight = np.stack([1 - part, part], axis=-1) * (position < REACH * PER_DEPTH)[..., None]
        load = np.zeros((*r.shape, 2, 2, 3), np.float32)  # real and imaginary, place, R Z T
        load[..., 0, :, 0] = weight * polar.real[..., None]
        load[..., 0, :, 1] = weight * fz[..., None]
        load[..., 1, :, 2] = weight * polar.imag[..., None]
        parts = load.reshape(*r.shape, 2, 6) @ self._table[self._size(radius), first]
        circular = parts[..., 0, :] + 1j * parts[..., 1, :]
        return summed(circular, turn)

    def _size(self, radius: ArrayLike) -> NDArray[np.intp]:
        """Number of the nearest radius in the tables."""
        ratio = np.clip(np.asarray(radius, float) / self.depth, SIZES[0], SIZES[-1]) / SIZES[0]
        return np.rint(np.log(ratio) / np.log(SIZES[1] / SIZES[0])).astype(np.intp)
