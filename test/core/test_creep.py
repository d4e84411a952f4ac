# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Compensation of creep against closed forms of viscoelastic laws, and against a power law."""

from __future__ import annotations

from dataclasses import fields, replace
from itertools import pairwise

import numpy as np
import pytest

from cube_tensor_driver.core.calibration import make_illustrative_calibration
from cube_tensor_driver.core.compensation.low_pass import compute_relaxed_share
from cube_tensor_driver.core.compensation.models import CreepModel
from cube_tensor_driver.core.errors import CalibrationError, LayoutError
from cube_tensor_driver.core.oscillator import compute_pad_frequency
from cube_tensor_driver.core.reconstructor import Reconstructor, RecordedHealth
from cube_tensor_driver.core.rows import FrequencyRows, StressRows
from cube_tensor_driver.core.status import COMPENSATION, CREEP

PLAIN = make_illustrative_calibration("planar")
TIME = np.array([0.1, 1.0, 10.0, 100.0])
AMPLITUDE = 0.02 * (1 + 0.2 * np.random.default_rng(1).standard_normal((8, 4)))
CREEPING = replace(PLAIN, creep=CreepModel(TIME, AMPLITUDE))
RESPONSE = PLAIN.response
LOAD = np.zeros(PLAIN.modes.n_modes)
LOAD[:3] = 20e3, 5e3, -3e3
"""Amplitudes of zz, zx and xx, in Pa."""


def readings(time: np.ndarray, load: np.ndarray) -> np.ndarray:
    """What the pads of `CREEPING` read while loads rise along straight lines (N, P).

    The creep compliance of a generalised Maxwell body, from the eigenvalues of its equations: with
    r' = D (u - r) and s = u - a r, u = s + a r gives r' = D (a - 1) r + D s, which is integrated
    exactly for s along straight lines.
    """
    pads = load @ RESPONSE.T
    found = pads.copy()
    system = (AMPLITUDE[:, None, :] - np.eye(4)) / TIME[:, None]
    value, vector = np.linalg.eig(system)  # of each pad
    drive = np.linalg.solve(vector, np.tile(1 / TIME, (8, 1))[..., None])[..., 0]
    weight = np.einsum("pk,pkj->pj", AMPLITUDE, vector)
    memory = np.zeros((8, 4), complex)
    for n, step in enumerate(np.diff(time)):
        growth = np.exp(value * step)
        constant = (growth - 1) / value
        linear = (constant - step) / value
        slope = (pads[n + 1] - pads[n]) / step
        memory *= growth
        memory += drive * (constant * pads[n][:, None] + linear * slope[:, None])
        found[n + 1] += (weight * memory).sum(axis=1).real
    return found


def rows_of(time: np.ndarray, pads: np.ndarray, cubes: int = 1) -> FrequencyRows:
    """Rows of the pads' readings (N, P) at times in s, the same for several cubes."""
    frequency = compute_pad_frequency(pads, PLAIN.rest_frequency, PLAIN.beta, PLAIN.modulus)
    stamp_ns = 10**9 + np.rint(1e9 * time).astype(np.int64)
    number = np.tile(np.arange(cubes, dtype=np.uint16), len(time))
    return FrequencyRows.from_values(
        number, np.repeat(frequency, cubes, axis=0), stamp_ns=np.repeat(stamp_ns, cubes)
    )


def test_the_exponential_is_exact():
    ratio = np.concatenate([[0.0], np.geomspace(1e-12, 1e4, 1000)])
    np.testing.assert_allclose(compute_relaxed_share(ratio), -np.expm1(-ratio), rtol=1e-14)


@pytest.mark.parametrize(("interval", "tolerance"), [(0.06, 0.5), (0.9, 3.0), (4.0, 15.0)])
def test_the_inverse_is_exact_at_any_interval(interval, tolerance):
    """A load of 20 kPa rises within 10 s, stays for 100 s and goes.

    Readings between samples are not quite the straight lines that the inverse assumes, which costs
    at most the tolerance, in Pa. What is subtracted while the load moves is that of the sample
    before, so these samples are left out; without the compensation, 1.1 kPa are lost.
    """
    time = np.arange(0, 160, interval)
    load = np.interp(time, [0, 10, 20, 120, 130, 999], [0, 0, 1, 1, 0, 0])[:, None] * LOAD
    rows = rows_of(time, readings(time, load))
    stays = np.diff(load[:, 0], prepend=0) == 0
    plain = Reconstructor([PLAIN]).process(rows).stress[:, 2] - load[:, 0]
    found = Reconstructor([CREEPING]).process(rows)
    assert np.abs(plain[stays]).max() > 1100
    assert np.abs(found.stress[:, 2] - load[:, 0])[stays].max() < tolerance
    assert (found.status[1:] & (CREEP | COMPENSATION) == CREEP).all()


def test_more_samples_on_a_straight_line_change_nothing():
    """The memories are exact for a reading that is a straight line between samples.

    The tolerance is the rounding of the frequencies' difference to that without load.
    """
    ends = []
    for interval in (0.25, 1.0, 5.0):
        # The last row makes the memories advance to the row before it.
        time = np.append(np.arange(0, 60 + interval / 2, interval), 60.1)
        pads = np.minimum(time, 60)[:, None] * (LOAD @ RESPONSE.T) / 60
        reconstructor = Reconstructor([CREEPING], np.float64)
        reconstructor.process(rows_of(time, pads))
        ends.append(reconstructor.compensation.collect_states()["creep"])
    np.testing.assert_allclose(ends[1:], [ends[0]] * 2, rtol=1e-9, atol=1e-100)


