# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Connected regions of significant pressure on a skin, and the parts of a region that are contacts.

The pressure is that at the depth of the cubes' centres, below the points of the surface.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from ...core.arrays import Array, Index, Mask
from ..inverse import SurfaceInverse

DETECTION_FRACTION = 0.2
"""Pressure (at the depth of the cubes' centres) above which a point of the surface belongs to a
contact, divided by the largest pressure on the skin. The pressure must also exceed an absolute
threshold."""

RELEASE_FRACTION = 0.75
"""Thresholds of the pressure (relative and absolute) for points that belonged to a contact in the
previous scan (set of values of all cubes), divided by the thresholds for other points. This
hysteresis keeps noise from changing the regions of contact in every scan."""

JOIN_PITCHES = 1.25
"""Largest distance of two regions of contact, divided by the pitch (distance of neighbouring
cubes), at which they are fitted as one region, because the same cubes measure both."""

MAX_JOINED_CUBES = 12
"""Largest number of cubes below regions of contact that are joined to one. Regions above more cubes
stay separate, so that each one is small enough to be fitted."""

VALLEY = 0.8
"""Ratio of the lowest pressure between two peaks to the pressure at the lower peak, below which the
two peaks are two contacts, if the fall of the pressure is also significant (`MIN_FALL`)."""

MIN_FALL = 4.0
"""Smallest fall of the pressure from the lower one of two peaks to the lowest pressure between
them, in units of the standard deviation of this fall, at which the peaks are two contacts."""

MIN_PEAK = 0.2
"""Smallest pressure at a peak that counts as a contact of its own, divided by the largest pressure
in the same region of contact."""


class PressureRegions:
    """Finds connected regions of significant pressure in every scan (set of values of all
    cubes)."""

    def __init__(self, inverse: SurfaceInverse, min_pressure: float) -> None:
        """Find the neighbours of all points.

        Args:
            inverse: Points of the surface.
            min_pressure: Smallest pressure of a contact at the depth of the cubes, in Pa.
        """
        self._min_pressure = min_pressure
        # Diagonal neighbours on the grid of points are 1.41 spacings apart.
        tree = cKDTree(inverse.points)
        self._neighbours = _list_neighbours(tree, 1.5 * inverse.spacing)
        self._wide_neighbours = _list_neighbours(tree, JOIN_PITCHES * inverse.pitch)
        self._cube = inverse.cube
        self._inside = np.zeros(len(inverse.points), bool)
        self._regions: list[Index] = []

    def find(
        self,
        pressure: Array,
        certain: Array | None = None,
    ) -> list[tuple[Index, float]]:
        """Find the regions in the newest scan.

        Args:
            pressure: Pressure (M,) in Pa at the depth of the cubes, below all points.
            certain: Pressure (M,) in Pa that the pressure below each point of a new region must
                exceed, because errors of the values may cause smaller ones; None: 0 at all points.

        Returns:
            Indices of the points of each region and their largest pressure in Pa, the region with
            the largest pressure first.
        """
        largest = float(pressure.max(initial=0.0))
        smallest = max(self._min_pressure, DETECTION_FRACTION * largest)
        threshold = np.maximum(smallest, 0.0 if certain is None else certain)
        release = RELEASE_FRACTION * threshold
        before = self._inside
        limits = np.where(before, release, threshold)
        self._inside = pressure > limits
        if not np.array_equal(self._inside, before):
            self._regions = self._connect_points()
        peaks = [float(pressure.take(region).max()) for region in self._regions]
        found = zip(self._regions, peaks, strict=True)
        return sorted(found, key=lambda pair: -pair[1])

    def find_around(self, points: Index) -> Index:
        """Return the indices of some points, and of all points within `JOIN_PITCHES` of them."""
        around = np.unique(self._wide_neighbours[points])
        return np.asarray(around[around < len(self._inside)])

    def _connect_points(self) -> list[Index]:
        """Return the indices of the points of each region, without an order of the regions.

        Regions within `JOIN_PITCHES` of each other are joined, unless they then lie above more than
        `MAX_JOINED_CUBES` cubes.
        """
        inside = np.flatnonzero(self._inside)
        wide = self._label(inside, self._wide_neighbours)
        regions = []
        for label in np.unique(wide):
            own = inside[wide == label]
            cubes = set(self._cube[own].tolist())
            if len(cubes) <= MAX_JOINED_CUBES:
                regions.append(own)
                continue
            narrow = self._label(own, self._neighbours)
            for narrow_label in np.unique(narrow):
                regions.append(own[narrow == narrow_label])
        return regions

    def _label(self, points: Index, neighbours: Index) -> Index:
        """Return the number (n,) of the connected component of each of n points.

        Args:
            points: Indices (n,) of the points.
            neighbours: Indices (M, k) of the points to which each point is connected.
        """
        # At first, the label of a point is its own index. Then each point takes the smallest label
        # of its neighbours, until no label changes.
        outside = len(self._inside)
        labels = np.full(outside + 1, outside)
        labels[points] = points
        around = neighbours[points]
        while True:
            smallest = labels[around].min(axis=1)
            # A label is the index of a point of the same component, whose own label may already be
            # smaller. Taking that one saves iterations.
            smallest = labels[smallest]
            if np.array_equal(smallest, labels[points]):
                return np.asarray(smallest)
            labels[points] = smallest


