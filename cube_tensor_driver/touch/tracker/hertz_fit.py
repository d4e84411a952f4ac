# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Fit of Hertz contacts to the values of the cubes around a region of contact.

A ball presses as a Hertz contact: force, centre and radius describe it with a few numbers, which
the values of the cubes determine better than the forces of many grid contacts (grid_fit.py), above
all where the cubes are far apart. Gauss-Newton steps find the parameters x with the largest
posterior. With the derivatives J of the whitened values by the parameters, the whitened residual r,
the prior mean x0 and precision P of the parameters, and the misfit t (chi-squared per value, at
least 1)::

    (J' J + P) change = J' r - P (x - x0),    covariance of x = t (J' J + P)^-1

Source: K. L. Johnson, Contact Mechanics (1985), 4.2 (Hertz); D. J. C. MacKay, Bayesian
interpolation, Neural Computation 4 (1992) 415 (evidence).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ...core.arrays import Array, Index
from ...mechanics.contact_response import DISC_SIZES
from ...mechanics.sensitivity import DEPTH_DEVIATION
from ..inverse import SurfaceInverse
from .contact_estimate import ContactEstimate, ContactSum, Discs
from .hertz_response import FLATNESS_STEP, N_PARAMETERS, differentiate
from .local_values import LocalValues, make_rotations_about_normal

SIZE_DEVIATION = 1.0
"""Prior standard deviation of the natural logarithm of the radius of a Hertz contact."""

USUAL_SIZE = 0.8
"""Prior median of the radius of a contact, divided by the depth of the cubes' centres below the
surface. The logarithm of the radius has a normal prior distribution."""

FORCE_DEVIATION = 1e2
"""Prior standard deviation of each component of the force of a contact, in N; the prior mean is 0.
The value is so large that the prior does not influence the fitted force."""

SHAPE_CUBES = 9
"""Number of cubes nearest to the contacts whose residuals test whether the contacts have the shape
(Hertz pressure in a circle) that the fit assumes."""

SETTLED_STEP = 0.02
"""Size of a Gauss-Newton step below which a fit has converged. The size is the larger one of two
numbers: the shift of a contact divided by the depth of the cubes' centres, and the change of the
natural logarithm of its radius."""

START_ELASTOMER_PRECISION = 1e4
"""Prior precision, in the first Gauss-Newton step, of the errors of depth, thickness and Poisson's
ratio of the elastomer, in units of their standard deviations.

The precision of later steps is the misfit (chi-squared per known value, at least 1). In the first
step, the contact may be far from its solution, and its residual is large. A low precision would let
the errors of the elastomer explain this residual, in place of a shift of the contact.
"""

MAX_PRECISION_RATIO = 2.0
"""Largest ratio of the prior precision of the errors of depth, thickness and Poisson's ratio to the
misfit (chi-squared per known value). Above it, the response is linearised again with the present
misfit as precision.

The prior variance of these errors is 1, in units of their standard deviations. The covariance of a
fit is multiplied by the misfit, so that a precision equal to the misfit restores the variance 1.
"""

REPEAT_STEP = 0.1
"""Size of a Gauss-Newton step, as in `SETTLED_STEP`, above which the fit makes another step for the
values of the same scan, from a response that is linearised at the new contacts."""

_MAX_STEP = 0.5
"""Largest Gauss-Newton step: shift of a contact divided by the depth of the cubes' centres, and
change of the natural logarithm of its radius."""

_STENCIL = np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]], float)
"""Shifts (5, 2) of a contact for numerical derivatives by its centre, in units of the step: none,
then both directions along x and along y."""


class Linearisation(NamedTuple):
    """Values of C components of n cubes under J Hertz contacts, and how these values change.

    The components are those of stress and gradient that the pads determine. The p = 8 J + S
    parameters are the 8 of each contact (force, centre, logarithm of the radius, flatness as in
    `FLATNESS_STEP`, moment), and then the errors of S quantities of the elastomer (sensitivity.py),
    in standard deviations.

    Attributes:
        contacts: The contacts.
        cubes: Positions and noise of the cubes.
        values: Values (n, C) under the contacts, in Pa.
        derivatives: Derivatives (n, C, p) of the values by the parameters.
        white_values: Values (n C,), whitened.
        jacobian: Derivatives (n C, p) of the whitened values.
        offset: Parameters (p,) of the contacts minus their prior mean.
        precision: Prior precisions (p,) of the parameters.
        information: Posterior precision (p, p) of the parameters if the residuals are no larger
            than the noise explains.
        covariance: Inverse (p, p) of `information`.
        nearest: Indices of the `SHAPE_CUBES` cubes with the smallest distances from a contact,
            whose residuals test the assumed shape of the contacts.
    """

    contacts: Discs
    cubes: LocalValues
    values: Array
    derivatives: Array
    white_values: Array
    jacobian: Array
    offset: Array
    precision: Array
    information: Array
    covariance: Array
    nearest: Index


