# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Pipeline: from frequencies of pads to stresses of cubes.

A row (sample of one cube) is computed in two steps: the pad law (`oscillator.py`) gives the stress
on each pad from its frequency, and a matrix product gives the 15 components of stress and gradient.
The same matrix has further columns for the residual, combinations of the pads' stresses that only
noise makes differ from 0. There is one matrix for each calibration, and one for each pair of a
calibration and a set of bad pads that has occurred. Whatever the numbers in a row are, they raise
no error.

This module makes the matrices; the kernel (`kernel/`) goes through the rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import NDArray

from .arrays import Array, Index, Mask, PadMasks, Real
from .calibration import Calibration, tabulate_pads
from .errors import CalibrationError, CubeError, LayoutError
from .estimator import Estimator, compute_chi2_limit, make_estimator
from .kernel.contract import (
    BLOCK,
    DONE,
    NEEDS_CONDITION,
    NEEDS_STEP,
    NEEDS_WINDOW,
    UNKNOWN_CUBE,
    Columns,
    Numbers,
    Tables,
    Task,
)
from .kernel.rows import (
    N_COMPONENTS,
    apply_law,
    compute_temperature_factor,
    find_existing,
    pack_bits,
    unpack_mask_bits,
)
from .kernel.run import run
from .modes import GRADIENT, STRESS
from .oscillator import find_highest_frequency
from .rows import FrequencyRows, StressRows
from .status import INVALID, STAMP

if TYPE_CHECKING:
    from .compensation.compensation import Compensation
    from .health.health import Health

MAX_CACHED_ESTIMATORS = 1024
"""Maximum number of matrices, from the stresses on the pads of a cube to components of stress, that
are kept in memory for cubes with bad pads.

There is one for each pair of a calibration and a set of bad pads that has occurred. If there is no
room for another one, all of them are removed.
"""

MIN_BETA = 1e-12
"""Smallest value of beta (ratio of a pad's parasitic to its active capacitance) in the pad law (the
formula from the frequency of a pad to the stress on it).

The computation divides by beta, so a pad with beta = 0 is computed with this value. It changes the
strain of the pad by 1e-12.
"""

NO_KEY = np.iinfo(np.int64).max
"""Entry of `Tables.keys` (calibration and bad pads of each matrix) where no matrix is stored yet.

It is larger than any other entry, so that the entries stay in rising order.
"""

UNKNOWN = np.iinfo(np.uint16).max
"""Cube number that replaces all numbers below 0 or above 65534, because the kernel (the loop over
rows) takes numbers of 16 bits. No skin has a cube with this number."""

_calibrations: WeakValueDictionary[str, Calibration] = WeakValueDictionary()
"""Calibrations in use by any pipeline of the process, by their ids (hashes of the content).

If a skin file is read again, its calibrations are replaced by the equal ones in this dictionary.
`_find_estimator` has cached the estimators of these.
"""


@lru_cache(maxsize=MAX_CACHED_ESTIMATORS)
def _find_estimator(calibration: Calibration, mask: int) -> Estimator:
    """Return the estimator (map from pad stresses to components) of a calibration.

    It is cached for all pipelines of the process, because making it takes longer than computing the
    stress from the data of one second.

    Args:
        calibration: The calibration.
        mask: Bit mask of the pads that are not used.

    Returns:
        Estimator of stresses, in Pa, and gradients, in Pa/m. Its arrays must not be changed.
    """
    pads = np.arange(calibration.layout.n_pads)
    is_missing = mask >> pads & 1 > 0
    estimator = make_estimator(
        calibration.response,
        calibration.noise,
        calibration.modes,
        pads[is_missing],
        calibration.neglect,
        drift=calibration.drift_stress,
    )
    # So far, the estimator gives gradients times d0 (half the side of the cube), in Pa.
    scale = calibration.component_scale
    return replace(
        estimator,
        matrix=estimator.matrix * scale[:, None],
        covariance=estimator.covariance * np.outer(scale, scale),
    )