def assert_same(found: StressRows, expected: StressRows) -> None:
    for field in fields(found):
        np.testing.assert_array_equal(
            getattr(found, field.name), getattr(expected, field.name), err_msg=field.name
        )


def shaken() -> FrequencyRows:
    """150 scans of three cubes with jitter, lost rows, a broken pad, a gap and a clock set back."""
    random = np.random.default_rng(2)
    time = np.cumsum(random.uniform(0.003, 0.03, 150))
    time[60:] += 30
    time[100:] -= 20
    rows = rows_of(time, 5e3 * random.normal(size=(150, 8)), cubes=3)
    rows.frequency[30:60, 3] = np.nan
    return rows.select(random.random(450) < 0.9)


def test_scans_at_once_and_from_a_recorded_state_are_the_scans_one_by_one_to_the_bit():
    rows = shaken()
    skin = [CREEPING, PLAIN, replace(CREEPING, uid=1)]
    found = Reconstructor(skin).process(rows)
    begins = [0, *(np.flatnonzero(np.diff(rows.cube.astype(int)) <= 0) + 1).tolist(), len(rows)]
    singly, later = Reconstructor(skin), None
    for number, ends in enumerate(pairwise(begins)):
        part = slice(*ends)
        if number == 70:
            # The rest frequencies change after the last row before the state, as by a tare.
            rest = singly.rest_frequency * (1 + 1e-4)
            singly.rest_frequency = rest
            states = singly.compensation.collect_states()
            later = Reconstructor(skin)
            later.rest_frequency = rest
            later.compensation.restore(states)
        one = singly.process(rows.select(part))
        if later is None:
            assert_same(one, found.select(part))
        else:
            status = one.status & ~np.uint16(CREEP | COMPENSATION)
            health = RecordedHealth(np.ones(len(one), bool), one.left_out, status)
            assert_same(later.process_known(rows.select(part), health), one)
    assert (found.status[rows.cube == 1] & (CREEP | COMPENSATION) == COMPENSATION).all()
    with pytest.raises(LayoutError, match="a state of creep has 9 numbers; it must have"):
        singly.compensation.restore({"creep": np.zeros(9)})


def test_unknown_earlier_loads_are_a_deviation_that_decays():
    """The program starts 100 s after a load began; and it misses 60 s in which the load went."""
    time = np.concatenate([np.arange(0, 200, 0.5), np.arange(300, 600, 0.5)])
    load = ((time > 0) & (time < 350))[:, None] * LOAD
    pads = readings(time, load)
    after, gap = time >= 100, (time < 320) | (time >= 380)
    for chosen, is_late in ((after, time[after] < 200), (gap, time[gap] > 380)):
        reconstruct = Reconstructor([CREEPING])
        rows = rows_of(time[chosen], pads[chosen])
        error, stated, status = [], [], []
        for row in range(len(rows)):
            found = reconstruct.process(rows.select(slice(row, row + 1)))
            error.append(abs(found.stress[0, 2] - load[chosen][row, 0]))
            stated.append(np.sqrt(reconstruct.compute_covariance(0)[2, 2]))
            status.append(found.status[0] & (CREEP | COMPENSATION))
        error, stated = np.array(error)[is_late], np.array(stated)[is_late]
        assert (error < 1.5 * stated).all()
        assert stated[0] > 500 and stated[-1] < 0.2 * stated[0]
        assert status[np.argmax(is_late)] == COMPENSATION
    assert status[-1] == CREEP


def test_a_tare_holds_although_the_pads_are_still_recovering():
    """20 s after 20 kPa for 10 min, with rest frequencies that are wrong by 3 kPa from the start.

    The zero that it leaves wanders by 0.4 kPa in a minute without the compensation.
    """
    zero = np.full(8, -3e3)
    held = 600.0
    steps = [5.0, held - 5, 18, 3, 60]
    rates = [4, 1, 4, 50, 2]
    parts = [np.arange(0, length, 1 / rate) for length, rate in zip(steps, rates, strict=True)]
    time = np.concatenate([p + sum(steps[:n]) for n, p in enumerate(parts)])
    pads = readings(time, ((time > 1) & (time < held))[:, None] * LOAD) + zero
    rows = rows_of(time, pads)
    last = int(np.searchsorted(time, held + 21)) - 1
    for cube, least, most in ((CREEPING, 0, 15), (PLAIN, 200, 300)):
        reconstruct = Reconstructor([cube])
        reconstruct.process(rows.select(slice(0, last)))
        reconstruct.tare()
        found = reconstruct.process(rows.select(slice(last, None)))
        assert least < np.abs(found.stress[:, 2]).max() < most


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"time": [1.0, 1.0], "amplitude": [[0.1, 0.1]] * 8}, "times must be above 0 and rise"),
        ({"time": [1.0, 2.0], "amplitude": [[0.6, 0.6]] * 8}, "add up to less than 1"),
        ({"time": [1.0], "amplitude": [[0.1, 0.1]] * 8}, "amplitude has shape"),
        (
            {"time": [1.0], "amplitude": [[0.1]] * 8, "deviation": [[[0.1, 0.2]]]},
            "deviation has shape",
        ),
    ],
)
def test_laws_that_cannot_be_are_named(values, said):
    with pytest.raises(CalibrationError, match=said):
        CreepModel(**values)
