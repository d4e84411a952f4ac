# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Inverse problem of a skin: the traction on its surface from the measured values of all cubes.

The measured values y depend linearly on the traction t (force per area on the surface) and have an
error e: y = H t + e, with the response H of the elastic layer (layer.py). posterior.py computes the
posterior of t, prediction.py replaces values that are missing.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..config.skin import Elastomer, Skin, as_skin
from ..core.arrays import Array, Index
from ..core.defaults import SURFACE_DEPTH
from ..core.errors import ElasticError
from ..core.modes import COMPONENTS, STRESS
from ..core.poses import CubePoses
from ..mechanics.contact_response import ContactResponse
from ..mechanics.influence import Influence
from ..mechanics.layer import Layer
from ..mechanics.measurement_model import CubeMeasurement, MeasurementModel
from ..mechanics.traction_prior import TractionPrior
from .pad_measurement import model_pads
from .pad_noise import GAIN_ERROR, compute_noise_of_all_pads, make_stress_matrices
from .posterior import WindowPosteriors
from .prediction import CubePrediction
from .surface import make_square_points, place_patches
from .unrolled_skin import unroll

MAX_PITCH_OF_FOUR_POINTS = 3.25
"""Largest pitch (distance of neighbouring cubes), in depths of the cubes' centres, at which the
traction is computed at 2 x 2 points of the surface around each cube. With a larger pitch there are
3 x 3 points, one of them above the cube. At a pitch of 4 depths, 2 x 2 points were not enough: a
ball that pressed with 0.3 N above a cube, between the four points, was not found."""

MIN_ERROR_CHANGE = 0.1
"""Smallest change of the errors that `SurfaceInverse.state_errors` sets (errors of the values other
than noise), divided by the largest of these errors. Smaller changes are ignored, because the noise
of all cubes must be computed again after each change."""


class TractionField(NamedTuple):
    """Traction (force per area) at M points of the surface of a skin.

    Attributes:
        traction: Traction (M, 3) in Pa on the skin along x, y and z of the cube below the point.
            The z component is negative where a body presses on the skin.
        depth_pressure: Pressure (M,) in Pa below each point, at the depth of the cubes.
    """

    traction: Array
    depth_pressure: Array

    def __repr__(self) -> str:
        largest_kpa = 1e-3 * abs(self.pressure.max(initial=0.0))
        return f"TractionField({len(self.traction)} points, pressure up to {largest_kpa:.3g} kPa)"

    @property
    def pressure(self) -> Array:
        """Pressure (M,) in Pa on the surface at the M points, positive where a body presses."""
        return -self.traction[:, 2]


class FieldDeviation(NamedTuple):
    """Standard deviations of a `TractionField`.

    Attributes:
        pressure: Standard deviation (M,) of the pressure on the surface, in Pa.
        depth_pressure: Standard deviation (M,) of the pressure at the depth of the cubes, in Pa.
    """

    pressure: Array
    depth_pressure: Array


