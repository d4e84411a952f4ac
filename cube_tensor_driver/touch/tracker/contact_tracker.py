# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Contact tracker: finds contacts in the traction on the surface and follows them in every scan.

In every scan (set of values of all cubes), the linear inverse problem (inverse.py) yields the field
of the pressure on the whole skin. Its connected regions of large pressure are the regions of
contact (pressure_regions.py). The traction in each region is then fitted to the values of the cubes
around the region (tracked_region.py): by one Hertz contact for each contact, or by grid contacts
(many small contacts on a grid, grid_fit.py) with a prior that is zero outside the region. Force,
position, moment and area of each contact follow from this fit.

Fits take a few milliseconds, so the work in a scan is limited, and the remaining work is done in
the next scans. After the first fit, Hertz contacts that move need one Gauss-Newton step per scan,
and a fit by grid contacts only needs matrix products. The contact of a region that has no fit yet
is reported with the integrals of the field, which are less exact.
"""

from __future__ import annotations

import math
from itertools import accumulate, compress
from typing import NamedTuple

import numpy as np
from scipy.spatial.distance import cdist

from ...core.arrays import Array, Index
from ..inverse import FieldDeviation, SurfaceInverse, TractionField
from ..surface import describe_contact
from .contact_estimate import ContactEstimate
from .fitted_field import add_fits
from .grid_fit import GridFit
from .hertz_fit import HertzFit, linearise
from .local_values import CubeNoise, make_rotations_about_normal, unroll_points
from .pressure_regions import PressureRegions
from .tracked_region import (
    COARSE_DEVIATION,
    TrackedRegion,
    Work,
    update_responses,
)

NEIGHBOUR_REACH_PITCHES = 3.0
"""Distance between two regions of contact, divided by the pitch (distance of neighbouring cubes),
below which they are neighbours: the same cubes measure both, so a contact only counts as refined
when the regions beside it are fitted, too."""

MAX_REGIONS = 32
"""Largest number of regions of contact on one skin; those with the largest pressure are kept."""

MAX_WORK_PER_SCAN = 12.0
"""Largest computing time of one scan (set of values of all cubes), in ms, as estimated by
`TRACKING_WORK_MS` and `WORK_MS`. The remaining steps of fits are made in the next scans; one step
is always made. With 11 instead of 12, the fits of twenty fingertips took 46 instead of 44 scans."""

TRACKING_WORK_MS = 0.25
"""CPU time, in ms for each region and scan, of the computation of the present fit for the newest
values. It is subtracted from `MAX_WORK_PER_SCAN`, before fits are made or improved."""

MATCH_PITCHES = 1.0
"""Largest distance that a contact moves between two scans, divided by the pitch (distance of
neighbouring cubes). A contact farther away from all previous ones is a new one."""


class TrackedContact(NamedTuple):
    """One contact in the skin's parent frame, with standard deviations.

    Attributes:
        id: Number of the contact, which stays the same as long as the contact lasts.
        position: Position (3,) in m, where the line of action of the normal force meets the
            surface.
        normal: Unit normal (3,) out of the skin.
        force: Force (3,) in N on the skin.
        normal_force: Normal force in N, positive for a body that presses on the skin.
        shear_force: Length of the tangential force in N.
        moment: Moment of the tangential traction about the normal through `position`, in N m.
        area: Area of the elliptic Hertz contact with the same second moments of pressure, in m^2.
        position_uncertainty: Standard deviation of the position along each axis, in m.
        force_uncertainty: Standard deviation of the normal force, in N.
        shear_uncertainty: Standard deviation of `shear_force`, in N.
        moment_uncertainty: Standard deviation of the moment, in N m.
        area_uncertainty: Standard deviation of the area, in m^2.
        refined: Whether force, position and moment come from a fit of the traction in the region of
            contact that agrees with the newest values, and all regions near it are fitted, too. If
            not, they are less exact (`COARSE_DEVIATION`): integrals of the linear field, or results
            of a fit that is to be repeated.
    """

    id: int
    position: Array
    normal: Array
    force: Array
    normal_force: float
    shear_force: float
    moment: float
    area: float
    position_uncertainty: float
    force_uncertainty: float
    shear_uncertainty: float
    moment_uncertainty: float
    area_uncertainty: float
    refined: bool

    def __repr__(self) -> str:
        return f"TrackedContact({self.id}: {describe_contact(self)})"


class ContactTracker:
    """Follows the contacts of a skin from scan to scan (set of values of all cubes).

    Attributes:
        single_fits: Fits of one Hertz contact each in the newest scan, by the ids of the contacts.
    """

    def __init__(self, inverse: SurfaceInverse, min_pressure: float) -> None:
        """Create a tracker without contacts.

        Args:
            inverse: Computes the traction on the surface of this skin.
            min_pressure: Smallest pressure of a contact at the depth of the cubes, in Pa.
        """
        self._inverse = inverse
        self._pressure_regions = PressureRegions(inverse, min_pressure)
        self._noise = CubeNoise(inverse)
        self._regions: list[TrackedRegion] = []
        self._last_positions = np.zeros((0, 3))
        self._last_ids: list[int] = []
        self._next_id = 0
        self.single_fits: dict[int, HertzFit] = {}
        n_cubes = len(inverse.poses.position)
        n_components = len(inverse.columns)
        self._scaled = np.full((n_cubes, n_components), np.nan)

    def __repr__(self) -> str:
        contacts = f"{len(self._last_ids)} contacts in the newest scan"
        return f"ContactTracker({self._inverse.poses!r}, {contacts})"

    def update(
        self,
        values: Array,
        certain: Array | None = None,
        *,
        max_work: float = MAX_WORK_PER_SCAN,
    ) -> list[TrackedContact]:
        """Find the contacts in the newest values.

        Args:
            values: Components (cubes, 15) in Pa and Pa/m, NaN where unknown.
            certain: Pressure (M,), in Pa at the depth of the cubes below each point of the surface,
                that a new contact must exceed, because errors of the values may cause smaller ones;
                None: 0.
            max_work: Limit of the computing time in ms (`MAX_WORK_PER_SCAN`). 0: no fit is made or
                improved. Infinite: all fits are improved as far as possible.

        Returns:
            Contacts, the one with the largest normal force first.
        """
        inverse = self._inverse
        scaled = inverse.scale_values(values)
        self._scaled = scaled
        self._follow_regions(inverse.compute_depth_pressure_of_scaled(scaled), certain)
        regions = self._regions
        self._noise.update(scaled, self._fitted_cubes)
        for region in regions:
            region.drop_grid_of_other_values()
        self._update_fits()

        if len(self._fits) < len(regions):
            self._integrate_field(inverse.compute_field_of_scaled(scaled))
        if max_work > 0:
            self._improve_fits(max_work)

        found = self._describe_contacts()
        return sorted(found, key=lambda contact: -contact.normal_force)

    @property
    def _fitted(self) -> list[TrackedRegion]:
        """Regions that are fitted."""
        return [region for region in self._regions if region.fit is not None]

    @property
    def _fits(self) -> list[HertzFit | GridFit]:
        """Fits of all regions that are fitted."""
        return [region.fit for region in self._regions if region.fit is not None]

    @property
    def _fitted_cubes(self) -> Index:
        """Indices (n,) of the cubes from whose values regions are fitted."""
        is_fitted = np.zeros(len(self._scaled), bool)
        for fit in self._fits:
            is_fitted[fit.values.cubes] = True
        return np.flatnonzero(is_fitted)

    @property
    def field(self) -> TractionField:
        """Traction on the surface in the newest scan, contacts included.

        It is computed when it is read, which takes several milliseconds for each contact.
        """
        residual = self._inverse.compute_field_of_scaled(
            self._scaled - self._compute_response_to_fits()
        )
        contacts, _ = add_fits(self._inverse, self._fits)
        pairs = zip(residual, contacts, strict=True)
        return TractionField(*(one + other for one, other in pairs))

    def deviation(self, values: Array) -> FieldDeviation:
        """Compute the standard deviations of `field`.

        Each variance is the sum of two variances: that of the residual field (traction that the
        fits do not explain) and that of the traction of the fits.

        Args:
            values: Components (cubes, 15) in Pa and Pa/m that the last `update` was called with.
        """
        inverse = self._inverse
        residual = self._scaled - self._compute_response_to_fits()
        deviation = inverse.compute_residual_deviation(residual, inverse.scale_values(values))
        _, contacts = add_fits(inverse, self._fits)
        pairs = zip(deviation, contacts, strict=True)
        return FieldDeviation(*(np.hypot(one, other) for one, other in pairs))

    def _compute_response_to_fits(self) -> Array:
        """Return the response of all cubes to the traction of all fits.

        The response is an array (cubes, C), in Pa, of the C components of stress and gradient
        (times d0, half the side of a cube) that the pads determine; NaN where the value of a cube
        is unknown.
        """
        fitted = self._fitted
        all_cubes = np.arange(len(self._scaled))
        update_responses(self._inverse, fitted, all_cubes)
        total = 0 * self._scaled
        for region in fitted:
            region.store_response()
            total = total + region.response
        return np.asarray(total)

    def _follow_regions(self, pressure: Array, certain: Array | None) -> None:
        """Find the regions of the newest scan, and match them with those of the previous scan.

        A matched region keeps its fit.

        Args:
            pressure: Pressure (M,) in Pa at the depth of the cubes' centres, below each of the M
                points of the surface.
            certain: Pressure (M,) in Pa that a new contact must exceed, as for `update`.
        """
        found = self._pressure_regions.find(pressure, certain)[:MAX_REGIONS]
        owner = np.full(len(pressure), len(self._regions))
        for number, region in enumerate(self._regions):
            owner[region.points] = number
        # A region matches the previous region with which it has most points in common, if no region
        # with a larger pressure has matched it before. The last entry of `unmatched` stands for
        # points that belonged to no region.
        unmatched: list[TrackedRegion | None] = [*self._regions, None]
        regions = []
        is_changed = len(found) != len(self._regions)
        for points, peak in found:
            n_common = np.bincount(owner.take(points), minlength=len(unmatched))
            n_common[-1] = 0
            best = int(n_common.argmax())
            old = unmatched[best] if n_common[best] else None
            unmatched[best] = None
            region = old or TrackedRegion(self._inverse, self._noise, self._respond)
            is_changed |= points is not region.points
            region.begin_scan(points, peak)
            regions.append(region)
        self._regions = regions
        if is_changed and regions:
            distances = self._measure_region_distances()
            are_near = distances < NEIGHBOUR_REACH_PITCHES * self._inverse.pitch
            rows = zip(
                regions,
                are_near.tolist(),
                distances.min(axis=1).tolist(),
                strict=True,
            )
            for region, is_near, region.gap in rows:
                region.near = list(compress(regions, is_near))

    def _measure_region_distances(self) -> Array:
        """Return the distances (n, n), in m, between n regions, infinite from a region to itself.

        The distance of two regions is that of their two nearest points.
        """
        points = [region.points for region in self._regions]
        starts = list(accumulate(map(len, points[:-1]), initial=0))
        positions = self._inverse.points.take(np.concatenate(points), axis=0)
        distances = cdist(positions, positions)
        to_points = np.minimum.reduceat(distances, starts, axis=0)
        to_regions = np.minimum.reduceat(to_points, starts, axis=1)
        np.fill_diagonal(to_regions, np.inf)
        return np.asarray(to_regions)

    def _update_fits(self) -> None:
        """Compute all fits for the newest values.

        In the fit of a region, the response of the cubes to all other regions is subtracted from
        their values first.
        """
        fitted = self._fitted
        hertz_fits = [fit for fit in self._fits if isinstance(fit, HertzFit)]
        due = [fit for fit in hertz_fits if fit.needs_linearisation]
        for one in due:
            one.values.refresh_if_stale()
            linearise(self._inverse, one)
        if len(fitted) > 1:
            update_responses(self._inverse, fitted, self._fitted_cubes)
        total, deviation = self._sum_responses(self._fitted_cubes)
        for region in fitted:
            fit = region.fit
            if fit is not None:
                cubes = fit.values.cubes
                others = region.subtract_others(fit.values, total, deviation)
                region.step()
                total[cubes] = others + region.response.take(cubes, axis=0)

    def _sum_responses(self, cubes: Index) -> tuple[Array, Array]:
        """Return the stored response of some cubes to all regions, and its standard deviation.

        Args:
            cubes: Indices (n,) of the cubes.

        Returns:
            Two arrays (cubes of the skin, C) in Pa, of the C components that the pads determine; 0
            for all other cubes.
        """
        total = np.zeros(self._scaled.shape)
        deviation = np.zeros(self._scaled.shape)
        responses = [region.response.take(cubes, axis=0) for region in self._regions]
        total[cubes] = sum(responses)
        # Deviations add linearly, because the same errors of the elastomer cause them.
        pairs = zip(self._regions, responses, strict=True)
        deviation[cubes] = sum(region.relative_error * np.abs(one) for region, one in pairs)
        return total, deviation

    def _respond(self, cubes: Index) -> tuple[Array, Array]:
        """Return the present response of some cubes to all regions, and its standard deviation.

        Outdated responses are computed again before `_sum_responses` adds up those of all regions.

        Args:
            cubes: Indices (n,) of the cubes.

        Returns:
            Two arrays as from `_sum_responses`.
        """
        if len(self._regions) > 1:
            update_responses(self._inverse, self._regions, cubes)
        return self._sum_responses(cubes)

    def _improve_fits(self, max_work: float) -> None:
        """Make and improve fits of regions, the most urgent first (`Work`), up to a limit of work.

        Args:
            max_work: Limit of the computing time in ms, as for `update`.
        """
        # Among equally urgent regions, the one that has waited longest comes first.
        order = [(region.next_work, -region.waited) for region in self._regions]
        left = max_work - TRACKING_WORK_MS * len(order)
        is_first = True
        while order:
            number = min(range(len(order)), key=order.__getitem__)
            region = self._regions[number]
            work, _ = order[number]
            if work == Work.NONE:
                break
            left -= region.estimate_ms(work)
            if left < 0 and not is_first:
                break
            is_first = False
            region.improve(work)
            order[number] = region.next_work, -region.waited

    def _integrate_field(self, field: TractionField) -> None:
        """Estimate the contacts of regions without a fit by integrals of the traction field.

        The normal force is the integral of the pressure at the depth of the cubes, which equals the
        integral on the surface. At this depth, the pressure spreads beyond the region. So the
        integrals include all points around it; points around several regions are divided equally
        among these regions.
        """
        inverse = self._inverse
        around = [self._pressure_regions.find_around(one.points) for one in self._regions]
        claims = np.zeros(len(inverse.points))
        owner = np.full(len(claims), -1)
        for number, (region, points) in enumerate(zip(self._regions, around, strict=True)):
            claims[points] += 1
            owner[region.points] = number
        claims[owner >= 0] = 1
        for number, (region, points) in enumerate(zip(self._regions, around, strict=True)):
            if region.fit is None:
                is_own = (owner[points] == number) | (owner[points] < 0)
                own = points[is_own]
                weight = inverse.area / claims[own]
                region.take_integral(self._integrate(region, own, weight, field))

    def _integrate(
        self,
        region: TrackedRegion,
        own: Index,
        weight: Array,
        field: TractionField,
    ) -> ContactEstimate:
        """Integrate the field around a region over n points.

        The result is in the frame of the home cube, the cube around which the skin is laid flat.

        Args:
            region: The region.
            own: Indices (n,) of the points.
            weight: Area (n,) in m^2 that each point represents.
            field: Traction on the surface.
        """
        inverse = self._inverse
        pressing = weight * field.depth_pressure[own]
        normal_force = float(pressing.sum())
        _, angle = inverse.unroll(region.home, inverse.cube[own])
        from_home = make_rotations_about_normal(angle)
        traction = np.einsum("nba,nb->na", from_home, field.traction[own])
        force = weight @ traction
        force[2] = -normal_force
        # A shear force shifts the centre of pressure at the depth of the cubes from that at the
        # surface, by the depth times the ratio of shear and normal force.
        moments = pressing @ unroll_points(inverse, region.home, own) - inverse.depth * force[:2]
        area = len(region.points) * inverse.area
        # The errors of the pressure at all points have the same causes, so their deviations (not
        # their variances) add up.
        error = float(weight @ inverse.error_deviation[own])
        error_share = error / max(normal_force, 1e-12)
        radius = np.sqrt(weight.sum() / np.pi)
        shift = np.hypot(COARSE_DEVIATION * inverse.pitch, error_share * radius)
        variance = (COARSE_DEVIATION * normal_force) ** 2 + error**2
        return ContactEstimate(
            force=force,
            force_covariance=variance * np.eye(3),
            place=moments / max(normal_force, 1e-12),
            place_variance=np.full(2, shift**2),
            moment=0.0,
            moment_variance=variance * area,
            area=area,
            area_variance=area**2,
            aspect=1.0,
        )

    def _describe_contacts(self) -> list[TrackedContact]:
        """Describe the contacts of all regions, and set `single_fits`."""
        refined = {region: region.is_refined for region in self._regions}
        contacts = [
            (region, one)
            for region, is_refined in refined.items()
            for one in region.estimate_contacts(is_refined)
            if one.force[2] < 0
        ]
        positions, rotations = self._to_parent_frame(contacts)
        ids = self._number_contacts(positions)
        fits = {number: region.fit for number, (region, _) in zip(ids, contacts, strict=True)}
        self.single_fits = {
            number: fit
            for number, fit in fits.items()
            if isinstance(fit, HertzFit) and len(fit.found.forces) == 1
        }
        return [
            _describe_contact(number, position, rotation, one, refined[region])
            for number, position, rotation, (region, one) in zip(
                ids,
                positions,
                rotations,
                contacts,
                strict=True,
            )
        ]

    def _to_parent_frame(
        self,
        contacts: list[tuple[TrackedRegion, ContactEstimate]],
    ) -> tuple[Array, Array]:
        """Find where n contacts are on the skin, from their positions on the skin laid flat.

        Args:
            contacts: The estimates, with their regions.

        Returns:
            Positions (n, 3) in m in the skin's parent frame, and rotations (n, 3, 3) from the frame
            of the estimate to the parent frame.
        """
        inverse = self._inverse
        n = len(contacts)
        cubes = np.zeros(n, np.intp)
        angles = np.zeros(n)
        from_cubes = np.full((n, 3), inverse.depth)
        for number, (region, one) in enumerate(contacts):
            places, cube_angles = inverse.unroll(region.frame, slice(None))
            offset = one.place - places
            cube = np.einsum("nk,nk->n", offset, offset).argmin()
            cubes[number], angles[number] = cube, cube_angles[cube]
            from_cubes[number, :2] = offset[cube]
        rotations = inverse.poses.rotation[cubes] @ make_rotations_about_normal(angles)
        positions = inverse.poses.position[cubes] + np.einsum("nij,nj->ni", rotations, from_cubes)
        return positions, rotations

    def _number_contacts(self, positions: Array) -> list[int]:
        """Return the id of each contact: that of the nearest contact in the previous scan, or a new
        id if there is none within `MATCH_PITCHES`.

        Args:
            positions: Positions (n, 3) of the contacts in m.
        """
        ids = [-1] * len(positions)
        distances = cdist(positions, self._last_positions).tolist()
        pairs = [
            (distance, row, number)
            for row, to_last in enumerate(distances)
            for distance, number in zip(to_last, self._last_ids, strict=True)
            if distance < MATCH_PITCHES * self._inverse.pitch
        ]
        for _, row, number in sorted(pairs):
            if ids[row] < 0 and number not in ids:
                ids[row] = number
        for row, number in enumerate(ids):
            if number < 0:
                ids[row] = self._next_id
                self._next_id += 1
        self._last_positions, self._last_ids = positions, ids
        return ids


def _describe_contact(
    number: int,
    position: Array,
    rotation: Array,
    estimate: ContactEstimate,
    is_refined: bool,
) -> TrackedContact:
    """Describe a contact in the skin's parent frame.

    Args:
        number: Id of the contact.
        position: Position (3,) in m.
        rotation: Rotation (3, 3) to the parent frame from the frame of the estimate, whose z axis
            is the normal.
        estimate: Force of the contact, with variances, on the flattened skin.
        is_refined: Value of `TrackedContact.refined`.
    """
    x, y, z = estimate.force.tolist()
    shear = math.hypot(x, y)
    (xx, xy, _), (_, yy, _), (_, _, zz) = estimate.force_covariance.tolist()
    # To first order, the length of the shear force only changes by errors along its direction.
    shear_variance = (x * x * xx + 2 * x * y * xy + y * y * yy) / max(shear**2, 1e-300)
    place_variance = sum(estimate.place_variance.tolist()) / 2
    return TrackedContact(
        id=number,
        position=position,
        normal=rotation[:, 2],
        force=rotation @ estimate.force,
        normal_force=-z,
        shear_force=shear,
        moment=estimate.moment,
        area=estimate.area,
        position_uncertainty=math.sqrt(place_variance),
        force_uncertainty=math.sqrt(zz),
        shear_uncertainty=math.sqrt(shear_variance),
        moment_uncertainty=math.sqrt(estimate.moment_variance),
        area_uncertainty=math.sqrt(estimate.area_variance),
        refined=is_refined,
    )
