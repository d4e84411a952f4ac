# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""A hub's clock that is set, sampling that is late, and rows whose stamps are in doubt meanwhile.

On simulated arrivals with fixed seeds and known true times.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray
from test_clock import BASE_S, EPOCH_NS, random_delays, stalls, usb_bursts

from conftest import sample_frame
from cube_tensor_driver.core.status import STAMP
from cube_tensor_driver.device.chain import LiveLinks
from cube_tensor_driver.device.clock.hub_clock import CLOCK_SET, CLOCK_STANDS_STILL, HubClock
from cube_tensor_driver.device.links.link import LinkConfig
from cube_tensor_driver.device.links.reader import LinkFrames
from cube_tensor_driver.device.scans.cube_table import CubeAddress
from cube_tensor_driver.device.wire.protocol import Ack, Command, Hello, Result

AT_S = 10.0  # when the clock is set
SEEN_S = 0.25  # limit of the issue


def quick(true_s: NDArray[np.float64], random: np.random.Generator) -> NDArray[np.float64]:
    return true_s + BASE_S + random.exponential(50e-6, len(true_s))


class Run:
    """One hub for 20 s. device_us: what its clock shows at the true times.

    error_ms, in_doubt, named: of each sample. in_doubt and named are those of its read.
    """

    def __init__(self, delay, true_s: NDArray[np.float64], device_us: NDArray, seed: int) -> None:
        arrival_s = np.maximum.accumulate(delay(true_s, np.random.default_rng(seed)))
        arrival_ns = EPOCH_NS + np.rint(arrival_s * 1e9).astype(np.int64)
        self.clock = HubClock()
        stamps, doubt, named = [], [], []
        edges = [0, *(np.flatnonzero(np.diff(arrival_ns) > 100_000) + 1), len(true_s)]
        for start, stop in pairwise(edges):
            times = device_us[start:stop].tolist()
            arrived_ns = int(arrival_ns[stop - 1])
            stamps += self.clock.update(times, arrived_ns, list(range(start, stop)))
            doubt += [self.clock.in_doubt] * (stop - start)
            named += [bool(self.clock.problems)] * (stop - start)
        self.error_ms = np.abs((np.array(stamps) - EPOCH_NS) * 1e-6 - (true_s + BASE_S) * 1e3)
        self.in_doubt, self.named, self.true_s = np.array(doubt), np.array(named), true_s

    def usual_ms(self) -> float:
        """The largest error before anything happens."""
        return float(self.error_ms[(self.true_s > 3) & (self.true_s < AT_S)].max())


def device_times(true_s: NDArray[np.float64], step_us: int = 0) -> NDArray[np.int64]:
    """50 ppm slow, and set by step_us at AT_S."""
    device_us = np.floor((true_s + 100) / (1 + 5e-5) * 1e6).astype(np.int64)
    return device_us + np.where(true_s >= AT_S, step_us, 0)


@pytest.mark.parametrize(
    ("delay", "rate"),
    [
        (quick, 20.0),
        (quick, 1000.0),
        (usb_bursts, 90.7),
        (usb_bursts, 500.0),
        (random_delays, 100.0),
        (random_delays, 1000.0),
        (stalls, 90.7),
    ],
)
@pytest.mark.parametrize("step_ms", [5, -5, 15, -15, -200, 300, 5000, -5000])
def test_a_step_of_the_hubs_clock_is_named_and_rows_until_then_are_in_doubt(
    delay, rate, step_ms
) -> None:
    """No row is wrong without a flag, none has a flag before, and nothing is forgotten."""
    true_s = np.arange(int(20 * rate)) / rate
    run = Run(delay, true_s, device_times(true_s, 1000 * step_ms), seed=int(rate))
    after = true_s >= AT_S
    assert not run.in_doubt[true_s < AT_S - 0.1].any()
    assert not run.named[true_s < AT_S - 0.1].any()
    assert run.named[true_s >= AT_S + SEEN_S].all()
    # Half a millisecond is as much as another sample's delay may move the line.
    assert run.error_ms[after & ~run.in_doubt].max() < run.usual_ms() + 0.5
    assert not run.in_doubt[true_s > AT_S + 2 * SEEN_S].any()
    assert run.clock.problems == {CLOCK_SET} and run.clock.resets == 1
    assert abs(1e6 * run.clock.track.drift - 50) < 5


