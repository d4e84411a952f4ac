"""Traction on the whole surface of a skin from all of its cubes, and how sure it is.

What the cubes see of a traction t is linear (layer.py), y = H t + e. With the Gaussian prior of
kernels.py, of standard deviation AMPLITUDE, and noise N, the posterior of the traction is::

    t = G y,   G = K_ty P,   P = (K_yy + N)^-1,   covariance K_tt - G K_yt

Every cube has a window of its nearest cubes, which make the points on its patch: a matrix that is
computed once, so that a scan is one product. Windows that look alike share it. On a bent skin a
window is laid flat: distances from its middle are kept.

Values that are missing (D; R are the others around their cube) change no matrix. The estimate
without them is the one with what the others predict in their place::

    y_D = -P_DD^-1 P_DR y_R,      covariance + G_D P_DD^-1 G_D'

The prior's size follows the data. Variances are s^2 times those of AMPLITUDE, plus what noise and
gain errors of the pads make (their covariance M is in pad_noise.py)::

    s^2 = (y' P y - tr P M) / n,      diag G M G'

Source: C. E. Rasmussen, C. K. I. Williams, Gaussian Processes for Machine Learning (2006), 2.2, 5.4
and (leaving out) 5.4.2.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial import cKDTree

from ..core.defaults import POISSONS_RATIO, SURFACE_DEPTH
from ..core.errors import ElasticError
from ..core.modes import STRESS
from ..core.scene import CubePoses
from ..core.tensor import rotation_from_rpy
from .cache import cached
from .influence import Influence
from .kernels import Kernels, Reading
from .layer import Layer
from .pad_noise import GAIN_ERROR, noise_by_pad, pad_stresses
from .pad_reading import read_pads
from .surface import patches

Array = NDArray[np.float64]
Single = NDArray[np.float32]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

WINDOW, INNER = 25, 13
"""Cubes of a window: 5 x 5 of a square grid; and those next to its middle that tell how large the
prior is and predict what is missing in the middle: P of all 25 would be most of the memory."""
AMPLITUDE = 20e3
"""Prior standard deviation of the pressure, Pa: that of a firm touch."""
MODEL_ERROR = 0.01
"""Of every component over its size: what response, depth and noise of the load leave uncertain."""
_ROWS = 4
"""Of a point: the traction along x, y, z and the pressure at the cubes' depth."""
_SAME = 1e-6
"""Places (m) and angles (rad) closer than this are the same."""


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
        by_pad = noise_by_pad(skin.calibrations)
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
        reading: Reading | None = None,
    ) -> SurfaceInverse:
        """The same from poses and by_pad (cubes, 15, P), see `noise_by_pad`. reading: how the cubes
        see; by default as points."""
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
        reading: Reading | None,
    ) -> None:
        if side < 1:
            raise ElasticError(f"{side} points a side of a patch; it must be at least 1")
        self.poses, self.depth, self.pitch, self.side = poses, depth, poses.pitch, side
        scale = float(np.median(poses.half_side))
        self.kernels = Kernels(layer, depth, scale, reading)
        n = len(poses.position)
        self.reading = np.zeros(n, np.intp) if reading is None else reading.of_cube
        self.spacing = poses.pitch / side
        self.area = self.spacing**2
        flat = patches(poses, self.spacing, side)
        self.points = (flat + depth * poses.rotation[:, None, :, 2]).reshape(-1, 3)
        self.cube = np.repeat(np.arange(len(flat)), side**2)
        self._patch = square(self.spacing, side)
        observed = np.isfinite(by_pad.sum(axis=2))
        self.columns = np.flatnonzero(observed.any(axis=0))
        if not len(self.columns):
            raise ElasticError("no cube of the skin observes any component; check the calibrations")
        self._units = np.where(self.columns < len(STRESS), 1.0, scale)
        self.by_pad = by_pad[:, self.columns] * self._units[:, None]
        self.observed = observed[:, self.columns]
        self._windows = _Windows(self)
        self._known = self.observed
        self._missing = _Missing(self._windows, self.observed, self.observed)

    def scaled(self, values: Array) -> Array:
        """(cubes, C) in Pa of values (cubes, 15): only what some cube observes."""
        return np.asarray(values)[:, self.columns] * self._units

    def flattened(self, middle: int, cubes: Index) -> tuple[Array, Array]:
        """Places (n, 2) m of cubes laid flat about the middle one, in its frame, and the angle (n,)
        rad by which each is turned."""
        place, angle = _flattened(self.poses, np.array([middle]), cubes[None])
        return place[0], angle[0]

    def field(self, values: Array) -> TractionField:
        """The traction that the values (cubes, 15) tell, NaN where a component is not known.

        Values as in `StressRows`: Pa and Pa/m. Where no cube of a window is known, the traction
        is 0.
        """
        return self.field_of(self.scaled(values))

    def field_of(self, scaled: Array) -> TractionField:
        """The same of `scaled` values."""
        result = self._windows.product(self._filled(scaled))
        rows: Array = result.reshape(len(self.points), _ROWS).astype(np.float64)
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
        known = np.isfinite(scaled) & self.observed
        if not np.array_equal(known, self._known):
            self._known = known
            self._missing = _Missing(self._windows, self.observed, known)
        y = np.where(known, scaled, 0.0).astype(np.float32)
        return self._missing.filled(y)


