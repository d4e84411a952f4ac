"""Pipeline: from frequencies of pads to stresses of cubes, without a loop over samples or cubes.

A row (sample of one cube) is computed in two steps: the pad law (`oscillator.py`) gives the stress
on each pad from its frequency, and a matrix product gives the 15 components of stress and gradient.
The same matrix has further rows for the residual, combinations of the pads' stresses that only
noise makes differ from 0. There is one matrix product per calibration if all pads are good. Rows
with bad pads are computed again without these pads, with one matrix per distinct pair of
calibration and bit mask. Whatever the numbers in a row are, they raise no error.

A scan has at most one row per cube. The bits of a row do not depend on the number of scans that are
processed with it. Therefore products are formed scan by scan, because the last bit of a matrix
product may depend on its shape.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from .arrays import AnyArray, Array, Index, Mask, PadMasks, Real, Times, pad_table
from .calibration import Calibration
from .errors import CalibrationError, CubeError, LayoutError
from .estimator import FALSE_ALARM, Estimator, chi2_limit, make_estimator
from .modes import COMPONENTS, STRESS
from .oscillator import highest_frequency
from .pattern import PatternCache, count_repeats
from .rows import FrequencyRows, StressRows
from .status import INVALID, PAD_FAULT, RESIDUAL, STAMP, TEMPERATURE

N_COMPONENTS = len(COMPONENTS)

MAX_CACHED_ESTIMATORS = 1024
"""Maximum number of estimators (matrices from the pads of a cube to components of stress) that are
kept in memory.

There is one for each combination of a calibration and a set of bad pads that has occurred.
"""

MIN_BETA = 1e-12
"""Smallest value of beta (ratio of a pad's parasitic to its active capacitance) in the pad law (the
formula from the frequency of a pad to the stress on it).

The computation divides by beta, so a pad with beta = 0 is computed with this value. It changes the
strain of the pad by 1e-12.
"""

LOWEST_STRESS_MARGIN = 1e-6
"""Margin above the stress on a pad that belongs to a frequency of 0, relative to that stress.

