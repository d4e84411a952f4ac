"""What cubes in a layer say of forces on its surface, from the influence functions of their pads.

A cube in the layer is not the same in all directions, but its influence functions are sums of
circular components (circular.py). With the direction phi from the force to the cube, every pad is::

    v = sum_m Re(w c),   c = exp(i m phi) (R(r) F_r + Z(r) F_z + i T(r) F_t)

A Fourier series over phi gives R, Z and T of every pad and order m; what pads have in common is a
few components of each order (singular values). Their spectra (spectra.py) are Hankel transforms::

    P = 2 pi int (R + T) J_{m-1}(kr) r dr,   M = 2 pi int (R - T) J_{m+1}(kr) r dr,
    N = 2 pi int Z J_m(kr) r dr

No Taylor series of the stress is made, and the pads see the surface and the ground as they are. A
cube says what its calibration makes of its pads (estimator.py).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..core.arrays import Array
from ..core.calibration import Calibration
from ..core.errors import ElasticError
from ..core.pipeline import Pipeline
from ..mechanics.influence import Influence
from ..mechanics.kernels import MeasurementModel
from ..mechanics.spectra import Spectra, tabulate_bessel, wavenumber_quadrature

ANGLES = 32
"""Directions from force to cube that the Fourier series is made from."""
HIGHEST = 9
"""Order of the series; a cube is a square, so its corners make orders up to 4 more than a point."""
NEGLIGIBLE = 1e-3
"""Singular value over the greatest, below which pads have nothing in common."""
_DISTANCES = 400
"""Gauss points in r: more than the Bessel functions turn over the body's half width."""
_SAME = 1e-6
"""Relative lengths closer than this are the same."""


def read_pads(influence: Influence, calibrations: Sequence[Calibration]) -> MeasurementModel:
    """How cubes with these calibrations see forces on the surface of the influence functions' body.

    ElasticError: the influence functions are of a cube of another size, or lack a pad.
    """
    kinds = list({id(one): one for one in calibrations}.values())
    number = {id(one): k for k, one in enumerate(kinds)}
    pads = [_pads(influence, one) for one in kinds]
    spectra, made = _components(influence)
    pipeline = Pipeline(kinds)
    said = [made[:, mine] @ np.nan_to_num(pipeline.matrix(k)).T for k, mine in enumerate(pads)]
    over_noise = np.zeros((len(kinds), len(made), pipeline.n_pads))
    for k, (one, mine) in enumerate(zip(kinds, pads, strict=True)):
        over_noise[k, :, : len(mine)] = made[:, mine] / one.noise
    of_cube = np.array([number[id(one)] for one in calibrations], np.intp)
    return MeasurementModel(spectra, np.stack(said), of_cube, over_noise)


def _pads(influence: Influence, calibration: Calibration) -> list[int]:
    """Which of the influence functions are those of the calibration's pads."""
    mine, given, side = calibration.layout, influence.layout, influence.side
    if abs(2 * calibration.half_side / side - 1) > _SAME:
        raise ElasticError(
            f"the influence functions are of a cube of {1e3 * side:g} mm and calibration "
            f"{calibration.id} of one of {2e3 * calibration.half_side:g} mm; make them again with "
            f"./cube fem MODEL --surface, with side: {2 * calibration.half_side:g} in the model"
        )
    found = []
    for name, position, normal in zip(mine.pads, mine.positions, mine.normals, strict=True):
        apart = np.abs(given.positions - position).max(axis=1)
        apart += np.abs(given.normals - normal).max(axis=1)
        nearest = int(np.argmin(apart))
        if apart[nearest] > _SAME or abs(given.pad_size - mine.pad_size) > _SAME:
            raise ElasticError(
                f"the influence functions have no pad like {name} of layout {mine.name!r}; make "
                "them again with ./cube fem MODEL --surface for this layout"
            )
        found.append(nearest)
    return found


def _components(influence: Influence) -> tuple[Spectra, Array]:
    """Spectra of n circular components, and the pads (2 n, P) that their real and imaginary parts
    make."""
    nodes, weights = np.polynomial.legendre.leggauss(_DISTANCES)
    r, weight = (nodes + 1) * influence.reach / 2, weights * influence.reach / 2
    series = _series(influence, r)
    root = np.sqrt(r * weight)
    parts = [
        np.linalg.svd((one * root).reshape(len(one), -1), full_matrices=False) for one in series
    ]
    greatest = max(sizes[0] for _, sizes, _ in parts)
    k, wave_weight = wavenumber_quadrature(influence.depth)
    bessel = tabulate_bessel(k, r)
    orders, spectra, made = [], [], []
    for order, (pads, sizes, shapes) in enumerate(parts):
        kept = sizes > NEGLIGIBLE * greatest
        along, normal, across = np.moveaxis(shapes[kept].reshape(kept.sum(), 3, -1) / root, 1, 0)
        integrals = [
            2 * np.pi * bessel(order + shift).T @ (one * (r * weight)).T
            for one, shift in ((along + across, -1), (along - across, 1), (normal, 0))
        ]
        orders += [order] * int(kept.sum())
        spectra.append(integrals)
        made.append((pads[:, kept] * sizes[kept]).reshape(2, -1, kept.sum()))
    plus, minus, normal = (np.concatenate(one, axis=1) for one in zip(*spectra, strict=True))
    of_pads = np.concatenate(made, axis=2).swapaxes(1, 2).reshape(2 * len(orders), -1)
    return Spectra(k, wave_weight, np.array(orders), plus, minus, normal), of_pads


def _series(influence: Influence, r: Array) -> list[Array]:
    """(2 P, 3, distances) R, Z and T of every pad for each order, those of its real part first."""
    angle = 2 * np.pi * np.arange(ANGLES) / ANGLES
    c, s = np.cos(angle), np.sin(angle)
    # The force lies where the direction comes from.
    place = -(r[:, None, None] * np.stack([c, s], axis=1)).reshape(-1, 2)
    x, y, z = np.moveaxis(influence.at(place).reshape(-1, len(r), ANGLES, 3), -1, 0)
    polar = np.stack([c * x + s * y, z, c * y - s * x], axis=1)
    waves_of = np.fft.fft(polar, axis=-1) / ANGLES
    series = []
    for order in range(HIGHEST):
        both = 1.0 if order == 0 else 2.0
        even, odd = both * waves_of[..., order].real, -both * waves_of[..., order].imag
        real = np.stack([even[:, 0], even[:, 1], -odd[:, 2]], axis=1)
        imaginary = np.stack([odd[:, 0], odd[:, 1], even[:, 2]], axis=1)
        series.append(np.concatenate([real, imaginary]))
    return series
