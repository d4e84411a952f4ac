"""What C follows changes nothing: stamps, counters and clocks are those of Python alone."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cube_tensor_driver.device.clock.clock import ClockMap
from cube_tensor_driver.device.scans.follower import Follower
from cube_tensor_driver.device.scans.sequence import Account, Arrival
from cube_tensor_driver.device.wire import native
from cube_tensor_driver.device.wire.decoder import Decoder
from cube_tensor_driver.device.wire.protocol import Sample, encode

pytestmark = pytest.mark.skipif(native.wire is None, reason="was not compiled")

PERIOD_US = 1000


class Link:
    """What the driver does with the samples of a link, with or without C."""

    def __init__(self, with_c: bool) -> None:
        self.account, self.clock = Account(), ClockMap()
        self.follower = Follower(self.account, self.clock) if with_c else None
        self.followed = 0

    def receive(self, samples: list[Sample], arrival_ns: int) -> list[int]:
        if self.follower is not None:
            stamps = self.follower.follow(samples, arrival_ns)
            if stamps is not None:
                self.followed += len(stamps)
                return stamps
            self.follower.take_back()
        stamps: list[int] = []
        run: list[Sample] = []
        for sample in samples:
            arrival = self.account.sample(sample)
            if arrival is Arrival.RESET:
                stamps += self._stamps(run, arrival_ns)
                run = []
                self.clock.reset()
            if arrival is not Arrival.DUPLICATE:
                run.append(sample)
        stamps += self._stamps(run, arrival_ns)
        if self.follower is not None:
            self.follower.lend()
        return stamps

    def _stamps(self, run: list[Sample], arrival_ns: int) -> list[int]:
        device_us = [sample.device_us for sample in run]
        return self.clock.update(device_us, arrival_ns, [sample.sequence for sample in run])

    def state(self) -> tuple[object, ...]:
        if self.follower is not None:
            self.follower.take_back()
        clock = self.clock
        times = clock.offset_ns, clock.drift_ppm, clock.jitter_ns, clock.delay_ns, clock.bound_ns
        found = clock.resets, clock.in_doubt, sorted(clock.problems)
        return self.account.counters(), self.account.contradictions(), times, found


def sample(number: int, device_us: int) -> Sample:
    frequency = np.full((1, 1), 1, "<u4")
    made = Sample(number % 2**32, 0, device_us, frequency, np.zeros(1, "<u4"), np.zeros(1, "<i2"))
    (decoded,) = Decoder().feed(encode(made))
    assert isinstance(decoded, Sample)
    return decoded


# Of a run of reads: samples a read, how many reads, jitter of the hub, delay on the way in µs.
usual = st.tuples(
    st.integers(1, 3), st.integers(1, 90), st.sampled_from([0, 1, 3, 400]), st.integers(0, 900)
)
# What happens before it: skipped numbers, step of the hub's clock, pause of the host, µs; whether
# the last sample comes again; whether somebody looks at the counters.
event = st.tuples(
    st.sampled_from([0, 0, 0, 1, 5, -3, 2**21]),
    st.sampled_from([0, 0, 0, 3_000, 50_000, -50_000, -5_000_000]),
    st.sampled_from([0, 0, 1_500_000]),
    st.booleans(),
    st.booleans(),
)


@settings(max_examples=60, deadline=None)
@given(
    parts=st.lists(st.tuples(event, usual), min_size=1, max_size=6),
    first=st.sampled_from([0, 7, 2**32 - 20]),
    since_us=st.sampled_from([0, 10**9, 2**50 - 40_000, 2**63]),
    seed=st.integers(0, 99),
)
def test_the_same_with_c_and_without(
    parts: list[tuple[tuple[int, int, int, bool, bool], tuple[int, int, int, int]]],
    first: int,
    since_us: int,
    seed: int,
) -> None:
    random = np.random.default_rng(seed)
    links = Link(with_c=True), Link(with_c=False)
    number, device_us, host_ns = first, since_us, 1_800_000_000 * 10**9
    for (skipped, step_us, pause_us, is_again, is_looked_at), (size, reads, jitter, delay) in parts:
        number, device_us = max(0, number + skipped), max(0, device_us + step_us)
        host_ns += 1000 * pause_us
        device_us += pause_us
        for read in range(reads):
            samples = []
            for _ in range(size):
                shift = int(random.integers(-jitter, jitter + 1))
                samples.append(sample(number, max(0, device_us + shift) % 2**64))
                number += 1
                device_us += PERIOD_US
                host_ns += 1000 * PERIOD_US
            if is_again and read == reads // 2:
                samples.append(samples[-1])
            arrival_ns = host_ns + 1000 * int(random.integers(0, delay + 1))
            stamps = [link.receive(samples, arrival_ns) for link in links]
            assert stamps[0] == stamps[1]
        if is_looked_at:
            assert links[0].state() == links[1].state()
    assert links[0].state() == links[1].state()


def test_nearly_all_samples_are_followed() -> None:
    """And the drift that is found from them is that of Python alone."""
    links = Link(with_c=True), Link(with_c=False)
    for number in range(7000):
        arrival_ns = 1_800_000_000 * 10**9 + 1_000_030 * number + 1000 * (number * 7919 % 500)
        samples = [sample(number, PERIOD_US * number)]
        stamps = [link.receive(samples, arrival_ns) for link in links]
        assert stamps[0] == stamps[1]
    assert links[0].followed > 0.97 * 7000
    assert links[0].state() == links[1].state()
    assert links[0].clock.drift_ppm == pytest.approx(30, abs=1)
