# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Fit of Hertz contacts, which replaces the traction on the nodes of a region where it is likelier.

A ball presses as a Hertz contact: force, centre and radius describe it with a few numbers, which
the values of the cubes determine better than the forces of many nodes, above all where the cubes
are far apart. The contacts start at force, place and area of the fit on nodes (node_fit.py), and
Gauss-Newton steps find the parameters x with the greatest posterior. With the derivatives J of the
whitened values by the parameters, the whitened residual r, and the prior precision P about x0::

    (J' J + P) change = J' r - P (x - x0),    covariance t (J' J + P)^-1

Source: K. L. Johnson, Contact Mechanics (1985), 4.2 (Hertz); D. J. C. MacKay, Bayesian
interpolation, Neural Computation 4 (1992) 415 (evidence).
"""

from __future__ import annotations

import numpy as np

from ...core.arrays import Array
from ...mechanics.kernels import DISC_SIZES
from .contact_estimate import ContactEstimate, ContactSum
from .local_values import LocalValues
from .node_fit import NodeFit

SIZE_DEVIATION = 1.0
"""Prior standard deviation of the natural logarithm of the radius of a Hertz contact."""

USUAL_SIZE = 0.8
"""Radius of a contact, divided by the depth of the cubes' centres below the surface, that the prior
expects: its logarithm is the prior mean of the logarithm of this ratio."""

MAX_START_SIZE = 2.0
"""Largest radius of a Hertz contact at the start of its fit, divided by the depth of the cubes'
centres below the surface. From a radius that is much too large, Gauss-Newton steps do not converge
to a small one."""

FORCE_DEVIATION = 1e2
"""Prior standard deviation of each component of the force of a contact, in N; the prior mean is 0.
The value is so large that the prior does not influence the fitted force."""

SIZE_STEP = 0.2
"""Change of the natural logarithm of the radius for the numerical derivative by it, and of the
narrower and the wider contact that make up the flatness.

The flatness moves pressure from the centre of a contact to its rim without changing force, position
and second moment: a contact is added, and a mixture of a narrower and a wider one is subtracted. A
Hertz contact has flatness 0, a rigid flat punch flatness 1.
"""

SETTLED_STEP = 0.02
"""Size of a Gauss-Newton step below which a fit has converged. The size is the larger one of two
numbers: the shift of a contact divided by the depth of the cubes' centres, and the change of the
natural logarithm of its radius."""

_MAX_STEP = 0.5
"""Largest Gauss-Newton step: shift of a contact divided by the depth of the cubes' centres, and
change of the natural logarithm of its radius."""

_DIFFERENCE_STEP = 1 / 50
"""Shift of a Hertz contact in each direction for the numerical derivatives by its centre, divided
by the depth of the cubes' centres below the surface."""

_N_PARAMETERS = 7
"""Number of parameters of a contact: force f_x, f_y, f_z, centre c_x, c_y, logarithm ln a of the
radius, and flatness."""

_STENCIL = np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]], float)
"""Shifts (5, 2) of a contact for numerical derivatives by its centre, in units of the step: none,
then both directions along x and along y."""