class _Windows:
    """The matrices of all windows, each kind of window once.

    near: (cubes, W) cubes of each window, the inner ones first, its own cube the first of all
    inner: how many these are; kind: (cubes,) which matrix is its own
    gain: (kinds, rows, W C) float32; precision: (kinds, inner C, inner C) P of the inner cubes
    prior: (kinds, points x 2) variances of pressure and pressure below, at the size 1
    by_pad: (kinds, points x 2, W P) what the variance of each pad's noise makes of these
    of_size: (kinds, inner P) what it makes of the mean of y' P y
    """

    def __init__(self, inverse: SurfaceInverse) -> None:
        poses = inverse.poses
        self.near = _nearest(poses)
        self.inner = min(INNER, self.near.shape[1])
        middles = np.arange(len(self.near))
        place, angle = _flattened(poses, middles, self.near)
        self.pads = np.nan_to_num(inverse.by_pad)
        noise_kind = _distinct(np.nan_to_num(inverse.by_pad, nan=-1.0).reshape(len(middles), -1))
        looks = [place.reshape(len(middles), -1), np.cos(angle), np.sin(angle)]
        looks = [np.round(look / _SAME / 10) for look in looks]
        looks += [noise_kind[self.near], inverse.reading[self.near]]
        self.kind = _distinct(np.concatenate(looks, axis=1))
        kinds, first = np.unique(self.kind, return_index=True)

        def solve() -> dict[str, NDArray[Any]]:
            """The matrices of the kinds, each written in its place: together they may be large."""
            solved: dict[str, NDArray[Any]] = {}
            for number, one in enumerate(first):
                window = _solve(inverse, self.near[one], place[one], angle[one])._asdict()
                for name, array in window.items():
                    whole = solved.setdefault(
                        name, np.empty((len(first), *array.shape), array.dtype)
                    )
                    whole[number] = array
            return solved

        near = self.near[first]
        key: list[Any] = [*inverse.kernels.made_from, inverse.spacing, inverse.side]
        key += [inverse.columns, place[first], angle[first]]
        key += [inverse.by_pad[near], inverse.reading[near]]
        solved = cached("windows", key, solve)
        self.gain, self.precision = solved["gain"], solved["precision"]
        self.prior = solved["variance"]
        self.by_pad, self.of_size = solved["by_pad"], solved["of_size"]
        counts = np.bincount(self.kind)
        self._rows = [(kind, np.flatnonzero(self.kind == kind)) for kind in kinds]
        self._many = [(kind, rows) for kind, rows in self._rows if len(rows) > 1]
        self._single = np.flatnonzero(counts[self.kind] == 1)
        self._single_gain = self.gain[self.kind[self._single]]

    def product(self, y: Single) -> Single:
        """(cubes, rows) of values y (cubes, C) that are 0 where unknown."""
        gathered = y[self.near].reshape(len(self.near), -1)
        result = np.empty((len(self.near), self.gain.shape[1]), np.float32)
        for kind, rows in self._many:
            result[rows] = gathered[rows] @ self.gain[kind].T
        if len(self._single):
            single = gathered[self._single][:, :, None]
            result[self._single] = (self._single_gain @ single)[:, :, 0]
        return result

    def size(self, y: Single, of_pads: Single, known: Mask) -> Array:
        """(cubes,) s^2 of each window; 1 where nothing is known. of_pads: as in `noise`."""
        inner = self.near[:, : self.inner]
        gathered, pads = y[inner].reshape(len(inner), -1), of_pads[inner].reshape(len(inner), -1)
        square = np.empty(len(inner))
        for kind, rows in self._rows:
            own = gathered[rows]
            square[rows] = ((own @ self.precision[kind]) * own).sum(axis=1)
            square[rows] -= pads[rows] @ self.of_size[kind]
        count = known.sum(axis=1)[inner].sum(axis=1)
        return np.where(count > 0, np.maximum(square, 0) / np.maximum(count, 1), 1.0)

    def noise(self, of_pads: Single) -> Array:
        """(cubes, points x 2) by `by_pad`, of_pads (cubes, P): variances over their noise."""
        gathered = of_pads[self.near].reshape(len(self.near), -1)
        noise = np.empty((len(gathered), self.by_pad.shape[1]))
        for kind, rows in self._rows:
            noise[rows] = gathered[rows] @ self.by_pad[kind].T
        return noise


