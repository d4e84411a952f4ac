"""The posterior of the surface's traction on the patch of each cube, from a window of cubes.

With the Gaussian prior of prior.py and noise N, values y tell the traction t::

    t = G y,   G = K_ty P,   P = (K_yy + N)^-1,   covariance K_tt - G K_yt

Every cube has a window of its nearest cubes, which make the points on its patch: a matrix that is
computed once, so that a scan is one product. Windows that look alike share it.

The prior's size follows the data. Variances are s^2 times those of AMPLITUDE, plus what noise and
gain errors of the pads make (their covariance M is in pad_noise.py)::

    s^2 = (y' P y - tr P M) / n,      diag G M G'

Source: C. E. Rasmussen, C. K. I. Williams, Gaussian Processes for Machine Learning (2006), 2.2 and
5.4.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial import cKDTree

from ..core.arrays import Array, Index, Mask, Single
from ..core.poses import CubePoses
from ..mechanics.cache import load_or_compute
from ..mechanics.kernels import Kernels
from .flattened import flattened
from .prior import AMPLITUDE, covariance_matrix
from .surface import square

WINDOW, INNER = 25, 13
"""Cubes of a window: 5 x 5 of a square grid; and those next to its middle that tell how large the
prior is and predict what is missing in the middle: P of all 25 would be most of the memory."""
MODEL_ERROR = 0.01
"""Of every component over its size: what response, depth and noise of the load leave uncertain."""
_ROWS = 4
"""Of a point: the traction along x, y, z and the pressure at the cubes' depth."""
_SAME = 1e-6
"""Places (m) and angles (rad) closer than this are the same."""


class Observed(NamedTuple):
    """What n cubes observe.

    columns: (C,) which of COMPONENTS some cube of the skin observes; known: (n, C) which each does
    by_pad: (n, C, P) as `noise_by_pad`, all in Pa; reading: (n,) as `MeasurementModel.variant`
    """

    columns: Index
    known: Mask
    by_pad: Array
    reading: Index

    def of(self, cubes: Index) -> Observed:
        """The same of some of the cubes; any shape of numbers of cubes becomes the leading axes."""
        return Observed(self.columns, self.known[cubes], self.by_pad[cubes], self.reading[cubes])


class Windows:
    """The matrices of all windows, each kind of window once.

    near: (cubes, W) cubes of each window, the inner ones first, its own cube the first of all
    inner: how many these are; kind: (cubes,) which matrix is its own
    gain: (kinds, rows, W C) float32; precision: (kinds, inner C, inner C) P of the inner cubes
    prior: (kinds, points x 2) variances of pressure and pressure below, at the size 1
    by_pad: (kinds, points x 2, W P) what the variance of each pad's noise makes of these
    of_size: (kinds, inner P) what it makes of the mean of y' P y
    """

    def __init__(
        self, kernels: Kernels, poses: CubePoses, observed: Observed, spacing: float, side: int
    ) -> None:
        """spacing, side: of the points on a cube's patch, m, and how many along its side."""
        self.near = _nearest(poses)
        self.inner = min(INNER, self.near.shape[1])
        middles = np.arange(len(self.near))
        place, angle = flattened(poses, middles, self.near)
        self.pads = np.nan_to_num(observed.by_pad)
        noise_kind = _distinct(np.nan_to_num(observed.by_pad, nan=-1.0).reshape(len(middles), -1))
        looks = [place.reshape(len(middles), -1), np.cos(angle), np.sin(angle)]
        looks = [np.round(look / _SAME / 10) for look in looks]
        looks += [noise_kind[self.near], observed.reading[self.near]]
        self.kind = _distinct(np.concatenate(looks, axis=1))
        points = square(spacing, side)
        kinds, first = np.unique(self.kind, return_index=True)

        def solve() -> dict[str, NDArray[Any]]:
            """The matrices of the kinds, each written in its place: together they may be large."""
            solved: dict[str, NDArray[Any]] = {}
            for number, one in enumerate(first):
                near = self.near[one]
                window = _solve(kernels, observed.of(near), place[one], angle[one], points)
                for name, array in window._asdict().items():
                    whole = solved.setdefault(
                        name, np.empty((len(first), *array.shape), array.dtype)
                    )
                    whole[number] = array
            return solved

        own = observed.of(self.near[first])
        key: list[Any] = [*kernels.inputs, spacing, side, place[first], angle[first]]
        key += [own.columns, own.by_pad, own.reading]
        solved = load_or_compute("windows", key, solve)
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


class _Window(NamedTuple):
    gain: Single
    precision: Single
    variance: Array
    by_pad: Single
    of_size: Single


def _solve(
    kernels: Kernels, observed: Observed, place: Array, angle: Array, points: Array
) -> _Window:
    """One window of cubes, see `Windows`: these at place (W, 2) m, turned by angle (W,) rad."""
    columns, reading = observed.columns, observed.reading
    pads, known = np.nan_to_num(observed.by_pad), observed.known.ravel()
    n, size = len(place), len(place) * len(columns)
    prior = AMPLITUDE**2 * covariance_matrix(kernels, columns, place, angle, reading)
    total = prior.copy()
    for cube, own in enumerate(pads):
        part = slice(cube * len(columns), (cube + 1) * len(columns))
        total[part, part] += own @ own.T
    total[np.diag_indices(size)] += MODEL_ERROR**2 * np.diag(prior)
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
        np.maximum(of_pressure(variance), 0),
        by_pad.reshape(len(rows), -1).astype(np.float32),
        of_size.ravel().astype(np.float32),
    )


def of_pressure(rows: Array) -> Array:
    """(..., points x 2) of the rows (..., points x _ROWS) of windows: those of the pressure and of
    the pressure below."""
    chosen = rows.reshape(*rows.shape[:-1], -1, _ROWS)[..., 2:]
    return chosen.reshape(*rows.shape[:-1], -1)


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


def _distinct(rows: Array) -> Index:
    """(n,) number of each row among the different ones."""
    _, number = np.unique(rows, axis=0, return_inverse=True)
    return np.asarray(number).reshape(-1)
