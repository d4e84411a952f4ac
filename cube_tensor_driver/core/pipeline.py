"""Pipeline: frequencies of many cubes in, stress and gradients out, without a loop over rows or
cubes.

One table per calibration holds a stacked matrix: 15 rows that give the components, then the
whitened null-space rows of the residual. Rows with all pads good are one pad law and one matrix
product per calibration. Rows with bad pads are done again with the estimator of their mask, one
product per distinct (calibration, mask). Nothing a row holds raises an error. A row's bits do not
depend on how many batches are processed with it: products are made batch by batch, because the last
bit of a matrix product may depend on its shape.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from .calibration import Calibration
from .column import Columns, turns
from .errors import CalibrationError, CubeError, LayoutError
from .estimator import FALSE_ALARM, Estimator, chi2_limit, make_estimator
from .modes import COMPONENTS, STRESS
from .oscillator import highest_frequency
from .status import INVALID, PAD_FAULT, RESIDUAL, TEMPERATURE

N = len(COMPONENTS)
MASKS_KEPT = 1024  # estimators of pad masks remembered at a time
BETA_FLOOR = (
    1e-12  # so that every pad has a highest frequency; changes the law by 1e-12 of a strain
)
FLOOR_MARGIN = 1e-6  # some roundings of float32
FEW_KINDS = (
    8  # up to so many calibrations: a product for each; more: one einsum for all of as many pads
)


class StressRows(NamedTuple):
    """One row per sample. Components that are not observed are NaN.

    stress: (N, 6) Pa, tension positive, order xx yy zz yz zx xy, in the cube's frame
    gradient: (N, 9) Pa/m, rows xx yy zz, columns d/dx d/dy d/dz
    residual: (N,) sqrt(chi-square / degrees of freedom), about 1 for noise alone; NaN without
    redundancy
    status: (N,) uint16 of the bits above; observed: (N,) uint16, bit i for component i of
    COMPONENTS
    """

    stress: np.ndarray
    gradient: np.ndarray
    residual: np.ndarray
    status: np.ndarray
    observed: np.ndarray


class _Table(NamedTuple):
    """An estimator laid out for rows: (15 + D, P) matrix on v / stiffness, scaled residual rows."""

    matrix: np.ndarray
    limit: float  # of the residual
    observed: int


class _Block(NamedTuple):
    """Rows of a column that share a product. matrix: (pads, 15 + D), or (pads, seen, rows) of many
    calibrations."""

    rows: slice | np.ndarray
    pads: int
    matrix: np.ndarray


class _Column(NamedTuple):
    """What depends on the cube column alone."""

    strange: np.ndarray  # (N,) bool: the index is none of our cubes
    kind: np.ndarray  # (N,) which calibration
    rest: np.ndarray  # (N, P)
    top: np.ndarray  # (N, P) highest frequency of the law
    floor: float  # v that f = 0 gives, of the row where it is highest
    pads: int  # how many pads there are in all rows
    blocks: list[_Block]
    limit: np.ndarray  # (N,)
    observed: np.ndarray


class Pipeline:
    """process() for cubes 0 .. len(calibrations) - 1; layouts may differ, columns fill up to the
    widest."""

    def __init__(self, calibrations: Sequence[Calibration], dtype=np.float64) -> None:
        self.dtype = np.dtype(dtype)
        if self.dtype not in (np.float32, np.float64):
            raise CubeError(f"pipeline: dtype {self.dtype}; use float32 or float64")
        if not calibrations:
            raise CalibrationError("pipeline: no calibrations; give one per cube")
        self.calibrations = tuple(calibrations)
        self.n_pads = max(c.layout.n_pads for c in self.calibrations)
        kinds = {c.id: c for c in reversed(self.calibrations)}
        self._kinds = tuple(kinds.values())
        number = {key: i for i, key in enumerate(kinds)}
        self._kind = np.array([number[c.id] for c in self.calibrations])
        self._beta = self._per_pad([np.maximum(c.beta, BETA_FLOOR) for c in self._kinds], 1)
        self._stiffness = (
            self._per_pad([c.modulus for c in self._kinds], 0) * (1 + self._beta) / self._beta
        )
        self._exists = self._per_pad([np.ones(c.layout.n_pads) for c in self._kinds], 0) > 0
        self._thermal = np.array([c.temperature is not None for c in self._kinds])
        self._any_thermal = bool(self._thermal.any())
        self._estimator = lru_cache(maxsize=MASKS_KEPT)(self._make_estimator)
        self._table = lru_cache(maxsize=MASKS_KEPT)(self._make_table)
        self._depth = max(self._estimator(k, 0).dof for k in range(len(self._kinds))) or 1
        full = [self._make_table(k, 0) for k in range(len(self._kinds))]
        self._matrices = np.array([t.matrix for t in full])
        self._seen = np.flatnonzero(~np.isnan(self._matrices).all(axis=(0, 2)))
        self._limits = np.array([t.limit for t in full], dtype=self.dtype)
        self._observed = np.array([t.observed for t in full], dtype=np.uint16)
        self._columns = Columns(self._make_column, len(self.calibrations))
        self.rest_frequency = self._per_pad([c.rest_frequency for c in self.calibrations], np.nan)

    def _per_pad(self, values: Sequence[np.ndarray], missing: float) -> np.ndarray:
        return np.array(
            [np.pad(v, (0, self.n_pads - len(v)), constant_values=missing) for v in values]
        )

    @property
    def rest_frequency(self) -> np.ndarray:
        """(cubes, P) in Hz at the reference temperature, NaN where a cube has no such pad; set by
        tare."""
        return self._rest.copy()

    @rest_frequency.setter
    def rest_frequency(self, value: np.ndarray) -> None:
        rest = np.array(value, dtype=float)
        exists = self._exists[self._kind]
        if rest.shape != exists.shape:
            raise LayoutError(
                f"rest_frequency has shape {rest.shape}; this skin needs {exists.shape}"
            )
        if not np.all(rest[exists] > 0) or not np.all(np.isfinite(rest[exists])):
            raise CubeError(
                f"rest_frequency holds {rest[exists].min():g} Hz; every pad's must be finite and above 0"
            )
        self._rest = np.where(exists, rest, np.nan)
        self._columns.clear()

    def temperature_factor(self, cube: np.ndarray, temperature: np.ndarray) -> np.ndarray:
        """(N, P) f0(T) / f0 of rows; 1 without a model or a temperature. Tare divides by it."""
        return self._factor(self._kind[cube], np.asarray(temperature, dtype=float))

    def process(
        self,
        cube: np.ndarray,
        frequency: np.ndarray,
        pad_fault: np.ndarray | None = None,
        temperature: np.ndarray | None = None,
    ) -> StressRows:
        """Stress rows of samples.

        cube: (N,) index; frequency: (N, P) Hz; pad_fault: (N,) bits of pads that the device reports
        broken
        temperature: (N,) degrees Celsius, NaN where unknown, or None
        B batches of the same cubes at once: frequency (B, N, P) and so on give B * N rows, to the
        same bits. Raises LayoutError for arrays of the wrong shape; all that a row can hold ends in
        its status.
        """
        with np.errstate(all="ignore", divide="raise"):
            column, v, mask, cold = self._law(cube, frequency, pad_fault, temperature)
            out = self._products(column, v)
            limit: np.ndarray = column.limit
            observed = column.observed.copy() if len(v) == 1 else np.tile(column.observed, len(v))
            if mask is not None:
                limit = np.tile(column.limit, (len(v), 1))
                flat, flat_limit, flat_v = (
                    out.reshape(-1, out.shape[2]),
                    limit.reshape(-1),
                    v.reshape(-1, self.n_pads),
                )
                for kind, bits, chosen in _distinct(np.tile(column.kind, len(v)), mask.ravel()):
                    table = self._table(kind, bits)
                    # Row by row: the last bit of one product for all may depend on how many there
                    # are, einsum's too.
                    flat[chosen] = np.matmul(table.matrix, flat_v[chosen][:, :, None])[:, :, 0]
                    flat_limit[chosen], observed[chosen] = table.limit, table.observed
                out[:, column.strange] = np.nan
                observed.reshape(len(v), -1)[:, column.strange] = 0
            rest = out[:, :, N:]
            residual = (
                np.abs(rest[:, :, 0])
                if self._depth == 1
                else np.sqrt(np.einsum("bnd,bnd->bn", rest, rest))
            )
            over = (residual > limit).ravel()
            status = (
                over * np.uint16(RESIDUAL)
                if np.count_nonzero(over)
                else np.zeros(len(over), np.uint16)
            )
        if mask is not None:
            status[mask.ravel() != 0] |= PAD_FAULT
            status[observed == 0] |= INVALID
        if cold is not None:
            status[cold.ravel()] |= TEMPERATURE
        out = out.reshape(-1, out.shape[2])
        return StressRows(
            out[:, : len(STRESS)], out[:, len(STRESS) : N], residual.ravel(), status, observed
        )

    def _products(self, column: _Column, v: np.ndarray) -> np.ndarray:
        """(B, N, 15 + D) components and residual rows of v (B, N, P)."""
        if len(column.blocks) == 1 and column.blocks[0].matrix.ndim == 2:
            return v[:, :, : column.blocks[0].pads] @ column.blocks[0].matrix
        out = np.full((*v.shape[:2], N + self._depth), np.nan, dtype=self.dtype)
        for rows, pads, matrix in column.blocks:
            if matrix.ndim == 2:
                out[:, rows] = v[:, rows, :pads] @ matrix
            else:
                part = out[:, rows]
                of_pads = np.ascontiguousarray(v[:, rows, :pads].transpose(2, 0, 1))
                part[:, :, self._seen] = np.einsum("pin,pbn->bni", matrix, of_pads)
                out[:, rows] = part
        return out

    def pad_stress(
        self,
        cube: np.ndarray,
        frequency: np.ndarray,
        pad_fault: np.ndarray | None = None,
        temperature: np.ndarray | None = None,
    ) -> np.ndarray:
        """(N, P) pad stresses in Pa as the law gives them, before gains; NaN for bad and missing
        pads."""
        kind, strange, pads, mask = self._pads(cube, frequency, pad_fault, temperature)
        bad = ~self._exists[kind] | strange[:, None] | _bits(mask, self.n_pads)
        return np.where(bad, np.nan, pads)

    def suspects(
        self,
        cube: np.ndarray,
        frequency: np.ndarray,
        pad_fault: np.ndarray | None = None,
        temperature: np.ndarray | None = None,
    ) -> np.ndarray:
        """(N, P) bool, pads of which one alone explains a bad residual; see Estimator.suspects."""
        kinds, strange, pads, mask = self._pads(cube, frequency, pad_fault, temperature)
        result = np.zeros(pads.shape, dtype=bool)
        for kind, bits, chosen in _distinct(kinds, mask, everything=True):
            n = self._kinds[kind].layout.n_pads
            result[chosen, :n] = self._estimator(kind, bits).suspects(pads[chosen, :n])
        return result & ~strange[:, None]

    def _pads(self, cube, frequency, pad_fault, temperature):
        """Of each row: kind (N,), whether its cube is none of ours (N,), pad stresses (N, P) in Pa,
        bad pads (N,)."""
        with np.errstate(all="ignore", divide="raise"):
            column, v, mask, _ = self._law(cube, frequency, pad_fault, temperature)
        kind, strange = np.tile(column.kind, len(v)), np.tile(column.strange, len(v))
        none = np.zeros(len(kind), dtype=np.int64)
        return (
            kind,
            strange,
            v.reshape(-1, self.n_pads) * self._stiffness[kind],
            none if mask is None else mask.ravel(),
        )

    def covariance(self, cube: int, pad_fault: int = 0) -> np.ndarray:
        """(15, 15) of one cube's components from its pads' noise, in Pa and Pa/m; NaN where
        unobserved."""
        kind = int(self._kind[cube])
        scale = self._scale(kind)
        mask = int(pad_fault) & int(_mask(self._exists[kind]))
        return self._estimator(kind, mask).covariance * np.outer(scale, scale)

    def _law(self, cube, frequency, pad_fault, temperature):
        """The column, v / stiffness (B, N, P), and, or None, masks (B, N) of bad pads and rows
        without temperature.

        Bad pads are 0; pads that a cube has not are NaN, or 0 where any pad is bad. A column of
        several turns becomes as many batches.
        """
        f, cube = np.asarray(frequency, dtype=self.dtype), np.asarray(cube)
        if cube.ndim != 1 or f.shape[-2:] != (len(cube), self.n_pads):
            raise LayoutError(
                f"pipeline: cube has shape {cube.shape} and frequency {f.shape}; "
                f"this skin needs (N,) and (N, {self.n_pads})"
            )
        column = self._columns.of(cube)
        n = len(column.kind)
        count = f.size // (n * self.n_pads) if n else 1
        f = f.reshape(
            (n, self.n_pads) if count == 1 else (count, n, self.n_pads)
        )  # numpy is faster with two axes
        rest, top, cold = column.rest, column.top, None
        if self._any_thermal:
            known = np.full((count, n), np.nan)
            if temperature is not None:
                known = np.asarray(temperature, dtype=float).reshape(count, n)
            cold = self._thermal[column.kind] & ~np.isfinite(known)
            factor = self._factor(column.kind, known)
            rest, top = (rest * factor).astype(self.dtype), (top * factor).astype(self.dtype)
        # the law of oscillator.py in three passes: v = E (1 + beta) / beta (f - f0) / (top - f)
        v = f - rest
        below = top - f
        reported = pad_fault is not None and np.count_nonzero(pad_fault) > 0
        try:
            v /= below
            # Falls with f down to 0 and is below -1 beyond top, so one comparison finds all that
            # the law has not.
            within = n > 0 and f.size == count * column.pads and v.min() > column.floor
        except FloatingPointError:  # f is top
            within = False
        v = v.reshape(count, n, self.n_pads)
        if within and not reported:
            return column, v, None, cold
        # NaN, Inf and frequencies beyond the law's range all fail one of the two comparisons
        good = ((f > 0) & (below > 0)).reshape(v.shape)
        if np.count_nonzero(good) == count * column.pads and not reported:
            return column, v, None, cold
        if reported:
            good &= ~_bits(np.asarray(pad_fault).reshape(count, n), self.n_pads)
        v[~good] = 0
        return column, v, _mask(self._exists[column.kind] & ~good), cold

    def _make_column(self, cube: np.ndarray) -> _Column:
        """Of several turns it is that of one."""
        count = turns(cube)
        if count > 1:
            return self._columns.of(cube[: len(cube) // count])
        strange = (cube < 0) | (cube >= len(self.calibrations))
        index = np.where(strange, 0, cube).astype(int)
        kind, rest = self._kind[index], self._rest[index]
        top = highest_frequency(rest, self._beta[kind])
        # A strange row never counts as good, so it always takes the slow way, where it is made NaN.
        pads = int(np.count_nonzero(self._exists[kind])) + int(strange.any())
        floor = float(np.nanmax(-rest / top, initial=-1.0)) * (1 - FLOOR_MARGIN)
        return _Column(
            strange,
            kind,
            rest.astype(self.dtype),
            top.astype(self.dtype),
            floor,
            pads,
            self._blocks(kind),
            self._limits[kind],
            self._observed[kind],
        )

    def _blocks(self, kind: np.ndarray) -> list[_Block]:
        few = len(self._kinds) <= FEW_KINDS
        n_pads = self._exists.sum(axis=1)[kind]
        blocks = []
        for value in np.unique(kind if few else n_pads).tolist():
            index = np.flatnonzero((kind if few else n_pads) == value)
            together = index[-1] - index[0] + 1 == len(index)
            rows = slice(int(index[0]), int(index[-1]) + 1) if together else index
            pads = int(n_pads[index[0]])
            if few:
                matrix = self._matrices[value, :, :pads].T
            else:
                matrix = self._matrices[:, self._seen][kind[index], :, :pads].transpose(2, 1, 0)
            blocks.append(_Block(rows, pads, np.ascontiguousarray(matrix)))
        return blocks

    def _factor(self, kind: np.ndarray, temperature: np.ndarray) -> np.ndarray:
        factor = np.ones((*temperature.shape, self.n_pads))
        for k, calibration in enumerate(self._kinds):
            if calibration.temperature is not None:
                rows = (kind == k) & np.isfinite(temperature)
                factor[rows, : calibration.layout.n_pads] = calibration.temperature.factor(
                    temperature[rows]
                )
        return factor

    def _scale(self, kind: int) -> np.ndarray:
        return np.where(np.arange(N) < len(STRESS), 1, 1 / self._kinds[kind].half_side)

    def _make_estimator(self, kind: int, mask: int) -> Estimator:
        c = self._kinds[kind]
        return make_estimator(
            c.response, c.noise, c.modes, np.flatnonzero(_bits(mask, c.layout.n_pads)), c.neglect
        )

    def _make_table(self, kind: int, mask: int) -> _Table:
        e, c = self._estimator(kind, mask), self._kinds[kind]
        matrix = np.zeros((N + self._depth, self.n_pads))
        n = c.layout.n_pads
        matrix[:N, :n] = e.matrix * self._scale(kind)[:, None]
        matrix[N:, :n] = np.nan
        null = e.null[
            : self._depth
        ]  # a mask that lowers the rank by more than a pad could have more rows
        dof = len(null)
        if dof:
            matrix[N:, :n] = 0
            matrix[N : N + dof, :n] = null / np.sqrt(dof)
        matrix *= self._stiffness[kind]
        limit = np.sqrt(chi2_limit(dof, FALSE_ALARM) / dof) if dof else np.nan
        return _Table(matrix.astype(self.dtype, order="F"), limit, int(_mask(e.observed)))


def _bits(mask, count: int) -> np.ndarray:
    """(..., count) bool from bit masks."""
    return (np.asarray(mask, dtype=np.int64)[..., None] >> np.arange(count)) & 1 > 0


def _mask(bits: np.ndarray) -> np.ndarray:
    """The inverse of _bits."""
    return bits @ (np.int64(1) << np.arange(bits.shape[-1]))


def _distinct(kind: np.ndarray, mask: np.ndarray, everything: bool = False):
    """(kind, mask, rows) of each distinct pair, of those with a bad pad unless everything."""
    rows = np.arange(len(mask)) if everything else np.flatnonzero(mask)
    pairs, where = np.unique(kind[rows] << 32 | mask[rows], return_inverse=True)
    order = np.argsort(where, kind="stable")
    ends = np.searchsorted(where[order], np.arange(len(pairs) + 1))
    for pair, start, end in zip(pairs.tolist(), ends[:-1], ends[1:], strict=True):
        yield pair >> 32, pair & 0xFFFFFFFF, rows[order[start:end]]
