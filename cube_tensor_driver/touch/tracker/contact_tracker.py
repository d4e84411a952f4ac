# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Contact tracker: finds contacts in the traction on the surface, follows them from scan to scan.

In every scan (set of values of all cubes), the linear inverse gives the field of the pressure,
whose connected regions are contacts (pressure_regions.py). The traction in each region is then
fitted to the values of the cubes around it (region_fit.py), with a prior that is zero outside the
region. Force, position, moment and area are integrals of this fit (contact_estimate.py).

Fits take a few milliseconds, so their number per scan is limited. As long as the region stays the
same, its fit only needs a matrix product for new values. A region that has no fit yet is reported
with the integrals of the field, which are less exact.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from ...core.arrays import Array, Index
from ..inverse import FieldDeviation, SurfaceInverse, TractionField
from .contact_estimate import ContactEstimate
from .fitted_field import add_fits, fit_variances
from .local_values import LocalValues
from .pressure_regions import PressureRegions
from .region_fit import MIN_FACING, RegionFit

MAX_CUBES = 48
"""Largest number of cubes from whose values the traction in one region of contact is fitted. A
wider region, such as that of a palm, is not fitted; its contact is the integral of the linear
field."""

CUBE_REACH_PITCHES = (2.0, 1.0)
"""Distances from a region of contact, divided by the pitch (distance of neighbouring cubes), within
which cubes take part in its fit. The second, smaller one is used if the first one gives more than
`MAX_CUBES` cubes."""

NEIGHBOUR_REACH_PITCHES = 3.0
"""Distance from a region of contact, divided by the pitch (distance of neighbouring cubes), within
which other regions take part in its fit, with coarse unknown tractions of their own. The response
to regions farther away is subtracted from the values before the fit."""

MAX_NEIGHBOUR_NODES = 30
"""Largest number of nodes (small contacts) that represent other contacts in the fit of a region."""

MAX_REGIONS = 32
"""Largest number of regions of contact on one skin; those with the largest pressure are kept."""

MAX_WORK_PER_SCAN = 100
"""Work after which no further fit is made or improved in the same scan (set of values of all
cubes).

The unit is a node, one of the small contacts whose sum is the traction of a region: a new fit of 80
nodes is a work of 80. The limit bounds the time of a scan; what remains is done in the next scans.
"""

MAX_PIECES_OF_WORK = 12
"""Largest number of steps (new fits and improvements of fits) per region of contact in one scan
(set of values of all cubes). It ends scans that may do any amount of work."""

MAX_CHANGE = 0.25
"""Relative change since the last fit of a region of contact above which the region is fitted again.

It is the larger one of two changes: that of the largest pressure, and the share of surface points
that have joined or left the region. The fit depends on the pressure, because the assumed errors of
the pads' gains are proportional to the stress.
"""

MAX_CHANGE_HERTZ = 0.6
"""Relative change of pressure or points, as in `MAX_CHANGE`, above which a region is fitted again
if its traction is a Hertz contact. It is larger than `MAX_CHANGE`, because the position of a Hertz
contact follows the body that presses."""

MAX_MISFIT_GROWTH = 1.3
"""Growth of the misfit since the last fit of a region above which the region is fitted again. The
misfit is the squared deviation of the values from the fit, divided by the value that their noise
causes. It grows when a contact moves or changes its shape."""

MATCH_PITCHES = 1.0
"""Largest distance that a contact moves between two scans, divided by the pitch (distance of
neighbouring cubes). A contact farther away from all previous ones is a new one."""

COARSE_DEVIATION = 0.1
"""Standard deviation of the force, divided by the force, that is stated for a contact whose force
is the integral of the linear field, because its region is not fitted yet.

Such integrals were off by 1 to 9 % for balls, punches and rods on skins whose cubes are two or
three depths (of their centres below the surface) apart. Beside other contacts, the integral also
replaces a fit with a larger deviation.
"""


class Work(IntEnum):
    """Next step of the fit of a region of contact; the step with the smallest number comes first.

    FIT makes a new fit. MOVE lets a Hertz contact follow the body that presses. SHARPEN improves a
    fit for the same values. NONE: nothing is to be done.
    """

    FIT = 0
    MOVE = 1
    SHARPEN = 2
    NONE = 3