class SurfaceInverse:
    """Computes the traction on the surface of a skin from the values that its cubes measure.

    Attributes:
        poses: Poses of the cubes.
        depth: Distance from the centres of the cubes to the surface, in m.
        pitch: Typical distance of neighbouring cubes, in m.
        points: Positions (M, 3) of the points on the surface in the parent frame, in m: `side` x
            `side` on the patch of each cube.
        cube: Index (M,) of the cube on whose patch a point lies.
        spacing: Distance of neighbouring points, in m.
        area: Area of the square that each point represents in integrals, in m^2.
        layer: Elastic layer that contains the cubes.
        contact_response: Components that cubes measure under Hertz contacts.
        columns: Indices (C,) in `COMPONENTS` of the components that some cube observes.
        observed: Whether each cube observes each of these components (cubes, C) if it uses all of
            its pads.
        by_pad: Change (cubes, C, P) of each component, in Pa, for one standard deviation of the
            noise of each pad, with the pads in use.
        variant: Index (cubes,) of each cube's variant (calibration and pads in use) in the
            measurement model.
        near: Indices (cubes, W) of the cubes nearest to each cube, which itself comes first.
        errors: Errors (cubes, C, K) of the values other than noise, in Pa: one standard deviation
            of the effect of each of K independent causes.
        revision: Number that increases when `leave_out` changes the pads in use, or `state_errors`
            the errors.
    """

    def __init__(
        self,
        skin: Skin | str | Path,
        *,
        depth: float | None = None,
        thickness: float | None = None,
        poisson: float | None = None,
        side: int | None = None,
        influence: Influence | None = None,
    ) -> None:
        """Set up the matrices. The first time takes about a second, later ones load from the cache.

        Args:
            skin: Skin as from `read_skin`, or the path of a skin file.
            depth: Distance from the centres of the cubes to the surface, in m. None: that of the
                skin file, or else `SURFACE_DEPTH`.
            thickness: Thickness of the elastomer on rigid ground, in m; infinite for a half space.
                None: that of the skin file, or else infinite.
            poisson: Poisson's ratio of the elastomer. None: that of the skin file, or else
                0.48.
            side: Number of points along a side of the patch (square grid of points) of each cube.
                None: 2 or 3, depending on the pitch (`MAX_PITCH_OF_FOUR_POINTS`).
            influence: Influence functions (stress of each pad under a force of 1 N, by the force's
                position), whose depth, thickness and Poisson's ratio replace those given here.
                None: cubes are modelled as points.

        Raises:
            ElasticError: The layer is impossible, no cube observes any component, or the influence
                functions belong to other cubes.
        """
        skin = as_skin(skin)
        by_pad = compute_noise_of_all_pads(skin.calibrations)
        elastomer = skin.elastomer or Elastomer(SURFACE_DEPTH, np.inf)
        depth = elastomer.depth if depth is None else depth
        layer = Layer(
            elastomer.thickness if thickness is None else thickness,
            elastomer.poisson if poisson is None else poisson,
        )
        model = None
        if influence is not None:
            layer = influence.layer
            depth = influence.depth
            model = model_pads(influence, skin.calibrations)
        self._set_up(
            skin.poses,
            by_pad,
            layer,
            depth,
            side,
            model,
        )

    @classmethod
    def from_poses(
        cls,
        poses: CubePoses,
        by_pad: Array,
        layer: Layer,
        depth: float,
        side: int | None = None,
        model: MeasurementModel | None = None,
    ) -> SurfaceInverse:
        """Create a `SurfaceInverse` from the cubes' poses and noise, without a skin file.

        Args:
            poses: Poses of the cubes.
            by_pad: Noise matrices (cubes, 15, P) as from `compute_noise_of_all_pads`.
            layer: Elastic layer that contains the cubes.
            depth: Distance from the centres of the cubes to the surface, in m.
            side: Number of points along a side of the patch of each cube, as for `SurfaceInverse`.
            model: Measurement model of the cubes as from `model_pads`; None: they are modelled as
                points.
        """
        inverse = cls.__new__(cls)
        inverse._set_up(
            poses,
            by_pad,
            layer,
            depth,
            side,
            model,
        )
        return inverse

    def __repr__(self) -> str:
        points = f"{len(self.points)} points {1e3 * self.spacing:.3g} mm apart"
        return f"SurfaceInverse({self.poses!r}, {points}, depth {1e3 * self.depth:.3g} mm)"

    def _set_up(
        self,
        poses: CubePoses,
        by_pad: Array,
        layer: Layer,
        depth: float,
        side: int | None,
        model: MeasurementModel | None,
    ) -> None:
        """Compute the points on the surface and all matrices; arguments as in `from_poses`.

        Raises:
            ElasticError: `side` is below 1, the layer does not contain the depth, or no cube
                observes any component.
        """
        if side is None:
            side = 2 if poses.pitch <= MAX_PITCH_OF_FOUR_POINTS * depth else 3
        if side < 1:
            raise ElasticError(f"{side} points a side of a patch; it must be at least 1")
        n = len(poses.position)
        self.revision = 0
        self._unrolled: dict[int, tuple[Array, Array]] = {}
        self.poses = poses
        self.depth = depth
        self.pitch = poses.pitch
        scale = float(np.median(poses.half_side))
        self.layer = layer
        self._cubes = CubeMeasurement(layer, depth, scale, model)
        self.contact_response = ContactResponse(self._cubes)

        self.spacing = self.pitch / side
        self.area = self.spacing**2
        above = depth * poses.rotation[:, None, :, 2]
        points = place_patches(poses, self.spacing, side) + above
        self.points = points.reshape(-1, 3)
        self.cube = np.repeat(np.arange(n), side**2)

        observed = np.isfinite(by_pad.sum(axis=2))
        self.columns = np.flatnonzero(observed.any(axis=0))
        if not len(self.columns):
            raise ElasticError("no cube of the skin observes any component; check the calibrations")
        self.observed = observed[:, self.columns]
        # Gradients times half the side of a cube are in Pa, too, so that all components are
        # comparable.
        is_stress = self.columns < len(STRESS)
        self._unit_factors = np.where(is_stress, 1.0, scale)
        self.by_pad = by_pad[:, self.columns] * self._unit_factors[:, None]

        # A cube gets another variant in the measurement model while some of its pads are left out.
        self._model = model
        self.variant = np.zeros(n, np.intp) if model is None else model.variant.copy()
        self._usable = self.observed

        self._windows = WindowPosteriors(
            TractionPrior(self._cubes),
            poses,
            self.columns,
            self.by_pad,
            self.variant,
            make_square_points(self.spacing, side),
        )
        self.near = self._windows.near
        self._pressure_gain = self._windows.matrices.gain[:, :, 3].copy()
        self._known = self.observed
        self._predictions: list[CubePrediction] = []
        self._to_pads: Array | None = None
        self.errors = np.zeros((n, len(self.columns), 0))
        self._error_variance = np.zeros((len(self.points), 2))

    def scale_values(self, values: Array) -> Array:
        """Select the components that some cube of the skin observes, and convert them to Pa.

        Args:
            values: Components (cubes, 15), stresses in Pa and gradients in Pa/m.

        Returns:
            The C components `columns` (cubes, C) in Pa; gradients are multiplied by half the side
            of a cube.
        """
        return self.select(np.asarray(values)) * self._unit_factors

    def select(self, components: Array) -> Array:
        """Return the C components `columns` (..., C) of all 15 components (..., 15). If C is 15,
        the argument itself is returned, not a copy."""
        if len(self.columns) == components.shape[-1]:
            return components
        return np.asarray(components[..., self.columns])

    def unroll(self, centre: int, cubes: Index | slice) -> tuple[Array, Array]:
        """Lay cubes of a bent skin flat around one cube, from which they keep their distance.

        Args:
            centre: Index of the cube in whose x-y plane the others are laid.
            cubes: Indices (n,) of the cubes to be laid flat.

        Returns:
            Positions (n, 2) in m and rotations (n,) about z in rad of these cubes, in the frame of
            the centre cube.
        """
        # The whole skin is laid flat at once, and the result is kept: contacts stay near few cubes,
        # so the same cubes are the centre again and again.
        if centre not in self._unrolled:
            everything = np.arange(len(self.poses.position))
            self._unrolled[centre] = unroll(
                self.poses,
                np.array([centre]),
                everything[None],
            )
        place, angle = self._unrolled[centre]
        return place[0, cubes], angle[0, cubes]

    def leave_out(self, cubes: Index, by_pad: Array) -> None:
        """Change the pads that cubes use, for example because some pads are broken.

        The contact tracker uses the components of a cube with pads left out like those of other
        cubes. `field` uses them only if cubes are modelled as points, because the response of
        points does not depend on the pads. With influence functions, the response depends on the
        pads in use, but the matrices of `field` are computed for all pads. `field` then treats the
        values of a cube with pads left out as missing.

        Args:
            cubes: Indices (n,) of the cubes.
            by_pad: Noise matrices (n, 15, P) as from `compute_noise_by_pad`, with the pads in use.
        """
        self.revision += 1
        self.by_pad[cubes] = by_pad[:, self.columns] * self._unit_factors[:, None]
        self._to_pads = None
        if self._model is None:
            return
        for cube, own in zip(cubes.tolist(), by_pad, strict=True):
            pads = self._model.pads[self._model.variant[cube]]
            self.variant[cube] = self._cubes.add_variant(pads @ np.nan_to_num(own).T)
        has_all_pads = self.variant == self._model.variant
        self._usable = self.observed & has_all_pads[:, None]

    def state_errors(self, errors: Array | None) -> None:
        """Set the errors of the values other than noise, such as those of the compensation.

        They increase the stated deviations of the traction field, but do not change the field.
        Errors that differ little from those in use (`MIN_ERROR_CHANGE`) are ignored.

        Args:
            errors: Errors (cubes, 15, K) in Pa and Pa/m, as from `Reconstructor.errors`: one
                standard deviation of the effect of each of K independent causes. None: no errors.
        """
        if errors is None:
            errors = np.zeros((len(self.observed), len(COMPONENTS), 0))
        scaled = np.nan_to_num(errors[:, self.columns] * self._unit_factors[:, None])
        if scaled.shape == self.errors.shape:
            limit = MIN_ERROR_CHANGE * np.abs(scaled).max(initial=0.0)
            if np.abs(scaled - self.errors).max(initial=0.0) <= limit:
                return
        self.errors = scaled
        self.revision += 1
        # Each cause changes the values of all cubes together, so its effect on the field is that of
        # all these changes at once. The causes are independent, so their variances add up.
        self._error_variance = np.zeros((len(self.points), 2))
        for column in np.moveaxis(scaled, 2, 0):
            field = self.compute_field_of_scaled(np.where(self._known, column, np.nan))
            self._error_variance += np.stack([field.pressure, field.depth_pressure], axis=1) ** 2

    @property
    def error_deviation(self) -> Array:
        """Standard deviation (M,) of the pressure at the depth of the cubes, in Pa, that the errors
        set by `state_errors` cause."""
        return np.sqrt(self._error_variance[:, 1])

    def field(self, values: Array) -> TractionField:
        """Compute the traction that explains the values of all cubes.

        Args:
            values: Components (cubes, 15) as in `StressRows`, in Pa and Pa/m, NaN where unknown.

        Returns:
            Traction at all points; 0 at points for which none of the `WINDOW_CUBES` nearest cubes
            has a value.
        """
        return self.compute_field_of_scaled(self.scale_values(values))

    def compute_field_of_scaled(self, scaled: Array) -> TractionField:
        """Compute the traction that explains values in Pa.

        Args:
            scaled: Values (cubes, C) in Pa as from `scale_values`, NaN where unknown.

        Returns:
            Traction at all points, as from `field`.
        """
        gain = self._windows.matrices.gain
        rows = self._windows.multiply(gain, self._fill(scaled)).reshape(-1, gain.shape[2])
        return TractionField(rows[:, :3], rows[:, 3])

    def compute_depth_pressure_of_scaled(self, scaled: Array) -> Array:
        """Return only `depth_pressure` (M,) of `compute_field_of_scaled`, which is faster."""
        return self._windows.multiply(self._pressure_gain, self._fill(scaled)).ravel()

    def deviation(self, values: Array) -> FieldDeviation:
        """Compute the standard deviations of the traction field that `field` returns.

        This takes several times as long as `field`.

        Args:
            values: Components (cubes, 15) in Pa and Pa/m, NaN where unknown, as for `field`.
        """
        scaled = self.scale_values(values)
        return self.compute_residual_deviation(scaled, scaled)

    def compute_residual_deviation(
        self,
        residual: Array,
        scaled: Array,
    ) -> FieldDeviation:
        """Compute the standard deviations of the field that is computed from a residual.

        Args:
            residual: Values (cubes, C) in Pa minus the response of the cubes to the contacts that
                the contact tracker has fitted.
            scaled: Values (cubes, C) in Pa as from `scale_values`. Errors of the pads' gains are
                proportional to them.
        """
        y = self._fill(residual)
        known = self._known
        # These matrices take most of the time and rarely change, so they are kept.
        if self._to_pads is None:
            self._to_pads = make_stress_matrices(self.by_pad, known)
        # `pad_variance` is the variance of each pad's error, divided by the variance of its noise:
        # 1 for the noise itself, plus the variance that the error of the pad's gain causes. A cube
        # without known values contributes no noise to the field.
        stresses = self._to_pads @ np.where(known, scaled, 0.0)[:, :, None]
        pad_variance = 1 + (GAIN_ERROR * stresses[:, :, 0]) ** 2
        pad_variance *= known.any(axis=1, keepdims=True)

        windows = self._windows
        scale = windows.compute_scale(y, pad_variance, known)
        variance = windows.multiply(windows.matrices.by_pad, pad_variance)
        variance += scale[:, None, None] * windows.matrices.variance[windows.kind]
        for prediction in self._predictions:
            prediction.add_variance(variance, scale, pad_variance)
        deviation = np.sqrt(variance.reshape(-1, 2) + self._error_variance)
        return FieldDeviation(*deviation.T)

    def _fill(self, scaled: Array) -> Array:
        """Replace missing values by predictions from the neighbouring cubes.

        Args:
            scaled: Values (cubes, C) in Pa, NaN where missing.

        Returns:
            Values (cubes, C) in Pa without NaN.
        """
        known = np.isfinite(scaled) & self._usable
        # The predictions depend only on which values are known, which rarely changes from scan to
        # scan.
        if not np.array_equal(known, self._known):
            self._known = known
            self._to_pads = None
            missing = self.observed & ~known
            incomplete = np.flatnonzero(missing.any(axis=1)).tolist()
            self._predictions = [
                CubePrediction(self._windows, missing, cube) for cube in incomplete
            ]
        y = np.where(known, scaled, 0.0)
        for prediction in self._predictions:
            prediction.fill(y)
        return y