class HertzFit:
    """J Hertz contacts in a region, fitted to C components of each of n cubes around the region.

    The components are those of stress and gradient that the pads determine. Whitened values are
    components transformed so that their noise has variance 1 and no correlation.

    Attributes:
        values: Positions and noise of the cubes.
        found: Parameters (force, centre, radius) of the contacts that the last step has found.
        misfit: Chi-squared (sum of the squares of the whitened residual, and prior terms) divided
            by the number of known values; at least 1.
        shape_misfit: Mean squared whitened residual of the `SHAPE_CUBES` cubes nearest to the
            contacts. A wrong shape changes it more than contacts elsewhere do.
        last_step: Size of the last Gauss-Newton step, as in `SETTLED_STEP`; infinite before the
            first step.
        linear: Response of the cubes for the next Gauss-Newton step, from `linearise`.
        contact_precision: Prior precisions (8 J,) of the parameters of the contacts.
    """

    linear: Linearisation

    def __init__(
        self,
        inverse: SurfaceInverse,
        values: LocalValues,
        starts: Discs,
    ) -> None:
        """Prepare a fit that begins at `starts`.

        To improve these contacts, call `linearise`, then `step` (a Gauss-Newton step).

        Args:
            inverse: Depth and responses of the skin.
            values: Positions and noise of the cubes around the region.
            starts: Contacts at which the fit begins.
        """
        self.values = values
        depth = inverse.depth
        self._depth = depth
        # Cubic interpolation of responses needs one tabulated radius below and two above.
        size_range = DISC_SIZES[[1, -3]] * depth
        self._log_range = np.log(size_range)
        log_sizes = np.clip(starts.log_sizes, *self._log_range)
        self.found = starts._replace(log_sizes=log_sizes)
        self.misfit = 1.0
        self.shape_misfit = 1.0
        self.last_step = np.inf
        # `_previous` are the contacts of the scan before, from which `predict` extrapolates. In the
        # first scan of a fit there are none.
        self._previous: Discs | None = None
        n_contacts = len(starts.forces)
        # `_lengths` are the units in which the size of a step (`SETTLED_STEP`) is measured: of the
        # changes of x, y and the logarithm of the radius of a contact.
        self._lengths = np.array([depth, depth, 1.0])
        flatness_deviation = 1.0
        moment_deviation = FORCE_DEVIATION * depth
        deviations = [
            *[FORCE_DEVIATION] * 3,
            *[depth] * 2,
            SIZE_DEVIATION,
            flatness_deviation,
            moment_deviation,
        ]
        precision = np.array(deviations) ** -2
        self.contact_precision = np.tile(precision, n_contacts)
        # `_changes` are the changes of all parameters by the last step: 8 of each contact, then the
        # errors of the elastomer, of which the first is that of the depth. Every step begins with
        # flatness, moment and errors 0, so the changes of these are their values.
        self._changes = np.zeros(len(self.contact_precision) + 1)

    @property
    def elastomer_precision(self) -> float:
        """Prior precision of the errors of the elastomer for the next linearisation."""
        return self.misfit if self.last_step < np.inf else START_ELASTOMER_PRECISION

    @property
    def depth_error(self) -> float:
        """Error of the depth of the cubes' centres that the last step has found, divided by the
        depth."""
        return DEPTH_DEVIATION * float(self._changes[len(self.contact_precision)])

    @property
    def displacement(self) -> float:
        """Difference between the contacts found and those at which the response was linearised.

        It is measured like the size of a step in `SETTLED_STEP`.
        """
        found, base = self.found, self.linear.contacts
        shift = (found.centres - base.centres).ravel().tolist()
        growth = (found.log_sizes - base.log_sizes).tolist()
        largest_shift = max(map(abs, shift)) / self._depth
        return float(max(largest_shift, *map(abs, growth)))

    @property
    def is_inexact(self) -> bool:
        """Whether the linearised response of the cubes is not exact for the contacts found.

        The response is not exact if it was computed for other cubes, if the `displacement` of the
        contacts is at least `SETTLED_STEP`, or if the prior precision of the elastomer's errors
        exceeds `MAX_PRECISION_RATIO` times the misfit.
        """
        if self.linear.cubes is not self.values:
            return True
        if self.displacement >= SETTLED_STEP:
            return True
        elastomer_precision = self.linear.precision[-1]
        return bool(elastomer_precision > MAX_PRECISION_RATIO * self.misfit)

    @property
    def needs_linearisation(self) -> bool:
        """Whether the response of the cubes must be linearised again before the next step, because
        the present one is inexact or the noise of the cubes has changed."""
        return self.is_inexact or self.values.is_stale

    @property
    def is_unsettled(self) -> bool:
        """Whether the last step was larger than `REPEAT_STEP`, so that the response of the cubes,
        linearised before the step, is not exact after it."""
        return self.last_step > REPEAT_STEP

    @property
    def is_pressing(self) -> bool:
        """Whether all contacts press on the surface; none pulls."""
        return bool(self.found.forces[:, 2].max() < 0)

    @property
    def inflation(self) -> float:
        """Factor by which all variances are multiplied if residuals are larger than noise explains.

        It is the larger one of `misfit` and `shape_misfit`. The latter is needed, for example, for
        a flat punch, whose infinite pressure at the edge only changes the nearest cubes' values.
        """
        return max(self.misfit, self.shape_misfit)

    @property
    def score(self) -> float:
        """-2 ln of the evidence (probability of the values, in Laplace approximation), up to a
        constant that is the same for `GridFit.score` of a fit by grid contacts."""
        _, log_posterior_precision = np.linalg.slogdet(self.linear.information)
        log_prior_precision = np.log(self.linear.precision).sum()
        occam_term = log_posterior_precision - log_prior_precision
        count = max(self.values.count, 1)
        noise_term = count * np.log(self.misfit)
        residual_term = self._chi_squared / self.misfit
        return float(residual_term + noise_term + occam_term)

    @property
    def discs(self) -> Discs:
        """Hertz contacts that the last step has found, or that are predicted for this scan."""
        return self.found

    @property
    def explained(self) -> Array:
        """Components (n, C), in Pa, that the contacts `found` cause in the n cubes around the
        region, by the linearised response `linear`."""
        return np.asarray(self.linear.values + self.linear.derivatives @ self._changes)

    def predict(self, extrapolates: bool) -> None:
        """Set the contacts at which the fit of a new scan (set of values of all cubes) begins.

        Args:
            extrapolates: Whether these contacts are extrapolated, by the changes of centres and
                forces between the last two scans; otherwise they are the contacts of the last scan.
        """
        found, previous = self.found, self._previous
        self._previous = found
        if extrapolates and previous is not None:
            limit = _MAX_STEP * self._depth
            shift = found.centres - previous.centres
            centres = found.centres + np.maximum(np.minimum(shift, limit), -limit)
            forces = 2 * found.forces - previous.forces
            self.found = found._replace(centres=centres, forces=forces)

    def move_home(self, values: LocalValues) -> None:
        """Continue the fit around another home cube, and rotate the contacts into its frame.

        The home cube is the cube around which the curved skin is laid flat for the fit; positions
        and forces are in its frame.

        Args:
            values: Positions and noise of the cubes around the new home cube. This cube is one of
                the cubes of the present fit.
        """
        is_home = self.values.cubes == values.home
        (number,) = np.flatnonzero(is_home)
        place = self.values.place[number]
        to_home = make_rotations_about_normal(self.values.angle[number])
        to_home_in_plane = to_home[:2, :2]

        def transform(discs: Discs) -> Discs:
            centres = (discs.centres - place) @ to_home_in_plane.T
            forces = discs.forces @ to_home.T
            return discs._replace(forces=forces, centres=centres)

        self.found = transform(self.found)
        if self._previous is not None:
            self._previous = transform(self._previous)
        self.values = values

    def step(self, white: Array) -> None:
        """Make a Gauss-Newton step from the contacts at which the response is linearised.

        Args:
            white: Whitened values (n C,), C components of each of n cubes, transformed by
                `LocalValues.whiten` so that their noise has variance 1 and no correlation.
        """
        linear = self.linear
        residual = white - linear.white_values
        prior_gradient = linear.precision * linear.offset
        gradient = residual @ linear.jacobian - prior_gradient
        change = linear.covariance @ gradient
        penalty = linear.offset @ prior_gradient
        self._chi_squared = float(residual @ residual + penalty - gradient @ change)
        count = max(self.values.count, 1)
        self.misfit = max(self._chi_squared / count, 1.0)

        known = self.values.known
        new_residual = residual - linear.jacobian @ change
        near_residual = new_residual.reshape(known.shape)[linear.nearest]
        near_square = float(np.vdot(near_residual, near_residual))
        near_count = int(np.count_nonzero(known[linear.nearest]))
        self.shape_misfit = near_square / max(near_count, 1)

        self._changes = change
        self._move_contacts(self._contact_changes)

    @property
    def _contact_changes(self) -> Array:
        """Changes (J, 8) by the last step of the 8 parameters of each contact."""
        n_parameters = len(self.contact_precision)
        return self._changes[:n_parameters].reshape(-1, N_PARAMETERS)

    def compute_weights(self, cubes: Index) -> Array:
        """Return the derivatives of force and position of the first contact by the values of cubes.

        The errors of the elastomer are held constant.

        Args:
            cubes: Indices (m,) of cubes of the skin. Cubes that are not in the fit get weight 0.

        Returns:
            Weights (5, m, C): force in N and position in m in the frame of the home cube, by the C
            components of each cube in Pa.
        """
        rows, columns = np.nonzero(self.values.cubes[:, None] == cubes)
        n_parameters = len(self.contact_precision)
        whitening = self.values.whitening[rows]
        jacobian = self.linear.jacobian.reshape(*self.values.known.shape, -1)
        jacobian = jacobian[rows, :, :n_parameters].reshape(-1, n_parameters)
        information = jacobian.T @ jacobian + np.diag(self.contact_precision)
        by_value = jacobian @ np.linalg.inv(information)[:, :5]
        by_cube = by_value.reshape(*whitening.shape[:2], 5).swapaxes(1, 2) @ whitening
        weights = np.zeros((5, len(cubes), whitening.shape[2]))
        weights[:, columns] = by_cube.swapaxes(0, 1)
        return weights

    def _move_contacts(self, change: Array) -> None:
        """Set the contacts to those at which the response was linearised plus a Gauss-Newton step.

        Args:
            change: Step (J, 8) of the 8 parameters of each contact. The steps of centre and radius
                are limited to `_MAX_STEP` in place.
        """
        base = self.linear.contacts
        steps = change[:, 3:6] / self._lengths
        steps = np.maximum(np.minimum(steps, _MAX_STEP), -_MAX_STEP)
        self.last_step = max(map(abs, steps.ravel().tolist()))
        change[:, 3:6] = steps * self._lengths
        smallest, largest = self._log_range
        log_sizes = np.maximum(np.minimum(base.log_sizes + change[:, 5], largest), smallest)
        change[:, 5] = log_sizes - base.log_sizes
        self.found = Discs(
            base.forces + change[:, :3],
            base.centres + change[:, 3:5],
            log_sizes,
        )

    def to_contacts(self, step: float) -> ContactSum:
        """Describe the contacts as a sum of Hertz contacts, with the covariance of their forces.

        The fitted contacts are not pure Hertz contacts: flatness moves their pressure to the rim
        (`FLATNESS_STEP`), and a moment about z acts on them. So each fitted contact becomes seven
        Hertz contacts: one with its centre and radius, one shifted each way along x and along y,
        one wider and one narrower. A difference of two of the seven approximates a derivative of
        the traction of the fitted contact, for example by its centre. So a change of any parameter
        means changes of the seven forces, and the covariance of the parameters gives the covariance
        of these forces.

        Args:
            step: Shift in m. The shift is at least the spacing of the points at which the traction
                is evaluated, because contacts shifted by less have the same traction there.
        """
        no_shift = np.zeros((2, 2))
        places = self.found.centres[:, None] + np.concatenate([step * _STENCIL, no_shift])
        growth = np.exp(FLATNESS_STEP * np.array([0, 0, 0, 0, 0, 1, -1]))
        sizes = np.exp(self.found.log_sizes)[:, None] * growth

        # Each row of `patterns` contains the weights of the seven Hertz contacts in a sum: the
        # fitted contact itself, its derivatives by x, y and the logarithm of the radius, and the
        # difference that defines the flatness (`FLATNESS_STEP`).
        wider_share = 1 / (1 + np.exp(2 * FLATNESS_STEP))
        patterns = np.zeros((5, 7))
        patterns[[0, 4], 0] = 1
        patterns[1, 1:3] = np.array([1, -1]) / (2 * step)
        patterns[2, 3:5] = np.array([1, -1]) / (2 * step)
        patterns[3, 5:] = np.array([1, -1]) / (2 * FLATNESS_STEP)
        patterns[4, 5:] = -wider_share, wider_share - 1
        # `slopes` are the derivatives (J, 8, 3, 7) of the forces of the seven contacts by the eight
        # parameters. Two distributions of force, with half of the moment each, make up a moment of
        # 1 N m: the derivative by x of a contact with the force 1/2 N along y, and the derivative
        # by y of a contact with the force -1/2 N along x.
        slopes = np.zeros((len(places), N_PARAMETERS, 3, 7))
        slopes[:, :3] = np.eye(3)[:, :, None] * patterns[0]
        slopes[:, 3:7] = patterns[1:, None] * self.found.forces[:, None, :, None]
        slopes[:, 7, 1] = patterns[1] / 2
        slopes[:, 7, 0] = -patterns[2] / 2
        shape = self._contact_changes[:, 6:, None, None] * slopes[:, 6:]
        forces = self.found.forces[:, :, None] * patterns[0] + shape.sum(axis=1)

        # Errors of different contacts of a region are treated as independent here.
        roots = np.linalg.cholesky(self._covariances)
        by_contact = np.einsum("jpak,jpm->jakm", slopes, roots)
        root = np.zeros((3, len(places), 7, len(places), N_PARAMETERS))
        for j, own in enumerate(by_contact):
            root[:, j, :, j] = own
        return ContactSum(
            places=places.reshape(-1, 2),
            sizes=sizes.ravel(),
            forces=forces.swapaxes(0, 1).reshape(3, -1),
            root=root.reshape(3, 7 * len(places), -1),
        )

    @property
    def _covariances(self) -> list[Array]:
        """Covariance (8, 8) of the parameters of each contact."""
        covariance = self.inflation * self.linear.covariance
        starts = range(0, len(self.contact_precision), N_PARAMETERS)
        blocks = [slice(start, start + N_PARAMETERS) for start in starts]
        return [covariance[block, block] for block in blocks]

    def estimate_contacts(self) -> list[ContactEstimate]:
        """Return force, position, moment and area of each contact."""
        estimates = []
        for force, centre, log_size, change, covariance in zip(
            *self.found,
            self._contact_changes,
            self._covariances,
            strict=True,
        ):
            variances = covariance.diagonal()
            *_, size_variance, _, moment_variance = variances.tolist()
            area = math.pi * math.exp(2 * log_size)
            estimate = ContactEstimate(
                force=force,
                force_covariance=covariance[:3, :3],
                place=centre,
                place_variance=variances[3:5],
                moment=float(change[7]),
                moment_variance=moment_variance,
                area=area,
                # The derivative of the area pi exp(2 ln a) by ln a is 2 area.
                area_variance=(2 * area) ** 2 * size_variance,
                aspect=1.0,
            )
            estimates.append(estimate)
        return estimates


