# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Which of many messages are due, so that a rate is held on average."""

from __future__ import annotations

import numpy as np
import pytest

from cube_tensor_driver.core.rate_limit import find_next_due_ns

PERIOD_NS = 10_000_000
START_NS = 1_700_000_000_123_456_789
"""Any time of a clock that counts since 1970."""


def select_due(stamps_ns: np.ndarray) -> list[int]:
    """Stamps at which something is due, from the first stamp on."""
    due_ns, found = 0, []
    for stamp_ns in stamps_ns.tolist():
        next_ns = find_next_due_ns(stamp_ns, due_ns, PERIOD_NS)
        if next_ns is not None:
            due_ns = next_ns
            found.append(stamp_ns)
    return found


@pytest.mark.parametrize("interval", [0.03, 0.1, 0.3, 0.64, 0.999, 1.0])
@pytest.mark.parametrize("jitter", [0.0, 0.01])
def test_the_rate_is_held_on_average(interval, jitter):
    """At messages that come faster, whose interval divides the period or not."""
    shift = jitter * np.random.default_rng(1).uniform(-1, 1, 20_000)
    periods = np.sort(interval * np.arange(20_000) + shift)
    stamps_ns = START_NS + (PERIOD_NS * periods).astype(np.int64)
    found = select_due(stamps_ns)
    elapsed = (stamps_ns[-1] - stamps_ns[0]) / PERIOD_NS
    assert abs(len(found) - 1 - elapsed) <= 1.5
    between = np.diff(found) / PERIOD_NS
    assert between.min() >= 0.5
    assert np.abs(between[1:] - 1).max() <= interval + 2 * jitter


@pytest.mark.parametrize("interval", [1.0, 1.001, 1.3, 2.5, 40.0])
def test_messages_that_come_once_a_period_or_less_often_are_all_due(interval):
    """With delays of up to a fifth of a period, which vary."""
    delay = np.random.default_rng(2).uniform(0, 0.2, 5_000)
    stamps_ns = START_NS + (PERIOD_NS * (interval * np.arange(5_000) + delay)).astype(np.int64)
    assert select_due(stamps_ns) == stamps_ns.tolist()


def test_a_gap_is_not_made_up_for():
    early = START_NS + np.arange(100) * (PERIOD_NS // 10)
    stamps_ns = np.concatenate([early, early + 1000 * PERIOD_NS + 12_345])
    found = select_due(stamps_ns)
    second = early[0] + 1000 * PERIOD_NS + 12_345
    assert second in found
    # Each part lasts 9.9 periods.
    assert len(found) == 22


@pytest.mark.parametrize("back", [0.001, 0.7, 1.0, 3.0, 1e7])
def test_stamps_that_go_back_interrupt_it_for_two_periods_at_most(back):
    """Stamps go back if a clock was set, or if a bag is played again."""
    step_ns = PERIOD_NS // 10
    first = START_NS + np.arange(1000) * step_ns
    again = first - int(back * PERIOD_NS) + first[-1] - first[0] + step_ns
    found = select_due(np.concatenate([first, again]))
    after = found[len(select_due(first)) :]
    assert after[0] - again[0] <= 2 * PERIOD_NS
    assert set(np.diff(after[1:])) == {PERIOD_NS} and abs(len(after) - 100) <= 2


def test_the_first_message_of_simulated_time_is_due():
    assert find_next_due_ns(0, 0, PERIOD_NS) == PERIOD_NS
