# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Health of pads: what is broken is named at once, and nothing healthy is."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest

from conftest import check, stamped
from cube_tensor_driver.config.package_data import find_package_data
from cube_tensor_driver.config.skin import read_skin
from cube_tensor_driver.core import status
from cube_tensor_driver.core.calibration import make_illustrative_calibration
from cube_tensor_driver.core.health.health import Health
from cube_tensor_driver.core.health.statistics import WINDOW_S
from cube_tensor_driver.core.oscillator import compute_pad_frequency
from cube_tensor_driver.core.pipeline import Pipeline
from cube_tensor_driver.core.reconstructor import Reconstructor
from cube_tensor_driver.core.status import (
    DRIFT,
    NOISY,
    OPEN,
    PAD_FAULT,
    RANGE,
    REPORTED,
    RESIDUAL,
    SHORT,
    STAMP,
    STUCK,
)
from cube_tensor_driver.simulation.cubes import SimulatedCubes
from cube_tensor_driver.simulation.load import Load, read_default_script

PERIOD_NS = 10_000_000  # 100 Hz
CALIBRATION = make_illustrative_calibration("planar")
NOISE = 8e-6


class Skin:
    """Cubes under a load that moves (or rests), with their health."""

    def __init__(self, cubes: int = 6, moving: bool = True, noise: float = NOISE) -> None:
        self.reconstructor = Reconstructor([CALIBRATION] * cubes)
        self.pipeline, self.health = self.reconstructor.pipeline, self.reconstructor.health
        self.cube = np.arange(cubes, dtype=np.uint16)
        self._moving, self._noise, self._random = moving, noise, np.random.default_rng(1)
        self.row = 0

    def frequency(self) -> np.ndarray:
        n = len(self.cube)
        phase = np.arange(8) + np.arange(n)[:, None]
        state = 10e3 * np.sin(
            2 * np.pi * 0.5 * self.row * 1e-9 * PERIOD_NS + phase[:, : CALIBRATION.modes.n_modes]
        )
        v = self._moving * state @ CALIBRATION.response.T
        f = compute_pad_frequency(
            v, CALIBRATION.rest_frequency, CALIBRATION.beta, CALIBRATION.modulus
        )
        f *= 1 + self._noise * self._random.standard_normal((n, 8))
        return np.rint(f * 1e3) * 1e-3

    def play(
        self, seconds: float, harm=lambda frequency, row: None, pad_fault: int = 0
    ) -> np.ndarray:
        """Returns the last mask of bad pads."""
        for _ in range(round(seconds * 1e9 / PERIOD_NS)):
            frequency = self.frequency()
            harm(frequency, self.row)
            faults = np.zeros(len(self.cube), np.uint32)
            faults[2] = pad_fault
            stamp_ns = np.full(len(self.cube), self.row * PERIOD_NS)
            rows = stamped(self.cube, frequency.astype(np.float32), faults, stamp_ns)
            mask = self.reconstructor.process(rows).left_out
            self.row += 1
        return mask


def test_last_is_the_newest_row():
    """Also while rows wait to be added."""
    skin = Skin()
    for n in range(1, 20):
        frequency = np.full((6, 8), 100e3 + n, np.float32)
        check(
            skin.health,
            stamped(skin.cube, frequency, np.zeros(6, np.uint32), np.full(6, n * PERIOD_NS)),
        )
        frequency += 1  # the caller's own, to fill again
        if n % 3 == 0:
            assert (skin.health.sums.view_pads("last") == 100e3 + n).all()
            assert (skin.health.read_window().rows == n).all()


@pytest.mark.parametrize("moving", [True, False])
@pytest.mark.parametrize("noise", [0.0, NOISE, 2 * NOISE])
def test_nothing_healthy_is_called_ill(moving, noise):
    skin = Skin(64, moving, noise)
    skin.play(20)
    assert not skin.health.collect()[0].any()