def _list_neighbours(tree: cKDTree, distance: float) -> Index:
    """Return the indices (M, k) of the points within a distance of each point, itself included.

    Missing neighbours have the index M.
    """
    found = tree.query_ball_point(tree.data, distance)
    n = len(found)
    width = max(map(len, found))
    rows = np.full((n, width), n, np.intp)
    for row, neighbours in zip(rows, found, strict=True):
        row[: len(neighbours)] = neighbours
    return rows


def split_peaks(pressure: Array, covariance: Array, is_neighbour: Mask) -> Index:
    """Assign the grid points of a region to peaks of the pressure that are separated by valleys.

    Grid points are the centres of grid contacts (grid_fit.py). `VALLEY`, `MIN_FALL` and `MIN_PEAK`
    define what a peak is.

    Args:
        pressure: Pressure (q,) at the grid points, in any unit.
        covariance: Covariance (q, q) of these pressures, in the squared unit of the pressure.
        is_neighbour: Whether two grid points are neighbours (q, q).

    Returns:
        Number (q,) of the peak of each grid point, from 0 on, the highest peak first.
    """
    # The loop works on lists, because numpy takes long for the few neighbours of one point.
    n = len(pressure)
    owner = [-1] * n
    peaks: list[int] = []
    limit = MIN_PEAK * float(pressure.max())
    neighbours: list[list[int]] = [[] for _ in range(n)]
    for point, other in np.argwhere(is_neighbour).tolist():
        neighbours[point].append(other)
    # Grid points are assigned in the order of falling pressure, each one to the peak of its
    # neighbours. A grid point with neighbours of two peaks is the saddle point between these peaks.
    for point in np.argsort(-pressure).tolist():
        around = sorted({owner[other] for other in neighbours[point]} - {-1})
        if not around:
            if pressure[point] < limit and peaks:
                continue
            around = [len(peaks)]
            peaks.append(point)
        first = around[0]
        owner[point] = first
        for other in around[1:]:
            peak = peaks[other]
            fall = pressure[peak] - pressure[point]
            variances = covariance[peak, peak] + covariance[point, point]
            variance = variances - 2 * covariance[peak, point]
            relative_limit = (1 - VALLEY) * pressure[peak]
            significant_fall = MIN_FALL * np.sqrt(max(variance, 0.0))
            if fall < max(relative_limit, significant_fall):
                owner = [first if one == other else one for one in owner]
    # Points without an owner have too little pressure for a peak of their own, and had no neighbour
    # that belongs to a peak. They are assigned to the highest peak.
    _, consecutive = np.unique(np.maximum(owner, 0), return_inverse=True)
    return np.asarray(consecutive.reshape(-1))
