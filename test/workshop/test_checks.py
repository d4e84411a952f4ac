# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The checks of torture find each thing that is wrong, and nothing where nothing is."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from cube_tensor_driver.config.grid import describe_grid
from cube_tensor_driver.config.skin import read_skin
from cube_tensor_driver.config.yaml import write_yaml
from cube_tensor_driver.core.reconstructor import Reconstructor
from cube_tensor_driver.core.rows import FrequencyRows, concatenate
from cube_tensor_driver.core.status import STUCK
from cube_tensor_driver.device.wire.protocol import TEMPERATURE_UNKNOWN
from cube_tensor_driver.simulation.cubes import SimulatedCubes
from cube_tensor_driver.simulation.faults import PAD_FAULTS, Fault
from cube_tensor_driver.simulation.injector import compute_broken_reading
from cube_tensor_driver.simulation.load import Load, read_default_script
from cube_tensor_driver.simulation.sample_log import FaultRecord, LinkLog, SampleLog, SampleRun
from workshop.checks import timing
from workshop.checks.all_checks import check_all
from workshop.checks.record import NodeAction, Received, Record, Samples
from workshop.checks.rest import TRANSPORT_S
from workshop.checks.run import Run
from workshop.checks.sent_readings import SentReadings, make_reading_type

INSTANTS, COUNT, PERIOD_US, EACH = 400, 2000, 2000, 2
FAULTS = {
    "stuck": Fault("stuck", link="hub0", cube=1, pad=4),
    "noisy": Fault("noisy", link="hub1", cube=0, pad=2, value=1e-3),
    "short": Fault("short", link="hub1", cube=1, pad=7),
    "report": Fault("report", link="hub0", cube=0, pad=3),
}
RECORDS = tuple(FaultRecord(500_000, 2_500_000, fault) for fault in FAULTS.values())
WRONG = (
    "miscounted",
    "unreadable",
    "lost",
    "wrong",
    "repeated",
    "missing_tensors",
    "wrong_tensors",
    "unflagged",
    "false_alarms",
    "wrong_periods",
)


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    """A log and a record of 4 s of two hubs with a restart, four broken pads and a dropped sample,
    as a program without a fault would leave them."""
    path = tmp_path_factory.mktemp("skin") / "skin.yaml"
    write_yaml(path, describe_grid(nx=4, ny=1, pitch=0.012, links=2, rate=500.0))
    skin = read_skin(path)
    run = SampleRun(first=0, last=COUNT - 1, start_us=PERIOD_US, period_us=PERIOD_US)
    half = COUNT // 2
    before = replace(run, last=half - 1)
    after = SampleRun(0, half - 1, PERIOD_US * (half + 1), PERIOD_US, boot=1)
    links = (
        LinkLog("hub0", (0, 1), 0, (run,), damaged=((0, 70),)),
        LinkLog("hub1", (2, 3), 0, (before, after)),
    )
    return recorded(skin, SampleLog(0, links, RECORDS))


@cache
def sound_readings(skin):
    """(instants, cubes, pads) in mHz."""
    load, cubes = Load(skin, read_default_script()), SimulatedCubes(skin.calibrations)
    times = load.period * np.arange(INSTANTS) / INSTANTS
    return np.array(
        [cubes.compute_frequency(*load.compute_stress_field(time), 0.0) for time in times]
    )


def sent_readings(skin, log):
    """What the hubs send in each sample under the faults of a log."""
    samples = Samples(log)
    times_us = samples.time_ns // 1000
    load_us = times_us.copy()
    for fault in samples.select_faults("hold"):
        load_us[(samples.link == fault.link) & fault.contains(samples.time_ns)] = (
            fault.begin_ns // 1000
        )
    instant = load_us // PERIOD_US % INSTANTS
    cube = EACH * samples.link[:, None] + np.arange(EACH)
    readings = np.zeros(len(samples), make_reading_type(EACH, 8))
    readings["millihertz"] = sound_readings(skin)[instant[:, None], cube]
    readings["centi_celsius"] = TEMPERATURE_UNKNOWN
    for fault in samples.select_faults(*PAD_FAULTS):
        rows = (samples.link == fault.link) & fault.contains(samples.time_ns)
        place = np.flatnonzero(rows), fault.fault.cube, fault.fault.pad
        if fault.kind == "report":
            readings["pad_fault"][place[:2]] |= np.uint32(1 << fault.fault.pad)
        else:
            sound = readings["millihertz"][place].tolist()
            readings["millihertz"][place] = [
                compute_broken_reading(fault.fault, one, sound[0], time_us)
                for one, time_us in zip(sound, times_us[rows].tolist(), strict=True)
            ]
    return readings