@pytest.mark.parametrize("frequency", [1.0, 3.0, 6.0])
def test_a_load_that_moves_fast_is_no_noise(frequency):
    """Though one pad of each cube feels 30 times as much of it as the others, and all more than
    their noise."""
    health = Health(Pipeline([CALIBRATION] * 8, np.float32))
    cube, random = np.arange(8, dtype=np.uint16), np.random.default_rng(5)
    stress = np.where(np.eye(8) > 0, -20e3, -20e3 / 30)
    for row in range(300):
        v = stress * np.sin(2e-9 * np.pi * frequency * row * PERIOD_NS)
        f = compute_pad_frequency(
            v, CALIBRATION.rest_frequency, CALIBRATION.beta, CALIBRATION.modulus
        )
        f = (f * (1 + NOISE * random.standard_normal(f.shape))).astype(np.float32)
        check(health, stamped(cube, f, np.zeros(8, np.uint32), np.full(8, row * PERIOD_NS)))
    assert not health.collect()[0].any()


def test_a_load_that_moves_while_hubs_stall_is_no_noise():
    """Up to 60 ms of rows at 500 Hz, then up to 0.2 s of none, as on a machine with too much to do;
    the demo's load at four times its speed."""
    skin = read_skin(find_package_data() / "config" / "skin_demo.yaml")
    load, cubes = (
        Load(skin, read_default_script()),
        SimulatedCubes([cube.calibration for cube in skin.cubes]),
    )
    table = [
        cubes.compute_frequency(*load.compute_stress_field(k * load.period / 1000), 0.0) * 1e-3
        for k in range(1000)
    ]
    health = Health(Pipeline([cube.calibration for cube in skin.cubes], np.float32))
    cube, random, begin = np.arange(16, dtype=np.uint16), np.random.default_rng(1), 0
    while begin < 60_000:
        end = begin + int(random.integers(1, 30))
        for row in range(begin, end):
            stamp = np.full(16, 2_000_000 * row)
            check(
                health,
                stamped(cube, table[row % 1000].astype(np.float32), np.zeros(16, np.uint32), stamp),
            )
        begin = end + int(random.integers(0, 99))
    assert not health.collect()[0].any()


