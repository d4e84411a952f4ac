"""Pipeline: rows of frequencies in, rows of stress out, without a loop over rows or cubes.

One table per calibration holds a stacked matrix: 15 rows that give the components, then the
whitened null-space rows of the residual. Rows with all pads good are one pad law and one matrix
product per calibration. Rows with bad pads are done again with the estimator of their mask, one
product per distinct (calibration, mask). Nothing that a row holds raises an error.

The bits of a row do not depend on how many scans are processed with it: products are made scan by
scan, because the last bit of a matrix product may depend on its shape.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from .calibration import Calibration
from .errors import CalibrationError, CubeError, LayoutError
from .estimator import FALSE_ALARM, Estimator, chi2_limit, make_estimator
from .modes import COMPONENTS, STRESS
from .oscillator import highest_frequency
from .pattern import PatternCache, count_repeats
from .rows import FrequencyRows, StressRows
from .status import INVALID, PAD_FAULT, RESIDUAL, STAMP, TEMPERATURE

N = len(COMPONENTS)
MASKS_KEPT = 1024
"""Estimators of pad masks remembered at a time."""
BETA_FLOOR = 1e-12
"""So that every pad has a highest frequency; changes the law by 1e-12 of a strain."""
LOWEST_MARGIN = 1e-6
"""Some roundings of float32."""
FEW_CALIBRATIONS = 8
"""Up to so many: a product for each. More: one einsum for all that have as many pads."""


class _Table(NamedTuple):
    """An estimator laid out for rows: (15 + D, P) matrix on v / stiffness, scaled residual rows."""

    matrix: np.ndarray
    limit: float  # of the residual
    observed: int


class _Block(NamedTuple):
    """Rows of a scan that share a product.

    matrix: (pads, 15 + D), or (pads, recovered, rows) where each row has its own calibration.
    """

    rows: slice | np.ndarray
    pads: int
    matrix: np.ndarray


class _Pattern(NamedTuple):
    """What depends on the cube indices of a scan alone."""

    unknown: np.ndarray  # (N,) bool: the skin has no such cube
    group: np.ndarray  # (N,) which calibration
    rest: np.ndarray  # (N, P) Hz
    highest: np.ndarray  # (N, P) Hz, highest frequency of the law
    lowest_v: float  # v that f = 0 gives, of the row where it is highest
    n_pads: int  # pads of all rows
    blocks: list[_Block]
    limit: np.ndarray  # (N,) of the residual
    observed: np.ndarray  # (N,)


class _PadLaw(NamedTuple):
    """Pads of B scans of N rows after the pad law.

    v: (B, N, P) pad stress / stiffness; bad pads are 0; pads that a cube does not have are NaN, or
        0 where any pad is bad
    bad: (B, N) bits of bad pads, None where there are none
    no_temperature: (B, N) bool, rows whose temperature is needed and unknown, None without a model
    """

    pattern: _Pattern
    v: np.ndarray
    bad: np.ndarray | None
    no_temperature: np.ndarray | None


class Pipeline:
    """Cubes 0 .. len(calibrations) - 1; layouts may differ, rows are as wide as the widest."""

    def __init__(self, calibrations: Sequence[Calibration], dtype=np.float64) -> None:
        """CubeError: dtype is not float32 or float64. CalibrationError: there are no cubes."""
        self.dtype = np.dtype(dtype)
        if self.dtype not in (np.float32, np.float64):
            raise CubeError(f"pipeline: dtype {self.dtype}; use float32 or float64")
        if not calibrations:
            raise CalibrationError("pipeline: no calibrations; give one per cube")
        self.calibrations = tuple(calibrations)
        self.n_pads = max(c.layout.n_pads for c in self.calibrations)
        # Cubes with the same calibration are a group.
        by_id = {c.id: c for c in reversed(self.calibrations)}
        self._groups = tuple(by_id.values())
        number = {key: i for i, key in enumerate(by_id)}
        self._group = np.array([number[c.id] for c in self.calibrations])
        beta = [np.maximum(c.beta, BETA_FLOOR) for c in self._groups]
        self._beta = self._per_pad(beta, 1)
        self._stiffness = (
            self._per_pad([c.modulus for c in self._groups], 0) * (1 + self._beta) / self._beta
        )
        self._exists = self._per_pad([np.ones(c.layout.n_pads) for c in self._groups], 0) > 0
        self._thermal = np.array([c.temperature is not None for c in self._groups])
        self._any_thermal = bool(self._thermal.any())
        self._estimator = lru_cache(maxsize=MASKS_KEPT)(self._make_estimator)
        self._table = lru_cache(maxsize=MASKS_KEPT)(self._make_table)
        groups = range(len(self._groups))
        self._n_residual = max(self._estimator(group, 0).dof for group in groups) or 1
        full = [self._make_table(group, 0) for group in groups]
        self._matrices = np.array([table.matrix for table in full])
        self._recovered = np.flatnonzero(~np.isnan(self._matrices).all(axis=(0, 2)))
        self._limits = np.array([table.limit for table in full], dtype=self.dtype)
        self._observed = np.array([table.observed for table in full], dtype=np.uint16)
        self._patterns = PatternCache(self._make_pattern, len(self.calibrations))
        self.rest_frequency = self._per_pad([c.rest_frequency for c in self.calibrations], np.nan)

    def _per_pad(self, values: Sequence[np.ndarray], missing: float) -> np.ndarray:
        padded = [
            np.pad(value, (0, self.n_pads - len(value)), constant_values=missing)
            for value in values
        ]
        return np.array(padded)

    @property
    def rest_frequency(self) -> np.ndarray:
        """(cubes, P) in Hz at the reference temperature, NaN where a cube has no such pad; set by
        tare. LayoutError, CubeError: another shape, or a value that is not finite and above 0."""
        return self._rest.copy()

    @rest_frequency.setter
    def rest_frequency(self, value: np.ndarray) -> None:
        rest = np.array(value, dtype=float)
        exists = self._exists[self._group]
        if rest.shape != exists.shape:
            raise LayoutError(
                f"rest_frequency has shape {rest.shape}; this skin needs {exists.shape}"
            )
        if not np.all(rest[exists] > 0) or not np.all(np.isfinite(rest[exists])):
            raise CubeError(
                f"rest_frequency holds {rest[exists].min():g} Hz; "
                "every pad's must be finite and above 0"
            )
        self._rest = np.where(exists, rest, np.nan)
        self._patterns.clear()

    def temperature_factor(self, cube: np.ndarray, temperature: np.ndarray) -> np.ndarray:
        """(N, P) f0(T) / f0 of rows; 1 without a model or a temperature. Tare divides by it."""
        return self._factor(self._group[cube], np.asarray(temperature, dtype=float))

    def process(self, rows: FrequencyRows, left_out: np.ndarray | None = None) -> StressRows:
        """Stress of N rows: of one scan, or of several scans of the same cubes one after the other.

        left_out: (N,) bits of pads that are not used; None: those that the device reports broken.
        LayoutError: arrays of the wrong shape. All else that a row can hold ends in its status.
        """
        if left_out is None:
            left_out = rows.pad_fault
        with np.errstate(all="ignore", divide="raise"):
            law = self._apply_law(rows, left_out)
            pattern, v, bad = law.pattern, law.v, law.bad
            out = self._products(pattern, v)
            limit = pattern.limit
            observed = np.concatenate([pattern.observed] * len(v))
            if bad is not None:
                limit = np.tile(pattern.limit, (len(v), 1))
                self._correct_bad_rows(pattern, v, bad, out, limit, observed)
            residual = self._residual(out)
            over = (residual > limit).ravel()
        status = over * np.uint16(RESIDUAL)
        if bad is not None:
            left_out = (left_out | bad.ravel()).astype(np.uint32)
            status[bad.ravel() != 0] |= PAD_FAULT
            status[observed == 0] |= INVALID
        if law.no_temperature is not None:
            status[law.no_temperature.ravel()] |= TEMPERATURE
        status |= rows.status & np.uint16(STAMP)
        out = out.reshape(-1, out.shape[2])
        return StressRows(
            cube=rows.cube,
            sequence=rows.sequence,
            stamp_ns=rows.stamp_ns,
            stress=out[:, : len(STRESS)],
            gradient=out[:, len(STRESS) : N],
            residual=residual.ravel(),
            status=status,
            observed=observed,
            left_out=left_out,
        )

    def _products(self, pattern: _Pattern, v: np.ndarray) -> np.ndarray:
        """(B, N, 15 + D) components and residual rows of v (B, N, P)."""
        if len(pattern.blocks) == 1 and pattern.blocks[0].matrix.ndim == 2:
            return v[:, :, : pattern.blocks[0].pads] @ pattern.blocks[0].matrix
        out = np.full((*v.shape[:2], N + self._n_residual), np.nan, dtype=self.dtype)
        for rows, pads, matrix in pattern.blocks:
            if matrix.ndim == 2:
                out[:, rows] = v[:, rows, :pads] @ matrix
            else:
                part = out[:, rows]
                of_pads = np.ascontiguousarray(v[:, rows, :pads].transpose(2, 0, 1))
                part[:, :, self._recovered] = np.einsum("pin,pbn->bni", matrix, of_pads)
                out[:, rows] = part
        return out

    def _correct_bad_rows(
        self,
        pattern: _Pattern,
        v: np.ndarray,
        bad: np.ndarray,
        out: np.ndarray,
        limit: np.ndarray,
        observed: np.ndarray,
    ) -> None:
        """Do rows with bad pads again, with the estimator of their mask; rows of unknown cubes are
        NaN. Writes into out (B, N, 15 + D), limit (B, N) and observed (B N,)."""
        flat, flat_limit = out.reshape(-1, out.shape[2]), limit.reshape(-1)
        flat_v = v.reshape(-1, self.n_pads)
        for group, bits, chosen in _distinct(np.tile(pattern.group, len(v)), bad.ravel()):
            table = self._table(group, bits)
            # Row by row: the last bit of a product for all may depend on how many there are.
            flat[chosen] = np.matmul(table.matrix, flat_v[chosen][:, :, None])[:, :, 0]
            flat_limit[chosen], observed[chosen] = table.limit, table.observed
        out[:, pattern.unknown] = np.nan
        observed.reshape(len(v), -1)[:, pattern.unknown] = 0

    def _residual(self, out: np.ndarray) -> np.ndarray:
        """(B, N) of components and residual rows (B, N, 15 + D)."""
        rest = out[:, :, N:]
        if self._n_residual == 1:
            return np.abs(rest[:, :, 0])
        residual: np.ndarray = np.sqrt(np.einsum("bnd,bnd->bn", rest, rest))
        return residual

    def pad_stress(self, rows: FrequencyRows, left_out: np.ndarray | None = None) -> np.ndarray:
        """(N, P) pad stresses in Pa as the law gives them, before gains; NaN for bad and missing
        pads."""
        group, unknown, pads, bad = self._pads(rows, left_out)
        missing = ~self._exists[group] | unknown[:, None] | _bits(bad, self.n_pads)
        return np.where(missing, np.nan, pads)

    def suspects(self, rows: FrequencyRows, left_out: np.ndarray | None = None) -> np.ndarray:
        """(N, P) bool, pads of which one alone explains a bad residual; see Estimator.suspects."""
        groups, unknown, pads, bad = self._pads(rows, left_out)
        result = np.zeros(pads.shape, dtype=bool)
        for group, bits, chosen in _distinct(groups, bad, also_good=True):
            n = self._groups[group].layout.n_pads
            result[chosen, :n] = self._estimator(group, bits).suspects(pads[chosen, :n])
        return result & ~unknown[:, None]

    def _pads(
        self, rows: FrequencyRows, left_out: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Of each row: group (N,), whether its cube is unknown (N,), pad stresses (N, P) in Pa,
        bits of bad pads (N,)."""
        with np.errstate(all="ignore", divide="raise"):
            law = self._apply_law(rows, rows.pad_fault if left_out is None else left_out)
        scans = len(law.v)
        group, unknown = np.tile(law.pattern.group, scans), np.tile(law.pattern.unknown, scans)
        bad = np.zeros(len(group), np.int64) if law.bad is None else law.bad.ravel()
        return group, unknown, law.v.reshape(-1, self.n_pads) * self._stiffness[group], bad

    def matrix(self, cube: int, left_out: int = 0) -> np.ndarray:
        """(15, P) one cube's components in Pa and Pa/m from its pads' stresses in Pa; NaN where
        unobserved, 0 for pads that are left out (bits)."""
        group = int(self._group[cube])
        mask = int(left_out) & int(_mask(self._exists[group]))
        return np.asarray(self._estimator(group, mask).matrix * self._scale(group)[:, None])

    def covariance(self, cube: int, left_out: int = 0) -> np.ndarray:
        """(15, 15) of one cube's components from its pads' noise, in Pa and Pa/m; NaN where
        unobserved."""
        group = int(self._group[cube])
        scale = self._scale(group)
        mask = int(left_out) & int(_mask(self._exists[group]))
        return self._estimator(group, mask).covariance * np.outer(scale, scale)

    def _apply_law(self, rows: FrequencyRows, left_out: np.ndarray) -> _PadLaw:
        """The law of oscillator.py in three passes: v = E (1 + beta) / beta (f - f0) / (top - f).

        Several scans of the same rising cubes become as many in the result; others are one scan.
        """
        f = np.asarray(rows.frequency, dtype=self.dtype)
        if f.ndim != 2 or f.shape != (len(rows), self.n_pads):
            raise LayoutError(
                f"pipeline: cube has shape {np.shape(rows.cube)} and frequency {f.shape}; "
                f"this skin needs (N,) and (N, {self.n_pads})"
            )
        pattern = self._patterns.get(rows.cube)
        n = len(pattern.group)
        count = len(rows) // n if n else 1
        # numpy is faster with two axes.
        f = f.reshape((n, self.n_pads) if count == 1 else (count, n, self.n_pads))
        rest, highest, no_temperature = pattern.rest, pattern.highest, None
        if self._any_thermal:
            known = np.asarray(rows.temperature, dtype=float).reshape(count, n)
            no_temperature = self._thermal[pattern.group] & ~np.isfinite(known)
            factor = self._factor(pattern.group, known)
            rest, highest = (
                (rest * factor).astype(self.dtype),
                (highest * factor).astype(self.dtype),
            )
        v = f - rest
        below = highest - f
        reported = np.count_nonzero(left_out) > 0
        try:
            v /= below
            # v falls with f down to 0 and is below -1 beyond the highest frequency: one comparison
            # finds all that is outside the law.
            full = f.size == count * pattern.n_pads
            within = n > 0 and full and v.min() > pattern.lowest_v
        except FloatingPointError:  # f is the highest frequency
            within = False
        v = v.reshape(count, n, self.n_pads)
        if within and not reported:
            return _PadLaw(pattern, v, None, no_temperature)
        # NaN, Inf and frequencies outside the law's range all fail one of the two comparisons.
        good = ((f > 0) & (below > 0)).reshape(v.shape)
        if np.count_nonzero(good) == count * pattern.n_pads and not reported:
            return _PadLaw(pattern, v, None, no_temperature)
        if reported:
            good &= ~_bits(np.asarray(left_out).reshape(count, n), self.n_pads)
        v[~good] = 0
        bad = _mask(self._exists[pattern.group] & ~good)
        return _PadLaw(pattern, v, bad, no_temperature)

    def _make_pattern(self, cube: np.ndarray) -> _Pattern:
        """Of one scan; several scans of the same cubes have the pattern of one of them."""
        repeats = count_repeats(cube)
        if repeats > 1:
            return self._patterns.get(cube[: len(cube) // repeats])
        unknown = (cube < 0) | (cube >= len(self.calibrations))
        index = np.where(unknown, 0, cube).astype(int)
        group, rest = self._group[index], self._rest[index]
        highest = highest_frequency(rest, self._beta[group])
        lowest_v = float(np.fmax.reduce(-rest / highest, axis=None, initial=-1.0)) * (
            1 - LOWEST_MARGIN
        )
        # One pad more than there are where a cube is unknown: such a scan never counts as full and
        # is always corrected, where its row becomes NaN.
        n_pads = int(np.count_nonzero(self._exists[group])) + int(unknown.any())
        return _Pattern(
            unknown=unknown,
            group=group,
            rest=rest.astype(self.dtype),
            highest=highest.astype(self.dtype),
            lowest_v=lowest_v,
            n_pads=n_pads,
            blocks=self._blocks(group),
            limit=self._limits[group],
            observed=self._observed[group],
        )

    def _blocks(self, group: np.ndarray) -> list[_Block]:
        few = len(self._groups) <= FEW_CALIBRATIONS
        n_pads = self._exists.sum(axis=1)[group]
        shared = group if few else n_pads
        blocks = []
        for value in np.unique(shared).tolist():
            index = np.flatnonzero(shared == value)
            neighbours = index[-1] - index[0] + 1 == len(index)
            rows = slice(int(index[0]), int(index[-1]) + 1) if neighbours else index
            pads = int(n_pads[index[0]])
            if few:
                matrix = self._matrices[value, :, :pads].T
            else:
                own = self._matrices[:, self._recovered][group[index], :, :pads]
                matrix = own.transpose(2, 1, 0)
            blocks.append(_Block(rows, pads, np.ascontiguousarray(matrix)))
        return blocks

    def _factor(self, group: np.ndarray, temperature: np.ndarray) -> np.ndarray:
        factor = np.ones((*temperature.shape, self.n_pads))
        for number, calibration in enumerate(self._groups):
            if calibration.temperature is not None:
                rows = (group == number) & np.isfinite(temperature)
                warm = calibration.temperature.factor(temperature[rows])
                factor[rows, : calibration.layout.n_pads] = warm
        return factor

    def _scale(self, group: int) -> np.ndarray:
        """(15,) of components: gradients are solved for in units of the half side."""
        return np.where(np.arange(N) < len(STRESS), 1, 1 / self._groups[group].half_side)

    def _make_estimator(self, group: int, mask: int) -> Estimator:
        c = self._groups[group]
        bad = np.flatnonzero(_bits(mask, c.layout.n_pads))
        return make_estimator(c.response, c.noise, c.modes, bad, c.neglect)

    def _make_table(self, group: int, mask: int) -> _Table:
        estimator, n = self._estimator(group, mask), self._groups[group].layout.n_pads
        matrix = np.zeros((N + self._n_residual, self.n_pads))
        matrix[:N, :n] = estimator.matrix * self._scale(group)[:, None]
        matrix[N:, :n] = np.nan
        # A mask that lowers the rank by more than a pad could have more null rows.
        null = estimator.null[: self._n_residual]
        dof = len(null)
        limit = np.nan
        if dof:
            matrix[N:, :n] = 0
            matrix[N : N + dof, :n] = null / np.sqrt(dof)
            limit = np.sqrt(chi2_limit(dof, FALSE_ALARM) / dof)
        matrix *= self._stiffness[group]
        return _Table(matrix.astype(self.dtype, order="F"), limit, int(_mask(estimator.observed)))


def _bits(mask: np.ndarray | int, count: int) -> np.ndarray:
    """(..., count) bool from bit masks."""
    bits: np.ndarray = (np.asarray(mask, dtype=np.int64)[..., None] >> np.arange(count)) & 1 > 0
    return bits


def _mask(bits: np.ndarray) -> np.ndarray:
    """The inverse of _bits."""
    return bits @ (np.int64(1) << np.arange(bits.shape[-1]))


def _distinct(
    group: np.ndarray, mask: np.ndarray, also_good: bool = False
) -> Iterator[tuple[int, int, np.ndarray]]:
    """(group, mask, rows) of each distinct pair with a bad pad; of those without one, too, if
    also_good."""
    rows = np.arange(len(mask)) if also_good else np.flatnonzero(mask)
    pairs, which = np.unique(group[rows] << 32 | mask[rows], return_inverse=True)
    order = np.argsort(which, kind="stable")
    ends = np.searchsorted(which[order], np.arange(len(pairs) + 1))
    for pair, start, end in zip(pairs.tolist(), ends[:-1], ends[1:], strict=True):
        yield pair >> 32, pair & 0xFFFFFFFF, rows[order[start:end]]
