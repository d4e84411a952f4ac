# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The kernel in numpy: it specifies the kernel in C, and runs where that was not compiled.

The rows of one scan (at most one row of each cube) are processed together; the kernel in C takes up
to 32 rows of a scan. Both give the same bits on every processor, because each operation is one
of + - * / sqrt, which IEEE 754 rounds correctly, and the terms of a sum are added in a fixed order.
A matrix product of numpy (BLAS) would choose the order by processor and shape.
"""

from __future__ import annotations

import numpy as np

from ..arrays import Array, Index, Mask, PadMasks, Real, Single, StatusBits, Times, multiply
from ..health.statistics import GAP_NS, MAX_JITTER_RATIO
from ..modes import COMPONENTS, STRESS
from ..oscillator import compute_rest_ratio
from ..status import COMPENSATION, INVALID, PAD_FAULT, RESIDUAL, STAMP, TEMPERATURE
from .contract import (
    DONE,
    MAX_GAP_NS,
    MAX_SPECIFIC_FORCE,
    NEEDS_CONDITION,
    NEEDS_STEP,
    NEEDS_WINDOW,
    PAD_QUANTITIES,
    UNKNOWN_CUBE,
    Columns,
    HealthState,
    Numbers,
    Offsets,
    Tables,
    Task,
)

N_COMPONENTS = len(COMPONENTS)
"""Number of components of stress and its gradient in a row of results: 15."""

MAX_ROWS = 4096
"""Maximum number of rows (samples of one cube) that numpy computes together.