@pytest.mark.parametrize("delay", [quick, usb_bursts, random_delays])
@pytest.mark.parametrize("pause_s", [0.007, 0.03, 1.5])
def test_a_hub_that_samples_late_has_not_set_its_clock(delay, pause_s) -> None:
    """Its samples go on pause_s later, without a gap in their numbers."""
    true_s = np.arange(2000) / 100
    true_s += np.where(true_s >= AT_S, pause_s, 0)
    run = Run(delay, true_s, device_times(true_s), seed=1)
    assert not run.named.any() and run.clock.resets == 0
    assert run.error_ms[true_s > 3].max() < run.usual_ms() + 0.5
    assert np.ptp(true_s[run.in_doubt]) < SEEN_S if run.in_doubt.any() else True
    assert delay is not quick or not run.in_doubt.any()


@pytest.mark.parametrize("seed", [6, 8])
def test_a_slow_hub_that_samples_early_has_not_set_its_clock(seed) -> None:
    """At 5 Hz, the delays of the samples of 0.2 s may all be as long as the step."""
    true_s = np.arange(200) / 5
    true_s -= np.where(true_s >= AT_S, 0.005, 0)
    run = Run(random_delays, true_s, device_times(true_s), seed)
    assert not run.named.any() and run.in_doubt.sum() <= 8


def test_a_hub_that_samples_early_during_a_pause_of_the_line_has_not_set_its_clock() -> None:
    """The line holds samples for 0.1 s, which looks like a clock that was set back."""
    true_s = np.arange(20_000) / 1000
    true_s -= np.where(true_s >= AT_S, 0.005, 0)
    late_s = np.where((true_s > AT_S - 0.01) & (true_s < AT_S + 0.1), 0.02, 0)

    def delay(true_s, random):
        return true_s + BASE_S + late_s + random.exponential(0.4e-3, len(true_s))

    run = Run(delay, true_s, device_times(true_s), seed=1)
    assert not run.named.any()


def test_one_sample_that_is_late_is_not_two_steps() -> None:
    true_s = np.arange(2000) / 100
    true_s[1000] += 0.005
    device_us = device_times(true_s)
    run = Run(usb_bursts, true_s, device_us, seed=1)
    assert not run.named.any() and run.in_doubt.sum() <= 2


@pytest.mark.parametrize("late_s", [1.0, 2.5])
def test_delays_that_are_longer_for_a_second_are_not_a_step(late_s) -> None:
    """For two seconds they are, and a step that is over again is the second one."""
    true_s = np.arange(2000) / 100
    delay_s = np.where((true_s > AT_S) & (true_s < AT_S + late_s), 0.05, 0)
    run = Run(lambda t, _: t + BASE_S + delay_s, true_s, device_times(true_s), seed=1)
    assert run.clock.resets == (0 if late_s < 2 else 2)


def test_loss_disorder_gaps_and_the_wrap_of_numbers_raise_no_doubt() -> None:
    """Samples lost one by one and for seconds, sent twice, and behind the one that follows."""
    random = np.random.default_rng(4)
    kept = random.random(6000) > 0.05
    kept[2000:3500] = False
    order = np.flatnonzero(kept)
    order = np.sort(np.concatenate([order, order[::50]]))
    swap = np.arange(10, len(order) - 1, 37)
    order[swap], order[swap + 1] = order[swap + 1], order[swap].copy()
    true_s = np.arange(6000) / 300
    device_us = device_times(true_s)
    arrival_s = np.maximum.accumulate(random_delays(true_s[order], random))
    clock = HubClock()
    for k, arrived_s in zip(order.tolist(), arrival_s.tolist(), strict=True):
        number = (k - 1000) % (1 << 32)
        arrival_ns = EPOCH_NS + round(1e9 * arrived_s)
        (stamp_ns,) = clock.update([int(device_us[k])], arrival_ns, [number])
        assert not clock.in_doubt and not clock.problems
        assert true_s[k] < 6 or abs(stamp_ns - EPOCH_NS - 1e9 * (true_s[k] + BASE_S)) < 1_000_000


