# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Values of cubes under Hertz contacts, and their derivatives by the contacts, in C or in numpy.

The functions in numpy are easier to read, and run without a compiler. The functions in C
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
radius, flatness (`FLATNESS_STEP`), and moment about z."""

_BLOCK = 4
"""Number of parameters whose derivatives the function in C whitens together. The number of columns
is rounded up to a multiple of this number."""


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
        The C measured components (n, C) in Pa, as from
        `ContactResponse.compute_response_to_forces`.
    """
    response = inverse.contact_response
    if native is None:
        positions, angles, sizes, forces = _combine(place, angle, discs)
        variants = np.tile(variant, len(sizes) // len(place))
        values = response.compute_response_to_forces(
            positions,
            angles,
            variants,
            sizes,
            forces,
        )
        return _sum_over_contacts(inverse.select(values), len(place))
    tables = response.collect_tables(inverse.columns)
    result = np.empty((len(place), 1, len(inverse.columns)))
    native.respond(
        *tables[:4],
        *_convert(place, angle, variant, discs),
        result,
    )
    return result[:, 0]


def respond_to_errors(
    inverse: SurfaceInverse,
    place: Array,
    angle: Array,
    discs: Discs,
) -> Array:
    """Compute how errors of the elastomer change the values of n cubes under J Hertz contacts.

    Args:
        inverse: Responses (stress in the skin under contacts of unit force).
        place: Positions (n, 2) of the cubes in m, in the frame of the contacts.
        angle: Rotations (n,) of the cubes about z in rad, in this frame.
        discs: The contacts.

    Returns:
        Changes (n, S, C) in Pa of the C measured components by S quantities of the elastomer, each
        with an error of one standard deviation (`ContactResponse.compute_sensitivity`).
    """
    response = inverse.contact_response
    if native is None:
        changes = response.compute_sensitivity(*_combine(place, angle, discs))
        return _sum_over_contacts(inverse.select(changes), len(place))
    scale, _, _, _, *tables = response.collect_tables(inverse.columns)
    result = np.empty((len(place), response.n_quantities, len(inverse.columns)))
    no_variant = np.zeros(len(place), np.intp)
    native.respond(
        scale,
        *tables,
        *_convert(place, angle, no_variant, discs),
        result,
    )
    return result


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
        Array (n, C, p + 1), in Pa, and the same array, whitened. The first p = 8 J + S columns are
        the derivatives of the C measured components by the parameters: those of the contacts
        (`N_PARAMETERS`), then the errors of S quantities of the elastomer, in standard deviations.
        The last column contains the components themselves.
    """
    # The response is not linear in the depth. The change of the response from the stated depth to
    # the one found follows from the derivative halfway between these two depths. In a half space,
    # this derivative is a factor times the derivative at the stated depth under a load whose
    # lengths are divided by `halfway`. The factor is left out: as it is the same for all values, it
    # only scales the error of the depth that the next Gauss-Newton step finds.
    halfway = 1 + depth_error / 2
    if native is None:
        columns = _differentiate_in_numpy(
            inverse,
            place,
            angle,
            variant,
            discs,
            halfway,
        )
        return columns, whitening @ columns
    tables = inverse.contact_response.collect_tables(inverse.columns)
    arrays = _convert(place, angle, variant, discs)
    n_columns = N_PARAMETERS * len(discs.forces) + inverse.contact_response.n_quantities + 1
    n_padded = n_columns + -n_columns % _BLOCK
    columns = np.empty((*whitening.shape[:2], n_padded))
    white = np.empty_like(columns)
    native.linearise(
        halfway,
        *tables[:4],
        *arrays,
        None,
        *tables[4:],
        whitening,
        columns,
        white,
    )
    return columns[..., :n_columns], white[..., :n_columns]


def _convert(
    place: Array,
    angle: Array,
    variant: Index,
    discs: Discs,
) -> list[AnyArray]:
    """Return the cubes and contacts as arrays of the types that the functions in C need."""
    cubes = place, angle, np.asarray(variant, np.int64)
    return [np.ascontiguousarray(one) for one in (*cubes, *discs)]


def _combine(
    place: Array,
    angle: Array,
    discs: Discs,
) -> tuple[Array, Array, Array, Array]:
    """Return the pairs of J contacts and n cubes, sorted by contact.

    Returns:
        Positions (J n, 2) of the cubes from the centres, rotations (J n,) of the cubes, and radii
        (J n,) and forces (J n, 3) of the contacts.
    """
    n_cubes, n_contacts = len(place), len(discs.forces)
    positions = place - discs.centres[:, None]
    return (
        positions.reshape(-1, 2),
        np.tile(angle, n_contacts),
        np.exp(discs.log_sizes).repeat(n_cubes),
        discs.forces.repeat(n_cubes, axis=0),
    )


def _sum_over_contacts(values: Array, n_cubes: int) -> Array:
    """Return the sums (n, ...) of values (J n, ...) over the contacts."""
    by_contact = values.reshape(-1, n_cubes, *values.shape[1:])
    return np.asarray(by_contact.sum(axis=0), float)


def _differentiate_in_numpy(
    inverse: SurfaceInverse,
    place: Array,
    angle: Array,
    variant: Index,
    discs: Discs,
    halfway: float,
) -> Array:
    """Compute the first array (n, C, p + 1) of `differentiate`, with derivatives and values."""
    n_contacts, n_cubes = len(discs.forces), len(place)
    response = inverse.contact_response
    positions, angles, sizes, forces = _combine(place, angle, discs)
    variants = np.tile(variant, n_contacts)
    slopes = response.compute_response_slopes(
        positions,
        angles,
        variants,
        sizes,
        forces,
    )
    # The derivative by the flatness is the response to a contact minus that to a mixture of a wider
    # and a narrower one (with h = `FLATNESS_STEP`, see there). With the derivatives `first` and
    # `second` of the response by the logarithm of the radius, this difference is
    # h^2 (first - second / 2), to order h^2.
    first, second = slopes[:, 5], slopes[:, 6]
    slopes[:, 6] = FLATNESS_STEP**2 * (first - second / 2)
    by_contact = inverse.select(slopes).reshape(
        n_contacts,
        n_cubes,
        N_PARAMETERS,
        -1,
    )
    of_contacts = by_contact.transpose(1, 3, 0, 2).reshape(
        n_cubes,
        len(inverse.columns),
        -1,
    )
    values = np.einsum("jnpc,jp->nc", by_contact[:, :, :3], discs.forces)

    changes = response.compute_sensitivity(
        positions / halfway,
        angles,
        sizes / halfway,
        forces,
    )
    changes[:, :, len(STRESS) :] /= halfway
    of_elastomer = _sum_over_contacts(inverse.select(changes), n_cubes).swapaxes(1, 2)
    return np.concatenate([of_contacts, of_elastomer, values[:, :, None]], axis=2)
