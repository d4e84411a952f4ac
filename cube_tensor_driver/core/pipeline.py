"""Pipeline: frequencies of many cubes in, stress and gradients out, without a loop over rows or cubes.

One table per calibration holds a stacked matrix: 15 rows that give the components, then the whitened
null-space rows of the residual. Rows with all pads good are one pad law and one matrix product. Rows with
bad pads are done again with the estimator of their mask, one product per distinct (calibration, mask).
Nothing a row holds raises an error.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from .calibration import Calibration
from .errors import CalibrationError, CubeError, LayoutError
from .estimator import FALSE_ALARM, Estimator, chi2_limit, make_estimator
from .modes import COMPONENTS, STRESS
from .oscillator import highest_frequency

PAD_FAULT = 1  # at least one pad was left out: fault bit of the device, or a frequency that no pad can have
RESIDUAL = 2  # chi-square above its false-alarm limit: a load outside the modes, or a broken pad
INVALID = 4  # nothing recovered: all components NaN
TEMPERATURE = 8  # the temperature is unknown though the calibration needs it; its reference was assumed
STATUS = {"PAD_FAULT": PAD_FAULT, "RESIDUAL": RESIDUAL, "INVALID": INVALID, "TEMPERATURE": TEMPERATURE}

N = len(COMPONENTS)
MASKS_KEPT = 1024  # estimators of pad masks remembered at a time
BETA_FLOOR = 1e-12  # so that every pad has a highest frequency; changes the law by 1e-12 of a strain
PATTERNS_KEPT = 64  # cube columns remembered at a time: one per hub


class StressRows(NamedTuple):
    """One row per sample. Components that are not observed are NaN.

    stress: (N, 6) Pa, tension positive, order xx yy zz yz zx xy, in the cube's frame
    gradient: (N, 9) Pa/m, rows xx yy zz, columns d/dx d/dy d/dz
    residual: (N,) sqrt(chi-square / degrees of freedom), about 1 for noise alone; NaN without redundancy
    status: (N,) uint16 of the bits above; observed: (N,) uint16, bit i for component i of COMPONENTS
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


class _Rows(NamedTuple):
    """What depends on the cube column alone, kept from call to call because a hub's cubes do not change."""

    cube: np.ndarray
    strange: np.ndarray  # (N,) bool: the index is none of our cubes
    all_known: bool
    kind: np.ndarray  # (N,) which calibration
    rest: np.ndarray  # (N, P)
    top: np.ndarray  # (N, P) highest frequency of the law
    matrix: np.ndarray  # (P, 15 + D) when all rows share it, else (P, seen rows, N): the rows' axis last is fastest
    limit: np.ndarray  # (N,), or one number
    observed: np.ndarray