def recorded(skin, log, actions=(), rest_after=None):
    """(record, log, readings) of what a program without a fault makes of a log.

    rest_after: (wall clock in ns, rest frequencies of all cubes) of a tare
    """
    samples = Samples(log)
    sent = sent_readings(skin, log)
    order = np.argsort(samples.time_ns, kind="stable")
    order = order[~samples.is_damaged[order]]
    cube = (EACH * samples.link[order, None] + np.arange(EACH)).ravel().astype(np.uint16)
    of = np.repeat(order, EACH)
    readings = SentReadings(samples, sent).select(cube, of)
    frequencies = FrequencyRows(
        cube=cube,
        sequence=samples.number[of].astype(np.uint32),
        stamp_ns=samples.time_ns[of] + 100_000,
        frequency=readings.frequency,
        temperature=readings.temperature,
        pad_fault=readings.pad_fault,
        status=np.zeros(len(cube), np.uint16),
    )
    reconstruct = Reconstructor(skin)
    scans = np.split(np.arange(len(cube)), np.flatnonzero(np.diff(samples.time_ns[of])) + 1)
    made = []
    for scan in map(frequencies.select, scans):
        if rest_after is not None and scan.stamp_ns[0] > rest_after[0]:
            reconstruct.rest_frequency = rest_after[1]
        made.append(reconstruct(scan))
    stress = concatenate(made)
    record = Record(
        skin=skin,
        frequencies=received(frequencies),
        stress=received(stress),
        actions=actions,
        counters={
            "lost_on_the_way": 1,
            "dropped_in_hub": 0,
            "rows published": len(cube),
            "rows of unknown cubes": 0,
            "rows dropped by a slow host": 0,
            "rows with another number of pads": 0,
            "rows unaccounted": 0,
            "rows lost by errors": 0,
        },
        messages_lost=0,
        begin_ns=0,
        end_ns=10**12,
    )
    return record, log, sent


def received(rows, **others):
    """Rows that were sent as soon as they were stamped."""
    return Received(rows, rows.stamp_ns, **others)


def found(played, frequencies=None, stress=None, **counters):
    """Names of the figures that are wrong when rows are exchanged."""
    record, log, readings = played
    if frequencies is not None:
        record = replace(record, frequencies=received(frequencies))
    if stress is not None:
        record = replace(record, stress=received(stress))
    record = replace(record, counters={**record.counters, **counters})
    figures = check_all(record, log, readings)
    return {name for name in WRONG if figures[name]}


def changed(rows, chosen=slice(None), **fields):
    """Rows with other values in some fields; each value may be a function of the old ones."""
    columns = {name: np.array(getattr(rows, name)) for name in fields}
    for name, value in fields.items():
        columns[name][chosen] = value(columns[name][chosen]) if callable(value) else value
    return replace(rows, **columns)


def test_nothing_is_found_where_nothing_is_wrong(played):
    assert found(played) == set()
    figures = check_all(*played)
    assert figures["faults_to_flag"] == len(FAULTS)
    assert figures["samples_sent"] - figures["delivered"] == EACH


ROW = 6000
FREQUENCY_CHANGES = {
    "one bit": (ROW, {"frequency": lambda f: np.nextafter(f, np.float32(0))}, "wrong"),
    "temperature": (ROW, {"temperature": 10.0}, "wrong"),
    "pad fault": (ROW, {"pad_fault": 1}, "wrong"),
    "sequence": (ROW, {"sequence": 99_999}, "wrong"),
    "pads": (slice(None), {"frequency": lambda f: f[:, ::-1]}, "wrong"),
}