class HertzFit:
    """Hertz contacts in place of the nodes of a region, one for each contact of the region.

    Attributes:
        centres: Centres (J, 2) of the contacts in m, on the skin laid flat.
        log_sizes: Logarithms (J,) of the radii in m.
        forces: Forces (J, 3) in N.
        score: -2 ln of the evidence (Laplace approximation), comparable with that of the region.
        last_step: Size of the last step: shift divided by the depth of the cubes' centres, or
            change of the logarithm of the radius.
        explained: Whitened values (n C,) that these contacts cause.
    """

    def __init__(self, region: NodeFit, starts: list[ContactEstimate], depth: float) -> None:
        """Start at the contacts that the fit on nodes found.

        Args:
            region: Fit of the same values on nodes (small contacts on a grid).
            starts: Contacts that this fit has found.
            depth: Distance from the centres of the cubes to the surface, in m.
        """
        self._region = region
        self._depth = depth
        self.centres = np.array([one.place for one in starts])
        sizes = np.minimum(np.sqrt([one.area / np.pi for one in starts]), MAX_START_SIZE * depth)
        # `Kernels` interpolates responses between the second and the third last radius of its
        # table.
        self._log_range = np.log(DISC_SIZES[[1, -3]] * depth)
        self.log_sizes = np.clip(np.log(sizes), *self._log_range)
        self.forces = np.array([one.force for one in starts])
        precision = np.array([FORCE_DEVIATION**-2] * 3 + [depth**-2] * 2 + [SIZE_DEVIATION**-2])
        own = np.tile([*precision, 1.0], len(starts))
        self._others = region.response_to_others()
        self._precision = np.concatenate([own, np.ones(self._others.shape[1])])
        self.score = np.inf
        self.last_step = np.inf
        self._linearise()

    def fit(self, white: Array, steps: int) -> None:
        """Make Gauss-Newton steps until they are small.

        Args:
            white: Whitened values (n C,) as from `LocalValues.whiten`.
            steps: Largest number of steps.
        """
        self.step(white)
        for _ in range(steps):
            if self.last_step < SETTLED_STEP:
                break
            self.follow(white)

    def follow(self, white: Array) -> None:
        """Linearise at the parameters that the last step has found, and make another step.

        Args:
            white: Whitened values (n C,) as from `LocalValues.whiten`.
        """
        self.forces, self.centres = self.found_forces, self.found_centres
        self.log_sizes = self.found_sizes
        self._linearise()
        self.step(white)

    def _linearise(self) -> None:
        """Compute the derivatives of the whitened values at the present parameters."""
        columns = []
        model = 0.0
        for centre, log_size, force in zip(self.centres, self.log_sizes, self.forces, strict=True):
            derivatives = differentiate_response(
                self._region.values, centre, np.exp(log_size), force, self._depth
            )
            model = model + derivatives[:, :3] @ force
            columns.append(derivatives)
        self._jacobian = np.concatenate([*columns, self._others], axis=1)
        self._model = model
        matrix = self._jacobian.T @ self._jacobian + np.diag(self._precision)
        self._inverse = np.linalg.inv(matrix)
        scaled = matrix / np.sqrt(np.outer(self._precision, self._precision))
        self._log_determinant = float(np.linalg.slogdet(scaled)[1])

    def step(self, white: Array) -> None:
        """Find parameters by one Gauss-Newton step from the last linearisation, and the evidence.

        The result is stored in `found_forces` (J, 3) in N, `found_centres` (J, 2) in m and
        `found_sizes` (J,), the logarithms of the radii in m.

        Args:
            white: Whitened values (n C,) as from `LocalValues.whiten`.
        """
        count = len(self.centres)
        residual = white - self._model
        deviation = np.zeros(len(self._precision))
        usual = np.log(USUAL_SIZE * self._depth)
        deviation[5 : _N_PARAMETERS * count : _N_PARAMETERS] = self.log_sizes - usual
        right = self._jacobian.T @ residual - self._precision * deviation
        change = self._inverse @ right
        penalty = deviation @ (self._precision * deviation)
        chi_squared = float(residual @ residual + penalty - right @ change)
        known = self._region.values.count
        self.misfit = max(chi_squared / known, 1.0)
        self.score = chi_squared / self.misfit + known * np.log(self.misfit)
        self.score += self._log_determinant

        own = change[: _N_PARAMETERS * count]
        self.explained = self._model + self._jacobian[:, : len(own)] @ own
        own = own.reshape(count, _N_PARAMETERS)
        shift = np.clip(own[:, 3:5], -_MAX_STEP * self._depth, _MAX_STEP * self._depth)
        growth = np.clip(own[:, 5], -_MAX_STEP, _MAX_STEP)
        largest_shift = float(np.abs(shift).max()) / self._depth
        self.last_step = max(largest_shift, float(np.abs(growth).max()))
        self.found_forces = self.forces + own[:, :3]
        self.found_centres = self.centres + shift
        self.found_sizes = np.clip(self.log_sizes + growth, *self._log_range)
        self._found_flatness = own[:, 6]

    def to_contacts(self, step: float) -> ContactSum:
        """Describe these contacts and their deviations as a sum of Hertz contacts.

        Each contact becomes seven: itself, one shifted each way along x and along y, one wider and
        one narrower. Differences of them are its derivatives by centre, size and flatness.

        Args:
            step: Shift in m. It is at least the spacing of the points at which the traction is
                evaluated, because differences over less than that vanish there.
        """
        count = len(self.found_forces)
        shifts = np.concatenate([step * _STENCIL, np.zeros((2, 2))])
        places = self.found_centres[:, None] + shifts
        factors = np.exp(SIZE_STEP * np.array([0, 0, 0, 0, 0, 1, -1]))
        sizes = np.exp(self.found_sizes)[:, None] * factors

        # Derivatives (3, contacts of the sum, parameters) of the forces by the parameters.
        slopes = np.zeros((3, count, 7, count, _N_PARAMETERS))
        share = 1 / (1 + np.exp(2 * SIZE_STEP))
        for j, force in enumerate(self.found_forces):
            own = slopes[:, j, :, j]
            own[:, 0, :3] = np.eye(3)
            own[:, [1, 2], 3] = force[:, None] * [1, -1] / (2 * step)
            own[:, [3, 4], 4] = force[:, None] * [1, -1] / (2 * step)
            own[:, [5, 6], 5] = force[:, None] * [1, -1] / (2 * SIZE_STEP)
            own[:, [0, 5, 6], 6] = force[:, None] * [1, -share, share - 1]
        forces = np.einsum("ajkj,j->ajk", slopes[..., 6], self._found_flatness)
        forces[:, :, 0] += self.found_forces.T

        n = _N_PARAMETERS * count
        covariance = self.misfit * self._inverse[:n, :n]
        root = slopes.reshape(3, -1, n) @ np.linalg.cholesky(covariance)
        return ContactSum(places.reshape(-1, 2), sizes.ravel(), forces.reshape(3, -1), root)

    def estimate(self, j: int, nodes: ContactEstimate) -> ContactEstimate:
        """Return the estimate of contact j, with the moment of the fit on nodes.

        Args:
            j: Index of the contact.
            nodes: Estimate of the same contact by the fit on nodes.
        """
        first = _N_PARAMETERS * j
        covariance = self.misfit * self._inverse[first : first + 6, first : first + 6]
        area = float(np.pi * np.exp(2 * self.found_sizes[j]))
        return nodes._replace(
            force=self.found_forces[j],
            force_covariance=covariance[:3, :3],
            place=self.found_centres[j],
            place_variance=np.diag(covariance)[3:5],
            area=area,
            area_variance=float((2 * area) ** 2 * covariance[5, 5]),
        )