If any stress of a scan is below this margin, each pad is checked for a frequency outside the range
of the pad law (formula from frequency to stress). The margin covers a few rounding errors of
float32.
"""

MAX_SEPARATE_PRODUCTS = 8
"""Maximum number of different calibrations for which one matrix product (BLAS) per calibration is
computed. With more calibrations, one einsum over all cubes with the same number of pads is
faster."""


class _Table(NamedTuple):
    """Matrix and limits for rows (samples) with the same calibration and the same good pads.

    P is the number of pads, D the number of degrees of freedom of the residual.

    Attributes:
        matrix: Map (15 + D, P) from v (pad stresses divided by the stiffness) to 15 components, and
            to D residuals whose sum of squares is chi-square / degrees of freedom.
        limit: Limit of the residual, sqrt(chi-square / degrees of freedom).
        observed: Bit mask of the components that the pads determine.
    """

    matrix: Real
    limit: float
    observed: int


class _Block(NamedTuple):
    """Rows of a scan that are computed in one matrix product.

    Attributes:
        rows: Numbers of these rows in the scan.
        pads: Number of pads of each of these rows.
        matrix: One matrix (pads, 15 + D) for all rows, or one per row (pads, recovered, rows) if
            the rows have different calibrations; "recovered" counts the components and residuals
            that some calibration determines.
    """

    rows: slice | Index
    pads: int
    matrix: Real


class _Pattern(NamedTuple):
    """Quantities that depend only on the cube numbers of a scan of N rows.

    Attributes:
        unknown: Whether the row has a cube number that the skin does not have (N,).
        group: Number of the calibration of the row's cube (N,).
        rest: Frequencies without load (N, P), in Hz.
        highest: Upper limits of the frequencies by the pad law (N, P), in Hz.
        lowest_v: Value of v (pad stress divided by the stiffness) above which all frequencies of a
            scan are above 0: the largest v, over all pads, that a frequency of 0 gives.
        n_pads: Number of pads of all N rows together.
        blocks: Rows that share a matrix product.
        limit: Limits of the residual (N,).
        observed: Bit masks of the components that the pads determine (N,).
    """

    unknown: Mask
    group: Index
    rest: Real
    highest: Real
    lowest_v: float
    n_pads: int
    blocks: list[_Block]
    limit: Array
    observed: AnyArray


class _PadLaw(NamedTuple):
    """Results of the pad law (frequency to stress of a pad) for B scans of N rows.

    Attributes:
        pattern: Quantities that depend only on the cubes of a scan.
        v: Pad stresses divided by the stiffness (B, N, P). Bad pads are 0. Pads that a cube does
            not have are NaN, or 0 if any pad is bad.
        bad: Bit masks of the bad pads (left out, or with an impossible frequency) (B, N); None if
            there are none.
        no_temperature: Whether a row needs a temperature that is unknown (B, N); None if no
            calibration has a temperature model.
    """

    pattern: _Pattern
    v: Real
    bad: Times | None
    no_temperature: Mask | None


class Pipeline:
    """Computes the stress of the cubes of one skin.

    Cubes may have different layouts. Tables of pads have as many columns as the cube with most pads
    has pads.

    Attributes:
        calibrations: Calibration of each cube.
        n_pads: Largest number of pads of a cube, P.
        dtype: Precision of the computation.
    """

    def __init__(self, calibrations: Sequence[Calibration], dtype: type = np.float64) -> None:
        """Prepare the matrices of all calibrations.

        Args:
            calibrations: Calibration of each cube.
            dtype: Precision of the computation, np.float32 or np.float64.

        Raises:
            CubeError: `dtype` is neither of the two.
            CalibrationError: There are no cubes.
        """
        self.dtype = np.dtype(dtype)
        if self.dtype not in (np.float32, np.float64):
            raise CubeError(f"pipeline: dtype {self.dtype}; use float32 or float64")
        if not calibrations:
            raise CalibrationError("pipeline: no calibrations; give one per cube")
        self.calibrations = tuple(calibrations)
        self.n_pads = max(c.layout.n_pads for c in self.calibrations)

        # Cubes with equal calibrations form a group, which shares its matrices.
        by_id = {c.id: c for c in reversed(self.calibrations)}
        numbers = {key: number for number, key in enumerate(by_id)}
        self._groups = tuple(by_id.values())
        self._group = np.array([numbers[c.id] for c in self.calibrations])
        # For pads that a cube does not have, these values give a stiffness of 0 without a division
        # by 0.
        beta = pad_table([c.beta for c in self._groups], self.n_pads, fill=1)
        modulus = pad_table([c.modulus for c in self._groups], self.n_pads, fill=0)
        self._beta = np.maximum(beta, MIN_BETA)
        self._stiffness = modulus * (1 + self._beta) / self._beta
        pad_counts = np.array([c.layout.n_pads for c in self._groups])
        self._exists: Mask = np.arange(self.n_pads) < pad_counts[:, None]
        self._is_thermal = np.array([c.temperature is not None for c in self._groups])
        self._any_thermal = bool(self._is_thermal.any())

        self._estimator = lru_cache(maxsize=MAX_CACHED_ESTIMATORS)(self._make_estimator)
        self._table = lru_cache(maxsize=MAX_CACHED_ESTIMATORS)(self._make_table)
        groups = range(len(self._groups))
        # Calibrations with no more pads than modes have no residual. Even if this holds for all,
        # the matrices have one row for the residual, which is NaN.
        most_dof = max(self._estimator(group, 0).dof for group in groups)
        self._n_residual = most_dof or 1
        tables = [self._make_table(group, 0) for group in groups]
        self._matrices = np.array([table.matrix for table in tables])
        is_recovered = ~np.isnan(self._matrices).all(axis=(0, 2))
        self._recovered = np.flatnonzero(is_recovered)
        self._limits = np.array([table.limit for table in tables], dtype=self.dtype)
        self._observed = np.array([table.observed for table in tables], dtype=np.uint16)
        self._patterns = PatternCache(self._make_pattern, len(self.calibrations))
        rest = [c.rest_frequency for c in self.calibrations]
        self.rest_frequency = pad_table(rest, self.n_pads, fill=np.nan)

    def __repr__(self) -> str:
        return (
            f"Pipeline(cubes={len(self.calibrations)}, calibrations={len(self._groups)}, "
            f"pads={self.n_pads}, dtype={self.dtype})"
        )

    @property
    def rest_frequency(self) -> Array:
        """Frequencies without load (cubes, P), in Hz, at the reference temperature.

        They are NaN where a cube has no such pad. Setting new ones, as a tare does, raises
        LayoutError for a wrong shape, and CubeError for values that are not finite and above 0.
        """
        rest: Array = self._rest.copy()
        return rest

    @rest_frequency.setter
    def rest_frequency(self, value: Array) -> None:
        rest = np.array(value, dtype=float)
        exists = self._exists[self._group]
        if rest.shape != exists.shape:
            raise LayoutError(
                f"rest_frequency has shape {rest.shape}; this skin needs {exists.shape}"
            )
        existing = rest[exists]
        is_valid = (existing > 0) & np.isfinite(existing)
        if not is_valid.all():
            raise CubeError(
                f"rest_frequency holds {existing.min():g} Hz; "
                "every pad's must be finite and above 0"
            )
        self._rest = np.where(exists, rest, np.nan)
        self._patterns.clear()

    def temperature_factor(self, cube: Index, temperature: Real) -> Array:
        """Return the ratio of rest frequencies at a temperature to those at the reference (N, P).

        The ratio is 1 if a calibration has no temperature model or the temperature is unknown.

        Args:
            cube: Numbers of the cubes (N,).
            temperature: Temperatures (N,), in °C; NaN where they are unknown.
        """
        return self._factor(self._group[cube], np.asarray(temperature, dtype=float))

    def process(self, rows: FrequencyRows, left_out: PadMasks | None = None) -> StressRows:
        """Compute the stress of N rows.

        Args:
            rows: Rows of one scan (at most one row per cube), or of several scans of the same cubes
                one after the other.
            left_out: Bit masks of the pads that are not used (N,). None stands for the pads that
                the device reports as broken.

        Raises:
            LayoutError: Arrays have the wrong shape. Every other problem of a row becomes a bit of
                its status.
        """
        if left_out is None:
            left_out = rows.pad_fault
        with np.errstate(all="ignore", divide="raise"):
            law = self._apply_law(rows, left_out)
            pattern, v, bad = law.pattern, law.v, law.bad
            out = self._multiply(pattern, v)
            limit = pattern.limit
            # concatenate makes a copy, so that the changes below for rows with bad pads do not
            # reach the cached array.
            observed = np.concatenate([pattern.observed] * len(v))
            if bad is not None:
                limit = np.tile(pattern.limit, (len(v), 1))
                self._correct_bad_rows(pattern, v, bad, out, limit, observed)
            residual = self._residual(out)
            is_over_limit = (residual > limit).ravel()

        status = is_over_limit * np.uint16(RESIDUAL)
        if bad is not None:
            bad = bad.ravel()
            left_out = (left_out | bad).astype(np.uint32)
            status[bad != 0] |= PAD_FAULT
            status[observed == 0] |= INVALID
        if law.no_temperature is not None:
            status[law.no_temperature.ravel()] |= TEMPERATURE
        # Only the STAMP bit of the source is adopted, because a sender of messages may have set any
        # other bit by mistake.
        status |= rows.status & np.uint16(STAMP)
        components = out.reshape(-1, out.shape[2])
        return StressRows(
            cube=rows.cube,
            sequence=rows.sequence,
            stamp_ns=rows.stamp_ns,
            stress=components[:, : len(STRESS)],
            gradient=components[:, len(STRESS) : N_COMPONENTS],
            residual=residual.ravel(),
            status=status,
            observed=observed,
            left_out=left_out,
        )

    def _multiply(self, pattern: _Pattern, v: Real) -> Real:
        """Multiply pad stresses by the matrices of the rows' calibrations.

        Args:
            pattern: Pattern of a scan.
            v: Pad stresses divided by the stiffness (B, N, P).

        Returns:
            15 components and D residuals of each row (B, N, 15 + D).
        """
        if len(pattern.blocks) == 1 and pattern.blocks[0].matrix.ndim == 2:
            # All cubes share one calibration: the product is the result, without a copy.
            [block] = pattern.blocks
            product: Real = v[:, :, : block.pads] @ block.matrix
            return product
        shape = (*v.shape[:2], N_COMPONENTS + self._n_residual)
        out = np.full(shape, np.nan, dtype=self.dtype)
        for rows, pads, matrix in pattern.blocks:
            if matrix.ndim == 2:
                out[:, rows] = v[:, rows, :pads] @ matrix
            else:
                part = out[:, rows]
                # The axis of the pads comes first and that of the cubes last, so that the inner
                # loop of einsum runs over neighbours in memory.
                by_pad = v[:, rows, :pads].transpose(2, 0, 1)
                product = np.einsum("pin,pbn->bni", matrix, np.ascontiguousarray(by_pad))
                part[:, :, self._recovered] = product
                out[:, rows] = part
        return out

    def _correct_bad_rows(
        self,
        pattern: _Pattern,
        v: Real,
        bad: Times,
        out: Real,
        limit: Array,
        observed: AnyArray,
    ) -> None:
        """Compute rows with bad pads again, with the matrix for their good pads.

        Rows of cubes that the skin does not have become NaN.

        Args:
            pattern: Pattern of a scan.
            v: Pad stresses divided by the stiffness (B, N, P).
            bad: Bit masks of the bad pads (B, N).
            out: Components and residuals of each row (B, N, 15 + D), which are changed.
            limit: Limits of the residual (B, N), which are changed.
            observed: Bit masks of the observed components (B N,), which are changed.
        """
        flat_out = out.reshape(-1, out.shape[2])
        flat_limit = limit.reshape(-1)
        flat_v = v.reshape(-1, self.n_pads)
        groups = np.tile(pattern.group, len(v))
        for group, mask, rows in _group_by_mask(groups, bad.ravel()):
            table = self._table(group, mask)
            # matmul forms one product per row, because the last bit of a single product for all
            # rows may depend on their number.
            product = np.matmul(table.matrix, flat_v[rows][:, :, None])
            flat_out[rows] = product[:, :, 0]
            flat_limit[rows] = table.limit
            observed[rows] = table.observed
        out[:, pattern.unknown] = np.nan
        observed.reshape(len(v), -1)[:, pattern.unknown] = 0

    def _residual(self, out: Real) -> Real:
        """Compute the residual sqrt(chi-square / degrees of freedom) of each row (B, N).

        Args:
            out: 15 components and D residuals of each row (B, N, 15 + D). The sum of squares of the
                D residuals is chi-square / degrees of freedom.
        """
        rest = out[:, :, N_COMPONENTS:]
        if self._n_residual == 1:
            return np.abs(rest[:, :, 0])
        residual: Real = np.sqrt(np.einsum("bnd,bnd->bn", rest, rest))
        return residual

    def pad_stress(self, rows: FrequencyRows, left_out: PadMasks | None = None) -> Array:
        """Compute pad stresses (N, P), in Pa, by the pad law.

        They are not divided by the gains (relative sensitivities) of the pads. They are NaN for
        bad pads, and for pads that the cube does not have.

        Args:
            rows: N rows of frequencies.
            left_out: Bit masks of the pads that are not used (N,). None stands for the pads that
                the device reports as broken.
        """
        group, unknown, stress, bad = self._apply_law_by_row(rows, left_out)
        is_bad = _unpack_bits(bad, self.n_pads)
        is_missing = ~self._exists[group] | unknown[:, None] | is_bad
        return np.where(is_missing, np.nan, stress)

    def suspects(self, rows: FrequencyRows, left_out: PadMasks | None = None) -> Mask:
        """Find the pads that explain a high residual if just this one pad is broken.

        Args:
            rows: N rows of frequencies.
            left_out: Bit masks of the pads that are not used (N,). None stands for the pads that
                the device reports as broken.

        Returns:
            Whether a pad is a suspect (N, P), by the rule of `Estimator.suspects`.
        """
        groups, unknown, stress, bad = self._apply_law_by_row(rows, left_out)
        result = np.zeros(stress.shape, dtype=bool)
        for group, mask, chosen in _group_by_mask(groups, bad, also_good=True):
            n_pads = self._groups[group].layout.n_pads
            estimator = self._estimator(group, mask)
            result[chosen, :n_pads] = estimator.suspects(stress[chosen, :n_pads])
        return result & ~unknown[:, None]

    def _apply_law_by_row(
        self, rows: FrequencyRows, left_out: PadMasks | None
    ) -> tuple[Index, Mask, Array, Times]:
        """Apply the pad law (frequency to stress of a pad) to N rows.

        Args:
            rows: N rows of frequencies.
            left_out: Bit masks of the pads that are not used (N,). None stands for the pads that
                the device reports as broken.

        Returns:
            Number of the calibration of each row (N,), whether the skin lacks the row's cube (N,),
            pad stresses (N, P) in Pa, and bit masks of the bad pads (N,).
        """
        if left_out is None:
            left_out = rows.pad_fault
        with np.errstate(all="ignore", divide="raise"):
            law = self._apply_law(rows, left_out)
        scans = len(law.v)
        group = np.tile(law.pattern.group, scans)
        unknown = np.tile(law.pattern.unknown, scans)
        bad = np.zeros(len(group), np.int64)
        if law.bad is not None:
            bad = law.bad.ravel()
        v = law.v.reshape(-1, self.n_pads)
        stress = v * self._stiffness[group]
        return group, unknown, stress, bad

    def matrix(self, cube: int, left_out: int = 0) -> Array:
        """Return the matrix (15, P) from the stresses on a cube's pads to its components.

        Args:
            cube: Number of the cube.
            left_out: Bit mask of the pads that are not used.

        Returns:
            Matrix with rows in Pa per Pa for the 6 stresses and in Pa/m per Pa for the 9 gradients.
            Rows of components that the pads do not determine are NaN, and columns of pads that are
            not used are 0.
        """
        estimator, scale = self._find_estimator(cube, left_out)
        return estimator.matrix * scale[:, None]

    def covariance(self, cube: int, left_out: int = 0) -> Array:
        """Return the covariance (15, 15) of a cube's components due to the noise of its pads.

        Args:
            cube: Number of the cube.
            left_out: Bit mask of the pads that are not used.

        Returns:
            Covariance of 6 stresses in Pa and 9 gradients in Pa/m; NaN in the rows and columns of
            components that the pads do not determine.
        """
        estimator, scale = self._find_estimator(cube, left_out)
        return estimator.covariance * np.outer(scale, scale)

    def _find_estimator(self, cube: int, left_out: int) -> tuple[Estimator, Array]:
        """Return the estimator of a cube, and factors for the units of its components.

        Args:
            cube: Number of the cube.
            left_out: Bit mask of the pads that are not used.

        Returns:
            Estimator, and the factors (15,) from its components, in Pa, to Pa and Pa/m.
        """
        group = int(self._group[cube])
        # Bits of pads that the cube does not have are removed, because they would fill the cache
        # with equal estimators.
        mask = int(left_out) & int(_pack_bits(self._exists[group]))
        return self._estimator(group, mask), self._scale(group)

    def _apply_law(self, rows: FrequencyRows, left_out: PadMasks) -> _PadLaw:
        """Apply the pad law v = (f - f0) / (f_highest - f), in three passes over the rows.

        The stress on a pad is v times its stiffness E (1 + beta) / beta. Several scans with the
        same rising cube numbers become as many scans in the result; rows in any other order become
        one scan.

        Args:
            rows: Rows of frequencies f.
            left_out: Bit masks of the pads that are not used (N,).

        Raises:
            LayoutError: The frequencies have the wrong shape.
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
        if count > 1:
            # A single scan keeps the two axes (rows, pads), because numpy is faster with them than
            # with a third axis of length 1.
            f = f.reshape(count, n, self.n_pads)
        rest, highest = pattern.rest, pattern.highest
        no_temperature = None
        if self._any_thermal:
            temperature = np.asarray(rows.temperature, dtype=float).reshape(count, n)
            no_temperature = self._is_thermal[pattern.group] & ~np.isfinite(temperature)
            factor = self._factor(pattern.group, temperature)
            rest = (rest * factor).astype(self.dtype)
            highest = (highest * factor).astype(self.dtype)
        v = f - rest
        below_highest = highest - f
        any_reported = np.count_nonzero(left_out) > 0
        try:
            v /= below_highest
            # As f falls to 0, v falls to `lowest_v`; for f above the highest frequency, v is below
            # -1. So one comparison of the smallest v finds any frequency outside the pad law.
            is_full = f.size == count * pattern.n_pads
            is_within = n > 0 and is_full and v.min() > pattern.lowest_v
        except FloatingPointError:  # f equals the highest frequency
            is_within = False
        v = v.reshape(count, n, self.n_pads)
        if is_within and not any_reported:
            return _PadLaw(pattern, v, None, no_temperature)

        # NaN, Inf and frequencies outside the range of the pad law fail one of these comparisons.
        is_good = (f > 0) & (below_highest > 0)
        is_good = is_good.reshape(v.shape)
        if np.count_nonzero(is_good) == count * pattern.n_pads and not any_reported:
            return _PadLaw(pattern, v, None, no_temperature)
        if any_reported:
            by_scan = np.asarray(left_out).reshape(count, n)
            is_good &= ~_unpack_bits(by_scan, self.n_pads)
        v[~is_good] = 0
        bad = _pack_bits(self._exists[pattern.group] & ~is_good)
        return _PadLaw(pattern, v, bad, no_temperature)

    def _make_pattern(self, cube: AnyArray) -> _Pattern:
        """Compute the quantities that depend only on the cube numbers of rows.

        Args:
            cube: Cube numbers of one scan, or of several scans of the same cubes. The result is
                then that of one of these scans.
        """
        repeats = count_repeats(cube)
        if repeats > 1:
            return self._patterns.get(cube[: len(cube) // repeats])
        unknown = (cube < 0) | (cube >= len(self.calibrations))
        known_cube = np.where(unknown, 0, cube).astype(int)
        group, rest = self._group[known_cube], self._rest[known_cube]
        highest = highest_frequency(rest, self._beta[group])
        # Each pad has its lowest v at f = 0. The largest of these values serves as the limit of all
        # pads.
        at_zero = -rest / highest
        lowest_v = float(np.fmax.reduce(at_zero, axis=None, initial=-1.0))
        # For a scan with a cube that the skin does not have, one pad too many is counted. So it
        # always appears to have a bad pad, and `_correct_bad_rows` sets that cube's row to NaN.
        n_pads = int(np.count_nonzero(self._exists[group]))
        n_pads += int(unknown.any())
        return _Pattern(
            unknown=unknown,
            group=group,
            rest=rest.astype(self.dtype),
            highest=highest.astype(self.dtype),
            lowest_v=lowest_v * (1 - LOWEST_STRESS_MARGIN),
            n_pads=n_pads,
            blocks=self._make_blocks(group),
            limit=self._limits[group],
            observed=self._observed[group],
        )

    def _make_blocks(self, group: Index) -> list[_Block]:
        """Divide the rows of a scan into blocks that are computed in one matrix product each.

        A block holds the rows of one calibration or, with more than `MAX_SEPARATE_PRODUCTS`
        calibrations, all rows with the same number of pads.

        Args:
            group: Number of the calibration of each row of the scan (N,).
        """
        is_separate = len(self._groups) <= MAX_SEPARATE_PRODUCTS
        n_pads = self._exists.sum(axis=1)[group]
        shared = group if is_separate else n_pads
        blocks = []
        for value in np.unique(shared).tolist():
            index = np.flatnonzero(shared == value)
            first, last = int(index[0]), int(index[-1])
            # Indexing with a slice makes no copy of an array, indexing with numbers does.
            are_neighbours = last - first + 1 == len(index)
            rows = slice(first, last + 1) if are_neighbours else index
            pads = int(n_pads[first])
            if is_separate:
                matrix = self._matrices[value, :, :pads].T
            else:
                recovered = self._matrices[:, self._recovered]
                matrix = recovered[group[index], :, :pads].transpose(2, 1, 0)
            blocks.append(_Block(rows, pads, np.ascontiguousarray(matrix)))
        return blocks

    def _factor(self, group: Index, temperature: Array) -> Array:
        """Return the ratio of rest frequencies at temperatures to those at the reference.

        Args:
            group: Number of the calibration of each row (N,).
            temperature: Temperatures (..., N), in °C; NaN where they are unknown.

        Returns:
            Ratio for each pad (..., N, P); 1 without a temperature or a temperature model.
        """
        factor = np.ones((*temperature.shape, self.n_pads))
        for number, calibration in enumerate(self._groups):
            if calibration.temperature is not None:
                rows = (group == number) & np.isfinite(temperature)
                own = calibration.temperature.factor(temperature[rows])
                factor[rows, : calibration.layout.n_pads] = own
        return factor

    def _scale(self, group: int) -> Array:
        """Return the factors (15,) from the components of an estimator to Pa and Pa/m.

        An estimator gives gradients times d0 (half the side of the cube), in Pa.

        Args:
            group: Number of the calibration.
        """
        is_stress = np.arange(N_COMPONENTS) < len(STRESS)
        return np.where(is_stress, 1, 1 / self._groups[group].half_side)

    def _make_estimator(self, group: int, mask: int) -> Estimator:
        """Construct the estimator (map from pad stresses to components) of a calibration.

        Args:
            group: Number of the calibration.
            mask: Bit mask of the pads that are not used.
        """
        calibration = self._groups[group]
        missing = np.flatnonzero(_unpack_bits(mask, calibration.layout.n_pads))
        return make_estimator(
            calibration.response,
            calibration.noise,
            calibration.modes,
            missing,
            calibration.neglect,
        )

    def _make_table(self, group: int, mask: int) -> _Table:
        """Construct the matrix and limits of a calibration without some pads.

        Args:
            group: Number of the calibration.
            mask: Bit mask of the pads that are not used.
        """
        estimator = self._estimator(group, mask)
        n_pads = self._groups[group].layout.n_pads
        matrix = np.zeros((N_COMPONENTS + self._n_residual, self.n_pads))
        matrix[:N_COMPONENTS, :n_pads] = estimator.matrix * self._scale(group)[:, None]
        # The residual is NaN (unknown) if there are no more pads than determined modes.
        matrix[N_COMPONENTS:, :n_pads] = np.nan
        # If pads are missing and the rank falls by more than their number, the residual has more
        # degrees of freedom than the table has rows for it. Then only the first of them are used.
        null = estimator.null[: self._n_residual]
        dof = len(null)
        limit = np.nan
        if dof:
            # The root of the sum of squares that these rows give is sqrt(chi-square / dof), which
            # is about 1 for noise alone.
            end = N_COMPONENTS + dof
            matrix[N_COMPONENTS:, :n_pads] = 0
            matrix[N_COMPONENTS:end, :n_pads] = null / np.sqrt(dof)
            limit = np.sqrt(chi2_limit(dof, FALSE_ALARM) / dof)
        # The matrix will be applied to pad stresses divided by the stiffness, so the stiffness is
        # included in it.
        matrix *= self._stiffness[group]
        observed = int(_pack_bits(estimator.observed))
        return _Table(matrix.astype(self.dtype, order="F"), limit, observed)


def _unpack_bits(mask: AnyArray | int, count: int) -> Mask:
    """Convert bit masks to truth values.

    Args:
        mask: Bit masks (...).
        count: Number of bits to convert, from bit 0 (the lowest) on.

    Returns:
        Whether each bit is set (..., count).
    """
    masks = np.asarray(mask, dtype=np.int64)
    shifted = masks[..., None] >> np.arange(count)
    bits: Mask = shifted & 1 > 0
    return bits


def _pack_bits(bits: Mask) -> Times:
    """Convert truth values (..., count) to bit masks (...); value p becomes bit p of a mask."""
    weights = np.int64(1) << np.arange(bits.shape[-1])
    masks: Times = bits @ weights
    return masks


def _group_by_mask(
    group: Index,
    mask: Times,
    also_good: bool = False,
) -> Iterator[tuple[int, int, Index]]:
    """Collect the rows of each distinct pair of calibration and bit mask of bad pads.

    Args:
        group: Number of the calibration of each row (N,).
        mask: Bit mask of the bad pads of each row (N,).
        also_good: Whether rows without bad pads are collected, too.

    Yields:
        Number of the calibration, bit mask, and the numbers of the rows that have both.
    """
    rows = np.arange(len(mask)) if also_good else np.flatnonzero(mask)
    # Masks have 32 bits, so the number of the calibration and the mask fit one 64-bit integer.
    keys = group[rows] << 32 | mask[rows]
    pairs, which = np.unique(keys, return_inverse=True)
    # A stable sort keeps the order of rows with the same calibration and mask.
    order = np.argsort(which, kind="stable")
    bounds = np.searchsorted(which[order], np.arange(len(pairs) + 1))
    for number, pair in enumerate(pairs.tolist()):
        start, end = bounds[number], bounds[number + 1]
        yield pair >> 32, pair & 0xFFFFFFFF, rows[order[start:end]]
