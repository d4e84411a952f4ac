# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Fit of Hertz contacts to the values of the cubes around a region of contact.

A ball presses as a Hertz contact: force, centre and radius describe it with a few numbers, which
the values of the cubes determine better than the forces of many nodes (node_fit.py), above all
where the cubes are far apart. Gauss-Newton steps find the parameters x with the greatest posterior.
With the derivatives J of the whitened values by the parameters, the whitened residual r, and the
prior precision P about x0::

    (J' J + P) change = J' r - P (x - x0),    covariance t (J' J + P)^-1

Source: K. L. Johnson, Contact Mechanics (1985), 4.2 (Hertz); D. J. C. MacKay, Bayesian
interpolation, Neural Computation 4 (1992) 415 (evidence).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...core.arrays import Array
from ...mechanics.kernels import DISC_SIZES
from ..inverse import SurfaceInverse
from .contact_estimate import ContactEstimate, ContactSum, Discs
from .local_values import LocalValues

SIZE_DEVIATION = 1.0
"""Prior standard deviation of the natural logarithm of the radius of a Hertz contact."""

USUAL_SIZE = 0.8
"""Radius of a contact, divided by the depth of the cubes' centres below the surface, that the prior
expects: its logarithm is the prior mean of the logarithm of this ratio."""

FORCE_DEVIATION = 1e2
"""Prior standard deviation of each component of the force of a contact, in N; the prior mean is 0.
The value is so large that the prior does not influence the fitted force."""

FLATNESS_STEP = 0.2
"""Change of the natural logarithm of the radius that defines the unit of the flatness.

The flatness moves pressure from the centre of a contact to its rim without changing force, position
and second moment: a contact is added, and a mixture of a narrower and a wider one is subtracted. A
Hertz contact has flatness 0, a rigid flat punch flatness 1.
"""

SHAPE_CUBES = 9
"""Number of cubes nearest to the contacts whose deviations from the fit show whether the contacts
have the shape (Hertz pressure in a circle) that the fit assumes."""

SETTLED_STEP = 0.02
"""Size of a Gauss-Newton step below which a fit has converged. The size is the larger one of two
numbers: the shift of a contact divided by the depth of the cubes' centres, and the change of the
natural logarithm of its radius."""

START_STIFFNESS = 1e4
"""Precision of the errors of the elastomer's data in the first step of a fit, in which the contacts
alone are to explain the values."""

MAX_STIFFNESS = 2.0
"""Ratio of the precision of these errors to the misfit above which the precision is lowered to the
misfit, the value that the prior has if the noise has this variance."""

MAX_UNFOLLOWED_STEP = 0.1
"""Largest size of a Gauss-Newton step, as in `SETTLED_STEP`, after which the linearised response is
still used for the values of the same scan."""

_MAX_STEP = 0.5
"""Largest Gauss-Newton step: shift of a contact divided by the depth of the cubes' centres, and
change of the natural logarithm of its radius."""

_N_PARAMETERS = 8
"""Number of parameters of a contact: force f_x, f_y, f_z, centre c_x, c_y, logarithm ln a of the
radius, flatness, and moment about z."""

_STENCIL = np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]], float)
"""Shifts (5, 2) of a contact for numerical derivatives by its centre, in units of the step: none,
then both directions along x and along y."""