@pytest.mark.parametrize("rate", [50.0, 1000.0])
def test_rows_of_a_clock_that_stands_still_are_in_doubt_until_it_goes_on(rate) -> None:
    true_s = np.arange(int(20 * rate)) / rate
    device_us = device_times(true_s)
    still = (true_s >= AT_S) & (true_s < AT_S + 2)
    device_us[true_s >= AT_S] -= 2_000_000
    device_us[still] = device_us[true_s < AT_S][-1]
    run = Run(quick, true_s, device_us, seed=2)
    # Less than 5 ms could be anything.
    assert run.in_doubt[still & (true_s >= AT_S + 0.005)].all()
    assert run.error_ms[~run.in_doubt & (true_s < AT_S + 2)].max() < 5
    assert CLOCK_STANDS_STILL in run.clock.problems
    assert not run.in_doubt[true_s > AT_S + 2 + SEEN_S].any()


def test_the_doubt_is_in_the_rows() -> None:
    """From frames to rows. Where delays spread, a small step back takes 0.2 s to be sure of."""
    rows = []
    live = LiveLinks(
        [LinkConfig("a", "/dev/null")],
        [CubeAddress("c", 0, 0, None, 2)],
        lambda given: rows.extend(zip(given.sequence.tolist(), given.status.tolist(), strict=True)),
    )
    live.receive([LinkFrames(0, 0, [Hello(1, 0, 2, 10_000, np.array([5], "<u8"))])])
    late_ns = np.random.default_rng(0).exponential(4e6, 1000)
    arrived_ns = np.maximum.accumulate(10_000_000 * np.arange(1000) + late_ns)
    for k in range(1000):
        device_us = 10_000 * k - (6000 if k >= 500 else 0)
        frame = sample_frame(k, device_us)
        live.receive([LinkFrames(0, EPOCH_NS + int(arrived_ns[k]), [frame])])
    doubtful = [number for number, status in rows if status]
    assert [number for number, _ in rows] == list(range(1000))
    assert {status for _, status in rows} == {0, STAMP}
    assert doubtful[0] == 500 and doubtful[-1] < 500 + 100 * SEEN_S


def test_a_step_after_another_sample_period_is_measured_with_that_period() -> None:
    """The rate falls from 500 to 250 Hz, then the clock is set: stamps were wrong by 2 ms."""
    stamps = {}
    live = LiveLinks(
        [LinkConfig("a", "/dev/null")],
        [CubeAddress("c", 0, 0, None, 2)],
        lambda rows: stamps.update(
            zip(rows.sequence.tolist(), rows.stamp_ns.tolist(), strict=True)
        ),
    )
    live.receive([LinkFrames(0, 0, [Hello(1, 0, 2, 2000, np.array([5], "<u8"))])])
    taken_us = {k: 2000 * k if k < 1000 else 4000 * k - 2_000_000 for k in range(2000)}
    for k, time_us in taken_us.items():
        ack = [Ack(Command.SET_PERIOD, Result.DONE, 4000)] if k == 1000 else []
        frame = sample_frame(k, time_us + (3_000_000 if k >= 1200 else 0))
        live.receive([LinkFrames(0, EPOCH_NS + 1000 * time_us, [*ack, frame])])
    errors_ns = [stamps[k] - EPOCH_NS - 1000 * taken_us[k] for k in range(1300, 2000)]
    assert np.abs(errors_ns).max() < 10_000