class _Missing:
    """What the inner cubes of a window predict where its own cube misses values.

    variance: (cubes, points x 2) what is added to the variances at the size 1

    Errors of the predictions of several cubes count as independent of each other.
    """

    def __init__(self, windows: _Windows, observed: Mask, known: Mask) -> None:
        missing = observed & ~known
        width = known.shape[1]
        self.variance = np.zeros((len(known), windows.prior.shape[1]))
        self._fill: list[tuple[int, Index, Index, Array]] = []
        self._noise: list[tuple[Index, Array, Index, Array]] = []
        for cube in np.flatnonzero(missing.any(axis=1)).tolist():
            near, kind = windows.near[cube, : windows.inner], windows.kind[cube]
            precision = windows.precision[kind].astype(float)
            out, own = missing[near].ravel(), np.flatnonzero(missing[cube])
            # Of the cube's own ones, the first ones of those that are out.
            some = np.eye(out.sum(), len(own))
            inside = cho_solve(cho_factor(precision[np.ix_(out, out)]), some)
            fill = -inside.T @ precision[out]
            fill[:, out] = 0.0
            rows, place = np.nonzero(windows.near == cube)
            columns = place[:, None] * width + own
            lost = windows.gain[windows.kind[rows][:, None], :, columns].astype(float)
            lost = _of_pressure(lost)
            self.variance[rows] += np.einsum("ncr,cd,ndr->nr", lost, inside[: len(own)], lost)
            if out.all():
                continue
            self._fill.append((cube, own, near, fill))
            pads = windows.pads[near]
            by_pad = np.einsum("fwc,wcp->fwp", fill.reshape(len(own), len(near), -1), pads)
            self._noise.append((near, by_pad.reshape(len(own), -1), rows, lost))

    def filled(self, y: Single) -> Single:
        """Values (cubes, C) that are 0 where they are missing, with what is predicted there."""
        filled = y.copy()
        for cube, own, near, fill in self._fill:
            filled[cube, own] = fill @ y[near].ravel()
        return filled

    def noise(self, of_pads: Single) -> Array:
        """(cubes, points x 2) as `_Windows.noise`, by the pads that the predictions are from."""
        total = np.zeros_like(self.variance)
        for near, by_pad, rows, lost in self._noise:
            covariance = (by_pad * of_pads[near].ravel()) @ by_pad.T
            total[rows] += np.einsum("ncr,cd,ndr->nr", lost, covariance, lost)
        return total


class _Window(NamedTuple):
    gain: Single
    precision: Single
    variance: Array
    by_pad: Single
    of_size: Single


def _solve(inverse: SurfaceInverse, cubes: Index, place: Array, angle: Array) -> _Window:
    """One window of cubes (W,), see `_Windows`."""
    kernels, columns = inverse.kernels, inverse.columns
    pads, reading = np.nan_to_num(inverse.by_pad[cubes]), inverse.reading[cubes]
    n, size = len(place), len(place) * len(columns)
    known = inverse.observed[cubes].ravel()
    prior = AMPLITUDE**2 * covariance_matrix(kernels, columns, place, angle, reading)
    total = prior.copy()
    for cube, own in enumerate(pads):
        part = slice(cube * len(columns), (cube + 1) * len(columns))
        total[part, part] += own @ own.T
    total[np.diag_indices(size)] += MODEL_ERROR**2 * np.diag(prior)
    points = inverse._patch
    offset = (place[:, None] - points[None]).reshape(-1, 2)
    turned, which = np.repeat(angle, len(points)), np.repeat(reading, len(points))
    cross = np.empty((len(points), _ROWS, n, len(columns)))
    of_traction = kernels.cross(offset, turned, which)[:, columns].reshape(n, len(points), -1, 3)
    cross[:, :3] = of_traction.transpose(1, 3, 0, 2)
    below = kernels.pressure(offset, turned, which)[:, columns].reshape(n, len(points), -1)
    cross[:, 3] = below.transpose(1, 0, 2)
    cross = AMPLITUDE**2 * cross.reshape(-1, size)[:, known]
    factor = cho_factor(total[np.ix_(known, known)])
    inside = cho_solve(factor, cross.T).T
    own = np.array([*kernels.variance, kernels.pressure_variance])
    variance = AMPLITUDE**2 * np.tile(own, len(points)) - (inside * cross).sum(axis=1)
    gain = np.zeros((len(inside), size), np.float32)
    gain[:, known] = inside
    rows = gain.reshape(-1, _ROWS, n, len(columns))[:, 2:].reshape(-1, n, len(columns))
    by_pad = np.einsum("rwc,wcp->rwp", rows, pads, optimize=True) ** 2
    inner = min(INNER, n)
    first = known[: inner * len(columns)]
    block = np.ix_(first, first)
    precision = np.zeros((len(first), len(first)))
    precision[block] = cho_solve(
        cho_factor(total[: len(first), : len(first)][block]), np.eye(first.sum())
    )
    one = np.arange(inner)
    own = precision.reshape(inner, len(columns), inner, len(columns))[one, :, one]
    of_size = np.einsum("wcp,wcd,wdp->wp", pads[:inner], own, pads[:inner], optimize=True)
    return _Window(
        gain,
        precision.astype(np.float32),
        np.maximum(_of_pressure(variance), 0),
        by_pad.reshape(len(rows), -1).astype(np.float32),
        of_size.ravel().astype(np.float32),
    )


