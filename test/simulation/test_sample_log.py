# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The sample log of a simulator, and the comparison of what was sent and received."""

from __future__ import annotations

import numpy as np
import pytest

from cube_tensor_driver.config.grid import describe_grid
from cube_tensor_driver.config.skin import read_skin
from cube_tensor_driver.config.yaml import write_yaml
from cube_tensor_driver.core.errors import ConfigError
from cube_tensor_driver.core.matching import NO_MATCH, SampleKeys
from cube_tensor_driver.core.rows import FrequencyRows
from cube_tensor_driver.demo.verification import Arrivals, compare
from cube_tensor_driver.simulation.faults import Fault
from cube_tensor_driver.simulation.sample_log import (
    ABSENT,
    FaultRecord,
    LinkLog,
    SampleLog,
    SampleRun,
)
from workshop.bench.hub_arrivals import HubArrivals

START_NS = 10**18
PERIOD_US = 2000
# hub0 restarts after 10 samples and counts from 0 again; hub1 passes 2^32.
RESTARTED = (
    SampleRun(first=0, last=9, start_us=0, period_us=PERIOD_US),
    SampleRun(first=0, last=19, start_us=100_000, period_us=PERIOD_US, boot=1),
)
WRAPPED = (SampleRun(first=2**32 - 5, last=2**32 + 4, start_us=0, period_us=PERIOD_US),)
LOG = SampleLog(
    START_NS,
    (LinkLog("hub0", (0, ABSENT, 1), 3, RESTARTED), LinkLog("hub1", (2, 3), 4, WRAPPED)),
    (FaultRecord(20_000, 100_000, Fault("unplug", link="hub0", seconds=0.08)),),
)
END_NS = START_NS + 10**9


def rows_of(cubes, sequence, stamp_ns) -> FrequencyRows:
    n = len(cubes)
    return FrequencyRows(
        cube=np.array(cubes, np.uint16),
        sequence=np.full(n, sequence % 2**32, np.uint32),
        stamp_ns=np.full(n, stamp_ns),
        frequency=np.zeros((n, 8), np.float32),
        temperature=np.zeros(n, np.float32),
        pad_fault=np.zeros(n, np.uint32),
        status=np.zeros(n, np.uint16),
    )


def everything():
    """(rows, link name) of all samples of the log, in order of each link."""
    table = LOG.table
    for link, number, time_ns in zip(table.link, table.number, table.time_ns, strict=True):
        yield rows_of(LOG.links[link].members, int(number), time_ns + 150_000)


@pytest.fixture(scope="module")
def skin(tmp_path_factory):
    path = tmp_path_factory.mktemp("skin") / "skin.yaml"
    write_yaml(path, describe_grid(nx=4, ny=1, pitch=0.012, links=2, rate=500.0))
    return read_skin(path)


def test_what_is_written_is_read(tmp_path):
    path = tmp_path / "log.json"
    LOG.write(path)
    assert SampleLog.read(path) == LOG
    assert LOG.dropped == 7 and LOG.links[0].members == [0, 1]


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"start_time_ns": 0, "links": [{}]}'])
def test_what_is_no_log_is_refused(tmp_path, text):
    path = tmp_path / "log.json"
    with pytest.raises(ConfigError, match=r"log.json: No such file .* when it ends"):
        SampleLog.read(path)
    path.write_text(text)
    with pytest.raises(ConfigError, match=r"log.json: no sample log"):
        SampleLog.read(path)


def test_when_a_sample_was_taken_and_how_many_in_a_span():
    cube, sequence = np.array([1, 1, 1, 2, 3, 2]), np.array([3, 3, 15, 2**32 - 1, 4, 5])
    near = START_NS + 1000 * np.array([0, 120_000, 0, 0, 0, 0])
    sample = LOG.table.match(SampleKeys(cube, sequence, near))
    time_ns = LOG.table.time_ns[sample]
    expected_us = [6000, 106_000, 130_000, 8000, 18_000]
    assert ((time_ns[:5] - START_NS) // 1000).tolist() == expected_us
    assert sample[5] == NO_MATCH
    # Two cubes on each hub; the hub of 10 samples and the wrapped one in the first 20 ms.
    assert LOG.table.count_rows_taken(START_NS, START_NS + 20_000_000) == 2 * 10 + 2 * 10
    assert LOG.table.count_rows_taken(START_NS, START_NS + 10_000_001) == 2 * 6 + 2 * 6
    assert LOG.table.count_rows_taken(START_NS, END_NS) == 2 * 30 + 2 * 10


@pytest.mark.parametrize("kind", [Arrivals, HubArrivals])
def test_rows_that_came_twice_or_were_never_taken_do_not_make_up_for_lost_ones(skin, kind):
    arrivals = kind(skin)
    samples = list(everything())
    for number, rows in enumerate(samples):
        if number not in (4, 17):
            arrivals.add(rows, int(rows.stamp_ns[0]) + 850_000)
    arrivals.add(samples[8])
    arrivals.add(rows_of([0, 1], 1000, START_NS))
    assert arrivals.rows == 2 * len(samples)
    comparison = compare(LOG.table, arrivals, START_NS, END_NS)
    assert (comparison.sent, comparison.received, comparison.missing) == (80, 76, 4)
    np.testing.assert_allclose(comparison.latency_ms, 1.0)
    np.testing.assert_allclose(comparison.stamp_error_ms, 0.15)
    # Of a span: the first 10 ms of both hubs.
    span = compare(LOG.table, arrivals, START_NS, START_NS + 10_000_000)
    assert (span.sent, span.received) == (20, 18)


def test_nothing_arrived(skin):
    comparison = compare(LOG.table, Arrivals(skin), START_NS, END_NS)
    assert (comparison.sent, comparison.received, comparison.missing) == (80, 0, 80)
