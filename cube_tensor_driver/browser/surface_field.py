# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Pressure and shear at the points of a skin that the page colours."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from ..core.arrays import Array, Index
from ..core.calibration import Calibration
from ..core.defaults import POISSONS_RATIO
from ..mechanics.layer import Layer
from ..touch.inverse import SurfaceInverse
from ..touch.pad_noise import compute_noise_of_all_pads
from ..touch.surface import Surface
from ..views.scene import QUANTITIES, Quantity

INTERPOLATION_POINTS = 4
"""Number of points with known pressure and shear from which the values at a point that the page
colours are interpolated: those nearest to it."""

DEVIATION = Quantity(
    label="standard deviation of pressure",
    unit="kPa",
    size=1e3,
    min_top=QUANTITIES["pressure"].min_top,
    signed=False,
    compute=lambda values, residual: np.full(len(values), np.nan),
)
"""The standard deviation of the pressure on the surface, as a quantity for colours.

Only the node `contacts` computes it, for points of the surface. From the values of the cubes alone
it is unknown, so that `of` returns NaN.
"""


class SurfaceField(NamedTuple):
    """Pressure and shear at the M points of a skin that the page colours, at one instant.

    Attributes:
        pressure: (M,) pressure in Pa; NaN where it is unknown.
        shear: (M,) magnitude of the shear traction in Pa; NaN where it is unknown.
        source: Text for the user about where the values are given and who computed them.
        sigma: (M,) standard deviation of the pressure, in Pa; None if it is unknown.
    """

    pressure: Array
    shear: Array
    source: str
    sigma: Array | None = None


class FieldModel:
    """Computes the field (pressure and shear on the surface) that the page shows.

    If the node `contacts` publishes the field, it is only interpolated to the points of the page.

    Otherwise the page solves the inverse problem of elasticity itself: from the values of the cubes
    to the traction on the surface of an elastomer of infinite thickness. Preparing this takes up to
    some seconds on a large skin. Until then, and if it is not possible, the field is interpolated
    between the cubes.

    Attributes:
        prepared: Future whose result is the solver of the inverse problem; a thread prepares it.
    """

    def __init__(
        self,
        surface: Surface,
        calibrations: Sequence[Calibration],
    ) -> None:
        """Begin to prepare the solver in another thread.

        Args:
            surface: Points at which the field is computed.
            calibrations: Calibration of each cube.
        """
        self._surface = surface
        # Points of the last interpolation, and its weights (see `_compute_interpolation_weights`).
        self._points: Array = np.empty((0, 3))
        self._nearest: Index = np.empty((0, 1), np.intp)
        self._weight: Array = np.empty((0, 1))
        worker = ThreadPoolExecutor(1)
        self.prepared: Future[SurfaceInverse] = worker.submit(
            _make_inverse,
            surface,
            calibrations,
        )
        # The thread ends when the preparation is done.
        worker.shutdown(wait=False)

    def compute(self, values: Array, cloud: Array | None) -> SurfaceField:
        """Compute the field at one instant.

        Args:
            values: (N, 15) values of the cubes, in Pa and Pa/m; NaN where unknown.
            cloud: Points (M, 6) of the topic `traction` at the same instant: position in m,
                pressure, shear and standard deviation of the pressure in Pa. None if the node
                `contacts` does not publish the topic.
        """
        if cloud is not None and len(cloud):
            points = cloud[:, :3]
            interpolated = self._interpolate(points, cloud[:, 3:])
            pressure, shear, sigma = interpolated.T
            return SurfaceField(
                pressure,
                shear,
                "on the surface, from the node contacts",
                sigma,
            )
        # If the preparation has failed, `result` would raise its error. The page then interpolates
        # between the cubes instead.
        if self.prepared.done() and self.prepared.exception() is None:
            inverse = self.prepared.result()
            traction = inverse.field(values).traction
            # The traction is a vector in the frame of the cube below the point; z points outwards.
            x, y, z = traction.T
            shear_size = np.hypot(x, y)
            columns = np.stack([-z, shear_size], axis=1)
            pressure, shear = self._interpolate(inverse.points, columns).T
            return SurfaceField(
                pressure,
                shear,
                "on the surface of a thick elastomer",
            )
        between = self._surface.field(values)
        # A shear component that is unknown (NaN) counts as 0 in the magnitude.
        shear = np.linalg.norm(np.nan_to_num(between.shear), axis=1)
        return SurfaceField(
            between.pressure,
            shear,
            "between the cubes, at their depth",
        )

    def _interpolate(self, points: Array, columns: Array) -> Array:
        """Interpolate C quantities to the N points of the surface, (N, C).

        The result is NaN where one of the nearest values is NaN.

        Args:
            points: Points (M, 3), in m, at which the quantities are known.
            columns: Values of the quantities at these points, (M, C).
        """
        # The points of a skin do not move, so the weights of the interpolation are computed once.
        if not np.array_equal(points, self._points):
            self._points = points
            self._nearest, self._weight = _compute_interpolation_weights(self._surface, points)
        nearest = columns[self._nearest]
        return np.asarray(np.einsum("pk,pkc->pc", self._weight, nearest))


def _make_inverse(
    surface: Surface,
    calibrations: Sequence[Calibration],
) -> SurfaceInverse:
    by_pad = compute_noise_of_all_pads(calibrations)
    layer = Layer(np.inf, POISSONS_RATIO)
    return SurfaceInverse.from_poses(
        surface.poses,
        by_pad,
        layer,
        surface.depth,
    )


def _compute_interpolation_weights(
    surface: Surface,
    points: Array,
) -> tuple[Index, Array]:
    """Return the weights of an interpolation to all N points of a surface.

    They are the inverse squared distances to the nearest `INTERPOLATION_POINTS` points (Shepard's
    method).

    Args:
        surface: The surface.
        points: (M, 3) points with known values, in m, in the parent frame of the skin.

    Returns:
        Indices (N, k) of the k nearest points with known values, and their weights (N, k).
    """
    n_nearest = min(INTERPOLATION_POINTS, len(points))
    shape = len(surface.points), n_nearest
    # `surface.points` lie in the plane of the cubes' centres, so they are moved up to the surface
    # by the depth of the cubes.
    up = surface.depth * surface.poses.rotation[surface.cube, :, 2]
    tree = cKDTree(points)
    distance, nearest = tree.query(surface.points + up, n_nearest)
    distance = distance.reshape(shape)
    # The lower limit of the distance avoids a division by zero where two points coincide.
    min_distance = 1e-3 * surface.spacing
    weight = 1 / np.maximum(distance, min_distance) ** 2
    total = weight.sum(axis=1, keepdims=True)
    return nearest.reshape(shape), weight / total