def linearise(inverse: SurfaceInverse, fit: HertzFit) -> None:
    """Linearise the response of the cubes at the contacts of a fit, for its next step.

    Args:
        inverse: Responses (stress in the skin under contacts of unit force).
        fit: The fit, whose attribute `linear` is set. Its noise (`LocalValues`) is not refreshed
            here, because the values of the next step must be whitened with the same noise.
    """
    contacts, values = fit.found, fit.values
    columns, white = differentiate(
        inverse,
        values.place,
        values.angle,
        values.variant,
        contacts,
        fit.depth_error,
        values.whitening,
    )
    white = white.reshape(-1, columns.shape[2])
    jacobian = white[:, :-1]

    precision = np.full(jacobian.shape[1], fit.elastomer_precision)
    n_contact_parameters = len(fit.contact_precision)
    precision[:n_contact_parameters] = fit.contact_precision
    prior_offset = np.zeros_like(precision)
    from_median = prior_offset[:n_contact_parameters].reshape(-1, N_PARAMETERS)
    from_median[:, :3] = contacts.forces
    from_median[:, 5] = contacts.log_sizes - math.log(USUAL_SIZE * inverse.depth)
    information = jacobian.T @ jacobian + np.diag(precision)
    offset = values.place - contacts.centres[:, None]
    squared_distance = (offset**2).sum(axis=2).min(axis=0)
    fit.linear = Linearisation(
        contacts=contacts,
        cubes=values,
        values=columns[..., -1],
        derivatives=columns[..., :-1],
        white_values=white[:, -1],
        jacobian=jacobian,
        offset=prior_offset,
        precision=precision,
        information=information,
        covariance=np.linalg.inv(information),
        nearest=squared_distance.argsort(kind="stable")[:SHAPE_CUBES],
    )
