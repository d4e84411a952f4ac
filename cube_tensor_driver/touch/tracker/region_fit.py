# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Fit of one region of contact: traction on nodes, or Hertz contacts where they are likelier.

Nodes are small contacts on a grid, whose forces are unknown (node_fit.py). A Hertz contact has a
few parameters: force, centre, radius and flatness (hertz_fit.py). Whitened values are the values of
the cubes, transformed so that their noise has variance 1 and no correlation.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from ...core.arrays import Array, Index
from ...mechanics.kernels import DISC_SIZES, REACH_DEPTHS
from ..inverse import SurfaceInverse
from .contact_estimate import ContactEstimate, ContactSum, estimate_contact
from .hertz_fit import HertzFit
from .local_values import LocalValues
from .node_fit import NodeFit

MIN_FACING = 0.5
"""Smallest cosine of the angle between the outward normals of two cubes at which one of them
responds to a contact above the other. On a bent skin, cubes that face away do not respond."""

MAX_HERTZ_ASPECT = 4.0
"""Largest ratio of length to width of a contact for which the fit of a round Hertz contact is
tried. Length and width are those that the fit on nodes (small contacts on a grid) has found."""

HERTZ_WORK = 40
"""Work of the first fit of a Hertz contact, in the unit of `MAX_WORK_PER_SCAN`: it takes as long as
a new fit with this number of nodes."""

MOVE_WORK = 15
"""Work of one step by which a Hertz contact follows a body that moves, in the unit of
`MAX_WORK_PER_SCAN`: it takes as long as a new fit with this number of nodes."""

MAX_UNFOLLOWED_STEP = 0.1
"""Largest change of a Hertz contact since its response was linearised at which the linearised
response is still used. The change is the larger one of two numbers: the shift divided by the depth
of the cubes' centres below the surface, and the change of the natural logarithm of the radius."""

MAX_STEPS = 10
"""Largest number of Gauss-Newton steps in the first fit of a Hertz contact."""