@pytest.mark.parametrize("name", list(FREQUENCY_CHANGES))
def test_a_wrong_field_of_frequencies_is_found(played, name):
    chosen, fields, figure = FREQUENCY_CHANGES[name]
    assert figure in found(played, changed(played[0].frequencies.rows, chosen, **fields))


STRESS_CHANGES = {
    "component": ({"stress": lambda s: 1.1 * s}, "wrong_tensors"),
    "gradient": ({"gradient": lambda g: -g}, "wrong_tensors"),
    "residual": ({"residual": 0.0}, "wrong_tensors"),
    "observed": ({"observed": lambda bits: bits ^ 1}, "wrong_tensors"),
    "left out": ({"left_out": 0}, "unflagged"),
    "other pad": ({"left_out": lambda bits: bits << np.uint32(1)}, "false_alarms"),
    "stuck bit": ({"status": lambda bits: bits & ~np.uint16(STUCK)}, "unflagged"),
    "stamp": ({"stamp_ns": lambda at: at + 1}, "missing_tensors"),
}


@pytest.mark.parametrize("name", list(STRESS_CHANGES))
def test_a_wrong_field_of_stress_is_found(played, name):
    fields, figure = STRESS_CHANGES[name]
    assert figure in found(played, stress=changed(played[0].stress.rows, **fields))


def test_rows_that_are_missing_or_came_twice_are_found(played):
    frequencies, stress = played[0].frequencies.rows, played[0].stress.rows
    all_but_one = np.delete(np.arange(len(frequencies)), ROW)
    one_twice = np.insert(np.arange(len(frequencies)), ROW, ROW)
    assert "lost" in found(played, frequencies.select(all_but_one), stress.select(all_but_one))
    assert "repeated" in found(played, frequencies.select(one_twice))
    assert found(played, stress=stress.select(all_but_one)) == {"missing_tensors"}
    assert found(played, stress=stress.select(one_twice)) == {"repeated"}


def test_rows_that_the_driver_counts_as_dropped_by_a_slow_host_are_not_lost(played):
    """As many as it counts, and no more."""
    frequencies, stress = played[0].frequencies.rows, played[0].stress.rows
    rest = np.delete(np.arange(len(frequencies)), [ROW, ROW + 1])
    both = frequencies.select(rest), stress.select(rest)
    counters = {"rows published": len(rest), "rows dropped by a slow host": 2}
    assert found(played, *both, **counters) == set()
    counters["rows dropped by a slow host"] = 1
    assert found(played, *both, **counters) == {"lost", "miscounted"}


TARED_NS, HELD_CUBES = 3_200_000_000, (0, 1)


@pytest.fixture(scope="module")
def tared(played):
    """Makes (record, log) of a tare of the cubes of hub0 at TARED_NS: by its error, and by how long
    their load had stayed."""
    skin, log = played[0].skin, played[1]

    def make(error, stayed_ns):
        start_us = (TARED_NS - stayed_ns) // 1000
        hold = FaultRecord(start_us, 3_900_000, Fault("hold", link="hub0"))
        held = replace(log, faults=(hold,))
        rest = np.array([cube.calibration.rest_frequency for cube in skin.cubes])
        instant = start_us // PERIOD_US % INSTANTS
        rest[list(HELD_CUBES)] = sound_readings(skin)[instant, HELD_CUBES] * 1e-3 * (1 + error)
        action = NodeAction(
            kind="tare", begin_ns=TARED_NS, end_ns=TARED_NS, succeeded=True, cubes=HELD_CUBES
        )
        return recorded(skin, held, (action,), (TARED_NS, rest))

    return make


def test_a_tare_of_another_load_is_found(tared):
    stayed_ns = 2_600_000_000
    assert found(tared(0.0, stayed_ns)) == set()
    assert found(tared(50e-6, stayed_ns)) == {"wrong_tensors"}


def test_what_a_tare_of_a_load_that_was_not_held_is_not_checked(tared):
    """It averages both loads, where they differ by less than noise does."""
    record, log, readings = played = tared(50e-6, 1_000_000_000)
    assert found(played) == set()
    rows = record.stress.rows
    after = (rows.stamp_ns >= TARED_NS - round(1e9 * TRANSPORT_S)) & np.isin(rows.cube, HELD_CUBES)
    assert check_all(record, log, readings)["tensors_not_judged"] == np.count_nonzero(after)
    other_cube = 2
    wrong = changed(
        rows, np.flatnonzero(rows.cube == other_cube)[-1], stress=lambda stress: 1.1 * stress
    )
    assert found(played, stress=wrong) == {"wrong_tensors"}