@dataclass
class _Region:
    """A region of contact in the newest scan.

    Attributes:
        points: Indices (n,) of its points of the surface.
        peak: Largest pressure in Pa at the depth of the cubes.
        near: Numbers of the other regions that take part in its fit.
        others: Indices of the points of these regions that take part in its fit.
        fit: Fit of the region, if there is one.
        response: Values (cubes, C) in Pa that the fit explains.
        is_tried: Whether a new fit was tried in this scan.
    """

    points: Index
    peak: float
    near: list[int]
    others: Index
    fit: RegionFit | None
    response: Array | float = 0.0
    is_tried: bool = False


class TrackedContact(NamedTuple):
    """One contact in the skin's parent frame, with standard deviations.

    Attributes:
        id: Number that stays the same from the first touch to the last.
        position: Position (3,) in m, where the line of action of the normal force meets the
            surface.
        normal: Unit normal (3,) out of the skin.
        force: Force (3,) in N on the skin.
        normal_force: Normal force in N, positive for a body that presses on the skin.
        shear_force: Length of the tangential force in N.
        moment: Moment of the traction about the normal through `position`, in N m.
        area: Area of the elliptic Hertz contact with the same second moments of pressure, in m^2.
        position_uncertainty: Standard deviation of the position along each axis, in m.
        force_uncertainty: Standard deviation of the normal force, in N.
        shear_uncertainty: Standard deviation of `shear_force`, in N.
        moment_uncertainty: Standard deviation of the moment, in N m.
        area_uncertainty: Standard deviation of the area, in m^2.
        refined: Whether force, position and moment come from a fit of the traction in the region of
            contact; if not, they are integrals of the linear field (`COARSE_DEVIATION`).
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


class ContactTracker:
    """Follows the contacts of a skin from scan to scan (set of values of all cubes)."""

    def __init__(self, inverse: SurfaceInverse, min_pressure: float) -> None:
        """Create a tracker without contacts.

        Args:
            inverse: Computes the traction on the surface of this skin.
            min_pressure: Smallest pressure of a contact at the depth of the cubes, in Pa.
        """
        self._inverse = inverse
        self._pressure_regions = PressureRegions(inverse, min_pressure)
        normals = inverse.poses.rotation[:, :, 2]
        self._above_cubes = cKDTree(inverse.poses.position + inverse.depth * normals)
        self._fits: list[RegionFit] = []
        self._known = np.zeros((0, 3))
        self._ids: list[int] = []
        self._next_id = 0
        n_values = (len(inverse.poses.position), len(inverse.columns))
        self._scaled = np.full(n_values, np.nan)

    def update(self, values: Array, max_work: float = MAX_WORK_PER_SCAN) -> list[TrackedContact]:
        """Find the contacts in the newest values.

        Args:
            values: Components (cubes, 15) in Pa and Pa/m, NaN where unknown.
            max_work: Number of nodes (see `MAX_WORK_PER_SCAN`) after which no further fit is
                improved in this scan. Infinite: all fits are improved as far as possible.

        Returns:
            Contacts, strongest first.
        """
        scaled = self._inverse.scaled(values)
        self._scaled = scaled
        field = self._inverse.field_of_scaled(scaled)
        pressure = field.depth_pressure
        regions = self._find_regions(pressure, scaled)
        for region in regions:
            self._update_response(region, regions)
        self._update_fits(regions)
        self._improve_fits(regions, pressure, max_work)
        if any(region.is_tried for region in regions) and len(regions) > 1:
            # The other fits now know the response to the new ones.
            self._update_fits(regions)
        self._fits = [region.fit for region in regions if region.fit is not None]

        contacts = []
        coarse = []
        for number, region in enumerate(regions):
            estimates = [] if region.fit is None else region.fit.estimate_contacts()
            if region.fit is None or (region.near and not all(map(_is_certain, estimates))):
                coarse.append(number)
            else:
                contacts += [self._to_parent_frame(one, region.fit) for one in estimates]
        if coarse:
            contacts += self._integrate_field(regions, coarse, field)
        return self._number_contacts([one for one in contacts if one.normal_force > 0])

    @property
    def field(self) -> TractionField:
        """Traction on the surface in the newest scan, contacts included.

        It is computed when it is read, which takes several milliseconds for each contact.
        """
        residual = self._scaled - sum(fit.respond() for fit in self._fits)
        return add_fits(self._inverse, self._inverse.field_of_scaled(residual), self._fits)

    def deviation(self, values: Array) -> FieldDeviation:
        """Compute the standard deviations of `field`.

        Each variance is the sum of that of the residual field (traction that the fits do not
        explain) and that of the fits.

        Args:
            values: Components (cubes, 15) in Pa and Pa/m that the last `update` was called with.
        """
        inverse = self._inverse
        residual = self._scaled - sum(fit.respond() for fit in self._fits)
        deviation = inverse.residual_deviation(residual, inverse.scaled(values))
        variance = np.stack(deviation, axis=1) ** 2 + fit_variances(inverse, self._fits)
        return FieldDeviation(*np.sqrt(variance).T)

    def _find_regions(self, pressure: Array, scaled: Array) -> list[_Region]:
        """Find the regions of the newest scan, and their fits among those of the previous scan.

        Args:
            pressure: Pressure (M,) in Pa at the depth of the cubes.
            scaled: Values (cubes, C) in Pa.
        """
        available = [fit for fit in self._fits if fit.values.is_valid(scaled)]
        found = self._pressure_regions.find(pressure)[:MAX_REGIONS]
        distances = self._region_distances(found)
        regions = []
        for number, points in enumerate(found):
            # The fit of a region is the one with which it has most points in common.
            overlaps = [np.isin(points, fit.points).sum() for fit in available]
            best = int(np.argmax(overlaps)) if overlaps else -1
            fit = available.pop(best) if overlaps and overlaps[best] > 0 else None
            near, others = self._choose_neighbours(found, number, distances[number])
            regions.append(_Region(points, float(pressure[points].max()), near, others, fit))
        return regions

    def _region_distances(self, found: list[Index]) -> Array:
        """Return the smallest distance (n, n) in m of the points of each pair of regions."""
        if not found:
            return np.zeros((0, 0))
        first = np.cumsum([0, *(len(one) for one in found[:-1])])
        points = self._inverse.points[np.concatenate(found)]
        rows = np.minimum.reduceat(cdist(points, points), first, axis=0)
        return np.asarray(np.minimum.reduceat(rows, first, axis=1))

    def _choose_neighbours(
        self, found: list[Index], number: int, distances: Array
    ) -> tuple[list[int], Index]:
        """Choose the regions that take part in the fit of one region.

        Args:
            found: Indices of the points of all regions.
            number: Index of the region in this list.
            distances: Distances (n,) of all regions from this one, in m.

        Returns:
            Indices of the other regions near this one, and their points that take part in the fit,
            at most `MAX_NEIGHBOUR_NODES`.
        """
        reach = NEIGHBOUR_REACH_PITCHES * self._inverse.pitch
        near = [k for k in np.flatnonzero(distances < reach).tolist() if k != number]
        # If there are too many points, only every second, third, ... of a region takes part.
        count = sum(len(found[k]) for k in near)
        step = -(-count // MAX_NEIGHBOUR_NODES) or 1
        return near, np.concatenate([np.zeros(0, np.intp), *(found[k][::step] for k in near)])

    def _without_others(self, region: _Region, regions: list[_Region]) -> Array:
        """Return the values (cubes, C) in Pa minus the response to regions outside of a fit."""
        rest = self._scaled
        for number, other in enumerate(regions):
            if other is not region and number not in region.near:
                rest = rest - other.response
        return rest

    def _update_fits(self, regions: list[_Region]) -> None:
        """Compute all fits for the newest values, minus the response to the other regions."""
        for region in regions:
            if region.fit is not None:
                region.fit.update(self._without_others(region, regions))
                self._update_response(region, regions)

    def _improve_fits(self, regions: list[_Region], pressure: Array, max_work: float) -> None:
        """Improve the fits of regions, the most urgent first, until the budget is spent.

        Args:
            regions: Regions, whose fits are changed.
            pressure: Pressure (M,) in Pa at the depth of the cubes.
            max_work: Work after which no further fit is improved.
        """
        spent = 0
        for _ in range(MAX_PIECES_OF_WORK * len(regions)):
            # Among equally urgent regions, the one that has waited longest comes first.
            order = [(self._next_work(one), -one.fit.waited if one.fit else 0) for one in regions]
            region = regions[min(range(len(regions)), key=order.__getitem__)]
            work = min(order)[0]
            if spent >= max_work or work == Work.NONE:
                break
            if region.fit is None or work == Work.FIT:
                region.fit = self._fit_region(region, regions, pressure)
                region.is_tried = True
                spent += 0 if region.fit is None else len(region.fit.nodes.places)
            else:
                spent += region.fit.improve()
            self._update_response(region, regions)

    def _update_response(self, region: _Region, regions: list[_Region]) -> None:
        """Set `response` of a region with a fit. With a single region, no other fit needs it."""
        if region.fit is not None and len(regions) > 1:
            region.response = region.fit.respond()

    def _next_work(self, region: _Region) -> Work:
        """Return the next step of the fit of a region of contact."""
        fit = region.fit
        if fit is None:
            return Work.NONE if region.is_tried else Work.FIT
        changes = (
            abs(region.peak / fit.peak - 1),
            _new_share(region.points, fit.points),
            _new_share(fit.points, region.points),
            # Neighbours that have gone do no harm. Half of the share of new ones counts, because
            # otherwise every neighbour that moves would cause new fits.
            _new_share(region.others, fit.others) / 2,
        )
        if max(changes) > (MAX_CHANGE if fit.hertz is None else MAX_CHANGE_HERTZ):
            return Work.FIT
        if fit.is_moving:
            return Work.MOVE
        if fit.misfit_growth > MAX_MISFIT_GROWTH:
            return Work.FIT
        return Work.NONE if fit.is_final else Work.SHARPEN

    def _fit_region(
        self, region: _Region, regions: list[_Region], pressure: Array
    ) -> RegionFit | None:
        """Make a new fit of the traction in one region of contact.

        Args:
            region: The region.
            regions: All regions.
            pressure: Pressure (M,) in Pa at the depth of the cubes.

        Returns:
            The fit; None if the region is too wide, or if no value around it is known.
        """
        inverse = self._inverse
        points = inverse.points[region.points]
        weights = pressure[region.points]
        distance = np.linalg.norm(points - weights @ points / weights.sum(), axis=1)
        home = int(inverse.cube[region.points[np.argmin(distance)]])
        normals = inverse.poses.rotation[:, :, 2]
        for reach in CUBE_REACH_PITCHES:
            found = self._above_cubes.query_ball_point(points, reach * inverse.pitch)
            cubes = np.unique(np.concatenate(found).astype(np.intp))
            cubes = cubes[normals[cubes] @ normals[home] > MIN_FACING]
            # The coarse nodes of other regions do not explain the values of the cubes below them.
            above = self._above_cubes.data[cubes]
            if len(region.others):
                to_others = cdist(above, inverse.points[region.others]).min(axis=1)
                cubes = cubes[cdist(above, points).min(axis=1) < to_others]
            if len(cubes) <= MAX_CUBES:
                break
        else:
            return None
        if not np.isfinite(self._scaled[cubes]).any():
            return None
        values = LocalValues(inverse, home, cubes, self._scaled)
        rest = self._without_others(region, regions)
        return RegionFit(inverse, region.points, region.others, region.peak, values, rest)

    def _integrate_field(
        self, regions: list[_Region], coarse: list[int], field: TractionField
    ) -> list[TrackedContact]:
        """Estimate contacts by integrals of the traction field over their regions of contact.

        Args:
            regions: All regions.
            coarse: Indices in `regions` of those whose contacts are to be estimated.
            field: Traction on the surface.
        """
        inverse = self._inverse
        # The field of a narrow contact spreads beyond its region. Each point within a pitch belongs
        # to the nearest region.
        tree = cKDTree(inverse.points[np.concatenate([one.points for one in regions])])
        numbers = np.repeat(np.arange(len(regions)), [len(one.points) for one in regions])
        distance, nearest = tree.query(inverse.points)
        owner = np.where(distance < inverse.pitch, numbers[nearest], -1)
        force = inverse.area * field.traction
        return [
            self._sum_points(np.flatnonzero(owner == number), force, len(regions[number].points))
            for number in coarse
        ]

    def _sum_points(self, own: Index, force: Array, count: int) -> TrackedContact:
        """Return the contact that consists of some points of the surface.

        Args:
            own: Indices (n,) of the points.
            force: Force (M, 3) in N on the square of each point, in the frame of its cube.
            count: Number of points with significant pressure.
        """
        inverse = self._inverse
        rotation = inverse.poses.rotation[inverse.cube[own]]
        pressing = -force[own, 2]
        normal_force = float(pressing.sum())
        divisor = max(normal_force, 1e-12)
        normal = pressing @ rotation[:, :, 2] / divisor
        normal /= max(np.linalg.norm(normal), 1e-12)
        shear = np.einsum("nij,nj->i", rotation[:, :, :2], force[own, :2])
        area = count * inverse.area
        deviation = COARSE_DEVIATION * abs(normal_force)
        return TrackedContact(
            id=-1,
            position=pressing @ inverse.points[own] / divisor,
            normal=normal,
            force=shear - normal * normal_force,
            normal_force=normal_force,
            shear_force=float(np.linalg.norm(shear)),
            moment=0.0,
            area=area,
            position_uncertainty=COARSE_DEVIATION * inverse.pitch,
            force_uncertainty=deviation,
            shear_uncertainty=deviation,
            moment_uncertainty=deviation * float(np.sqrt(area)),
            area_uncertainty=area,
            refined=False,
        )

    def _to_parent_frame(self, estimate: ContactEstimate, fit: RegionFit) -> TrackedContact:
        """Convert an estimate from the flattened skin to the skin's parent frame.

        Args:
            estimate: Force and position of the contact, with variances, on the flattened skin.
            fit: Fit of the region of the contact.
        """
        inverse = self._inverse
        around = fit.values
        nearest = int(np.argmin(np.linalg.norm(around.place - estimate.place, axis=1)))
        cosine = np.cos(around.angle[nearest])
        sine = np.sin(around.angle[nearest])
        to_cube = np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1.0]])
        cube = around.cubes[nearest]
        rotation = inverse.poses.rotation[cube]
        local = to_cube[:2, :2] @ (estimate.place - around.place[nearest])
        position = inverse.poses.position[cube] + rotation @ np.array([*local, inverse.depth])

        shear = float(np.linalg.norm(estimate.force[:2]))
        # The variance of the length of the shear force is the variance along its direction.
        direction = estimate.force[:2] / max(shear, 1e-300)
        shear_variance = direction @ estimate.force_covariance[:2, :2] @ direction
        return TrackedContact(
            id=-1,
            position=position,
            normal=rotation[:, 2].copy(),
            force=rotation @ to_cube @ estimate.force,
            normal_force=float(-estimate.force[2]),
            shear_force=shear,
            moment=estimate.moment,
            area=estimate.area,
            position_uncertainty=float(np.sqrt(estimate.place_variance.mean())),
            force_uncertainty=float(np.sqrt(estimate.force_covariance[2, 2])),
            shear_uncertainty=float(np.sqrt(shear_variance)),
            moment_uncertainty=float(np.sqrt(estimate.moment_variance)),
            area_uncertainty=float(np.sqrt(estimate.area_variance)),
            refined=True,
        )

    def _number_contacts(self, contacts: list[TrackedContact]) -> list[TrackedContact]:
        """Give each contact the id of the nearest contact of the previous scan, or a new one.

        Returns:
            The contacts with their ids, the one with the largest normal force first.
        """
        positions = np.array([one.position for one in contacts]).reshape(-1, 3)
        distance = cdist(positions, self._known)
        ids = [-1] * len(contacts)
        for flat in np.argsort(distance, axis=None).tolist():
            row, column = np.unravel_index(flat, distance.shape)
            if distance[row, column] > MATCH_PITCHES * self._inverse.pitch:
                break
            if ids[row] < 0 and self._ids[column] not in ids:
                ids[row] = self._ids[column]
        for row, number in enumerate(ids):
            if number < 0:
                ids[row] = self._next_id
                self._next_id += 1
        self._known, self._ids = positions, ids
        numbered = [one._replace(id=k) for one, k in zip(contacts, ids, strict=True)]
        return sorted(numbered, key=lambda contact: -contact.normal_force)


def _is_certain(estimate: ContactEstimate) -> bool:
    """Return whether an estimate is more exact than the integral of the field."""
    variance = estimate.force_covariance[2, 2]
    return bool(variance < (COARSE_DEVIATION * estimate.force[2]) ** 2)


def _new_share(new: Index, old: Index) -> float:
    """Return the share of the elements of one set that another set does not have."""
    return 1 - float(np.isin(new, old).mean()) if len(new) else 0.0
