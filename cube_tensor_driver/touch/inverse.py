"""Traction on the whole surface of a skin from all of its cubes, and how sure it is.

What the cubes see of a traction t is linear (layer.py), y = H t + e. windows.py has its posterior,
and missing.py what takes the place of values that are missing.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ..core.arrays import Array, Index, Single
from ..core.defaults import POISSONS_RATIO, SURFACE_DEPTH
from ..core.errors import ElasticError
from ..core.modes import STRESS
from ..core.poses import CubePoses
from ..core.tensor import rotation_from_rpy
from ..mechanics.influence import Influence
from ..mechanics.kernels import Kernels, MeasurementModel
from ..mechanics.layer import Layer
from .flattened import flattened
from .missing import Missing
from .pad_noise import GAIN_ERROR, noise_of_all_pads, pad_stresses
from .pad_reading import read_pads
from .surface import patches
from .windows import Observed, Windows


class TractionField(NamedTuple):
    """On the M points of the surface, in the frame of the point's cube.

    traction: (M, 3) Pa on the skin along x, y, z; pressing is negative along z
    below: (M,) Pa the pressure at the depth of the cubes
    """

    traction: Array
    below: Array

    @property
    def pressure(self) -> Array:
        """(M,) Pa on the surface."""
        return -self.traction[:, 2]


class FieldDeviation(NamedTuple):
    """Standard deviations of a TractionField: pressure (M,) and below (M,), Pa."""

    pressure: Array
    below: Array


class SurfaceInverse:
    """Traction on the surface of a skin from its stress rows; set up once for a skin.

    points: (M, 3) m on the surface in the parent frame, `side` x `side` on the patch of each cube
    cube: (M,) whose patch it is; poses: of the cubes; kernels: of the layer

    Parameters: skin: as `read_skin` gives it. depth: from the cubes' centres to the surface, m.
    thickness: of the elastomer over rigid ground, m; inf: a half space. poisson: of the elastomer.
    side: points along a side of a patch. influence: of the pads; then depth, thickness and poisson
    are theirs. None: cubes count as points. Raises ElasticError for what no layer is, where no cube
    observes anything, and for influence functions of other cubes.
    """

    def __init__(
        self,
        skin: Any,
        *,
        depth: float = SURFACE_DEPTH,
        thickness: float = np.inf,
        poisson: float = POISSONS_RATIO,
        side: int = 2,
        influence: Influence | None = None,
    ) -> None:
        poses = CubePoses(
            position=np.array([cube.xyz for cube in skin.cubes]),
            rotation=np.array([rotation_from_rpy(*cube.rpy) for cube in skin.cubes]),
            half_side=np.array([calibration.half_side for calibration in skin.calibrations]),
        )
        by_pad = noise_of_all_pads(skin.calibrations)
        layer, reading = Layer(thickness, poisson), None
        if influence is not None:
            layer, depth = influence.layer, influence.depth
            reading = read_pads(influence, skin.calibrations)
        self._set_up(poses, by_pad, layer, depth, side, reading)

    @classmethod
    def of_cubes(
        cls,
        poses: CubePoses,
        by_pad: Array,
        layer: Layer,
        depth: float,
        side: int = 2,
        reading: MeasurementModel | None = None,
    ) -> SurfaceInverse:
        """The same from poses and by_pad (cubes, 15, P), see `noise_of_all_pads`. reading: how the
        cubes see; by default as points."""
        inverse = cls.__new__(cls)
        inverse._set_up(poses, by_pad, layer, depth, side, reading)
        return inverse

    def _set_up(
        self,
        poses: CubePoses,
        by_pad: Array,
        layer: Layer,
        depth: float,
        side: int,
        reading: MeasurementModel | None,
    ) -> None:
        if side < 1:
            raise ElasticError(f"{side} points a side of a patch; it must be at least 1")
        self.poses, self.depth, self.pitch, self.side = poses, depth, poses.pitch, side
        scale = float(np.median(poses.half_side))
        self.kernels = Kernels(layer, depth, scale, reading)
        n = len(poses.position)
        self.reading = np.zeros(n, np.intp) if reading is None else reading.variant.copy()
        self.spacing = poses.pitch / side
        self.area = self.spacing**2
        flat = patches(poses, self.spacing, side)
        self.points = (flat + depth * poses.rotation[:, None, :, 2]).reshape(-1, 3)
        self.cube = np.repeat(np.arange(len(flat)), side**2)
        observed = np.isfinite(by_pad.sum(axis=2))
        self.columns = np.flatnonzero(observed.any(axis=0))
        if not len(self.columns):
            raise ElasticError("no cube of the skin observes any component; check the calibrations")
        self._units = np.where(self.columns < len(STRESS), 1.0, scale)
        self.by_pad = by_pad[:, self.columns] * self._units[:, None]
        self._all_pads = self.by_pad.copy()
        self._of_pads = None if reading is None else reading.pads
        self._kind = self.reading.copy()
        self._differs = np.zeros(n, bool)
        self.observed = observed[:, self.columns]
        seen = Observed(self.columns, self.observed, self._all_pads, self._kind)
        self._windows = Windows(self.kernels, poses, seen, self.spacing, side)
        self._known = self.observed
        self._missing = Missing(self._windows, self.observed, self.observed)

    def scaled(self, values: Array) -> Array:
        """(cubes, C) in Pa of values (cubes, 15): only what some cube observes."""
        return np.asarray(values)[:, self.columns] * self._units

    def flattened(self, middle: int, cubes: Index) -> tuple[Array, Array]:
        """Places (n, 2) m of cubes laid flat about the middle one, in its frame, and the angle (n,)
        rad by which each is turned."""
        place, angle = flattened(self.poses, np.array([middle]), cubes[None])
        return place[0], angle[0]

    def leave_out(self, cubes: Index, by_pad: Array) -> None:
        """From now on these cubes (n,) have other pads, by_pad (n, 15, P) as from `noise_by_pad`.

        Contacts take what such a cube says as it is. The field takes it so where cubes count as
        points: they say the same without some pads. Where their pads are known it does not, since
        its matrices are those of all pads: there the cube counts as missing.
        """
        self.by_pad[cubes] = by_pad[:, self.columns] * self._units[:, None]
        if self._of_pads is None:
            return
        for cube, own in zip(cubes.tolist(), by_pad, strict=True):
            said = self._of_pads[self._kind[cube]] @ np.nan_to_num(own).T
            self.reading[cube] = self.kernels.add_variant(said)
            here, whole = self.by_pad[cube], self._all_pads[cube]
            self._differs[cube] = not np.array_equal(here, whole, equal_nan=True)

    def field(self, values: Array) -> TractionField:
        """The traction that the values (cubes, 15) tell, NaN where a component is not known.

        Values as in `StressRows`: Pa and Pa/m. Where no cube of a window is known, the traction
        is 0.
        """
        return self.field_of(self.scaled(values))

    def field_of(self, scaled: Array) -> TractionField:
        """The same of `scaled` values."""
        result = self._windows.product(self._filled(scaled))
        rows: Array = result.reshape(len(self.points), -1).astype(np.float64)
        return TractionField(rows[:, :3], rows[:, 3])

    def deviation(self, values: Array) -> FieldDeviation:
        """How far the field of these values may be off. Takes several times as long as `field`."""
        scaled = self.scaled(values)
        return self.deviation_of(scaled, scaled)

    def deviation_of(self, left: Array, scaled: Array) -> FieldDeviation:
        """How far the field of what is left of `scaled` values may be off; all of these are on the
        pads whose gains are not quite known."""
        windows, y = self._windows, self._filled(left)
        stresses = pad_stresses(self.by_pad, self._known, scaled)
        whole = np.where(self._known.any(axis=1)[:, None], (GAIN_ERROR * stresses) ** 2 + 1, 0)
        of_pads = whole.astype(np.float32)
        square = windows.size(y, of_pads, self._known)[:, None]
        prior = windows.prior[windows.kind] + self._missing.variance
        variance = square * prior + windows.noise(of_pads) + self._missing.noise(of_pads)
        return FieldDeviation(*np.sqrt(variance).reshape(-1, 2).T)

    def _filled(self, scaled: Array) -> Single:
        """Values (cubes, C); where they are unknown, what the others predict."""
        known = np.isfinite(scaled) & self.observed & ~self._differs[:, None]
        if not np.array_equal(known, self._known):
            self._known = known
            self._missing = Missing(self._windows, self.observed, known)
        y = np.where(known, scaled, 0.0).astype(np.float32)
        return self._missing.filled(y)