def test_what_the_driver_counts_is_checked(played):
    for counter in ("lost_on_the_way", "rows published", "rows unaccounted"):
        assert found(played, **{counter: played[0].counters[counter] + 1}) == {"miscounted"}
    assert found(played, lost_on_the_way=0) == {"miscounted"}


def test_a_tensor_that_the_reconstruction_counts_as_lost_is_not_missing(played):
    """As many messages as it says, and no more."""
    record, log, readings = played
    stress = record.stress.rows
    rest = received(stress.select(stress.stamp_ns != stress.stamp_ns[ROW]))
    for lost, figures in ((0, {"missing_tensors"}), (1, set()), (2, {"miscounted"})):
        changed_record = replace(record, stress=rest, messages_lost=lost)
        assert {name for name in WRONG if check_all(changed_record, log, readings)[name]} == figures


def test_what_comes_to_a_reconstruction_that_is_down_has_no_tensor(played):
    """From the last message that it made tensors of, until it is back."""
    record, log, readings = played
    stamp_ns = record.stress.rows.stamp_ns
    down = (stamp_ns > stamp_ns[ROW]) & (stamp_ns < stamp_ns[ROW] + 100_000_000)
    rest = received(record.stress.rows.select(~down))
    for late_ns, figures in ((0, set()), (-50_000_000, {"missing_tensors"})):
        begin_ns, end_ns = int(stamp_ns[ROW]) + 10_000_000, int(stamp_ns[down].max()) + late_ns
        action = NodeAction(
            kind="restart reconstruction", begin_ns=begin_ns, end_ns=end_ns, succeeded=True
        )
        killed = check_all(replace(record, stress=rest, actions=(action,)), log, readings)
        assert {name for name in WRONG if killed[name]} == figures


def test_what_a_driver_counted_just_before_it_was_killed_is_not_known(played):
    record, log, readings = played
    stamp_ns = record.frequencies.rows.stamp_ns
    dead_ns = int(stamp_ns[-1]) + 1
    dead = NodeAction(kind="restart driver", begin_ns=dead_ns, end_ns=dead_ns, succeeded=True)
    for unreported_ns, figures in ((1_400_000_000, set()), (1_600_000_000, {"miscounted"})):
        unreported = np.count_nonzero(stamp_ns > dead_ns - unreported_ns)
        counters = {**record.counters, "rows published": len(stamp_ns) - int(unreported)}
        killed = replace(record, counters=counters, actions=(dead,))
        assert {name for name in WRONG if check_all(killed, log, readings)[name]} == figures


def test_what_did_not_arrive_here_is_not_checked(played):
    """The numbers of DDS show that messages are missing: their rows are not checked."""
    record, log, readings = played
    rest = np.r_[0:4000, 4400:8000]
    frequencies = record.frequencies.rows
    rest = rest[rest < len(frequencies)]
    record = replace(
        record,
        frequencies=received(frequencies.select(rest), gaps=((4000, 100),)),
        counters={**record.counters},
    )
    figures = check_all(record, log, readings)
    assert figures["missed_by_judge"] == 100
    assert {name for name in WRONG if figures[name]} == set()


def test_stamps_are_checked_from_a_time_after_the_first_row_of_each_link(played, monkeypatch):
    """The driver began long before. The first row of hub1 comes after 2.5 s."""
    monkeypatch.setattr(timing, "CLOCK_SETTLE_S", 1.0)
    record, log, readings = played
    rows = record.frequencies.rows
    rest = rows.select((rows.cube < EACH) | (rows.stamp_ns >= 2_500_000_000))
    record = replace(record, begin_ns=-(10**10), frequencies=received(rest))
    errors_ms = timing.measure_stamp_errors(Run(record, log, readings))
    # of 4 s: the last 3 s of hub0 and 0.5 s of hub1
    assert len(errors_ms) == pytest.approx(500 * 3.5, abs=3)
    assert errors_ms == pytest.approx(0.1)