class Pipeline:
    """process() for cubes 0 .. len(calibrations) - 1; layouts may differ, columns fill up to the widest."""

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
        self._stiffness = self._per_pad([c.modulus for c in self._kinds], 0) * (1 + self._beta) / self._beta
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
        self._kept: dict[tuple, _Rows] = {}
        self.rest_frequency = self._per_pad([c.rest_frequency for c in self.calibrations], np.nan)

    def _per_pad(self, values: Sequence[np.ndarray], missing: float) -> np.ndarray:
        return np.array([np.pad(v, (0, self.n_pads - len(v)), constant_values=missing) for v in values])

    @property
    def rest_frequency(self) -> np.ndarray:
        """(cubes, P) in Hz at the reference temperature, NaN where a cube has no such pad; set by tare."""
        return self._rest.copy()

    @rest_frequency.setter
    def rest_frequency(self, value: np.ndarray) -> None:
        rest = np.array(value, dtype=float)
        exists = self._exists[self._kind]
        if rest.shape != exists.shape:
            raise LayoutError(f"rest_frequency has shape {rest.shape}; this skin needs {exists.shape}")
        if not np.all(rest[exists] > 0) or not np.all(np.isfinite(rest[exists])):
            raise CubeError(f"rest_frequency holds {rest[exists].min():g} Hz; every pad's must be finite and above 0")
        self._rest = np.where(exists, rest, np.nan)
        self._kept.clear()

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

        cube: (N,) index; frequency: (N, P) Hz; pad_fault: (N,) bits of pads that the device reports broken
        temperature: (N,) degrees Celsius, NaN where unknown, or None
        Raises LayoutError for arrays of the wrong shape; all that a row can hold ends in its status.
        """
        with np.errstate(all="ignore"):
            rows, v, mask, cold = self._law(cube, frequency, pad_fault, temperature)
            if rows.matrix.ndim == 2:
                out = v @ rows.matrix
            else:
                out = np.full((N + self._depth, len(v)), np.nan, dtype=self.dtype)
                out[self._seen] = np.einsum("pin,pn->in", rows.matrix, np.ascontiguousarray(v.T))
                out = out.T
            limit, observed = rows.limit, rows.observed.copy()
            if mask is not None:
                limit = np.array(np.broadcast_to(limit, len(v)))
                for kind, bits, chosen in _distinct(rows.kind, mask):
                    table = self._table(kind, bits)
                    out[chosen] = v[chosen] @ table.matrix.T
                    limit[chosen], observed[chosen] = table.limit, table.observed
                out[rows.strange], observed[rows.strange] = np.nan, 0
            rest = out[:, N:]
            residual = np.abs(rest[:, 0]) if self._depth == 1 else np.sqrt(np.einsum("nd,nd->n", rest, rest))
            status = (residual > limit).astype(np.uint16) * np.uint16(RESIDUAL)
        if mask is not None:
            status[mask != 0] |= PAD_FAULT
            status[observed == 0] |= INVALID
        if cold is not None:
            status[cold] |= TEMPERATURE
        return StressRows(out[:, : len(STRESS)], out[:, len(STRESS) : N], residual, status, observed)

    def pad_stress(
        self,
        cube: np.ndarray,
        frequency: np.ndarray,
        pad_fault: np.ndarray | None = None,
        temperature: np.ndarray | None = None,
    ) -> np.ndarray:
        """(N, P) pad stresses in Pa as the law gives them, before gains; NaN for bad and missing pads."""
        with np.errstate(all="ignore"):
            rows, v, mask, _ = self._law(cube, frequency, pad_fault, temperature)
        pads = v * self._stiffness[rows.kind]
        bad = ~self._exists[rows.kind] | rows.strange[:, None]
        return np.where(bad if mask is None else bad | _bits(mask, self.n_pads), np.nan, pads)

    def suspects(
        self,
        cube: np.ndarray,
        frequency: np.ndarray,
        pad_fault: np.ndarray | None = None,
        temperature: np.ndarray | None = None,
    ) -> np.ndarray:
        """(N, P) bool, pads of which one alone explains a bad residual; see Estimator.suspects."""
        with np.errstate(all="ignore"):
            rows, v, mask, _ = self._law(cube, frequency, pad_fault, temperature)
        result = np.zeros(v.shape, dtype=bool)
        pads = v * self._stiffness[rows.kind]
        mask = np.zeros(len(v), dtype=np.int64) if mask is None else mask
        for kind, bits, chosen in _distinct(rows.kind, mask, everything=True):
            n = self._kinds[kind].layout.n_pads
            result[chosen, :n] = self._estimator(kind, bits).suspects(pads[chosen, :n])
        return result & ~rows.strange[:, None]

    def covariance(self, cube: int, pad_fault: int = 0) -> np.ndarray:
        """(15, 15) of one cube's components from its pads' noise, in Pa and Pa/m; NaN where unobserved."""
        kind = int(self._kind[cube])
        scale = self._scale(kind)
        mask = int(pad_fault) & int(_mask(self._exists[kind]))
        return self._estimator(kind, mask).covariance * np.outer(scale, scale)

    def _law(self, cube, frequency, pad_fault, temperature):
        """Rows, v / stiffness (bad pads 0), and, or None, masks of bad pads and rows that lack their temperature."""
        f, cube = np.asarray(frequency, dtype=self.dtype), np.asarray(cube)
        if cube.ndim != 1 or f.shape != (len(cube), self.n_pads):
            raise LayoutError(
                f"pipeline: cube has shape {cube.shape} and frequency {f.shape}; "
                f"this skin needs (N,) and (N, {self.n_pads})"
            )
        rows = self._rows(cube)
        rest, top, cold = rows.rest, rows.top, None
        if self._any_thermal:
            known = np.full(len(f), np.nan) if temperature is None else np.asarray(temperature, dtype=float)
            cold = self._thermal[rows.kind] & ~np.isfinite(known)
            factor = self._factor(rows.kind, known)
            rest, top = (rest * factor).astype(self.dtype), (top * factor).astype(self.dtype)
        # the law of oscillator.py in three passes: v = E (1 + beta) / beta (f - f0) / (top - f)
        v = f - rest
        below = top - f
        v /= below
        # NaN, Inf and frequencies beyond the law's range all fail one of the two comparisons
        if (
            len(f)
            and f.min() > 0
            and below.min() > 0
            and rows.all_known
            and (pad_fault is None or not np.count_nonzero(pad_fault))
        ):
            return rows, v, None, cold
        good = (f > 0) & (below > 0)
        if pad_fault is not None:
            good &= ~_bits(np.asarray(pad_fault), self.n_pads)
        v[~good] = 0
        return rows, v, _mask(self._exists[rows.kind] & ~good), cold

    def _rows(self, cube: np.ndarray) -> _Rows:
        key = (len(cube), cube[0], cube[-1]) if len(cube) else (0,)  # cheap; the comparison below makes it sure
        kept = self._kept.get(key)
        if kept is not None and (kept.cube == cube).all():
            return kept
        if len(self._kept) >= PATTERNS_KEPT:
            self._kept.clear()
        strange = (cube < 0) | (cube >= len(self.calibrations))
        index = np.where(strange, 0, cube).astype(int)
        kind, rest = self._kind[index], self._rest[index]
        if len(kind) and (kind == kind[0]).all():
            matrix, limit = np.ascontiguousarray(self._matrices[kind[0]].T), self._limits[kind[0]]
        else:
            matrix, limit = (
                np.ascontiguousarray(self._matrices[:, self._seen][kind].transpose(2, 1, 0)),
                self._limits[kind],
            )
        rows = self._kept[key] = _Rows(
            cube.copy(),
            strange,
            not strange.any(),
            kind,
            rest.astype(self.dtype),
            highest_frequency(rest, self._beta[kind]).astype(self.dtype),
            matrix,
            limit,
            self._observed[kind],
        )
        return rows

    def _factor(self, kind: np.ndarray, temperature: np.ndarray) -> np.ndarray:
        factor = np.ones((len(kind), self.n_pads))
        for k, calibration in enumerate(self._kinds):
            if calibration.temperature is not None:
                rows = (kind == k) & np.isfinite(temperature)
                factor[rows, : calibration.layout.n_pads] = calibration.temperature.factor(temperature[rows])
        return factor

    def _scale(self, kind: int) -> np.ndarray:
        return np.where(np.arange(N) < len(STRESS), 1, 1 / self._kinds[kind].half_side)

    def _make_estimator(self, kind: int, mask: int) -> Estimator:
        c = self._kinds[kind]
        return make_estimator(c.response, c.noise, c.modes, np.flatnonzero(_bits(mask, c.layout.n_pads)), c.neglect)

    def _make_table(self, kind: int, mask: int) -> _Table:
        e, c = self._estimator(kind, mask), self._kinds[kind]
        matrix = np.zeros((N + self._depth, self.n_pads))
        n = c.layout.n_pads
        matrix[:N, :n] = e.matrix * self._scale(kind)[:, None]
        matrix[N:, :n] = np.nan
        null = e.null[: self._depth]  # a mask that lowers the rank by more than a pad could have more rows
        dof = len(null)
        if dof:
            matrix[N:, :n] = 0
            matrix[N : N + dof, :n] = null / np.sqrt(dof)
        matrix *= self._stiffness[kind]
        limit = np.sqrt(chi2_limit(dof, FALSE_ALARM) / dof) if dof else np.nan
        return _Table(matrix.astype(self.dtype), limit, int(_mask(e.observed)))


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