def differentiate_response(
    values: LocalValues, centre: Array, size: float, force: Array, depth: float
) -> Array:
    """Compute the derivatives of whitened values by the parameters of one Hertz contact.

    Args:
        values: Values of the cubes around the contact.
        centre: Centre (2,) of the contact in m, in the frame of the home cube.
        size: Radius in m.
        force: Force (3,) in N, in this frame.
        depth: Distance from the centres of the cubes to the surface, in m.

    Returns:
        Derivatives (n C, 7) by force f_x, f_y, f_z, centre c_x, c_y, logarithm of the radius, and
        flatness. The first three columns are the response to unit forces.
    """

    def respond(centres: Array, radius: float) -> Array:
        """Return the whitened response (n C, 3, K) to 1 N along x, y and z on K contacts."""
        _, white = values.respond(centres, radius)
        return np.asarray(white.reshape(len(white), 3, -1))

    step = _DIFFERENCE_STEP * depth
    moved = respond(centre + step * _STENCIL, size)
    wider, narrower = (
        respond(centre[None], size * np.exp(sign * SIZE_STEP))[:, :, 0] @ force for sign in (1, -1)
    )
    under_force = np.einsum("dak,a->dk", moved, force)
    by_centre = (under_force[:, [1, 3]] - under_force[:, [2, 4]]) / (2 * step)
    by_log_size = (wider - narrower) / (2 * SIZE_STEP)
    # The mixture with this share of the wider contact has the second moment of the contact.
    share = 1 / (1 + np.exp(2 * SIZE_STEP))
    flatness = under_force[:, 0] - (share * wider + (1 - share) * narrower)
    slopes = [by_centre, by_log_size[:, None], flatness[:, None]]
    return np.concatenate([moved[:, :, 0], *slopes], axis=1)