class RegionFit:
    """Fit of the traction in one region of contact to the values of the cubes around it.

    Attributes:
        points: Indices (n,) of the points of the surface that form the region.
        others: Indices of the points of other regions that take part in the fit.
        peak: Largest pressure of the region, in Pa, at the depth of the cubes at the time of the
            fit.
        home: Index of the cube in whose frame the fit is described.
        values: Values of the cubes around the region.
        nodes: Traction on nodes.
        hertz: Hertz contacts, if they are likelier than the traction on nodes.
        waited: Number of scans since the fit was last improved.
    """

    def __init__(
        self,
        inverse: SurfaceInverse,
        points: Index,
        others: Index,
        peak: float,
        values: LocalValues,
        scaled: Array,
    ) -> None:
        """Fit the forces of nodes (small contacts on a grid); Hertz contacts are tried later.

        Args:
            inverse: Poses, points, noise and kernels of the skin.
            points: Indices (n,) of the points of the surface that form the region.
            others: Indices of the points of other regions near this one.
            peak: Largest pressure of the region, in Pa, at the depth of the cubes.
            values: Values of the cubes around the region.
            scaled: Values (cubes, C) in Pa, without the response to other contacts farther away.
        """
        self.points = points
        self.others = others
        self.peak = peak
        self.home = values.home
        self.values = values
        self.nodes = NodeFit(inverse, points, others, values)
        self.hertz: HertzFit | None = None
        self.waited = 0
        self._inverse = inverse
        self._white = values.whiten(scaled)
        self.nodes.solve(self._white)
        self.nodes.label_peaks()
        self._is_hertz_due = True
        self._first_misfit = self.misfit

    @property
    def misfit(self) -> float:
        """Factor by which the squared values deviate more than their noise explains, at least 1."""
        return self.nodes.misfit if self.hertz is None else self.hertz.misfit

    @property
    def misfit_growth(self) -> float:
        """Misfit in the newest scan, divided by that when the fit was last improved."""
        return self.misfit / self._first_misfit

    @property
    def is_final(self) -> bool:
        """Whether `improve` cannot make the fit more exact as long as the values stay the same."""
        is_sharp = self.nodes.is_sharp and not self._is_hertz_due
        return is_sharp or self.hertz is not None

    @property
    def is_moving(self) -> bool:
        """Whether a Hertz contact has changed by more than `MAX_UNFOLLOWED_STEP` (position, radius)
        since its response was linearised, so that `improve` must linearise it again."""
        return self.hertz is not None and self.hertz.last_step > MAX_UNFOLLOWED_STEP

    def update(self, scaled: Array) -> None:
        """Compute the posterior for the values of a new scan.

        Args:
            scaled: Values (cubes, C) in Pa, without the response to other contacts farther away.
        """
        self.waited += 1
        self._white = self.values.whiten(scaled)
        self.nodes.solve(self._white)
        if self.hertz is not None:
            self.hertz.step(self._white)

    def improve(self) -> int:
        """Do the next piece of work that makes the fit more exact.

        A Hertz contact follows the body that presses. Without one, it is tried once at the start
        and once when the prior of the nodes is as narrow as possible.

        Returns:
            Work that this took, in the unit of `MAX_WORK_PER_SCAN`.
        """
        self.waited = 0
        if self.hertz is not None:
            self.hertz.follow(self._white)
            return MOVE_WORK
        if self._is_hertz_due:
            self._is_hertz_due = False
            self._fit_hertz()
            work = HERTZ_WORK
        else:
            self.nodes.sharpen(self._white)
            self._is_hertz_due = self.nodes.is_sharp
            work = len(self.nodes.places) // 2
        self._first_misfit = self.misfit
        return work

    def _fit_hertz(self) -> None:
        """Fit one Hertz contact for each contact on nodes, and keep them if they are likelier."""
        starts = self._estimate_on_nodes()
        if max(one.aspect for one in starts) > MAX_HERTZ_ASPECT:
            return
        hertz = HertzFit(self.nodes, starts, self._inverse.depth)
        hertz.fit(self._white, MAX_STEPS)
        if hertz.last_step < MAX_UNFOLLOWED_STEP and hertz.score < self.nodes.posterior.score:
            self.hertz = hertz

    def estimate_contacts(self) -> list[ContactEstimate]:
        """Return force, position, moment and area of each contact in the region."""
        estimates = self._estimate_on_nodes()
        if self.hertz is None:
            return estimates
        return [self.hertz.estimate(j, one) for j, one in enumerate(estimates)]

    def respond(self) -> Array:
        """Return the values (cubes, C) in Pa that the traction of the fit causes at all cubes.

        C is the number of components that some cube of the skin observes.
        """
        if self.hertz is None:
            force = self.nodes.posterior.forces.sum(axis=1)
            near = self.nodes.response @ self.nodes.posterior.forces.ravel()
        else:
            force = self.hertz.found_forces.sum(axis=0)
            near = self.values.unwhiten(self.hertz.explained)
        total = np.zeros(self._inverse.observed.shape)
        far, response = self._far_response
        total[far] = response @ force
        total[self.values.cubes] = near
        return total

    def to_contacts(self) -> ContactSum:
        """Describe the traction of the fit as a sum of Hertz contacts."""
        if self.hertz is not None:
            return self.hertz.to_contacts(self._inverse.spacing)
        sizes = np.full(len(self.nodes.places), self.nodes.size)
        posterior = self.nodes.posterior
        return ContactSum(self.nodes.places, sizes, posterior.forces, posterior.root)

    @cached_property
    def _far_response(self) -> tuple[Index, Array]:
        """Indices (n,) of the cubes outside of the fit, and their response (n, C, 3) in Pa/N.

        The response is that to a force of 1 N on the region along x, y and z. These cubes are so
        far away that the traction acts on them like a single Hertz contact.
        """
        inverse = self._inverse
        poses = inverse.poses
        distance = np.linalg.norm(poses.position - poses.position[self.home], axis=1)
        facing = poses.rotation[:, :, 2] @ poses.rotation[self.home, :, 2]
        is_far = (distance < REACH_DEPTHS * inverse.depth) & (facing > MIN_FACING)
        is_far[self.values.cubes] = False
        far = np.flatnonzero(is_far)

        whole = estimate_contact(self.nodes, np.ones(len(self.nodes.places), bool))
        smallest, largest = DISC_SIZES[[1, -3]] * inverse.depth
        size = float(np.clip(np.sqrt(whole.area / np.pi), smallest, largest))
        place, angle = inverse.unroll(self.home, far)
        variant = inverse.variant[far]
        response = inverse.kernels.response(place - whole.place, angle, variant, size)
        return far, response[:, inverse.columns]

    def _estimate_on_nodes(self) -> list[ContactEstimate]:
        """Return the integrals of the traction on nodes over each contact of the region."""
        labels = self.nodes.labels
        return [estimate_contact(self.nodes, labels == one) for one in range(labels.max() + 1)]
