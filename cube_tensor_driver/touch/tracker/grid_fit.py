# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Posterior of the traction in one region of contact, from the values of the cubes around it.

The traction is different from zero only in the region, which is known from the pressure field of
the linear inverse problem (pressure_regions.py). This knowledge makes integrals over the region far
more exact than integrals of the field, whose prior is the same everywhere.

The traction is modelled as the sum of grid contacts: small, equally wide Hertz contacts that are
centred on the points of a square grid. Let f be the forces of the grid contacts in N, B the
whitened response of the cubes to them, w the whitened values and e their noise. The posterior is
that of a Gaussian process::

    w = B f + e,    f ~ N(0, s^2 K),    e ~ N(0, t)
    mean f = s^2 K B' W w,    covariance t (s^2 K - s^4 K B' W B K),    W = (1 + s^2 B K B')^-1

K is the prior covariance of the forces for a pressure of variance 1 Pa^2. The scale s is that with
the largest evidence; the misfit t is chi-squared divided by the number of values, but at least 1,
so that an imperfect model increases the stated deviations. One eigenvalue decomposition of
K^1/2' B' B K^1/2 gives mean, covariance and evidence for every s.

The number of grid contacts is limited, so those of a wide region lie far apart. Where such a fit
finds force, a finer grid is tried, and kept if its evidence is greater.

Depth, thickness and Poisson's ratio of the elastomer have errors, too. In units of their standard
deviations, they have the prior N(0, 1). To first order, each one changes w in proportion.

Source: C. E. Rasmussen, C. K. I. Williams, Gaussian Processes for Machine Learning (2006), 2.2 and
5.4.1 (evidence).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.linalg.lapack import dpstrf
from scipy.spatial.distance import cdist

from ...core.arrays import Array, Index, Mask, Single
from ...mechanics.traction_prior import AMPLITUDE, SHEAR_RATIO
from ..inverse import SurfaceInverse
from ..surface import make_square_points
from .contact_estimate import (
    N_MOMENTS,
    ContactEstimate,
    ContactSum,
    Discs,
    compute_moment_polynomials,
    estimate_contact,
    make_discs,
)
from .local_values import LocalValues, unroll_points
from .pressure_regions import split_peaks

GRID_STEP = 0.4
"""Distance of neighbouring grid contacts (small contacts that make up the traction), divided by the
depth of the cubes' centres. With 0.6 instead of 0.4, forces of narrow contacts are off by 0.5 %
instead of 0.1 %."""

MAX_GRID_CONTACTS = 80
"""Largest number of grid contacts (small contacts that make up the traction) of a fit. The time of
a fit grows with the third power of their number. In larger regions, they lie farther apart."""

BORDER_REACH_PITCHES = 1.5
"""Distance from a region of contact at the border of the skin, divided by the pitch (distance of
neighbouring cubes), up to which grid contacts (small contacts that make up the traction) are placed
beyond the border. The region ends at the border, because it consists of points of the skin, but the
contact may extend farther."""

MAX_BORDER_REACH_DEPTHS = 4.0
"""Largest distance from a region of contact at which grid contacts (small contacts that make up the
traction) are placed beyond the border of the skin, divided by the depth of the cubes' centres.
The cubes' values do not determine the forces of grid contacts much farther away. With such grid
contacts, the force of the whole contact would be arbitrary."""

SUPPORT_FORCE = 0.2
"""Smallest normal force of a grid contact (one of the small contacts whose sum is the traction)
around which a finer grid is placed, divided by the force of the strongest one. Both forces are root
mean squares of the posterior, which include the standard deviations. On planar cubes three depths
apart, forces of rods were off by 0.88 % without a finer grid, by 0.67 % with the value 0.1 and by
0.53 % with 0.2."""

SUPPORT_MARGIN = 1.0
"""Largest distance of the grid contacts (small contacts that make up the traction) of a finer grid
from the nearest grid contact of the coarser grid with a force above `SUPPORT_FORCE`, divided by the
spacing of the coarser grid."""

MAX_FINER_SPACING = 0.9
"""Largest spacing of a finer grid of grid contacts (small contacts that make up the traction),
divided by that of the coarser grid. A smaller change is not worth the computing time."""

ENVELOPE_FLOOR = 0.03
"""Smallest prior standard deviation of the force of a grid contact (one of the small contacts whose
sum is the traction), divided by that of the strongest grid contact.

A second fit of the same values gets prior standard deviations that are proportional to the forces
of the first fit, smoothed over neighbouring grid contacts. Force that the first fit spread over
points where nothing touches the skin then disappears. The limit lets the second fit find a little
force where the first one found none.
"""

MIN_SCORE_GAIN = 1.0
"""Smallest decrease of -2 ln(evidence) for which a narrower prior of the traction, or a finer grid,
replaces the present one. The evidence is the probability of the values, with the traction
integrated over its prior."""

_GRID_CONTACT_RADIUS = 0.36
"""Radius of a grid contact (one of the small contacts whose sum is the traction), divided by the
depth of the cubes' centres: 0.9 times `GRID_STEP`. It is the same where grid contacts lie farther
apart, because wider ones would blur narrow edges, and because gaps between grid contacts that are
up to a depth apart hardly change the stress in the cubes."""

_PEAK_WIDTH = 0.5
"""Standard deviation of the Gaussian that smooths the fitted pressure before its peaks are counted,
divided by the depth of the cubes' centres below the surface. Every peak of a region is a
contact."""

_POINT_MARGIN = 0.75
"""Largest distance of a grid contact (one of the small contacts whose sum is the traction) from the
nearest point of its region of contact, divided by the distance of neighbouring points of the
surface. Every point represents a square with half a diagonal of 0.71, so grid contacts may lie
anywhere in these squares."""

_CORRELATION_LENGTHS = np.array([0.2, 0.8, 3.0])
"""Correlation lengths of the pressure in a contact, divided by the depth of the cubes' centres: for
narrow, medium and wide contacts."""

_VARIANCE_SHARES = np.array([0.4, 0.4, 0.2])
"""Shares (3,) of the prior variance of the pressure: of its parts with the correlation lengths 0.2,
0.8 and 3 depths (`_CORRELATION_LENGTHS`)."""

_SCALES = AMPLITUDE * np.geomspace(0.01, 100, 41)
"""Prior standard deviations s (41,) of the pressure, in Pa, from which every fit chooses the one
with the largest evidence (probability of the values)."""

_RELATIVE_DEVIATIONS = np.array([SHEAR_RATIO, SHEAR_RATIO, 1.0])
"""Prior standard deviations of the traction along x, y and z, divided by that of the pressure."""


RANK_TOLERANCE = 1e-8
"""Largest error of the diagonal elements of the matrix D' D (`_Decomposition`), divided by the
largest element, when a matrix of smaller rank replaces D' D. The eigenvalues of D' D are
proportional to the ratio of signal and noise (of variances) of combinations of forces. Errors of
the pads' gains limit this ratio to 1e6, so the ratios of the combinations left out are below 0.01.
"""

MIN_SIGNAL_TO_NOISE = 0.01
"""Smallest ratio of prior variance to noise variance with which a combination of the forces of the
grid contacts is estimated from the values of later scans. Combinations with a smaller ratio keep
their prior mean, 0, which saves a third of the computing time of these scans."""


class GridPosterior(NamedTuple):
    """Posterior of the forces of q grid contacts (small contacts whose sum is a region's traction).

    The k unknowns are the combinations of forces that the values determine, divided by their prior
    standard deviations. All covariances hold for whitened values (N of them) whose noise has
    variance 1; `GridFit` multiplies them by its misfit.

    Attributes:
        response: Whitened response (k, N) to each unknown.
        shrinkage: Variance (k,) of each unknown after the values are known; 1 before.
        to_forces: Matrix (3 q, k) from the unknowns to the forces of the grid contacts in N:
            along x of all grid contacts, then along y, then along z.
        to_errors: Matrix (S - 1, N) from the values to the errors of the S properties of the
            elastomer (sensitivity.py) except the depth, in standard deviations.
        by_errors: Change (k, S - 1) of the product of `response` and the values for one standard
            deviation of each of these errors.
        scale: Scale s of the prior in Pa.
        ratios: Posterior variances of the amplitudes of all eigenvectors (`_Decomposition`),
            divided by their prior variances.
        errors_root: Square root (3 q, S) of the covariance of the forces due to the errors of the
            elastomer, in N.
        occam_term: Part of -2 ln of the evidence that does not depend on the values.
    """

    response: Single
    shrinkage: Array
    to_forces: Array
    to_errors: Array
    by_errors: Array
    scale: float
    ratios: Array
    errors_root: Array
    occam_term: float


class _Decomposition(NamedTuple):
    """Eigenvalues and eigenvectors from which the posteriors for all scales of the prior follow.

    At the scale 1 Pa, the forces are combinations of 3 q unknowns with independent priors of
    variance 1. The design matrix D (N, 3 q) contains the N whitened values that each unknown
    causes. Of the eigenvalues of D' D, k are large enough to matter (`RANK_TOLERANCE`). The
    amplitudes of the eigenvectors are the coefficients of the unknowns in this basis.

    Attributes:
        eigenvalues: Eigenvalues (k,) of D' D.
        vectors: Their eigenvectors V (3 q, k).
        design: Matrix D (N, 3 q).
        root: Matrix (3, q, q) from the unknowns to the forces along x, y and z.
        basis: Matrix (3 q, k) from the amplitudes of the eigenvectors to the forces.
    """

    eigenvalues: Array
    vectors: Array
    design: Array
    root: Array
    basis: Array


class _Scale(NamedTuple):
    """Scale s of the prior (prior standard deviation of the pressure), and what follows from it.

    Of the S properties of the elastomer (sensitivity.py), the depth comes first. The errors of the
    other ones are estimated together with the forces, in units of their standard deviations. The k
    eigenvectors and their amplitudes are those of `_Decomposition`.

    Attributes:
        scale: Scale s in Pa.
        projected: Products (k, 1 + S) of the whitened values that each eigenvector causes with the
            measured values (first column), and with their sensitivities to the properties.
        variances: Posterior variances (k,) of the amplitudes.
        signal_to_noise: Ratio (k,) of prior variance to noise variance of each amplitude.
        errors: Estimated errors (S - 1, 2): from the values, and as they would follow if the values
            were their sensitivities to the depth.
        information: Precision (S - 1, S - 1) of the estimated errors.
        occam_term: Part of -2 ln of the evidence that does not depend on the values.
        score: -2 ln of the evidence, up to a constant.
    """

    scale: float
    projected: Array
    variances: Array
    signal_to_noise: Array
    errors: Array
    information: Array
    occam_term: float
    score: float


class GridFit:
    """Traction in one region as the sum of grid contacts (small Hertz contacts on a grid).

    `solve` and `sharpen` compute the posterior of the forces of the grid contacts, which takes
    milliseconds. `step` only multiplies the values of later scans by matrices of this posterior.

    Attributes:
        places: Positions (q, 2) of the grid contacts in m, on the skin laid flat.
        spacing: Distance of neighbouring grid contacts in m.
        size: Radius of a grid contact in m.
        values: Noise and positions of n cubes around the region.
        posterior: Posterior of the forces.
        forces: Forces (3, q) of the grid contacts along x, y and z, in N, for the newest values.
        misfit: Chi-squared divided by the number of known values; at least 1. It multiplies the
            covariance of the forces.
        score: -2 ln of the evidence, up to a constant.
        is_sharpened: Whether `sharpen` was called after the last `solve`.
        is_sharp: Whether `sharpen` has found that neither a narrower prior nor a finer grid has a
            greater evidence.
    """

    posterior: GridPosterior
    forces: Array
    misfit: float
    score: float

    def __init__(
        self,
        inverse: SurfaceInverse,
        values: LocalValues,
        places: Array,
        spacing: float,
    ) -> None:
        """Compute the response of the cubes to the grid contacts.

        Args:
            inverse: Poses, points, noise and responses of the skin.
            values: Positions and noise of the cubes around the region.
            places: Positions (q, 2) of the grid contacts in m, on the skin laid flat.
            spacing: Distance of neighbouring grid contacts in m.
        """
        self._inverse = inverse
        self.values = values
        self.places = places
        self.spacing = spacing
        # `_coarsest` is the fit of the whole region if `sharpen` has made this fit from that one.
        self._coarsest: GridFit | None = None
        self._first_envelope = np.ones(len(places))
        self._finer: GridFit | None = None
        self.size = _GRID_CONTACT_RADIUS * inverse.depth
        self._peak_width = _PEAK_WIDTH * inverse.depth

        # The force of a grid contact is its pressure times the square of the spacing, so
        # covariances of forces contain the fourth power of the spacing.
        self._squared_distances = cdist(
            self.places,
            self.places,
            "sqeuclidean",
        )
        lengths = _CORRELATION_LENGTHS[:, None, None] * inverse.depth
        exponents = self._squared_distances / (2 * lengths**2)
        correlations = np.exp(-exponents)
        pressure_covariance = np.tensordot(_VARIANCE_SHARES, correlations, 1)
        self._covariance = self.spacing**4 * pressure_covariance

        # The response (n C, 3 q) in Pa/N has the forces in the order of `to_forces`.
        response = values.respond(self.places, self.size).astype(np.float32)
        self._response = response.reshape(values.known.size, -1)
        # `_estimates` and `_discs` are the contacts for the newest values, once they are computed.
        self._estimates: list[ContactEstimate] = []
        self._discs: Discs | None = None
        self.is_sharpened = False
        self.is_sharp = False

    @classmethod
    def cover(
        cls,
        inverse: SurfaceInverse,
        points: Index,
        values: LocalValues,
    ) -> GridFit:
        """Place grid contacts on a whole region.

        Args:
            inverse: Poses, points, noise and responses of the skin.
            points: Indices of the points of the surface that form the region.
            values: Positions and noise of the cubes around the region.
        """
        is_around = np.isin(inverse.cube, values.cubes)
        around = np.flatnonzero(is_around)
        region_points = unroll_points(inverse, values.home, points)
        points_around = unroll_points(inverse, values.home, around)
        places, spacing = _place_grid_contacts(
            region_points,
            points_around,
            inverse,
        )
        return cls(inverse, values, places, spacing)

    @property
    def of_region(self) -> GridFit:
        """Fit whose grid contacts cover the whole region: this one, except on a finer grid."""
        return self._coarsest or self

    def solve(self, white: Array) -> None:
        """Compute the posterior with the prior of the first fit.

        This prior is the same for all grid contacts, except on a finer grid (`sharpen`).

        Args:
            white: Values (n C,), C components of stress and gradient of each of n cubes,
                transformed by `LocalValues.whiten` so that their noise has variance 1.
        """
        whitening = self.values.whitening
        # In whitening matrices, rows of unknown components are 0. A 1 on the diagonal makes the
        # matrices invertible.
        is_unknown = ~self.values.known
        invertible = whitening + is_unknown[:, :, None] * np.eye(is_unknown.shape[1])
        self._unwhitening = np.linalg.inv(invertible)
        white_response = whitening @ self._response.reshape(*whitening.shape[:2], -1)
        self._white_response = white_response.reshape(len(white), 3, -1)
        self._decomposition = self._decompose(self._first_envelope)
        self._finish(white, self._find_scale(self._decomposition, white[:, None]))
        self.is_sharpened = False
        self.is_sharp = False

    def sharpen(self, white: Array) -> GridFit:
        """Fit again with a prior that allows less force where the present fit finds little force.

        This removes force that the first fit spreads over points where nothing touches the skin. If
        the evidence of the new fit is not clearly higher, the present fit is kept, and the next
        call tries a finer grid where the present fit finds force.

        Args:
            white: Whitened values (n C,), as for `solve`.

        Returns:
            The fit to use from now on: this one, or one with a finer grid.
        """
        self.is_sharpened = True
        if self._finer is not None:
            finer, self._finer = self._finer, None
            self.step(white)
            finer.solve(white)
            finer.is_sharpened = True
            self.is_sharp = finer.score > self.score - MIN_SCORE_GAIN
            return self if self.is_sharp else finer
        columns = np.column_stack([white, self._white_sensitivity])
        present = self._find_scale(self._decomposition, columns)
        narrower = self._decompose(self._compute_envelope(self.places))
        best = self._find_scale(narrower, columns)
        if best.score < present.score - MIN_SCORE_GAIN:
            self._decomposition = narrower
            self._finish(white, best)
        else:
            self._finer = self._refine_grid()
            self.is_sharp = self._finer is None
        return self

    def _refine_grid(self) -> GridFit | None:
        """Return a fit with a finer grid where the present fit finds force, before it is solved.

        None: the grid cannot become finer.
        """
        step = GRID_STEP * self._inverse.depth
        if self.spacing <= step:
            return None
        mean_square = self._mean_square
        support = self.places[mean_square > SUPPORT_FORCE**2 * mean_square.max()]
        margin = SUPPORT_MARGIN * self.spacing

        def is_near_force(places: Array) -> Mask:
            return np.asarray(cdist(places, support).min(axis=1) < margin)

        places, spacing = _make_grid(support, margin, step, is_near_force)
        if spacing > MAX_FINER_SPACING * self.spacing:
            return None
        finer = GridFit(self._inverse, self.values, places, spacing)
        finer._coarsest = self.of_region
        finer._first_envelope = self._compute_envelope(places)
        return finer

    def step(self, white: Array) -> None:
        """Compute forces and misfit for new values of the same cubes.

        Args:
            white: Whitened values (n C,), as for `solve`.
        """
        posterior = self.posterior
        self._estimates = []
        self._discs = None
        self._errors = posterior.to_errors @ white
        projected = posterior.response @ white.astype(np.float32)
        unknowns = posterior.shrinkage * (projected - posterior.by_errors @ self._errors)
        self.forces = (posterior.to_forces @ unknowns).reshape(3, -1)

        by_forces = unknowns.astype(np.float32) @ posterior.response
        self._explained = by_forces + self._white_sensitivity[:, 1:] @ self._errors
        deviations = np.concatenate([white - self._explained, unknowns, self._errors])
        chi_squared = float(deviations @ deviations)
        count = self.values.count
        self.misfit = max(chi_squared / count, 1.0)
        noise_term = count * float(np.log(self.misfit))
        self.score = chi_squared / self.misfit + noise_term + posterior.occam_term

    @property
    def explained(self) -> Array:
        """Components (n, C), in Pa, that the forces and the estimated errors of the elastomer cause
        in the cubes around the region; 0 where the component is unknown."""
        whitened = self._explained.reshape(*self.values.known.shape, 1)
        return np.asarray((self._unwhitening @ whitened)[:, :, 0])

    @property
    def discs(self) -> Discs:
        """Round Hertz contacts that act on distant cubes like the grid contacts."""
        if self._discs is None:
            self._discs = make_discs(self.estimate_contacts())
        return self._discs

    def estimate_contacts(self) -> list[ContactEstimate]:
        """Return force, centre, moment and area of each contact of the region, by integration."""
        if self._estimates:
            return self._estimates
        # For the area, the radius of grid contacts counts as proportional to their distance, so
        # that gaps between grid contacts that lie far apart do not reduce the area.
        radius = _GRID_CONTACT_RADIUS / GRID_STEP * self.spacing
        for centre, polynomials, unit_root in self._contacts:
            root = np.sqrt(self.misfit) * unit_root
            estimate = estimate_contact(
                centre,
                self.forces @ polynomials,
                root,
                radius,
            )
            self._estimates.append(estimate)
        return self._estimates

    @property
    def shape_misfit(self) -> float:
        """Misfit that shows whether the model of the traction is wrong.

        It is `misfit`, to which all cubes around the region contribute, because grid contacts
        assume no shape of the contact. A `HertzFit` assumes a shape, and therefore computes
        `shape_misfit` from the cubes nearest to its contacts.
        """
        return self.misfit

    def to_contacts(self, step: float) -> ContactSum:
        """Describe the traction as the sum of the grid contacts.

        Args:
            step: Not used here; `HertzFit.to_contacts` needs it.
        """
        sizes = np.full(len(self.places), self.size)
        weights = np.eye(self.forces.size).reshape(-1, *self.forces.shape)
        root = np.sqrt(self.misfit) * self._propagate(weights)
        return ContactSum(
            self.places,
            sizes,
            self.forces,
            root.reshape(*self.forces.shape, -1),
        )

    def _finish(self, white: Array, first: _Scale) -> None:
        """Compute the posterior with errors of the elastomer, and divide the region into contacts.

        Args:
            white: Whitened values (n C,).
            first: Result of `_find_scale` for `_decomposition`, either without sensitivities to the
                elastomer's properties or with those of the last fit.
        """
        decomposition = self._decomposition
        basis = decomposition.basis
        exact = first.projected[:, 0] - first.projected[:, 2:] @ first.errors[:, 0]
        forces = basis @ (first.variances * exact)
        sensitivity = self.values.compute_sensitivity(
            self.places,
            self.size,
            forces.reshape(3, -1),
        )
        white_sensitivity = self.values.whitening @ sensitivity
        self._white_sensitivity = white_sensitivity.reshape(len(white), -1)
        columns = np.column_stack([white, self._white_sensitivity])
        best = self._find_scale(decomposition, columns)
        scale, variances, projected = best.scale, best.variances, best.projected

        # Errors of the elastomer's properties add two parts to the covariance: one for the error of
        # the depth, and one for the other errors, which are estimated together with the forces.
        by_column = basis @ (variances[:, None] * projected[:, 1:])
        by_depth = by_column[:, :1] - by_column[:, 1:] @ best.errors[:, 1:]
        cholesky_factor = np.linalg.cholesky(best.information)
        by_errors = by_column[:, 1:] @ np.linalg.inv(cholesky_factor).T

        design, vectors = decomposition.design, decomposition.vectors
        explained = design @ (vectors @ (variances[:, None] * projected[:, 2:]))
        to_errors = np.linalg.solve(best.information, (columns[:, 2:] - explained).T)
        is_known = best.signal_to_noise > MIN_SIGNAL_TO_NOISE
        response = vectors[:, is_known].T.astype(np.float32) @ design.T.astype(np.float32)
        ratios = 1 / (1 + best.signal_to_noise)
        self.posterior = GridPosterior(
            response=np.float32(scale) * response,
            shrinkage=ratios[is_known],
            to_forces=scale * basis[:, is_known],
            to_errors=to_errors,
            by_errors=scale * projected[is_known, 2:],
            scale=scale,
            ratios=ratios,
            errors_root=np.hstack([by_errors, by_depth]),
            occam_term=best.occam_term,
        )
        self.step(white)
        self._separate_contacts()

    def _propagate(self, weights: Array) -> Array:
        """Return a square root (m, n) of the covariance of m weighted sums of the forces.

        The covariance is that for a misfit of 1. Otherwise, the result has to be multiplied by the
        square root of the misfit.

        Args:
            weights: Weights (m, 3, q) of the forces along x, y and z.
        """
        posterior, decomposition = self.posterior, self._decomposition
        count = len(weights)
        flat = weights.reshape(count, -1)
        # The values reduce the prior standard deviations only along the eigenvectors.
        by_axis = weights.swapaxes(0, 1) @ decomposition.root
        prior = by_axis.swapaxes(0, 1).reshape(count, -1)
        along = flat @ decomposition.basis
        exact = prior - along * (1 - np.sqrt(posterior.ratios)) @ decomposition.vectors.T
        return np.hstack([posterior.scale * exact, flat @ posterior.errors_root])

    @property
    def _normal_covariance(self) -> Array:
        """Covariance (q, q), in N^2, of the normal forces of the q grid contacts for a misfit of 1.
        Otherwise, the covariance has to be multiplied by the misfit."""
        posterior, decomposition = self.posterior, self._decomposition
        root = decomposition.root[2]
        basis, errors_root = decomposition.basis[-len(root) :], posterior.errors_root[-len(root) :]
        exact = root @ root.T - basis * (1 - posterior.ratios) @ basis.T
        return np.asarray(posterior.scale**2 * exact + errors_root @ errors_root.T)

    def _find_scale(self, decomposition: _Decomposition, columns: Array) -> _Scale:
        """Find the scale of the prior (prior standard deviation s of the pressure) that has the
        largest evidence (probability of the values).

        Args:
            decomposition: Result of `_decompose`.
            columns: Array (n C, 1 + S). The first column contains the whitened values: C components
                of each of n cubes. The others contain their sensitivities to S properties of the
                elastomer, the depth first; they are left out if the sensitivities are unknown.
        """
        prior_variances = _SCALES[:, None] ** 2
        projected = decomposition.vectors.T @ (decomposition.design.T @ columns)

        # With X = `columns` and the inverse covariance W = (1 + s^2 B K B')^-1 of the whitened
        # values (head of this file), `products` are X' W X for every scale s. By the Woodbury
        # identity, they are X' X minus `explained_by_forces`.
        signal_to_noise = prior_variances * decomposition.eigenvalues
        weights = prior_variances / (1 + signal_to_noise)
        explained_by_forces = (projected.T * weights[:, None]) @ projected
        products = columns.T @ columns - explained_by_forces

        # The errors of all properties but the depth are estimated together with the forces. The
        # error of the depth is not estimated; it only adds to the covariance of the forces.
        information = products[:, 2:, 2:] + np.eye(products[0, 2:].shape[0])
        gradients = products[:, 2:, :2]
        errors = np.linalg.solve(information, gradients)
        by_error = errors[:, :, 0] * gradients[:, :, 0]
        chi_squared = products[:, 0, 0] - by_error.sum(axis=1)
        chi_squared = np.maximum(chi_squared, 0)
        count = self.values.count
        misfit = np.maximum(chi_squared / count, 1.0)

        _, log_information = np.linalg.slogdet(information)
        occam_terms = np.log1p(signal_to_noise).sum(axis=1) + log_information
        scores = chi_squared / misfit + count * np.log(misfit) + occam_terms
        best = int(np.argmin(scores))
        return _Scale(
            scale=float(_SCALES[best]),
            projected=projected,
            variances=weights[best],
            signal_to_noise=signal_to_noise[best],
            errors=errors[best],
            information=information[best],
            occam_term=float(occam_terms[best]),
            score=float(scores[best]),
        )

    @property
    def _mean_square(self) -> Array:
        """Expected squares (q,) of the normal forces in the present posterior, in N^2."""
        return np.asarray(self.forces[2] ** 2 + self.misfit * self._normal_covariance.diagonal())

    def _compute_envelope(self, places: Array) -> Array:
        """Return prior standard deviations (m,) of the forces of grid contacts for `sharpen`.

        They are divided by the largest one. Their squares are the expected squares of the normal
        forces in the present posterior, smoothed over neighbouring grid contacts.

        Args:
            places: Positions (m, 2) of the grid contacts in m.
        """
        squared_distances = cdist(places, self.places, "sqeuclidean")
        smoothing = np.exp(-squared_distances / (2 * self.spacing**2))
        smooth_square = smoothing @ self._mean_square / smoothing.sum(axis=1)
        envelope = np.sqrt(smooth_square / smooth_square.max())
        return np.asarray(envelope.clip(ENVELOPE_FLOOR))

    def _separate_contacts(self) -> None:
        """Assign each grid contact to one of the peaks of the pressure; each peak is a contact."""
        exponents = self._squared_distances / (2 * self._peak_width**2)
        smoothing = np.exp(-exponents)
        covariance = self._normal_covariance
        # Diagonal neighbours on the grid are 1.41 spacings apart.
        reach = 1.5 * self.spacing
        is_neighbour = self._squared_distances < reach**2
        labels = split_peaks(
            -smoothing @ self.forces[2],
            self.misfit * smoothing @ covariance @ smoothing,
            is_neighbour,
        )
        self._estimates = []
        self._discs = None
        # Each contact is described by its centre, the polynomials (1, x, ..., y^2) of its grid
        # contacts, and a square root of the covariance of its moments for a misfit of 1.
        self._contacts = []
        for label in range(labels.max() + 1):
            own = labels == label
            centre = self.places[own].mean(axis=0)
            polynomials = np.zeros((len(labels), N_MOMENTS))
            polynomials[own] = compute_moment_polynomials(self.places[own] - centre)
            weights = np.zeros((3, N_MOMENTS, 3, len(labels)))
            for axis in range(3):
                weights[axis, :, axis] = polynomials.T
            columns = self._propagate(weights.reshape(-1, 3, len(labels))).T
            triangle = np.asarray(np.linalg.qr(columns, mode="r"))
            self._contacts.append((centre, polynomials, triangle.T.reshape(3, N_MOMENTS, -1)))

    def _decompose(self, envelope: Array) -> _Decomposition:
        """Compute the eigenvalues and eigenvectors from which every posterior follows.

        Args:
            envelope: Prior standard deviation (q,) of the force of each of q grid contacts, divided
                by the largest one.
        """
        covariance = self._covariance * np.outer(envelope, envelope)
        # Rounding errors could give the covariance a negative eigenvalue, and this tiny increase of
        # its diagonal prevents that.
        n_grid_contacts = len(covariance)
        covariance[np.diag_indices(n_grid_contacts)] *= 1 + 1e-8
        cholesky_factor = np.linalg.cholesky(covariance)
        root = _RELATIVE_DEVIATIONS[:, None, None] * cholesky_factor
        by_axis = self._white_response.reshape(-1, 3, n_grid_contacts).swapaxes(0, 1)
        design = np.concatenate(by_axis @ root, axis=1)

        # A pivoted Cholesky decomposition finds k < 3 q columns L with L L' = D' D up to the
        # tolerance. The smaller matrix L' L has the same eigenvalues.
        gram = design.T @ design
        largest = float(gram.diagonal().max())
        upper, pivots, rank, _ = dpstrf(gram, tol=RANK_TOLERANCE * largest)
        # LAPACK returns the matrix in the order of Fortran, in which its rows are not contiguous.
        columns = np.tril(upper[:rank].T)
        eigenvalues, small_vectors = np.linalg.eigh(columns.T @ columns)
        # Rounding errors may make the smallest eigenvalues negative.
        eigenvalues = np.maximum(eigenvalues, np.finfo(float).eps * largest)
        vectors = np.empty_like(columns)
        vectors[pivots - 1] = columns @ (small_vectors / np.sqrt(eigenvalues))
        basis = root @ vectors.reshape(3, n_grid_contacts, -1)
        return _Decomposition(
            eigenvalues=eigenvalues,
            vectors=vectors,
            design=design,
            root=root,
            basis=basis.reshape(3 * n_grid_contacts, -1),
        )


def _place_grid_contacts(
    region: Array,
    around: Array,
    inverse: SurfaceInverse,
) -> tuple[Array, float]:
    """Place grid contacts on a region, and beyond the border of the skin next to it.

    Args:
        region: Positions (n, 2) of the points of the region in m, on the skin laid flat.
        around: Positions (m, 2) of all points around the region.
        inverse: Gives the depth and pitch of the cubes, and the spacing of the points.

    Returns:
        Positions (q, 2) of at most `MAX_GRID_CONTACTS` grid contacts in m, and the distance of
        neighbouring ones in m.
    """
    farthest = MAX_BORDER_REACH_DEPTHS * inverse.depth
    reach = min(BORDER_REACH_PITCHES * inverse.pitch, farthest)
    margin = _POINT_MARGIN * inverse.spacing

    def is_in_region_or_beyond_border(places: Array) -> Mask:
        to_region = cdist(places, region).min(axis=1)
        to_skin = cdist(places, around).min(axis=1)
        is_beyond_border = (to_region < reach) & (to_skin > margin)
        return np.asarray((to_region < margin) | is_beyond_border)

    return _make_grid(
        region,
        reach,
        GRID_STEP * inverse.depth,
        is_in_region_or_beyond_border,
    )


def _make_grid(
    region: Array,
    reach: float,
    step: float,
    is_inside: Callable[[Array], Mask],
) -> tuple[Array, float]:
    """Return the points (q, 2) of a square grid in an area, at most `MAX_GRID_CONTACTS`.

    Args:
        region: Positions (n, 2) of points of the area in m.
        reach: Largest distance of the area from these points along each axis, in m.
        step: Smallest distance of neighbouring points of the grid in m.
        is_inside: Tells for positions (m, 2) whether each of them is in the area.

    Returns:
        The points in m, and the distance of neighbouring ones in m.
    """
    centre = region.mean(axis=0)
    extent = np.abs(region - centre).max() + reach
    while True:
        steps_each_way = int(np.ceil(extent / step))
        places = centre + make_square_points(step, 2 * steps_each_way + 1)
        places = places[is_inside(places)]
        if len(places) <= MAX_GRID_CONTACTS:
            return places, step
        # The number of points is proportional to 1 / step^2. The additional 2 % usually save a
        # further iteration.
        squared_growth = 1.02 * len(places) / MAX_GRID_CONTACTS
        step *= np.sqrt(squared_growth)