class HertzFit:
    """J Hertz contacts in a region, fitted to C components of each of n cubes around the region.

    The components are those of stress and gradient that the pads determine. Whitened values are
    components transformed so that their noise has variance 1 and no correlation.

    Attributes:
        found: Parameters (force, centre, radius) of the contacts that the last step has found.
        misfit: Squared deviation of the values from the fit, divided by the value that their noise
            causes; at least 1.
        shape_misfit: Mean squared deviation of the whitened values of the cubes nearest to the
            contacts (`SHAPE_CUBES`), which a wrong shape changes more than contacts elsewhere do.
        last_step: Size of the last step: shift divided by the depth of the cubes' centres, or
            change of the logarithm of the radius.
        jacobian: Derivatives (n C, 8 J) of the whitened values by the 8 parameters of each contact:
            force (3), centre (2), logarithm of the radius, flatness, moment.
        covariance: Covariance (8 J, 8 J) of these parameters for a misfit of 1.
    """

    def __init__(self, inverse: SurfaceInverse, values: LocalValues, starts: Discs) -> None:
        """Start without a step; `linearise` and `step` have to follow.

        Args:
            inverse: Depth and kernels of the skin.
            values: Values of the cubes around the region.
            starts: Contacts at which the fit begins.
        """
        self.values = values
        self._depth = depth = inverse.depth
        # `Kernels` interpolates responses between the second and the third last radius of its
        # table.
        self._log_range = np.log(DISC_SIZES[[1, -3]] * depth)
        self.found = starts._replace(log_sizes=np.clip(starts.log_sizes, *self._log_range))
        self.misfit = self.shape_misfit = self._stiffness = 1.0
        self.last_step = np.inf
        self._previous = self._at = self.found
        self._flatness = self._moments = np.zeros(len(starts.forces))
        deviations = [FORCE_DEVIATION] * 3 + [depth] * 2 + [SIZE_DEVIATION, 1.0]
        deviations.append(FORCE_DEVIATION * depth)
        self._contact_precision = np.tile(np.array(deviations) ** -2, len(starts.forces))
        self._elastomer = np.zeros(0)

    @property
    def displacement(self) -> float:
        """Difference of the contacts from those at which the response was linearised.

        It has the unit of `SETTLED_STEP`, and is infinite if no step was made yet.
        """
        if not np.isfinite(self.last_step):
            return np.inf
        shift = np.abs(self.found.centres - self._at.centres).max() / self._depth
        growth = np.abs(self.found.log_sizes - self._at.log_sizes).max()
        return float(max(shift, growth))

    @property
    def is_moving(self) -> bool:
        """Whether the response of the cubes must be linearised again before the next step.

        This is so if the `displacement` exceeds `SETTLED_STEP`, if the misfit has fallen, or if the
        noise of the cubes has changed.
        """
        is_stiff = self._stiffness > MAX_STIFFNESS * self.misfit
        return self.displacement >= SETTLED_STEP or is_stiff or self.values.is_stale

    @property
    def is_unsettled(self) -> bool:
        """Whether the last step was larger than `MAX_UNFOLLOWED_STEP`, so that the response of the
        cubes, linearised before the step, is not exact after it."""
        return self.last_step > MAX_UNFOLLOWED_STEP

    @property
    def inflation(self) -> float:
        """Factor by which all variances grow, because the values deviate more than by their noise.

        It is the larger misfit, that of all cubes or that of the nearest ones: the edge of a flat
        punch, where the pressure is infinite, shows in the nearest cubes alone.
        """
        return max(self.misfit, self.shape_misfit)

    @property
    def score(self) -> float:
        """-2 ln of the evidence (probability of the values, in Laplace approximation).

        It is comparable with the score of a fit of the traction on nodes.
        """
        _, log_determinant = np.linalg.slogdet(self._information)
        volume = log_determinant - np.log(self._precision).sum()
        scatter = max(self.values.count, 1) * np.log(self.misfit)
        return float(self._chi_squared / self.misfit + scatter + volume)

    @property
    def discs(self) -> Discs:
        """Contacts that the last step has found, or that are predicted for this scan."""
        return self.found

    @property
    def explained(self) -> Array:
        """Values that the contacts `found` (result of the last step) cause.

        They are the C components of stress and gradient (times d0, half the side of a cube) of each
        of n cubes around the region, (n, C), in Pa.
        """
        change = np.zeros((len(self.found.forces), _N_PARAMETERS))
        change[:, :3] = self.found.forces - self._at.forces
        change[:, 3:5] = self.found.centres - self._at.centres
        change[:, 5] = self.found.log_sizes - self._at.log_sizes
        change[:, 6] = self._flatness
        change[:, 7] = self._moments
        return np.asarray(self._explained + self._columns @ np.append(change, self._elastomer))

    def predict(self, is_moving: bool) -> None:
        """Begin a new scan (set of values of all cubes).

        Args:
            is_moving: Whether centres and forces are extrapolated, by their changes between the
                last two scans; otherwise the contacts of the last scan are the start.
        """
        found, previous = self.found, self._previous
        self._previous = found
        if is_moving:
            limit = _MAX_STEP * self._depth
            shift = np.clip(found.centres - previous.centres, -limit, limit)
            forces = 2 * found.forces - previous.forces
            self.found = found._replace(centres=found.centres + shift, forces=forces)

    def move_home(self, values: LocalValues) -> None:
        """Continue the fit around another home cube, and rotate the contacts into its frame.

        The home cube is the cube around which the curved skin is laid flat for the fit; positions
        and forces are in its frame.

        Args:
            values: Source of the measured stress and gradient of the cubes around the new home
                cube. The new home cube is one of the cubes of the present fit.
        """
        (number,) = np.flatnonzero(self.values.cubes == values.home)
        place, angle = self.values.place[number], self.values.angle[number]
        cosine, sine = np.cos(angle), np.sin(angle)
        to_home = np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]])

        def turn(discs: Discs) -> Discs:
            centres = (discs.centres - place) @ to_home[:2, :2].T
            return discs._replace(forces=discs.forces @ to_home.T, centres=centres)

        self.found, self._previous = turn(self.found), turn(self._previous)
        self.values = values
        self.last_step = np.inf

    def linearise(self, slopes: Array, sensitivity: Array) -> None:
        """Store the values of the cubes under the contacts `found`, and how these values change.

        The results (`jacobian`, `covariance`) serve the next Gauss-Newton step.

        Args:
            slopes: For each of J contacts and n cubes, 8 sets of the C components of stress and
                gradient (times d0, half the side of a cube): (J, n, 8, C). Sets 0 to 2 are those
                under a force of 1 N along x, y and z, in Pa/N. Sets 3 to 6 are the derivatives
                by x and y of the contact's centre (Pa/m), and the first and second derivative by
                the logarithm of its radius (Pa). Set 7 is that under a moment of 1 N m about z, in
                Pa/(N m).
            sensitivity: Changes (n, S, C) in Pa of the values under the contacts by one standard
                deviation of each of S quantities of the elastomer (sensitivity.py).
        """
        self._at = self.found
        distance = np.linalg.norm(self.values.place[:, None] - self._at.centres, axis=2)
        self._near = np.argsort(distance.min(axis=1), kind="stable")[:SHAPE_CUBES]
        columns = slopes.astype(float)
        explained = np.einsum("jnac,ja->nc", columns[:, :, :3], self._at.forces)
        # The mixture of a wider and a narrower contact with the second moment of the contact.
        columns[:, :, 6] = FLATNESS_STEP**2 * (columns[:, :, 5] - columns[:, :, 6] / 2)
        whitening = self.values.whitening
        by_cube = columns.transpose(1, 3, 0, 2).reshape(*explained.shape, -1)
        by_cube = np.concatenate([by_cube, sensitivity.swapaxes(1, 2)], axis=2)
        # In units of their standard deviations, the errors of these quantities have precision 1,
        # for values whose noise has the variance `misfit`. Far from the solution, the misfit is so
        # large that they do not take up what is due to the contacts.
        has_misfit = np.isfinite(self.last_step)
        self._stiffness = self.misfit if has_misfit else START_STIFFNESS
        of_elastomer = np.full(sensitivity.shape[1], self._stiffness)
        precision = np.append(self._contact_precision, of_elastomer)
        self._precision = precision
        self._explained, self._columns = explained, by_cube
        self.jacobian = (whitening @ by_cube).reshape(-1, by_cube.shape[2])
        self._model = (whitening @ explained[:, :, None]).ravel()
        information = self.jacobian.T @ self.jacobian
        information[np.diag_indices(len(information))] += self._precision
        self.covariance = np.linalg.inv(information)
        self._information = information

    def step(self, white: Array) -> None:
        """Make a Gauss-Newton step from the parameters at which the response is linearised.

        Args:
            white: Whitened values (n C,), C components of each of n cubes, transformed by
                `LocalValues.whiten` so that their noise has variance 1 and no correlation.
        """
        at = self._at
        residual = white - self._model
        deviation = np.zeros((len(at.forces), _N_PARAMETERS))
        deviation[:, :3] = at.forces
        deviation[:, 5] = at.log_sizes - np.log(USUAL_SIZE * self._depth)
        flat = np.append(deviation, 0 * self._precision[deviation.size :])
        right = self.jacobian.T @ residual - self._precision * flat
        change = self.covariance @ right
        penalty = flat @ (self._precision * flat)
        chi_squared = float(residual @ residual + penalty - right @ change)
        known = max(self.values.count, 1)
        self.misfit = max(chi_squared / known, 1.0)
        rest = (residual - self.jacobian @ change).reshape(self.values.known.shape)
        near = self._near
        below = max(int(self.values.known[near].sum()), 1)
        self.shape_misfit = float((rest[near] ** 2).sum()) / below
        self._chi_squared = chi_squared

        self._elastomer = change[deviation.size :]
        change = change[: deviation.size].reshape(-1, _N_PARAMETERS)
        limit = _MAX_STEP * self._depth
        shift = np.clip(change[:, 3:5], -limit, limit)
        growth = np.clip(change[:, 5], -_MAX_STEP, _MAX_STEP)
        largest_shift = float(np.abs(shift).max()) / self._depth
        self.last_step = max(largest_shift, float(np.abs(growth).max()))
        sizes = np.clip(at.log_sizes + growth, *self._log_range)
        self.found = Discs(at.forces + change[:, :3], at.centres + shift, sizes)
        self._flatness = change[:, 6]
        self._moments = change[:, 7]

    def to_contacts(self, step: float) -> ContactSum:
        """Describe these contacts and their deviations as a sum of Hertz contacts.

        Each contact becomes seven: itself, one shifted each way along x and along y, one wider and
        one narrower. Differences of them are its derivatives by centre, size, flatness and moment.

        Args:
            step: Shift in m. It is at least the spacing of the points at which the traction is
                evaluated, because contacts shifted by less have the same traction there.
        """
        count = len(self.found.forces)
        shifts = np.concatenate([step * _STENCIL, np.zeros((2, 2))])
        places = self.found.centres[:, None] + shifts
        factors = np.exp(FLATNESS_STEP * np.array([0, 0, 0, 0, 0, 1, -1]))
        sizes = np.exp(self.found.log_sizes)[:, None] * factors

        # Derivatives (3, contacts of the sum, parameters) of the forces by the parameters.
        slopes = np.zeros((3, count, 7, count, _N_PARAMETERS))
        share = 1 / (1 + np.exp(2 * FLATNESS_STEP))
        for j, force in enumerate(self.found.forces):
            own = slopes[:, j, :, j]
            own[:, 0, :3] = np.eye(3)
            own[:, [1, 2], 3] = force[:, None] * [1, -1] / (2 * step)
            own[:, [3, 4], 4] = force[:, None] * [1, -1] / (2 * step)
            own[:, [5, 6], 5] = force[:, None] * [1, -1] / (2 * FLATNESS_STEP)
            own[:, [0, 5, 6], 6] = force[:, None] * [1, -share, share - 1]
            own[1, [1, 2], 7] = np.array([1, -1]) / (4 * step)
            own[0, [3, 4], 7] = np.array([-1, 1]) / (4 * step)
        forces = np.einsum("ajkj,j->ajk", slopes[..., 6], self._flatness)
        forces += np.einsum("ajkj,j->ajk", slopes[..., 7], self._moments)
        forces[:, :, 0] += self.found.forces.T

        n = _N_PARAMETERS * count
        covariance = self.inflation * self.covariance[:n, :n]
        root = slopes.reshape(3, -1, n) @ np.linalg.cholesky(covariance)
        return ContactSum(places.reshape(-1, 2), sizes.ravel(), forces.reshape(3, -1), root)

    def estimate_contacts(self) -> list[ContactEstimate]:
        """Return force, position, moment and area of each contact."""
        estimates = []
        for j, log_size in enumerate(self.found.log_sizes.tolist()):
            own = slice(_N_PARAMETERS * j, _N_PARAMETERS * (j + 1))
            covariance = self.inflation * self.covariance[own, own]
            area = float(np.pi * np.exp(2 * log_size))
            estimates.append(
                ContactEstimate(
                    force=self.found.forces[j],
                    force_covariance=covariance[:3, :3],
                    place=self.found.centres[j],
                    place_variance=np.diag(covariance)[3:5],
                    moment=float(self._moments[j]),
                    moment_variance=float(covariance[7, 7]),
                    area=area,
                    area_variance=float((2 * area) ** 2 * covariance[5, 5]),
                    aspect=1.0,
                )
            )
        return estimates