Each row takes a copy of the matrix of its cube, up to 6 kB, so the copies take up to 25 MB. Where
the health of pads is assessed, a scan (at most one row per cube) is computed at a time instead.
"""


def run(start: int, task: Task) -> tuple[int, int]:
    """Process rows of frequencies until the caller has to do something.

    Arguments and results are those of the function `run` in `kernel/run.py`.
    """
    cube = task.columns.cube
    is_unknown = cube[start:] >= len(task.tables.calibration)
    unknown = np.flatnonzero(is_unknown)
    if task.health is not None and len(unknown):
        return start, UNKNOWN_CUBE
    n_rows = len(cube)
    if len(unknown):
        n_rows = start + int(unknown[0])
    # A scan begins at each row whose cube number is not larger than that of the row before.
    begins_scan = np.ones(len(cube) + 1, bool)
    begins_scan[1:-1] = cube[1:] <= cube[:-1]
    while start < n_rows:
        end = start + MAX_ROWS
        if task.health is not None or task.offsets is not None:
            later_begins = begins_scan[start + 1 :]
            end = start + 1 + int(np.argmax(later_begins))
        scan = slice(start, min(end, n_rows))
        if begins_scan[start]:
            due = _find_due(scan, task)
            if due != DONE:
                return start, due
        with np.errstate(all="ignore"):
            start, request = _process(scan, task)
        if request != DONE:
            return start, request
    if len(unknown):
        return start, UNKNOWN_CUBE
    return start, DONE


def apply_law(
    tables: Tables,
    cube: Index,
    frequency: Real,
    temperature: Real,
) -> tuple[Real, Mask]:
    """Apply the pad law v = (f - f0) / (f_highest - f), with f0 and f_highest at a temperature.

    Args:
        tables: Tables of the skin.
        cube: Numbers of the cubes (N,).
        frequency: Frequencies f (N, P), in Hz.
        temperature: Temperatures (N,), in °C; NaN where they are unknown.

    Returns:
        Pad stresses divided by the stiffness E (1 + beta) / beta (N, P), 0 for bad pads, and
        whether the frequency lies in the range of the law, 0 < f < f_highest (N, P).
    """
    factor = compute_temperature_factor(
        tables,
        tables.calibration[cube],
        temperature,
    )
    rest = (tables.rest[cube] * factor).astype(frequency.dtype)
    highest = (tables.highest[cube] * factor).astype(frequency.dtype)
    below = highest - frequency
    # NaN fails both comparisons.
    is_good = (frequency > 0) & (below > 0)
    v = np.where(is_good, (frequency - rest) / below, 0)
    return v, is_good


def compute_temperature_factor(
    tables: Tables,
    calibration: Numbers,
    temperature: Real,
) -> Array:
    """Return the rest frequencies at temperatures, relative to the reference temperature (N, P).

    The ratio is 1 without a temperature model, and for an unknown temperature.

    Args:
        tables: Tables of the skin.
        calibration: Numbers of the calibrations (N,).
        temperature: Temperatures (N,), in °C; NaN where they are unknown.
    """
    change = temperature.astype(float) - tables.reference[calibration]
    known_change = np.where(np.isfinite(change), change, 0)
    return compute_rest_ratio(tables.coefficients[calibration], known_change)


def find_existing(tables: Tables, calibration: Numbers) -> Mask:
    """Return a mask of the pads that N cubes have; a cube may have fewer pads than others.

    Args:
        tables: Tables of the skin.
        calibration: Number of the calibration of each cube (N,).

    Returns:
        Mask (N, P), where P is the largest number of pads of a cube of the skin.
    """
    pads = np.arange(tables.rest.shape[1])
    return pads < tables.pads[calibration][:, None]


def unpack_mask_bits(tables: Tables, calibration: Numbers, mask: PadMasks) -> Mask:
    """Return a mask (N, P) of the pads that the cubes have and whose bits are set in bit masks.

    Args:
        tables: Tables of the skin.
        calibration: Numbers of the calibrations (N,).
        mask: Bit masks of pads (N,).
    """
    pads = np.arange(tables.rest.shape[1])
    is_set = mask[:, None] >> pads & 1 > 0
    return find_existing(tables, calibration) & is_set


def pack_bits(bits: Mask) -> PadMasks:
    """Convert truth values (..., count) to bit masks (...), for up to 32 values.

    Value p becomes bit p of a mask.
    """
    places = np.arange(bits.shape[-1], dtype=np.uint32)
    weighted = bits * (np.uint32(1) << places)
    masks: PadMasks = weighted.sum(axis=-1, dtype=np.uint32)
    return masks


def _find_due(scan: slice, task: Task) -> int:
    """Return what the caller has to do before a scan, by the newest time stamp of the scan.

    The time stamp is also stored in the state of the health.

    Returns:
        `NEEDS_WINDOW`, `NEEDS_STEP`, or `DONE` if nothing is due.
    """
    newest_ns = int(task.columns.stamp_ns[scan].max())
    if task.health is not None:
        window_ns = task.health.window_ns
        window_ns[2] = newest_ns
        if not window_ns[0] <= newest_ns < window_ns[1]:
            return NEEDS_WINDOW
    if task.offsets is not None:
        begin_ns, end_ns = task.offsets.step_ns
        if not begin_ns <= newest_ns < end_ns:
            return NEEDS_STEP
    return DONE


def _process(scan: slice, task: Task) -> tuple[int, int]:
    """Process the rows of one scan, up to the first for which the caller has to do something.

    Args:
        scan: The rows of the scan (at most one row of each cube).
        task: All rows, and the arrays that are read and written.

    Returns:
        Number of the first row that is not processed, and what the caller has to do: `DONE`,
        `NEEDS_CONDITION`, or the key (see `Tables.keys`) of a matrix that must be added.
    """
    n_residuals, tables, health, offsets, columns, results, offset = task
    rows = columns.select(scan)
    out = results.select(scan)
    cube = rows.cube.astype(np.intp)
    calibration = tables.calibration[cube]
    has_new_condition = np.zeros(len(cube), bool)
    if health is not None:
        state = health.cubes[cube]
        is_assessed = np.ones(len(cube), bool) if rows.known is None else ~rows.known
        left_out = rows.pad_fault | state["mask"]
        np.copyto(out.left_out, left_out, where=is_assessed)
        np.copyto(out.status, state["status"], where=is_assessed)
        is_impossible, is_reported = find_impossible(
            tables,
            health,
            rows,
            cube,
        )
        new_conditions = pack_bits(is_impossible | is_reported) & ~state["found"]
        has_new_condition = new_conditions != 0

    v, is_good = apply_law(tables, cube, rows.frequency, rows.temperature)
    is_lacking = find_existing(tables, calibration) & ~is_good
    is_left_out = unpack_mask_bits(tables, calibration, out.left_out)
    is_bad = is_lacking | is_left_out
    bad = pack_bits(is_bad)
    if offsets is not None:
        subtracted = _find_offsets(offsets, rows, cube, v, is_bad, out.status)
        v -= subtracted
        if offset is not None:
            offset[scan] = subtracted
    v[is_bad] = 0
    table, key = _find_tables(tables, calibration, bad)
    stops = np.flatnonzero(has_new_condition | (key != DONE))
    end = len(cube)
    request = DONE
    if len(stops):
        end = int(stops[0])
        request = NEEDS_CONDITION if has_new_condition[end] else int(key[end])
    table = table[:end]

    outputs = multiply(v[:end], tables.matrix[table])
    squares = np.zeros(end, outputs.dtype)
    for column in range(N_COMPONENTS, N_COMPONENTS + n_residuals):
        squares += outputs[:, column] * outputs[:, column]
    residual = np.sqrt(squares)
    is_over_limit = residual > tables.limit[table]
    observed = tables.observed[table]
    is_thermal = ~np.isnan(tables.reference[calibration])
    is_cold = is_thermal & ~np.isfinite(rows.temperature)

    out.stress[:end] = outputs[:, : len(STRESS)]
    out.gradient[:end] = outputs[:, len(STRESS) : N_COMPONENTS]
    out.residual[:end] = residual
    out.observed[:end] = observed
    out.left_out[:end] |= bad[:end]
    status = out.status[:end]
    status |= rows.doubt[:end] & np.uint16(STAMP)
    for bit, condition in (
        (PAD_FAULT, bad[:end] != 0),
        (RESIDUAL, is_over_limit),
        (INVALID, observed == 0),
        (TEMPERATURE, is_cold[:end]),
    ):
        status |= condition * np.uint16(bit)
    if health is not None:
        _add_to_window(health, rows, cube[:end], is_over_limit)
    return scan.start + end, request


def _find_offsets(
    offsets: Offsets,
    rows: Columns,
    cube: Index,
    v: Real,
    is_bad: Mask,
    status: StatusBits,
) -> Real:
    """Return what is subtracted from rows of one scan (N, P), by the equation of `Offsets`.

    Args:
        offsets: Creep, temperature and weight; the newest rows of the cubes are stored in it.
        rows: Rows of one scan.
        cube: Numbers of the cubes of the rows, as an index into tables of cubes.
        v: Pad stress / stiffness by the pad law (N, P).
        is_bad: Whether a pad is not used (N, P).
        status: Status bits of the rows (N,), to which those of the compensation are added.
    """
    elapsed_ns = rows.stamp_ns - offsets.since_ns[cube]
    elapsed_s = np.maximum(elapsed_ns, 0) * 1e-9
    elapsed_s = elapsed_s.astype(v.dtype)
    slope = offsets.slope[cube] + offsets.gain[cube] * v
    total: Real = offsets.offset[cube] + slope * elapsed_s[:, None]
    lasting = offsets.lasting[cube]
    is_near = (elapsed_ns >= 0) & (elapsed_ns <= MAX_GAP_NS)
    is_valid = is_near | (lasting == 0)
    status |= np.where(is_valid, lasting, np.uint16(COMPENSATION))
    if rows.force is not None:
        # NaN, which stands for an unknown force, fails the comparison.
        largest = np.abs(rows.force).max(axis=1)
        is_known: Mask = largest < MAX_SPECIFIC_FORCE
        force = np.where(is_known[:, None], rows.force, 0)
        for axis in range(3):
            total += offsets.response[cube, axis] * force[:, axis, None]
        weighing = offsets.weighing[cube]
        status |= np.where(is_known, weighing, np.uint16(COMPENSATION))
        force[~is_known] = np.nan
        offsets.newest_force[cube] = force
    offsets.newest_ns[cube] = rows.stamp_ns
    offsets.reading[cube] = np.where(is_bad, np.nan, v)
    offsets.subtracted[cube] = total
    return total


def _find_tables(
    tables: Tables,
    calibration: Numbers,
    bad: PadMasks,
) -> tuple[Numbers, Times]:
    """Find the matrix that each of N rows needs for its calibration and its set of bad pads.

    Args:
        tables: Tables of the skin.
        calibration: Numbers of the calibrations of the rows (N,).
        bad: Bit masks of the bad pads (N,).

    Returns:
        Index of the matrix of each row in `Tables.matrix` (N,), and its key (see `Tables.keys`) if
        the matrix does not exist yet, otherwise `DONE` (N,).
    """
    key = calibration.astype(np.int64) << 32 | bad
    place = np.searchsorted(tables.keys, key)
    place = np.minimum(place, len(tables.keys) - 1)
    is_missing = (bad != 0) & (tables.keys[place] != key)
    table = np.where(bad == 0, calibration, tables.numbers[place])
    return table, np.where(is_missing, key, DONE)


def find_impossible(
    tables: Tables,
    health: HealthState,
    rows: Columns,
    cube: Index,
) -> tuple[Mask, Mask]:
    """Find the pads with an impossible frequency, and those with a fault that the device reports.

    Args:
        tables: Tables of the skin.
        health: State of the health, with the possible range of frequencies.
        rows: N rows of one scan.
        cube: Numbers of the cubes of the rows, as an index into tables of cubes.

    Returns:
        Whether the frequency of a pad is impossible, and whether the device reports it (N, P).
    """
    f = rows.frequency.astype(np.float32)
    low = health.view_pads("low")[cube]
    high = health.view_pads("high")[cube]
    calibration = tables.calibration[cube]
    is_possible = (f > low) & (f < high)
    is_impossible = ~is_possible & find_existing(tables, calibration)
    # The device may set the bit of a pad that the cube does not have.
    return is_impossible, unpack_mask_bits(tables, calibration, rows.pad_fault)


def _add_to_window(
    health: HealthState,
    rows: Columns,
    cube: Index,
    is_over_limit: Mask,
) -> None:
    """Add rows of one scan to the sums of the present window; `statistics.py` has the equations.

    Args:
        health: State of the health, which is changed.
        rows: Rows of one scan, of which only the first n are added.
        cube: Numbers of the cubes of these rows (n,), to index with.
        is_over_limit: Whether the residual of a row is above its limit.
    """
    ratio, weight = _measure_pace(health, rows, cube)
    n = len(cube)
    f = rows.frequency[:n].astype(np.float32)
    pads = {name: health.view_pads(name) for name in PAD_QUANTITIES}
    difference = f - pads["last"][cube]
    second = difference - ratio * pads["difference"][cube]
    squares = second * second * weight
    pads["second_squares"][cube] += squares
    bound = pads["bound"][cube]
    pads["bounded_squares"][cube] += np.minimum(squares, bound)
    pads["first_squares"][cube] += difference * difference
    pads["sum"][cube] += f - pads["base"][cube]
    # fmin and fmax ignore NaN, which stands for a sample in which the pad had no frequency.
    lowest = pads["lowest"][cube]
    highest = pads["highest"][cube]
    pads["lowest"][cube] = np.fmin(lowest, f)
    pads["highest"][cube] = np.fmax(highest, f)
    pads["difference"][cube] = difference
    pads["last"][cube] = f

    health.cubes["temperature"][cube] = rows.temperature[:n]
    health.cubes["rows"][cube] += 1
    health.cubes["over_limit"][cube] += is_over_limit


def _measure_pace(
    health: HealthState,
    rows: Columns,
    cube: Index,
) -> tuple[Single, Single]:
    """Compute ratios and weights for second differences from the intervals between rows.

    The ratio r of two successive intervals makes the second difference of a linear drift vanish.
    The weight w gives the square of a second difference of noise the same mean for each r.
    `statistics.py` has the formulas.

    Args:
        health: State of the health, whose times are changed.
        rows: Rows of one scan, of which only the first n are used.
        cube: Numbers of the cubes of these rows (n,), to index with.

    Returns:
        Ratios r and weights w (n, 1), to apply to all pads of a row.
    """
    state = health.cubes
    n = len(cube)
    stamp_ns = rows.stamp_ns[:n]
    is_doubtful = rows.doubt[:n] & STAMP > 0
    between = stamp_ns - state["time_ns"][cube]
    before = state["interval_ns"][cube]
    # An interval that begins or ends with a doubtful time stamp is unknown.
    was_doubtful = state["is_doubtful"][cube] > 0
    now = np.where(is_doubtful | was_doubtful, 0, between)
    state["time_ns"][cube] = stamp_ns
    state["interval_ns"][cube] = now
    state["is_doubtful"][cube] = is_doubtful

    # `gap_before` is the gap between the last row of the previous window and the first row of this
    # one; `gap_within` is the longest gap between two rows of this window. A negative interval
    # (time went back) is a gap, too.
    is_gap = (between < 0) | (between >= GAP_NS)
    is_first = state["rows"][cube] == 0
    gap_before = state["gap_before"][cube]
    gap_within = state["gap_within"][cube]
    is_longer = np.abs(between) > np.abs(gap_within)
    is_longest = is_gap & ~is_first & is_longer
    state["gap_before"][cube] = np.where(
        is_gap & is_first,
        between,
        gap_before,
    )
    state["gap_within"][cube] = np.where(is_longest, between, gap_within)

    shorter = np.minimum(now, before)
    longer = np.maximum(now, before)
    is_known = (shorter > 0) & (longer < GAP_NS)
    is_even = longer < MAX_JITTER_RATIO * shorter
    safe_before = np.where(is_known, before, 1)
    ratio = np.where(is_known & ~is_even, now / safe_before, 1.0)
    # Variance of the second difference as a multiple of the variance of the noise.
    variance = 1 + (1 + ratio) * (1 + ratio) + ratio * ratio
    weight = is_known * 6 / variance
    ratio = ratio.astype(np.float32)
    weight = weight.astype(np.float32)
    return ratio[:, None], weight[:, None]