class Pipeline:
    """Computes the stress of the cubes of one skin.

    Cubes may have different layouts. Tables of pads have as many columns as the cube with most pads
    has pads.

    Attributes:
        calibrations: Calibration of each cube.
        n_pads: Largest number of pads of a cube, P.
        dtype: Precision of the computation.
        newest_offset: Sum of the effects of weight, creep and temperature that was subtracted from
            the newest row of each cube (cubes, P), as stress divided by the stiffness of the pad;
            None: nothing is compensated.
        rest_changes: Number of changes of the rest frequencies so far, by tare or drift.
    """

    rest_changes = -1  # the calibrated rest frequencies, which are set first, are no change

    def __init__(
        self,
        calibrations: Sequence[Calibration],
        dtype: type = np.float64,
    ) -> None:
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
        # Cubes with equal calibrations form a group, which shares its matrices.
        ids = [calibration.id for calibration in calibrations]
        _, first, group = np.unique(
            ids,
            return_index=True,
            return_inverse=True,
        )
        self._groups = tuple(
            _calibrations.setdefault(ids[cube], calibrations[cube]) for cube in first.tolist()
        )
        self.calibrations = tuple(self._groups[number] for number in group.tolist())
        self.n_pads = max(calibration.layout.n_pads for calibration in self._groups)
        # For pads that a cube does not have, these values give a stiffness of 0 without a division
        # by 0.
        beta = tabulate_pads(self._groups, "beta", self.n_pads, fill=1)
        modulus = tabulate_pads(self._groups, "modulus", self.n_pads, fill=0)
        self._beta = np.maximum(beta, MIN_BETA)
        self._stiffness = modulus * (1 + self._beta) / self._beta
        whole = [_find_estimator(calibration, 0) for calibration in self._groups]
        # Calibrations with no more pads than modes have no residual. Even if this holds for all,
        # the matrices have one column for the residual, which is NaN.
        self._n_residuals = max(estimator.dof for estimator in whole) or 1
        self._tables = self._allocate_tables(group.astype(np.int32))
        for number, estimator in enumerate(whole):
            self._store_table(number, number, estimator)
        self._n_extra = 0
        self.newest_offset: Real | None = None
        self.rest_frequency = tabulate_pads(
            self.calibrations,
            "rest_frequency",
            self.n_pads,
            fill=np.nan,
        )

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
        group = self._tables.calibration
        exists = find_existing(self._tables, group)
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
        self.rest_changes += 1
        self._tables.rest[:] = self._rest
        self._tables.highest[:] = find_highest_frequency(self._rest, self._beta[group])

    @property
    def stiffness(self) -> Array:
        """Stiffness E (1 + beta) / beta of each pad (cubes, P), in Pa.

        It is 0 where a cube has no such pad. E is the modulus of the pad's foam, and beta the ratio
        of the pad's parasitic to its active capacitance. The kernel computes with pad stresses
        divided by the stiffness.
        """
        stiffness: Array = self._stiffness[self._tables.calibration]
        return stiffness

    def compute_unloaded_factor(
        self,
        cube: Index,
        temperature: Real,
        offset: Real | None = None,
    ) -> Array:
        """Return the ratio of the frequencies without load to the rest frequencies (N, P).

        The ratio is the product of two factors. One states how temperature changes the frequency of
        a pad without load. The other is the ratio f / f0 at which the stress of a pad, divided by
        its stiffness, is the offset o that the compensation subtracts. It follows from the pad law
        o = (f - f0) / (f0 (1 + beta) / beta - f), where beta is the ratio of the parasitic to the
        active capacitance of a pad without load.

        Args:
            cube: Numbers of the cubes (N,).
            temperature: Temperatures (N,), in °C; NaN where they are unknown.
            offset: Offsets o (N, P), stress / stiffness; None: those of the newest rows.
        """
        calibration = self._tables.calibration[cube]
        factor = compute_temperature_factor(
            self._tables,
            calibration,
            temperature,
        )
        if offset is None and self.newest_offset is not None:
            offset = self.newest_offset[cube].astype(float)
        if offset is None:
            return factor
        beta = self._beta[calibration]
        numerator = 1 + offset * (1 + beta) / beta
        shifted: Array = factor * numerator / (1 + offset)
        return shifted

    def compute_zero_shift(self, before: Array) -> Array:
        """Return by how much stresses were too high because of older rest frequencies (cubes, P).

        The rest frequency of a pad is its frequency without load. The result is the stress,
        divided by the stiffness of the pad (no unit), that follows from the present rest frequency
        if the older one is taken for the frequency without load.

        Args:
            before: The older rest frequencies (cubes, P), in Hz.
        """
        ratio = self._rest / before
        beta = self._beta[self._tables.calibration]
        highest_ratio = (1 + beta) / beta
        return (ratio - 1) / (highest_ratio - ratio)

    def process(
        self,
        rows: FrequencyRows,
        left_out: PadMasks | None = None,
        *,
        watch: Health | None = None,
        known: Mask | None = None,
        out: StressRows | None = None,
        effects: Compensation | None = None,
        offset: Real | None = None,
    ) -> StressRows:
        """Compute the stress of N rows.

        Args:
            rows: Rows of one scan (at most one row per cube), or of several scans one after the
                other.
            left_out: Bit masks of the pads that are not used (N,). None stands for the pads that
                the device reports as broken.
            watch: Health, which is updated with each row before its stress is computed. The pads
                that it finds broken are not used, and the conditions of the cube's pads are added
                to the status.
            known: Whether the health of a row (pads that are not used, conditions) is given by
                `left_out` and the `status` of `out`, and not by `watch` (N,). None: for no row.
            out: Rows to write into; None makes new ones.
            effects: Effects that are subtracted; None: none are, whatever columns the rows have.
            offset: Array for what is subtracted (N, P), stress / stiffness; None: not wanted.

        Raises:
            LayoutError: Arrays have the wrong shape, or `watch` is given and a row is of a cube
                that the skin does not have. Every other problem of a row becomes a bit of its
                status.
        """
        columns = self._read_columns(rows, known)
        if out is None:
            out = self.make_rows(rows)
        if watch is None or known is not None:
            out.left_out[:] = rows.pad_fault if left_out is None else left_out
        task = Task(
            n_residuals=self._n_residuals,
            tables=self._tables,
            health=watch.sums if watch else None,
            offsets=effects.offsets if effects else None,
            columns=columns,
            out=out,
            offset=offset,
        )
        row = 0
        while row < len(rows):
            row, request = run(row, task)
            if request == UNKNOWN_CUBE:
                if watch:
                    raise self._make_layout_error(rows)
                _fill_unknown(out, rows, row)
                row += 1
            elif request == NEEDS_WINDOW and watch:
                watch.advance()
            elif request == NEEDS_STEP and effects:
                effects.step(columns, row)
            elif request == NEEDS_CONDITION and watch:
                watch.find_conditions(self._tables, columns, row)
            elif request != DONE:
                self._add_table(request)
        return out

    def make_rows(self, rows: FrequencyRows) -> StressRows:
        """Return rows of stress for `process` to write into, with the status 0.

        Args:
            rows: N rows of frequencies, from which cube, sequence number and time stamp are taken.
        """
        n = len(rows)
        return StressRows(
            cube=rows.cube,
            sequence=rows.sequence,
            stamp_ns=rows.stamp_ns,
            stress=np.empty((n, len(STRESS)), self.dtype),
            gradient=np.empty((n, len(GRADIENT)), self.dtype),
            residual=np.empty(n, self.dtype),
            status=np.zeros(n, np.uint16),
            observed=np.empty(n, np.uint16),
            left_out=np.empty(n, np.uint32),
        )

    def compute_pad_stress(
        self,
        rows: FrequencyRows,
        left_out: PadMasks | None = None,
    ) -> Array:
        """Compute pad stresses (N, P), in Pa, by the pad law.

        They are not divided by the gains (relative sensitivities) of the pads. They are NaN for
        bad pads, and for pads that the cube does not have.

        Args:
            rows: N rows of frequencies.
            left_out: Bit masks of the pads that are not used (N,). None stands for the pads that
                the device reports as broken.
        """
        _, is_used, stress = self._apply_law(rows, left_out)
        return np.where(is_used, stress, np.nan)

    def find_suspects(
        self,
        rows: FrequencyRows,
        left_out: PadMasks | None = None,
    ) -> Mask:
        """Find each pad that, as the only broken pad of a cube, would explain a high residual.

        Args:
            rows: N rows of frequencies.
            left_out: Bit masks of the pads that are not used (N,). None stands for the pads that
                the device reports as broken.

        Returns:
            Whether a pad is a suspect (N, P), by the rule of `Estimator.find_suspects`.
        """
        group, is_used, stress = self._apply_law(rows, left_out)
        result = np.zeros(stress.shape, dtype=bool)
        # Masks have 32 bits, so the number of the calibration and the mask fit one 64-bit integer.
        keys = group.astype(np.int64) << 32 | pack_bits(~is_used)
        for key in np.unique(keys).tolist():
            chosen = keys == key
            calibration = self._groups[key >> 32]
            n_pads = calibration.layout.n_pads
            estimator = _find_estimator(calibration, key & 0xFFFFFFFF)
            suspects = estimator.find_suspects(stress[chosen, :n_pads])
            result[chosen, :n_pads] = suspects
        return result

    def find_matrix(self, cube: int, left_out: int = 0) -> Array:
        """Return the matrix (15, P) from the stresses on a cube's pads to its components.

        Args:
            cube: Number of the cube.
            left_out: Bit mask of the pads that are not used.

        Returns:
            Matrix with rows in Pa per Pa for the 6 stresses and in Pa/m per Pa for the 9 gradients.
            Rows of components that the pads do not determine are NaN, and columns of pads that are
            not used are 0.
        """
        return _find_estimator(self.calibrations[cube], int(left_out)).matrix

    def compute_covariance(self, cube: int, left_out: int = 0) -> Array:
        """Return the covariance (15, 15) of a cube's components due to the noise of its pads.

        Args:
            cube: Number of the cube.
            left_out: Bit mask of the pads that are not used.

        Returns:
            Covariance of 6 stresses in Pa and 9 gradients in Pa/m; NaN in the rows and columns of
            components that the pads do not determine.
        """
        return _find_estimator(self.calibrations[cube], int(left_out)).covariance

    def _read_columns(self, rows: FrequencyRows, known: Mask | None) -> Columns:
        """Return the columns of rows in the types that the kernel takes.

        Args:
            rows: N rows of frequencies.
            known: Whether the health of the pads is given for each row (N,), so that the kernel
                does not assess it; None: for no row.

        Raises:
            LayoutError: The frequencies have the wrong shape.
        """
        frequency = rows.frequency
        if frequency.dtype != self.dtype:
            with np.errstate(all="ignore"):  # a frequency that float32 does not hold is infinite
                frequency = frequency.astype(self.dtype)
        frequency = np.ascontiguousarray(frequency)
        if frequency.shape != (len(rows), self.n_pads):
            raise self._make_layout_error(rows)
        force = rows.specific_force
        cube = rows.cube
        if cube.dtype != np.uint16:
            is_possible = (cube >= 0) & (cube < UNKNOWN)
            cube = np.where(is_possible, cube, UNKNOWN).astype(np.uint16)
        return Columns(
            np.ascontiguousarray(cube),
            frequency,
            np.ascontiguousarray(rows.temperature, np.float32),
            np.ascontiguousarray(rows.pad_fault, np.uint32),
            np.ascontiguousarray(rows.stamp_ns, np.int64),
            np.ascontiguousarray(rows.status, np.uint16),
            known,
            None if force is None else np.ascontiguousarray(force, self.dtype),
        )

    def _make_layout_error(self, rows: FrequencyRows) -> LayoutError:
        """Return the error for rows with other cubes, or more or fewer pads, than the skin has."""
        return LayoutError(
            f"pipeline: frequencies of shape {rows.frequency.shape} for {len(rows)} rows of cubes "
            f"up to {max(rows.cube, default=0)}; this skin has {len(self.calibrations)} cubes and "
            f"needs (N, {self.n_pads}): use the skin file of the driver"
        )

    def _apply_law(
        self,
        rows: FrequencyRows,
        left_out: PadMasks | None,
    ) -> tuple[Numbers, Mask, Array]:
        """Apply the pad law (frequency to stress of a pad) to N rows.

        Args:
            rows: N rows of frequencies.
            left_out: Bit masks of the pads that are not used (N,). None stands for the pads that
                the device reports as broken.

        Returns:
            Number of the calibration of each row (N,), whether a cube has a pad and it is good
            (N, P), and pad stresses (N, P) in Pa, 0 for bad pads.
        """
        columns = self._read_columns(rows, None)
        is_known = columns.cube < len(self.calibrations)
        cube = np.where(is_known, columns.cube, 0)
        group = self._tables.calibration[cube]
        masks = columns.pad_fault if left_out is None else np.asarray(left_out)
        with np.errstate(all="ignore"):
            v, is_good = apply_law(
                self._tables,
                cube,
                columns.frequency,
                columns.temperature,
            )
        is_left_out = unpack_mask_bits(self._tables, group, masks)
        is_used = is_good & ~is_left_out & is_known[:, None]
        stress = np.where(is_used, v * self._stiffness[group], 0)
        return group, is_used, stress

    def _allocate_tables(self, group: NDArray[np.int32]) -> Tables:
        """Return the tables of the skin, with room for `MAX_CACHED_ESTIMATORS` sets of bad pads.

        Args:
            group: Number of the calibration of each cube.
        """
        n_groups = len(self._groups)
        pads = [calibration.layout.n_pads for calibration in self._groups]
        models = [calibration.temperature for calibration in self._groups]
        n_degrees = max(model.coefficients.shape[1] if model else 0 for model in models)
        coefficients = np.zeros((n_groups, n_degrees, self.n_pads))
        reference = np.full(n_groups, np.nan)
        for number, model in enumerate(models):
            if model:
                of_pads = model.coefficients.T
                degrees, model_pads = of_pads.shape
                coefficients[number, :degrees, :model_pads] = of_pads
                reference[number] = model.reference
        n_outputs = N_COMPONENTS + self._n_residuals
        n_outputs += -n_outputs % BLOCK
        n_tables = n_groups + MAX_CACHED_ESTIMATORS
        shape = len(self.calibrations), self.n_pads
        return Tables(
            calibration=group,
            pads=np.array(pads, np.int32),
            rest=np.empty(shape, self.dtype),
            highest=np.empty(shape, self.dtype),
            reference=reference,
            coefficients=coefficients,
            # The system provides memory only for the tables that are written.
            matrix=np.zeros((n_tables, self.n_pads, n_outputs), self.dtype),
            limit=np.zeros(n_tables, self.dtype),
            observed=np.zeros(n_tables, np.uint16),
            keys=np.full(MAX_CACHED_ESTIMATORS, NO_KEY),
            numbers=np.zeros(MAX_CACHED_ESTIMATORS, np.int32),
        )

    def _add_table(self, key: int) -> None:
        """Make the matrix of a calibration for cubes with some bad pads.

        If there is no room for it, all matrices for cubes with bad pads are removed before.

        Args:
            key: Number of the calibration * 2**32 + bit mask of the bad pads.
        """
        keys = self._tables.keys
        numbers = self._tables.numbers
        if self._n_extra == len(keys):
            self._n_extra = 0
            keys[:] = NO_KEY
        number = len(self._groups) + self._n_extra
        group = key >> 32
        mask = key & 0xFFFFFFFF
        estimator = _find_estimator(self._groups[group], mask)
        self._store_table(number, group, estimator)
        self._n_extra += 1
        place = int(np.searchsorted(keys, key))
        keys[place + 1 :] = keys[place:-1].copy()
        numbers[place + 1 :] = numbers[place:-1].copy()
        keys[place] = key
        numbers[place] = number

    def _store_table(
        self,
        number: int,
        group: int,
        estimator: Estimator,
    ) -> None:
        """Write the matrix and limits of rows with the same calibration and the same good pads.

        Args:
            number: Number of the table.
            group: Number of the calibration.
            estimator: Map from the stresses on the good pads to components and residuals.
        """
        n_pads = self._groups[group].layout.n_pads
        matrix = np.zeros(self._tables.matrix.shape[1:])
        matrix[:n_pads, :N_COMPONENTS] = estimator.matrix.T
        # If pads are missing and the rank falls by more than their number, the residual has more
        # degrees of freedom than the table has columns for it. Then the excess ones are not used.
        null = estimator.null[: self._n_residuals]
        dof = len(null)
        # The residual is NaN (unknown) if there are no more pads than determined modes.
        matrix[:n_pads, N_COMPONENTS] = np.nan
        limit = np.nan
        if dof:
            # The root of the sum of squares that these columns give is sqrt(chi-square / dof),
            # which is about 1 for noise alone.
            end = N_COMPONENTS + dof
            matrix[:n_pads, N_COMPONENTS:end] = null.T / np.sqrt(dof)
            limit = np.sqrt(compute_chi2_limit(dof) / dof)
        # The matrix will be applied to pad stresses divided by the stiffness, so the stiffness is
        # included in it.
        stiffness = self._stiffness[group]
        self._tables.matrix[number] = matrix * stiffness[:, None]
        self._tables.limit[number] = limit
        self._tables.observed[number] = pack_bits(estimator.observed)


def _fill_unknown(out: StressRows, rows: FrequencyRows, row: int) -> None:
    """Write a row of stress for a cube that the skin does not have.

    Args:
        out: Rows to write into.
        rows: Rows of frequencies, whose status states whether a time stamp is doubtful.
        row: Number of the row.
    """
    for column in (out.stress, out.gradient, out.residual):
        column[row] = np.nan
    out.observed[row] = 0
    out.status[row] |= INVALID | rows.status[row] & STAMP
