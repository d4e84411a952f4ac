# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Values of cubes under Hertz contacts, and their derivatives by the contacts, in C or in numpy.

The functions in numpy are the ones to read, and run without a compiler. The ones in C
(native/cube_contact.c) add the terms of sums in another order, so that results differ by rounding
errors.
"""

from __future__ import annotations

import numpy as np

from ...core.arrays import AnyArray, Array, Index
from ...core.kernel.run import native
from ...core.modes import STRESS
from ..inverse import SurfaceInverse
from .contact_estimate import Discs

FLATNESS_STEP = 0.2
"""Difference h of the natural logarithms of radii in the definition of the flatness, a parameter of
the pressure distribution of a contact.

To a Hertz contact of radius a, the flatness adds a multiple of the following difference: this
contact minus a mixture of Hertz contacts of the radii a exp(h) and a exp(-h) with the same force,
centre and second moment. This moves pressure from the centre to the rim. A Hertz contact has
flatness 0, a rigid flat punch flatness 1.
"""

N_PARAMETERS = 8
"""Number of parameters of a contact: force f_x, f_y, f_z, centre c_x, c_y, logarithm ln a of the
radius, flatness, and moment about z."""

_BLOCK = 4
"""Number of parameters whose derivatives the function in C whitens side by side."""


def respond(
    inverse: SurfaceInverse,
    place: Array,
    angle: Array,
    variant: Index,
    discs: Discs,
) -> Array:
    """Compute the values of n cubes under J Hertz contacts approximately, but fast.

    Args:
        inverse: Responses (stress in the skin under contacts of unit force).
        place: Positions (n, 2) of the cubes in m, in the frame of the contacts.
        angle: Rotations (n,) of the cubes about z in rad, in this frame.
        variant: Index (n,) of each cube's variant in the measurement model.
        discs: The contacts.

    Returns:
        The C components (n, C) in Pa (`ContactResponse.compute_response_to_forces`).
    """
    values = np.zeros((len(place), len(inverse.columns)))
    if native is not None:
        native.respond(*_collect(inverse, place, angle, variant, discs), values)
        return values
    for force, centre, log_size in zip(*discs, strict=True):
        by_disc = inverse.contact_response.compute_response_to_forces(
            place - centre,
            angle,
            variant,
            np.full(len(place), np.exp(log_size)),
            np.tile(force, (len(place), 1)),
        )
        values += inverse.select(by_disc)
    return values


def differentiate(
    inverse: SurfaceInverse,
    place: Array,
    angle: Array,
    variant: Index,
    discs: Discs,
    depth_error: float,
    whitening: Array,
) -> tuple[Array, Array]:
    """Compute the values of n cubes under J Hertz contacts, and their derivatives.

    Args:
        inverse: Responses (stress in the skin under contacts of unit force).
        place: Positions (n, 2) of the cubes in m, in the frame of the contacts.
        angle: Rotations (n,) of the cubes about z in rad, in this frame.
        variant: Index (n,) of each cube's variant in the measurement model.
        discs: The contacts.
        depth_error: Error of the depth of the cubes' centres, divided by the depth.
        whitening: Lower triangular matrices (n, C, C) that whiten the values.

    Returns:
        Derivatives (n, C, p + 1), in Pa, of the values by the p = 8 J + S parameters, which are
        those of the contacts and the errors of S quantities of the elastomer, in standard
        deviations. The values are the last column. Then the same array, whitened.
    """
    # The response is not linear in the depth. Its change from the stated depth to the one found
    # follows from the derivative halfway between these two depths. In a half space, this derivative
    # is that at the stated depth for a load whose lengths are divided by `halfway`, times a factor.
    # The factor is the same for all values, so it only scales the error that the next step finds.
    halfway = 1 + depth_error / 2
    if native is None:
        columns = _differentiate_in_numpy(inverse, place, angle, variant, discs, halfway)
        return columns, whitening @ columns
    n_columns = N_PARAMETERS * len(discs.forces) + inverse.contact_response.n_quantities + 1
    n_padded = n_columns + -n_columns % _BLOCK
    padded = np.empty((*whitening.shape[:2], n_padded))
    white = np.empty_like(padded)
    arrays = _collect(inverse, place, angle, variant, discs)
    native.linearise(halfway, *arrays, None, whitening, padded, white)
    return padded[..., :n_columns], white[..., :n_columns]


def _collect(
    inverse: SurfaceInverse,
    place: Array,
    angle: Array,
    variant: Index,
    discs: Discs,
) -> list[AnyArray]:
    """Return the arrays that both functions in C take first, with the types that they need."""
    tables = inverse.contact_response.collect_tables(inverse.columns)
    doubles = [np.ascontiguousarray(one, float) for one in (place, angle, *discs)]
    doubles.insert(2, np.ascontiguousarray(variant, np.int64))
    return [*tables, *doubles]


def _differentiate_in_numpy(
    inverse: SurfaceInverse,
    place: Array,
    angle: Array,
    variant: Index,
    discs: Discs,
    halfway: float,
) -> Array:
    """Compute the derivatives and values (n, C, p + 1) of `differentiate`."""
    forces, centres, log_sizes = discs
    n_contacts, n_cubes = len(forces), len(place)
    n_columns = len(inverse.columns)

    # The responses are computed for all contacts and cubes in one call.
    response = inverse.contact_response
    positions = (place - centres[:, None]).reshape(-1, 2)
    angles = np.tile(angle, n_contacts)
    variants = np.tile(variant, n_contacts)
    sizes = np.exp(log_sizes).repeat(n_cubes)
    all_forces = forces.repeat(n_cubes, axis=0)
    slopes = response.compute_response_slopes(positions, angles, variants, sizes, all_forces)
    # The derivative by the flatness is the response to a contact minus that to a mixture of a wider
    # and a narrower one (see `FLATNESS_STEP`, h). With the derivatives `first` and `second` by the
    # logarithm of the radius, it is h^2 (first - second / 2), to order h^2.
    first, second = slopes[:, 5], slopes[:, 6]
    slopes[:, 6] = FLATNESS_STEP**2 * (first - second / 2)
    by_contact = inverse.select(slopes).reshape(n_contacts, n_cubes, N_PARAMETERS, n_columns)
    of_contacts = by_contact.transpose(1, 3, 0, 2).reshape(n_cubes, n_columns, -1)
    values = np.einsum("jnpc,jp->nc", by_contact[:, :, :3], forces)

    sensitivity = response.compute_sensitivity(
        positions / halfway,
        angles,
        sizes / halfway,
        all_forces,
    )
    sensitivity[:, :, len(STRESS) :] /= halfway
    by_elastomer = inverse.select(sensitivity).reshape(n_contacts, n_cubes, -1, n_columns)
    of_elastomer = by_elastomer.sum(axis=0).swapaxes(1, 2)
    return np.concatenate([of_contacts, of_elastomer, values[:, :, None]], axis=2)