def test_a_load_that_moves_under_stamps_in_doubt_is_no_noise():
    """As where the host's clock is being set, and rows are stamped by their arrival: one pad is
    pressed, and rows seem to come at any distance."""
    health = Health(Pipeline([CALIBRATION], np.float32))
    random = np.random.default_rng(4)
    stress = np.zeros(8)
    stress[3] = 10e3
    found = []
    for doubt in (0, STAMP, 0):
        for row in range(250):
            at_s = 1e-9 * PERIOD_NS * row
            v = stress * np.sin(2 * np.pi * 0.5 * at_s)
            f = compute_pad_frequency(
                v, CALIBRATION.rest_frequency, CALIBRATION.beta, CALIBRATION.modulus
            )
            f = (f * (1 + NOISE * random.standard_normal(8))).astype(np.float32)
            late_ns = int(random.integers(0, 8 * PERIOD_NS // 10)) if doubt else 0
            stamp_ns = [health.newest_ns + PERIOD_NS // 10 + late_ns]
            rows = stamped([0], f[None], [0], stamp_ns)
            check(health, replace(rows, status=np.array([doubt], np.uint16)))
        found.append(health.collect()[0].any())
    assert found == [False, False, False]


class Press:
    """Cubes of which one pad is pressed harder than the others, and rows are missing, of each cube
    on its own."""

    def __init__(self, cubes: int, missing: float) -> None:
        self._random = np.random.default_rng(3)
        self.health = Health(Pipeline([CALIBRATION] * cubes, np.float32))
        self._cubes, self._missing = cubes, missing

    def play(self, seconds: float, noise: np.ndarray) -> np.ndarray:
        """noise: (cubes, 8) of the frequency. Returns the bits found."""
        stress = np.where(np.arange(8) == np.arange(self._cubes)[:, None] % 8, -10e3, -1e3)
        for row in range(round(seconds * 1e9 / PERIOD_NS)):
            cube = np.flatnonzero(self._random.random(self._cubes) >= self._missing).astype(
                np.uint16
            )
            v = stress[cube] * np.sin(2 * np.pi * 0.5 * row * 1e-9 * PERIOD_NS)
            f = compute_pad_frequency(
                v, CALIBRATION.rest_frequency, CALIBRATION.beta, CALIBRATION.modulus
            )
            f = (f * (1 + noise[cube] * self._random.standard_normal(f.shape))).astype(np.float32)
            jitter = self._random.integers(0, PERIOD_NS // 10, len(cube))
            check(
                self.health,
                stamped(cube, f, np.zeros(len(cube), np.uint32), row * PERIOD_NS + jitter),
            )
        return self.health.collect()[0]


@pytest.mark.parametrize("missing", [0.0, 0.1, 0.4])
def test_missing_rows_of_a_moving_load_are_no_noise(missing):
    assert not Press(64, missing).play(5, np.full((64, 8), NOISE)).any()


@pytest.mark.parametrize("missing", [0.1, 0.4])
def test_noise_is_found_among_missing_rows(missing):
    noise = np.full((16, 8), NOISE)
    noise[3, 6] = 3e-4
    found = Press(16, missing).play(5, noise)
    assert found[3, 6] == NOISY
    found[3, 6] = 0
    assert not found.any()


def set_pad(value):
    def harm(frequency, row):
        frequency[2, 5] = value

    return harm


def noisy(noise):
    """noise: standard deviation relative to the frequency."""

    def harm(frequency, row):
        frequency[2, 5] *= 1 + noise * np.random.default_rng(row).standard_normal()

    return harm


FAULTS = {
    "short": (set_pad(np.nan), SHORT, 0.01),
    "zero": (set_pad(0.0), SHORT, 0.01),
    "open": (set_pad(350e3), OPEN, 0.01),
    "beyond the law": (set_pad(4e6), OPEN, 0.01),
    "squeezed": (set_pad(20e3), RANGE, 0.01),
    "stretched": (set_pad(180e3), RANGE, 0.01),
    "stuck": (set_pad(101_234.567), STUCK, 1.02),
    "noisy": (noisy(3e-4), NOISY, 1.02),
    "very noisy": (noisy(1e-2), NOISY, 1.02),
}


@pytest.mark.parametrize("name", list(FAULTS))
def test_a_broken_pad_is_named_in_time_left_out_and_taken_back(name):
    harm, bit, within = FAULTS[name]
    skin = Skin()
    skin.play(3)
    mask = skin.play(within, harm)
    expected = np.zeros((6, 8), np.uint16)
    expected[2, 5] = bit
    np.testing.assert_array_equal(skin.health.state, expected)
    mask = skin.play(0.02, harm)
    assert mask.tolist() == [0, 0, 1 << 5, 0, 0, 0]
    skin.play(5)
    assert not skin.health.state.any()
    assert skin.health.collect()[0][2, 5] & bit  # not forgotten until it was told
    assert not skin.health.collect()[0].any()


def test_what_the_hub_reports():
    skin = Skin()
    assert skin.play(0.01, pad_fault=1 << 3).tolist() == [0, 0, 8, 0, 0, 0]
    assert skin.health.state[2, 3] == REPORTED


def test_one_bad_row_between_two_looks_is_seen_and_a_flapping_pad_does_not_flicker():
    skin = Skin()
    skin.play(1)
    skin.play(0.01, set_pad(np.nan))
    skin.play(3)
    assert skin.health.collect()[0][2, 5] == SHORT

    changes, before = 0, 0

    def flap(frequency, row):
        nonlocal changes, before
        if row % 120 == 0:  # every 1.2 s; what is found lasts 1.5 s
            frequency[2, 5] = np.nan
        changes += before != skin.health.state[2, 5]
        before = int(skin.health.state[2, 5])

    skin.play(10, flap)
    assert changes == 1


def test_one_pad_that_wanders_while_all_rest_is_drifting_and_still_used():
    skin = Skin(moving=False)
    skin.play(2)
    start = skin.row

    def wander(frequency, row):
        frequency[2, 5] *= 1 + 2e-5 * (row - start) * 1e-9 * PERIOD_NS  # 20 ppm a second

    skin.play(20, wander)
    expected = np.zeros((6, 8), np.uint16)
    expected[2, 5] = DRIFT
    np.testing.assert_array_equal(skin.health.state, expected)
    assert not skin.health.sums.cubes["mask"].any()

    # all together is temperature or load, not a pad
    skin = Skin(moving=False)
    skin.play(20, lambda frequency, row: frequency.__imul__(1 + 2e-5 * row * 1e-9 * PERIOD_NS))
    assert not skin.health.state.any()


def test_a_load_put_on_between_two_windows_is_no_drift():
    skin = Skin(moving=False)
    skin.play(WINDOW_S * 4)
    start = skin.row

    def load(frequency, row):
        frequency[2] *= 1 + 0.01 * np.arange(8) / 8

    skin.play(5, load)
    assert start % round(WINDOW_S * 1e9 / PERIOD_NS) == 0
    assert not skin.health.collect()[0].any()


def test_a_residual_is_of_the_cube_and_has_hysteresis():
    skin = Skin()

    def bend(share):
        return lambda frequency, row: frequency[2].__setitem__(
            5, frequency[2, 5] * (1 + 0.01 * (row % 50 < share))
        )

    skin.play(2)
    assert not skin.health.high_residual.any()
    skin.play(3, bend(50))
    assert skin.health.high_residual.tolist() == [False, False, True, False, False, False]
    skin.play(3, bend(15))  # 30 % of the rows: stays what it was
    assert skin.health.high_residual[2]
    skin.play(2)
    assert not skin.health.high_residual.any()
    skin.play(3, bend(15))
    assert not skin.health.high_residual.any()


@pytest.mark.parametrize("first", [3, 5])
def test_many_rows_of_one_cube_take_bounded_time(first):
    """As many scans as rows, whether or not another cube comes before them."""
    n = 30_000
    cube = np.full(n, 5, np.uint16)
    cube[0] = first
    rows = stamped(cube, np.full((n, 8), 100e3, np.float32), np.zeros(n, np.uint32), np.arange(n))
    health = Skin().health
    begun = time.perf_counter()
    left_out, _ = check(health, rows)
    assert time.perf_counter() - begun < 1.0  # 0.1 s; each row for itself takes 2.5 s
    assert not left_out.any()
    assert health.read_window().rows.sum() == n and health.read_window().rows[first] >= 1


def test_a_cube_twice_in_a_batch_and_cubes_in_any_order():
    """Rows fed one by one and all at once leave the same state."""
    generator = np.random.default_rng(3)
    cube = np.array([4, 1, 4, 0, 1, 4], np.uint16)
    frequency = (100e3 * (1 + 1e-5 * generator.standard_normal((6, 8)))).astype(np.float32)
    together, singly = (Health(Pipeline([CALIBRATION] * 6, np.float32)) for _ in range(2))
    none = np.zeros(6, np.uint32)
    check(together, stamped(cube, frequency, none, 0))
    for row in range(6):
        one = slice(row, row + 1)
        check(singly, stamped(cube[one], frequency[one], none[one], 0))
    np.testing.assert_array_equal(together.sums.view_pads("last"), singly.sums.view_pads("last"))
    for one, other in zip(together.read_window(), singly.read_window(), strict=True):
        np.testing.assert_array_equal(one, other)
    assert together.collect()[2].tolist() == [1, 2, 0, 0, 3, 0]


def test_a_jump_back_in_time_begins_a_new_window():
    """What was gathered before is of another time: it goes neither into sums nor into the share of
    bad residuals."""
    skin = Skin()
    skin.play(1.2)
    before = skin.health.closed
    skin.health.sums.cubes["over_limit"] = 50
    skin.row = 0
    skin.play(0.1)
    assert skin.health.read_window().rows.tolist() == [10] * 6
    skin.play(0.5)
    assert skin.health.closed == before + 1 and skin.health.history[-1].rows.max() == 50
    assert skin.health.newest_ns == 59 * PERIOD_NS


def test_mixed_layouts_and_pads_that_do_not_exist():
    pipeline = Pipeline([make_illustrative_calibration("quad"), CALIBRATION], np.float32)
    watch = Health(pipeline)
    frequency = np.full((2, 8), 100e3, np.float32)
    frequency[0, 4:] = np.nan
    check(watch, stamped(np.arange(2), frequency, np.array([0xF0, 0], np.uint32), np.zeros(2)))
    assert not watch.state.any()


def test_bits_are_those_of_the_message():
    message = pytest.importorskip("cube_tensor_driver.msg", exc_type=ImportError).SkinStress
    assert (message.PAD_FAULT, message.RESIDUAL) == (PAD_FAULT, RESIDUAL)
    for name in ("OPEN", "SHORT", "RANGE", "STUCK", "NOISY", "REPORTED", "DRIFT"):
        assert getattr(message, f"PAD_{name}") == getattr(status, name)


def test_a_line_says_when_a_cube_breaks_and_when_it_is_fine_again():
    """The one is bad, the other is not; and neither is said twice."""
    pytest.importorskip("rclpy", reason="needs rclpy: run this with ./cube test")
    from diagnostic_msgs.msg import KeyValue

    from cube_tensor_driver.ros.diagnostics.reconstruction import CubeHealth

    skin = Skin(16)
    words = CubeHealth(
        read_skin(find_package_data() / "config" / "skin_demo.yaml"), skin.reconstructor
    )
    said, statuses, summaries = [], [], []
    for harm in (
        lambda frequency, row: None,
        set_pad(np.nan),
        set_pad(np.nan),
        *[lambda frequency, row: None] * 3,
    ):
        skin.play(2 * WINDOW_S, harm)
        summaries.append(words.count_faults())
        now, lines = words.make_statuses({2: 0xC2})
        said.append(lines)
        statuses.append([(one.level, one.hardware_id, one.values) for one in now])
    rows = [KeyValue(key="rows since the last", value=str(round(2 * WINDOW_S * 1e9 / PERIOD_NS)))]
    assert statuses[0] == [] and statuses[1] == [(b"\2", "0xc2", rows)]
    assert summaries[:2] == [{}, {"pads short": 1}] and summaries[-1] == {}
    pad = CALIBRATION.layout.pads[5]
    assert said[1] == [(f"cube c02: pad {pad} short", True)]
    assert [line for lines in said[2:] for line in lines] == [("cube c02: ok", False)]
    assert not said[0]


def test_a_cube_with_a_residual_is_a_warning_and_counted():
    pytest.importorskip("rclpy", reason="needs rclpy: run this with ./cube test")
    from cube_tensor_driver.ros.diagnostics.reconstruction import CubeHealth

    skin = Skin(16)
    words = CubeHealth(
        read_skin(find_package_data() / "config" / "skin_demo.yaml"), skin.reconstructor
    )
    skin.play(2)
    words.make_statuses({})
    skin.play(3, lambda frequency, row: frequency[2].__setitem__(5, 1.01 * frequency[2, 5]))
    (status,), _ = words.make_statuses({})
    assert (status.name, status.level) == ("cube c02", b"\1")
    assert status.message.startswith("residual above its level")
    assert words.count_faults() == {"cubes with a residual": 1}


def test_a_start_is_quiet_and_a_cube_that_stays_away_is_not():
    """Statuses say it at once, the log when hubs had time to start."""
    pytest.importorskip("rclpy", reason="needs rclpy: run this with ./cube test")
    from cube_tensor_driver.ros.diagnostics.reconstruction import MIN_UPDATES_TO_LOG, CubeHealth

    skin = read_skin(find_package_data() / "config" / "skin_demo.yaml")
    n = len(skin.cubes)
    reconstructor = Reconstructor(skin)
    words = CubeHealth(skin, reconstructor)
    rest = np.array([cube.calibration.rest_frequency for cube in skin.cubes])

    def step(number: int, cubes: int) -> list[tuple[str, bool]]:
        rows = np.arange(cubes)
        stamps = np.full(cubes, number * 1_000_000_000)
        reconstructor(stamped(rows, rest[:cubes], np.zeros(cubes, np.uint32), stamps))
        return words.make_statuses({})[1]

    statuses, lines = words.make_statuses({})
    assert len(statuses) == n and all("missing" in one.message for one in statuses)
    assert not lines
    for number in range(2, MIN_UPDATES_TO_LOG + 1):
        assert not step(number, n - 1)
    late = [(f"cube {skin.cubes[-1].name}: missing: no row yet, see its link", True)]
    assert step(MIN_UPDATES_TO_LOG + 1, n - 1) == late
    assert not step(MIN_UPDATES_TO_LOG + 2, n - 1)
    assert step(MIN_UPDATES_TO_LOG + 3, n) == [(f"cube {skin.cubes[-1].name}: ok", False)]