def covariance_matrix(
    kernels: Kernels, columns: Index, place: Array, angle: Array, reading: Index
) -> Array:
    """(n C, n C) prior covariance of the components of cubes, for unit variance of the pressure."""
    n, width = len(place), len(columns)
    one, other = np.triu_indices(n)
    table = kernels.covariance(
        place[one] - place[other], angle[one], reading[one], angle[other], reading[other]
    )[:, columns][:, :, columns]
    matrix = np.empty((n, width, n, width))
    matrix[other, :, one] = table.swapaxes(1, 2)
    matrix[one, :, other] = table
    # A cube with itself is symmetric but for rounding.
    own = np.arange(n)
    matrix[own, :, own] = (table[one == other] + table[one == other].swapaxes(1, 2)) / 2
    return matrix.reshape(n * width, -1)


def positive(covariance: Array) -> Array:
    """The same with so much more variance of each component that all combinations have some. They
    lack it where cubes are so far apart that `Kernels` counts their covariance as zero."""
    for share in (1e-6, 1e-3, 1e-2, 1e-1):
        more = covariance + share * np.diag(np.diag(covariance))
        try:
            np.linalg.cholesky(more)
        except np.linalg.LinAlgError:
            continue
        break
    return more


def _of_pressure(rows: Array) -> Array:
    """(..., points x 2) of the rows (..., points x _ROWS) of windows: those of the pressure and of
    the pressure below."""
    chosen = rows.reshape(*rows.shape[:-1], -1, _ROWS)[..., 2:]
    return chosen.reshape(*rows.shape[:-1], -1)


def square(spacing: float, side: int) -> Array:
    """(side^2, 2) m: the points of a patch about its cube, in the order of surface.patches."""
    line = (np.arange(side) - (side - 1) / 2) * spacing
    x, y = np.meshgrid(line, line)
    return np.stack([x.ravel(), y.ravel()], axis=1)


def _nearest(poses: CubePoses) -> Index:
    """(cubes, W) the nearest cubes, the own one first; those equally far in a fixed order."""
    n = len(poses.position)
    count = min(WINDOW, n)
    wanted = min(3 * count, n)
    near = cKDTree(poses.position).query(poses.position, wanted)[1].reshape(n, -1)
    offset = np.einsum(
        "nji,nkj->nki", poses.rotation, poses.position[near] - poses.position[:, None]
    )
    offset = np.round(offset / poses.pitch, 4)
    distance = np.round(np.linalg.norm(offset, axis=2), 4)
    order = np.lexsort((offset[..., 1], offset[..., 0], distance))[:, :count]
    return np.take_along_axis(near, order, axis=1)


def _flattened(poses: CubePoses, middles: Index, near: Index) -> tuple[Array, Array]:
    """Places (n, W, 2) and angles (n, W) of near cubes (n, W) about middles (n,)."""
    rotation = poses.rotation[middles]
    apart = poses.position[near] - poses.position[middles][:, None]
    local = np.einsum("nji,nkj->nki", rotation, apart)
    distance, across = np.linalg.norm(local, axis=2), np.hypot(local[..., 0], local[..., 1])
    place = local[..., :2] * (distance / np.where(across > 0, across, 1.0))[..., None]
    relative = np.einsum("nji,nkjl->nkil", rotation, poses.rotation[near])
    sine = relative[..., 1, 0] - relative[..., 0, 1]
    angle = np.arctan2(sine, relative[..., 0, 0] + relative[..., 1, 1])
    return place, angle


def _distinct(rows: Array) -> Index:
    """(n,) number of each row among the different ones."""
    _, number = np.unique(rows, axis=0, return_inverse=True)
    return np.asarray(number).reshape(-1)
