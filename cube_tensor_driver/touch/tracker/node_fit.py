# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Posterior of the traction in one region of contact, from the values of the cubes around it.

The traction is different from zero only in the region, which the field of the inverse problem shows
(pressure_regions.py). This knowledge makes integrals over the region far more exact than those of
the field, whose prior is the same everywhere. The traction is the sum of small Hertz contacts on a
grid of nodes. With the forces f of the nodes (N), the whitened response B of the cubes to them, and
the whitened values w, which have noise of variance 1, the posterior is that of a Gaussian process::

    w = B f + e,    f ~ N(0, s^2 K),    e ~ N(0, t)
    mean f = s^2 K B' W w,    covariance t (s^2 K - s^4 K B' W B K),    W = (1 + s^2 B K B')^-1

K is the covariance of the nodes for a pressure of 1 Pa^2. The scale s is that with the greatest
evidence; the misfit t, never below 1, is the factor by which the values deviate more than their
noise explains, so that an imperfect model increases the stated deviations. An eigenvalue
decomposition of K^1/2' B' B K^1/2 gives all of this for every s at once.

Source: C. E. Rasmussen, C. K. I. Williams, Gaussian Processes for Machine Learning (2006), 2.2 and
5.4.1 (evidence).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial.distance import cdist

from ...core.arrays import Array, Index
from ...mechanics.kernels import SHEAR_RATIO
from ..inverse import SurfaceInverse
from ..prior import AMPLITUDE
from ..surface import square_points
from .contact_estimate import ContactEstimate, ContactSum, Discs, discs_of, estimate_contact
from .local_values import LocalValues, unroll_points
from .pressure_regions import split_peaks

NODE_STEP = 0.4
"""Distance of neighbouring nodes (small contacts that make up the traction), divided by the depth
of the cubes' centres. With 0.6, the traction of a narrow contact cannot be represented exactly
enough, and forces are off by 0.5 % instead of 0.1 %."""

MAX_NODES = 80
"""Largest number of nodes (small contacts that make up the traction) of a fit, whose time grows
with its third power. The nodes of larger regions lie farther apart."""

BORDER_REACH_PITCHES = 1.5
"""Distance from the region, divided by the pitch (distance of neighbouring cubes), up to which
nodes are placed beyond the border of the skin, where no field is computed."""

ENVELOPE_FLOOR = 0.03
"""Smallest prior standard deviation of the force of a node (one of the small contacts whose sum is
the traction), divided by that of the strongest node.

A second fit of the same values gets a prior that is proportional to the forces of the first fit
(their smoothed envelope), so that force spread over nodes without contact disappears. The limit
lets a node keep a little force that the first fit did not find there.
"""

MIN_SCORE_GAIN = 1.0
"""Smallest decrease of -2 ln(evidence) for which a narrower prior of the traction replaces the
present one. The evidence is the probability of the values, with the traction integrated over its
prior."""

_NODE_RADIUS = 0.9
"""Radius of the Hertz contact of a node, divided by the distance of neighbouring nodes."""

_PEAK_WIDTH = 0.5
"""Standard deviation of the Gaussian that smooths the fitted pressure before its peaks are counted,
divided by the depth of the cubes' centres below the surface. Every peak of a region is a
contact."""

_POINT_MARGIN = 0.75
"""Largest distance of a node (one of the small contacts whose sum is the traction) from the nearest
point of its region of contact, divided by the distance of neighbouring points of the surface. Half
of the diagonal of the square that a point represents is 0.71."""

_LENGTHS = np.array([0.2, 0.8, 3.0])
"""Correlation lengths of the pressure in a contact, divided by the depth of the cubes' centres: for
narrow, medium and wide contacts."""

_SHARES = np.array([0.4, 0.4, 0.2])
"""Shares (3,) of the prior variance of the pressure that have the correlation lengths `_LENGTHS`,
from the narrowest to the widest."""

_SCALES = AMPLITUDE * np.geomspace(0.01, 100, 41)
"""Prior standard deviations (41,) of the pressure, in Pa. The one with the greatest evidence
(probability of the values) is used."""

_DEVIATIONS = np.array([SHEAR_RATIO, SHEAR_RATIO, 1.0])
"""Prior standard deviations of the traction along x, y and z, divided by that of the pressure."""


class Posterior(NamedTuple):
    """Posterior of the forces of q nodes (small contacts whose sum is the traction of a region).

    Attributes:
        forces: Forces (3, q) of the nodes along x, y and z, in N.
        root: Square root (3, q, n) of their covariance, in N.
        score: -2 ln of the evidence, up to a constant.
    """

    forces: Array
    root: Array
    score: float


class NodeFit:
    """Traction in one region on a grid of nodes (small Hertz contacts).

    Attributes:
        places: Positions (q, 2) of the nodes in m, on the skin laid flat.
        spacing: Distance of neighbouring nodes in m.
        size: Radius of the Hertz contact of a node in m.
        response: Values (n, C, 3 q) in Pa/N of the cubes around the region, for forces along x of
            all nodes, then along y, then along z.
        values: Values of these cubes.
        posterior: Posterior of the forces for the newest values.
        misfit: Factor t by which the values deviate more than their noise explains.
        is_sharp: Whether a narrower prior has no greater evidence.
        labels: Number (q,) of the contact to which each node belongs.
    """

    posterior: Posterior
    misfit: float
    labels: Index

    def __init__(self, inverse: SurfaceInverse, points: Index, values: LocalValues) -> None:
        """Compute the response of the cubes to the nodes.

        Args:
            inverse: Poses, points, noise and kernels of the skin.
            points: Indices of the points of the surface that form the region.
            values: Values of the cubes around the region.
        """
        self.values = values
        around = np.flatnonzero(np.isin(inverse.cube, values.cubes))
        region = unroll_points(inverse, values.home, points)
        self.places, self.spacing = _place_nodes(
            region, unroll_points(inverse, values.home, around), inverse
        )
        self.size = _NODE_RADIUS * self.spacing

        # Prior covariance for a pressure of variance 1 Pa^2
        self._squares = cdist(self.places, self.places, "sqeuclidean")
        exponents = self._squares / (2 * (_LENGTHS[:, None, None] * inverse.depth) ** 2)
        self._covariance = self.spacing**4 * np.tensordot(_SHARES, np.exp(-exponents), 1)

        self.response, white = values.respond(self.places, self.size)
        self._white_response = white.reshape(len(white), 3, -1)
        self._peak_width = _PEAK_WIDTH * inverse.depth
        self.is_sharp = False
        # Errors of the elastomer's data in standard deviations, and changes (n, C, S) by one each.
        self._errors = np.zeros(0)
        self._changes = np.zeros((*values.known.shape, 1))
        self._white_changes = np.zeros((len(white), 1))
        self._decomposition = self._decompose(np.ones(len(self.places)))

    def step(self, white: Array) -> None:
        """Compute `posterior` (forces of the nodes) and `misfit` for new values of the same cubes.

        Args:
            white: Values (n C,), C components of stress and gradient of each of n cubes,
                transformed by `LocalValues.whiten` so that their noise has variance 1.
        """
        design, eigenvalues, vectors, basis = self._decomposition
        # The columns are the values, then their changes by errors of depth, Poisson's ratio, ...
        columns = np.column_stack([white, self._white_changes])
        projected = vectors.T @ (design.T @ columns)
        ratio = _SCALES[:, None] ** 2
        shares = ratio / (1 + ratio * eigenvalues)
        # Products of the columns with W = (1 + s^2 B K B')^-1 between them, for every scale s.
        products = columns.T @ columns - np.einsum("se,ea,eb->sab", shares, projected, projected)
        # All errors but that of the depth are estimated together with the forces.
        information = products[:, 2:, 2:] + np.eye(columns.shape[1] - 2)
        right = products[:, 2:, :2]
        errors = np.linalg.solve(information, right)
        explained = (errors[:, :, 0] * right[:, :, 0]).sum(axis=1)
        chi_squared = np.maximum(products[:, 0, 0] - explained, 0)
        count = self.values.count
        misfit = np.maximum(chi_squared / count, 1.0)
        scores = np.log1p(ratio * eigenvalues).sum(axis=1) + np.linalg.slogdet(information)[1]
        scores += chi_squared / misfit + count * np.log(misfit)

        best = int(np.argmin(scores))
        self._scale = float(_SCALES[best])
        self.misfit = float(misfit[best])
        self._errors = errors[best, :, 0]
        gain = 1 / (eigenvalues + self._scale**-2)
        means = basis @ (gain[:, None] * projected)
        forces, by_depth = (means[:, :2] - means[:, 2:] @ errors[best]).T
        # Square root of the covariance: for known data of the elastomer, then one column for each
        # error of these data.
        root_errors = np.linalg.inv(np.linalg.cholesky(information[best])).T
        parts = [basis * np.sqrt(gain), means[:, 2:] @ root_errors, by_depth[:, None]]
        root = np.sqrt(self.misfit) * np.hstack(parts)
        self.posterior = Posterior(
            forces.reshape(3, -1), root.reshape(3, len(self.places), -1), float(scores[best])
        )

    def update_sensitivity(self) -> None:
        """Compute how the values change by errors of the elastomer's data, for the present forces.

        It is in use from the next `step` on.
        """
        self._changes = self.values.sensitivity(self.places, self.size, self.posterior.forces)
        white = self.values.whitening @ self._changes
        self._white_changes = white.reshape(-1, white.shape[2])

    def sharpen(self, white: Array) -> None:
        """Fit again with a prior that allows less force where the present fit finds little force.

        This removes force that the first fit spreads over nodes without contact. If the evidence of
        the new fit is not clearly higher, the present fit is kept.

        Args:
            white: Values (n C,), divided by their noise: C components of each of n cubes.
        """
        self.update_sensitivity()
        self.step(white)
        before = self.posterior, self.misfit, self._errors, self._scale, self._decomposition
        square = self.posterior.forces[2] ** 2 + (self.posterior.root[2] ** 2).sum(axis=1)
        smoothing = np.exp(-self._squares / (2 * self.spacing**2))
        envelope = np.sqrt(smoothing @ square / smoothing.sum(axis=1))
        self._decomposition = self._decompose(np.maximum(envelope / envelope.max(), ENVELOPE_FLOOR))
        self.step(white)
        if self.posterior.score > before[0].score - MIN_SCORE_GAIN:
            self.posterior, self.misfit, self._errors, self._scale, self._decomposition = before
            self.is_sharp = True
        self.label_peaks()

    def label_peaks(self) -> None:
        """Set `labels`: assign each node to one of the peaks of the pressure, which are
        contacts."""
        smoothing = np.exp(-self._squares / (2 * self._peak_width**2))
        pressure = -smoothing @ self.posterior.forces[2]
        root = smoothing @ self.posterior.root[2]
        self.labels = split_peaks(pressure, root, self._squares < (1.5 * self.spacing) ** 2)

    @property
    def explained(self) -> Array:
        """Values (n, C) in Pa of the cubes around the region under the traction on the nodes."""
        explained = self.response @ self.posterior.forces.ravel()
        return np.asarray(explained + self._changes[:, :, 1:] @ self._errors)

    @property
    def discs(self) -> Discs:
        """Round Hertz contacts that act on distant cubes like the traction on the nodes."""
        return discs_of(self.estimate_contacts())

    def estimate_contacts(self) -> list[ContactEstimate]:
        """Return the integrals of the traction over each contact of the region."""
        estimates = []
        for label in range(self.labels.max() + 1):
            own = self.labels == label
            forces, root = self.posterior.forces[:, own], self.posterior.root[:, own]
            estimates.append(estimate_contact(self.places[own], forces, root, self.size))
        return estimates

    @property
    def shape_misfit(self) -> float:
        """Squared deviation of the values from the fit, divided by the value that noise causes.

        It is `misfit`, that of all cubes around the region, because nodes assume no shape. A
        `HertzFit` computes the property of this name from the cubes nearest to its contacts.
        """
        return self.misfit

    def to_contacts(self, step: float) -> ContactSum:
        """Describe the traction as a sum of small Hertz contacts, one for each node.

        Args:
            step: Not used here; `HertzFit.to_contacts` needs it.
        """
        sizes = np.full(len(self.places), self.size)
        return ContactSum(self.places, sizes, self.posterior.forces, self.posterior.root)

    def _decompose(self, envelope: Array) -> tuple[Array, Array, Array, Array]:
        """Compute the eigenvalues and eigenvectors from which every posterior follows.

        Args:
            envelope: Prior standard deviation (q,) of the force of each of q nodes, divided by the
                largest one.

        Returns:
            The response D (n C, 3 q) of the whitened values (C of each of n cubes) to unknowns that
            have independent priors of variance 1; eigenvalues (3 q,) and eigenvectors (3 q, 3 q) of
            D' D; and the matrix (3 q, 3 q) from amplitudes of the eigenvectors to the forces of the
            nodes.
        """
        covariance = self._covariance * np.outer(envelope, envelope)
        # This tiny increase of the diagonal makes up for rounding errors.
        covariance[np.diag_indices(len(covariance))] *= 1 + 1e-8
        root = np.linalg.cholesky(covariance)
        white = self._white_response
        parts = [white[:, axis] @ (root * _DEVIATIONS[axis]) for axis in range(3)]
        design = np.concatenate(parts, axis=1)
        eigenvalues, vectors = np.linalg.eigh(design.T @ design)
        by_axis = vectors.reshape(3, len(root), -1)
        basis = (root @ by_axis) * _DEVIATIONS[:, None, None]
        return design, np.maximum(eigenvalues, 0), vectors, basis.reshape(len(vectors), -1)


def _place_nodes(region: Array, around: Array, inverse: SurfaceInverse) -> tuple[Array, float]:
    """Place nodes (small contacts) on a region, and beyond the border of the skin next to it.

    Args:
        region: Positions (n, 2) of the points of the region in m, on the skin laid flat.
        around: Positions (m, 2) of all points around the region.
        inverse: Pitch and spacing of the points.

    Returns:
        Positions (q, 2) of at most `MAX_NODES` nodes in m, and their distance in m.
    """
    reach = BORDER_REACH_PITCHES * inverse.pitch
    margin = _POINT_MARGIN * inverse.spacing
    middle = region.mean(axis=0)
    extent = np.abs(region - middle).max() + reach
    step = NODE_STEP * inverse.depth
    while True:
        nodes = middle + square_points(step, 2 * int(np.ceil(extent / step)) + 1)
        to_region = cdist(nodes, region).min(axis=1)
        nodes, to_region = nodes[to_region < reach], to_region[to_region < reach]
        is_outside = cdist(nodes, around).min(axis=1) > margin
        nodes = nodes[(to_region < margin) | is_outside]
        if len(nodes) <= MAX_NODES:
            return nodes, step
        step *= np.sqrt(1.02 * len(nodes) / MAX_NODES)