def linearise(inverse: SurfaceInverse, fits: Sequence[HertzFit]) -> None:
    """Compute the stress of the cubes under the contacts of each fit, and store it in the fits.

    Its derivatives by the parameters of the contacts (force, centre, radius, flatness, moment) are
    computed and stored, too. All fits together take little longer than one.

    Args:
        inverse: Kernels (stress in the skin under contacts of unit force).
        fits: Fits, whose `linearise` gets the results.
    """
    if not fits:
        return
    offsets, angles, variants, sizes, forces = [], [], [], [], []
    for fit in fits:
        fit.values.refresh()
        values, found = fit.values, fit.found
        count, n = len(found.forces), len(values.cubes)
        offsets.append((values.place - found.centres[:, None]).reshape(-1, 2))
        angles.append(np.tile(values.angle, count))
        variants.append(np.tile(values.variant, count))
        sizes.append(np.repeat(np.exp(found.log_sizes), n))
        forces.append(np.repeat(found.forces, n, axis=0))
    slopes = inverse.kernels.response_slopes(
        np.concatenate(offsets),
        np.concatenate(angles),
        np.concatenate(variants),
        np.concatenate(sizes),
        np.concatenate(forces),
    )[:, :, inverse.columns]
    ends = np.cumsum([len(one) for one in angles])
    sensitivity = inverse.kernels.sensitivity(
        np.concatenate(offsets),
        np.concatenate(angles),
        np.concatenate(sizes),
        np.concatenate(forces),
    )[:, :, inverse.columns]
    for fit, own, changes in zip(
        fits, np.split(slopes, ends[:-1]), np.split(sensitivity, ends[:-1]), strict=True
    ):
        count = len(fit.found.forces)
        fit.linearise(
            own.reshape(count, -1, *own.shape[1:]),
            changes.reshape(count, -1, *changes.shape[1:]).sum(axis=0),
        )
