# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Measurement model of cubes in an elastic layer, from the influence functions of their pads.

The influence function of a pad (one of a cube's sensing elements) is the stress that it measures
under a force of 1 N on the surface, as a function of the force's position. A cube is not
rotationally symmetric, but its influence functions are sums of circular components (circular.py).
With the distance r and direction phi from the force to the cube, and the force's components F_r
along this direction, F_t across it and F_z along the normal, each pad stress v is::

    v = sum_m Re(w c),   c = exp(i m phi) (R(r) F_r + Z(r) F_z + i T(r) F_t)

A Fourier series over phi gives the functions R, Z and T of every pad and order m. The functions of
all pads are combinations, with complex weights w, of a few circular components of each order, found
by singular value decomposition. The spectra of these components as functions of the wave number k
(spectra.py) are Hankel transforms::

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
from ..core.pipeline import Pipeline
from ..mechanics.cache import load_or_compute
from ..mechanics.influence import Influence
from ..mechanics.measurement_model import MeasurementModel
from ..mechanics.spectra import BesselTable, Spectra, make_wavenumber_quadrature, tabulate_bessel

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

_PADS = "pads"
"""Name, in the cached file, of the matrix from circular components to the stresses of the pads. A
rotation about the normal of the skin multiplies a circular component by a phase. The other arrays
of the file are the attributes of `Spectra`."""

_MATCH_TOLERANCE = 1e-6
"""Largest difference up to which the cube and pads of a calibration count as those of the influence
functions. It applies to the relative difference of the cubes' sides, to the positions and sizes of
pads (sensing elements) in units of half a side, and to their unit normals."""


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
    # Cubes with the same calibration file share one `Calibration` object, so that the different
    # calibrations are found by identity.
    variants = list({id(one): one for one in calibrations}.values())
    variant_numbers = {id(one): number for number, one in enumerate(variants)}
    spectra, all_pads = _load_decomposition(influence)

    pipeline = Pipeline(variants)
    components = []
    shape = len(variants), len(all_pads), pipeline.n_pads
    pads = np.zeros(shape)
    for number, calibration in enumerate(variants):
        matches = _match_pads(influence, calibration)
        own = all_pads[:, matches]
        matrix = np.nan_to_num(pipeline.find_matrix(number))
        components.append(own @ matrix.T)  # circular components -> pads -> measured components
        pads[number, :, : own.shape[1]] = own / calibration.noise

    variant = np.array(
        [variant_numbers[id(one)] for one in calibrations],
        np.intp,
    )
    return MeasurementModel(spectra, np.stack(components), variant, pads)


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

    same_size = abs(given.pad_size - layout.pad_size) <= _MATCH_TOLERANCE
    matches = []
    for name, position, normal in zip(
        layout.pads,
        layout.positions,
        layout.normals,
        strict=True,
    ):
        shift = np.abs(given.positions - position)
        turn = np.abs(given.normals - normal)
        difference = shift.max(axis=1)
        difference += turn.max(axis=1)
        nearest = int(np.argmin(difference))
        if difference[nearest] > _MATCH_TOLERANCE or not same_size:
            raise ElasticError(
                f"the influence functions have no pad like {name} of layout {layout.name!r}; make "
                "them again with ./cube fem MODEL --load surface for this layout"
            )
        matches.append(nearest)
    return matches


def _load_decomposition(influence: Influence) -> tuple[Spectra, Array]:
    """Return the result of `_decompose`, from the cache if it is there."""

    def compute() -> dict[str, Array]:
        spectra, pads = _decompose(influence)
        return {**vars(spectra), _PADS: pads}

    inputs = [influence.depth, influence.place, influence.pads]
    arrays = load_or_compute("pads", inputs, compute)
    pads = arrays.pop(_PADS)
    order = arrays.pop("order").astype(np.int64)
    return Spectra(order=order, **arrays), pads


def _decompose(influence: Influence) -> tuple[Spectra, Array]:
    """Decompose the influence functions into n circular components.

    Returns:
        Spectra (Hankel transforms) of the components, and the matrix (2 n, P) from the real parts
        and then the imaginary parts of the components to the stresses of P pads.
    """
    abscissae, weights = np.polynomial.legendre.leggauss(_N_DISTANCES)
    half_reach = influence.reach / 2
    r = (abscissae + 1) * half_reach
    weight = weights * half_reach

    # The functions of the distance r are weighted with sqrt(r dr). The square of a singular value
    # is then an integral over the plane in which the force is moved.
    root = np.sqrt(r * weight)
    decompositions = [
        np.linalg.svd(
            (series * root).reshape(len(series), -1),
            full_matrices=False,
        )
        for series in _compute_fourier_series(influence, r)
    ]
    largest = max(values[0] for _, values, _ in decompositions)

    k, wave_weight = make_wavenumber_quadrature(influence.depth)
    bessel = tabulate_bessel(k, r)
    orders: list[int] = []
    spectra = []
    pads = []
    for order, (left, values, right) in enumerate(decompositions):
        is_kept = values > MIN_SINGULAR_VALUE * largest
        n_kept = int(is_kept.sum())
        weighted_functions = right[is_kept].reshape(n_kept, 3, -1)
        functions = weighted_functions / root
        orders += [order] * n_kept
        transforms = _compute_hankel_transforms(
            functions,
            order,
            bessel,
            r * weight,
        )
        spectra.append(transforms)
        weighted = left[:, is_kept] * values[is_kept]
        pads.append(weighted.reshape(2, -1, n_kept))

    by_kind = zip(*spectra, strict=True)
    plus, minus, normal = (np.concatenate(parts, axis=1) for parts in by_kind)
    to_pads = np.concatenate(pads, axis=2).swapaxes(1, 2)  # (2: real and imaginary, n, P)
    to_pads = to_pads.reshape(2 * len(orders), -1)
    return Spectra(
        k,
        wave_weight,
        np.array(orders),
        plus,
        minus,
        normal,
    ), to_pads


def _compute_hankel_transforms(
    functions: Array,
    order: int,
    bessel: BesselTable,
    weight: Array,
) -> tuple[Array, Array, Array]:
    """Compute the spectra P, M and N (file head) of n circular components of one order m.

    A circular component is a combination of the pads' stresses that a rotation about the normal of
    the skin only multiplies by a phase.

    Args:
        functions: Radial functions R, Z and T (n, 3, distances): response to a radial, normal and
            tangential force (circular.py).
        order: Order m.
        bessel: Function that returns the Bessel function J_m(k r) (distances, waves) of an order.
        weight: Quadrature weights r dr (distances,) in m^2.

    Returns:
        Spectra P, M and N (waves, n), the Hankel transforms of R + T, R - T and Z, at the wave
        numbers of `bessel`.
    """
    along, normal, across = np.moveaxis(functions, 1, 0)

    def transform(function: Array, shift: int) -> Array:
        waves = bessel(order + shift).T
        weighted = function * weight
        return np.asarray(2 * np.pi * waves @ weighted.T)

    plus = transform(along + across, -1)
    minus = transform(along - across, 1)
    return plus, minus, transform(normal, 0)


def _compute_fourier_series(influence: Influence, r: Array) -> list[Array]:
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
        For each order m, the functions R, Z and T (2 P, 3, distances): first those of the component
        c of each of the P pads, then those of the component c' of each pad.
    """
    angle = 2 * np.pi * np.arange(N_DIRECTIONS) / N_DIRECTIONS
    cosine = np.cos(angle)
    sine = np.sin(angle)
    direction = np.stack([cosine, sine], axis=1)
    # The direction runs from the force to the cube, so the force lies at minus r.
    place = -r[:, None, None] * direction
    responses = influence.interpolate(place.reshape(-1, 2))
    responses = responses.reshape(-1, len(r), N_DIRECTIONS, 3)

    x, y, z = np.moveaxis(responses, -1, 0)
    radial = cosine * x + sine * y
    tangential = cosine * y - sine * x
    polar = np.stack([radial, z, tangential], axis=1)
    coefficients = np.fft.fft(polar, axis=-1) / N_DIRECTIONS

    series = []
    for order in range(N_ORDERS):
        # The terms exp(i m phi) and exp(-i m phi) of a real function are complex conjugates. Both
        # contribute to order m, hence the factor 2; at order 0 they are the same term.
        factor = 1.0 if order == 0 else 2.0
        even = factor * coefficients[..., order].real
        odd = -factor * coefficients[..., order].imag
        real = np.stack(
            [
                even[:, 0],
                even[:, 1],
                -odd[:, 2],
            ],
            axis=1,
        )
        imaginary = np.stack([odd[:, 0], odd[:, 1], even[:, 2]], axis=1)
        series.append(np.concatenate([real, imaginary]))
    return series
