# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Measurement model of cubes in an elastic layer, from the influence functions of their pads.

The influence function of a pad (one of a cube's sensing elements) is the stress that it measures
under a force of 1 N on the surface, as a function of the force's position. A cube is not
rotationally symmetric, but its influence functions are sums of circular components (circular.py).
With the distance r and direction phi from the force to the cube, and the force's components F_r
along this direction, F_t across it and F_z along the normal, the stress v of a pad is::

    v = sum_m Re(w c),   c = exp(i m phi) (R(r) F_r + Z(r) F_z + i T(r) F_t)

A Fourier series over phi gives the functions R, Z and T of every pad and order m. The functions of
all pads are combinations, with complex weights w, of a few circular components of each order, found
by singular value decomposition. The spectra P, M and N of these components as functions of the wave
number k (spectra.py) are Hankel transforms, with the Bessel functions J::

    P = 2 pi int (R + T) J_{m-1}(kr) r dr,   M = 2 pi int (R - T) J_{m+1}(kr) r dr,
    N = 2 pi int Z J_m(kr) r dr

In contrast to cubes that are modelled as points, no Taylor series of the stress is involved, and
the pads' stresses include the effects of the cube's stiffness, of the surface and of the ground.
The measured components of a cube (stresses and their gradients) follow from its pads by its
calibration (estimator.py).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..core.arrays import Array
from ..core.calibration import Calibration
from ..core.errors import ElasticError
from ..mechanics.cache import load_or_compute
from ..mechanics.influence import Influence
from ..mechanics.measurement_model import MeasurementModel
from ..mechanics.spectra import Spectra, make_wavenumber_quadrature, tabulate_bessel
from .pad_noise import compute_noise_of_all_pads

N_DIRECTIONS = 32
"""Number of equally spaced directions from the force to the cube at which the influence functions
(stress on each pad under a force of 1 N) are evaluated for their Fourier series."""

N_ORDERS = 9
"""Number of orders m, 0 to 8, of the Fourier series of the influence functions (stress on each pad
under a force of 1 N) over the direction from the force to the cube.

The stress and its gradients at a point under a point force have orders up to 4; the four-fold
symmetry of a cube adds up to 4.
"""

MIN_SINGULAR_VALUE = 1e-3
"""Smallest singular value, divided by the largest one, of a circular component that is kept.

The influence function of a pad is its stress under a force of 1 N, as a function of the force's
position. A singular value decomposition expresses the influence functions of all pads by circular
components, which a rotation about the normal of the skin multiplies by a phase.
"""

_N_DISTANCES = 400
"""Number of Gauss points in r, the distance between force and cube. They resolve the oscillations
of the Bessel functions up to the largest distance (half the width of the finite element body)."""

_MATCH_TOLERANCE = 1e-6
"""Largest difference between a calibrated pad (sensing element) and a pad with a known influence
function (stress under a force of 1 N) at which they count as the same. It applies to the positions
and sizes of pads in units of half the cube's side, to their unit normals, and to the relative
difference of the cubes' sides."""


def model_pads(
    influence: Influence,
    calibrations: Sequence[Calibration],
) -> MeasurementModel:
    """Build the measurement model of the cubes of a skin.

    Args:
        influence: Influence functions of the pads of one cube in its layer: stress of each pad
            under a force of 1 N, as a function of the force's position.
        calibrations: Calibration of each cube.

    Raises:
        ElasticError: The influence functions belong to a cube of another size, or there is none
            for a pad of a calibration.
    """
    # Cubes with the same calibration file share one `Calibration`. They are compared by identity.
    variants = list(dict.fromkeys(calibrations))
    variant = np.array([variants.index(one) for one in calibrations], np.intp)
    spectra, all_pads = _load_decomposition(influence)

    by_pad = compute_noise_of_all_pads(variants)
    pads = np.zeros((len(variants), len(all_pads), by_pad.shape[2]))
    for own, calibration in zip(pads, variants, strict=True):
        matched = all_pads[:, _match_pads(influence, calibration)]
        own[:, : matched.shape[1]] = matched / calibration.noise
    # Circular components yield the stresses of the pads, and these the measured components.
    components = pads @ np.nan_to_num(by_pad).swapaxes(1, 2)
    return MeasurementModel(spectra, components, variant, pads)


def _match_pads(influence: Influence, calibration: Calibration) -> list[int]:
    """Find the influence function of each pad of a calibration by the pad's position and normal.

    Returns:
        Index of the influence function for each pad, in the order of the calibration's pads.

    Raises:
        ElasticError: The size of the cube differs, or a pad has no influence function.
    """
    layout = calibration.layout
    given = influence.layout
    side = 2 * calibration.half_side
    if abs(side / influence.side - 1) > _MATCH_TOLERANCE:
        raise ElasticError(
            f"the influence functions are of a cube of {1e3 * influence.side:g} mm and calibration "
            f"{calibration.id} of one of {1e3 * side:g} mm; make them again with "
            f"./cube fem MODEL --load surface, with side: {side:g} in the model"
        )

    own, theirs = (np.hstack([one.positions, one.normals]) for one in (layout, given))
    difference = np.abs(own[:, None] - theirs).max(axis=2)
    difference += abs(given.pad_size - layout.pad_size)
    unmatched = np.flatnonzero(difference.min(axis=1) > _MATCH_TOLERANCE)
    if len(unmatched):
        raise ElasticError(
            f"the influence functions have no pad like {layout.pads[unmatched[0]]} of layout "
            f"{layout.name!r}; make them again with ./cube fem MODEL --load surface for this layout"
        )
    return [int(row.argmin()) for row in difference]


def _load_decomposition(influence: Influence) -> tuple[Spectra, Array]:
    """Return the result of `_decompose`, from the cache if it is there.

    Returns:
        Spectra (Hankel transforms) of n circular components, and the matrix (2 n, P) from the real
        parts and then the imaginary parts of the components to the stresses of P pads.
    """
    inputs = [influence.depth, influence.place, influence.pads]
    arrays = load_or_compute("pads", inputs, lambda: _decompose(influence))
    pads = arrays.pop("pads")
    order = arrays.pop("order").astype(np.int64)
    return Spectra(order=order, **arrays), pads


def _decompose(influence: Influence) -> dict[str, Array]:
    """Decompose the influence functions into circular components.

    A circular component is a combination of the pads' stresses that a rotation about the normal of
    the skin only multiplies by a phase.

    Returns:
        Attributes of the `Spectra` of the components by name, and as "pads" the matrix from the
        components to the stresses of the pads; see `_load_decomposition`.
    """
    abscissae, weights = np.polynomial.legendre.leggauss(_N_DISTANCES)
    half_reach = influence.reach / 2
    r = (abscissae + 1) * half_reach
    area = r * weights * half_reach  # r dr of the integrals over r

    # The functions of the distance r are weighted with sqrt(r dr). The square of a singular value
    # is then an integral of squared stresses over the plane in which the force is moved.
    root = np.sqrt(area)
    series = _compute_fourier_series(influence, r) * root
    flat = series.reshape(*series.shape[:2], -1)
    left, values, right = np.linalg.svd(flat, full_matrices=False)
    order, number = np.nonzero(values > MIN_SINGULAR_VALUE * values.max())
    n = len(order)
    functions = right[order, number].reshape(n, 3, -1) / root
    pads = left[order, :, number] * values[order, number, None]
    # The first half of the columns belongs to the real parts, the second to the imaginary parts.
    pads = pads.reshape(n, 2, -1).swapaxes(0, 1).reshape(2 * n, -1)

    k, weight = make_wavenumber_quadrature(influence.depth)
    bessel = tabulate_bessel(k, r)

    def transform(parts: Array, shift: int) -> Array:
        pairs = zip(parts * area, order.tolist(), strict=True)
        return 2 * np.pi * np.stack([part @ bessel(m + shift) for part, m in pairs], axis=1)

    along, normal, across = np.moveaxis(functions, 1, 0)
    spectra = Spectra(
        k,
        weight,
        order.astype(np.int64),
        transform(along + across, -1),
        transform(along - across, 1),
        transform(normal, 0),
    )
    return {**vars(spectra), "pads": pads}


def _compute_fourier_series(influence: Influence, r: Array) -> Array:
    """Compute the Fourier series of the influence functions over the direction from force to cube.

    The influence function of a pad is its stress under a force of 1 N, as a function of the force's
    position. With the distance r and direction phi from the force to the cube, and the components
    F_r (along this direction), F_t (across it) and F_z (along the normal) of the force, each order
    m contributes Re(c) + Im(c') to the stress of a pad. Both c and c' have the form::

        exp(i m phi) (R(r) F_r + Z(r) F_z + i T(r) F_t)

    Args:
        influence: Influence functions of P pads.
        r: Distances (distances,) between force and cube, in m.

    Returns:
        Functions R, Z and T of each order m (`N_ORDERS`, 2 P, 3, distances): first those of the
        component c of each of the P pads, then those of the component c' of each pad.
    """
    # Vectors in the plane are complex numbers x + i y.
    direction = np.exp(2j * np.pi * np.arange(N_DIRECTIONS) / N_DIRECTIONS)
    # The direction runs from the force to the cube, so the force lies at minus r.
    place = -np.outer(r, direction).ravel()
    responses = influence.interpolate(np.stack([place.real, place.imag], axis=1))
    responses = responses.reshape(-1, len(r), N_DIRECTIONS, 3)
    x, y, z = np.moveaxis(responses, -1, 0)
    rotated = (x + 1j * y) / direction  # radial + i tangential
    polar = np.stack([rotated.real, z, rotated.imag], axis=1)

    # The terms exp(i m phi) and exp(-i m phi) of a real function are complex conjugates. Both
    # contribute to order m, hence the factor 2; at order 0 they are the same term.
    terms = np.fft.ifft(polar)[..., :N_ORDERS]
    terms[..., 1:] *= 2
    terms[:, 2] *= 1j
    return np.moveaxis(np.concatenate([terms.real, terms.imag]), -1, 0)
