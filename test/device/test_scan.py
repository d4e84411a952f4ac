# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""From samples to rows: which cube a value belongs to, what is left out and counted, when a scan is
complete."""

from __future__ import annotations

import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from conftest import sample_frame
from cube_tensor_driver.core.errors import LinkError
from cube_tensor_driver.device.chain import LiveLinks
from cube_tensor_driver.device.links.link import LinkConfig, LinkState
from cube_tensor_driver.device.links.link_log import LinkLogger
from cube_tensor_driver.device.links.reader import LinkFrames
from cube_tensor_driver.device.scans.cube_table import CubeAddress
from cube_tensor_driver.device.scans.row_counts import RowCounts
from cube_tensor_driver.device.scans.scan import ScanBuilder
from cube_tensor_driver.device.wire.protocol import Hello, Sample


def hello(uids, n_pads=2):
    return Hello(1, 1, n_pads, 1000, np.array(uids, "<u8"))


def sample(sequence, hertz, first=0, fault=0, celsius=-32768):
    frequency = np.rint(np.array(hertz) * 1e3).astype("<u4")
    n = len(frequency)
    return Sample(
        sequence, first, 0, frequency, np.full(n, fault, "<u4"), np.full(n, celsius, "<i2")
    )


def two_links():
    # cube 0 on link 1 index 0; cube 1 on link 0 index 1; cube 2 by uid 77 anywhere; cube 3 on link
    # 1 index 1
    scan = ScanBuilder(
        2,
        [
            CubeAddress("a", 1, 0, None, 2),
            CubeAddress("b", 0, 1, None, 2),
            CubeAddress("c", None, None, 77, 2),
            CubeAddress("d", 1, 1, None, 2),
        ],
    )
    assert scan.cubes.learn(0, hello([77, 5])) == []
    assert scan.cubes.learn(1, hello([6, 7])) == []
    return scan


def test_rows_carry_the_cubes_of_the_skin():
    scan = two_links()
    scan.add(0, sample(10, [[1.0, 2.0], [3.0, 4.0]], celsius=2150), 1000)
    assert scan.is_complete()  # link 1 has never delivered: nobody waits for it
    scan.add(1, sample(20, [[5.0, 6.0], [7.0, 8.0]], fault=2), 3000)
    rows = scan.build()
    assert rows.cube.tolist() == [2, 1, 0, 3]
    assert rows.sequence.tolist() == [10, 10, 20, 20]
    assert rows.stamp_ns.tolist() == [1000, 1000, 3000, 3000]
    assert rows.frequency.tolist() == [[1.0, 2.0], [3.0, 4.0], [5.0, 6.0], [7.0, 8.0]]
    assert rows.pad_fault.tolist() == [0, 0, 2, 2]
    np.testing.assert_allclose(rows.temperature, [21.5, 21.5, np.nan, np.nan], rtol=1e-6)  # float32
    assert scan.build() is None


def test_a_scan_waits_for_live_links_but_not_twice():
    scan = two_links()
    for link in (0, 1):
        scan.add(link, sample(0, [[1.0, 1.0]]), 0)
    scan.build()
    scan.add(0, sample(1, [[1.0, 1.0]]), 1)
    assert not scan.is_complete()
    scan.add(0, sample(2, [[1.0, 1.0]]), 2)
    assert scan.is_complete()
    scan.build()
    scan.add(0, sample(3, [[1.0, 1.0]]), 3)
    scan.forget(1)
    assert scan.is_complete()


def test_a_link_that_was_late_once_does_not_stay_a_sample_behind():
    scan = two_links()

    def give(link, number):
        scan.add(link, sample(number, [[1.0, 1.0]] * 2), 1000 * (number + 1) + link)

    def taken():
        rows = scan.build() if scan.is_complete() else None
        return None if rows is None else rows.sequence.tolist()

    for link, number, expected in (
        (0, 0, [0, 0]),
        (1, 0, [0, 0]),  # each begins for itself
        (0, 1, None),
        (1, 1, [1, 1, 1, 1]),
        (1, 2, None),
        (0, 2, [2, 2, 2, 2]),
    ):
        give(link, number)
        assert taken() == expected, (link, number)
    scan = two_links()
    for link in (0, 1):
        give(link, 0)
    assert taken() == [0] * 4
    give(0, 1), give(0, 2), give(1, 1)
    assert taken() == [1] * 4, "the second was late once: what the first has given more waits"
    assert taken() is None
    give(1, 2)
    assert taken() == [2] * 4 and scan.count_rows_waiting() == 0
    give(0, 3), give(0, 4)
    assert taken() == [3, 3, 4, 4], "nothing from the second: nobody waits for it any longer"
    give(1, 3)
    assert taken() == [3, 3], "what is late to a scan waits for nobody"
    give(0, 5), give(1, 4), give(1, 5)
    assert [taken(), taken(), taken()] == [[5, 5, 4, 4], [5, 5], None]
    give(0, 6), give(1, 6)
    assert taken() == [6] * 4 and scan.count_rows_waiting() == 0


def taken(scan, max_scans=None):
    """Sequences of the rows that are complete, one list for each time they are built."""
    lists = []
    while scan.is_complete():
        rows = scan.build(max_scans=max_scans)
        lists.append([] if rows is None else rows.sequence[::2].tolist())
    return lists


def test_links_that_are_late_by_different_times_make_whole_scans():
    """As where this process cannot keep up. Parts of scans would cost it even more time."""
    scan = two_links()

    def give(link, *numbers):
        for number in numbers:
            scan.add(link, sample(number, [[1.0, 1.0]] * 2), 1000 * number + link)

    give(0, 0), give(1, 0)
    taken(scan)
    give(0, 1, 2), give(1, 7, 8)
    assert taken(scan) == [[1, 7, 2, 8]]
    give(0, 3), give(1, 9, 10)
    assert taken(scan) == [[3, 9]] and scan.count_rows_waiting() == 2, (
        "the second has given one more"
    )
    give(0, 4), give(1, 11)
    assert taken(scan) == [[4, 10]]
    give(0, 5, 6), give(1, 12, 13, 14)
    assert taken(scan) == [[5, 11, 6, 12]]
    scan.forget(0)
    assert taken(scan) == [[13, 14]], "nobody waits for a link that is gone"
    give(0, 7), give(1, *range(15, 21))
    assert taken(scan) == [[7, *range(15, 21)]], "so far ahead nothing waits"
    give(1, 21), give(0, 21)
    assert taken(scan) == [[21, 21]], "and then they are in step again"


@given(st.lists(st.tuples(*[st.integers(0, 3)] * 2), max_size=30), st.sampled_from([None, 1, 4]))
def test_each_sample_is_built_once_and_in_order(turns, max_scans):
    """However late the links are, and by whatever."""
    scan, given, built = two_links(), [0, 0], [[], []]
    for turn, counts in enumerate([*turns, None]):
        for link in (0, 1):
            if counts is None:
                scan.forget(link)
                continue
            for _ in range(counts[link]):
                number, stamp_ns = given[link], 1_000_000 * turn + given[link]
                scan.add(link, sample(number, [[1.0, 1.0]] * 2), stamp_ns)
                given[link] += 1
        while scan.is_complete():
            rows = scan.build(max_scans=max_scans)
            for link, cubes in enumerate(((1, 2), (0, 3))):
                built[link] += rows.sequence[np.isin(rows.cube, cubes)][::2].tolist()
    assert built == [list(range(count)) for count in given] and scan.count_rows_waiting() == 0


@pytest.mark.parametrize("begins, lost", [(1, ()), (3, ()), (4, ()), (0, (11, 12))])
def test_what_a_link_has_not_sent_does_not_keep_batches_small(begins, lost):
    """Batches of five scans; the second link begins later, or loses two samples."""
    scan, period, sizes = two_links(), 10_000_000, []
    for number in range(60):
        for link in (0, 1):
            if link == 0 or (number >= begins and number not in lost):
                frame = sample(number, [[1.0, 1.0], [1.0, 1.0]])
                scan.add(link, frame, number * period + 1_000_000 * link)
            while scan.is_complete(5):
                rows = scan.build(max_scans=6)
                sizes.append(len(rows))
    assert set(sizes[4:]) == {5 * 2 * 2}
    sent = 60 * 2 * 2 - 2 * (begins + len(lost))
    assert sum(sizes) + scan.count_rows_waiting() == sent and scan.count_rows_waiting() < 5 * 2 * 2


def test_a_sample_in_two_frames_goes_on_at_once():
    """Its second part does not wait for the next scan, whichever hub is the earlier one."""
    scan = two_links()
    for link, stamp_ns in ((0, 1010), (0, 1010), (1, 1000)):
        scan.add(link, sample(0, [[1.0, 1.0]]), stamp_ns)
    taken = [len(scan.build().cube) for _ in range(2) if scan.is_complete()]
    assert taken == [2, 1] and not scan.is_complete() and scan.count_rows_waiting() == 0


def test_not_measured_is_nan_and_millihertz_survive():
    scan = ScanBuilder(1, [CubeAddress("a", 0, 0, None, 2)])
    scan.cubes.learn(0, hello([1]))
    scan.add(0, sample(0, [[0.0, 100_000.001]]), 0)
    frequency = scan.build().frequency
    # 1 mHz is below float32's spacing at 100 kHz (7.8 mHz): the nearest float32 is what must come
    # out
    assert np.isnan(frequency[0, 0]) and frequency[0, 1] == np.float32(100_000.001)


def test_unknown_cubes_are_counted_and_left_out():
    scan = ScanBuilder(1, [CubeAddress("a", 0, 1, None, 2)])
    assert scan.cubes.learn(0, hello([1, 2, 3])) == [
        "the hub's cubes 0 (uid 0x1), 2 (uid 0x3) not in the skin file: add it there",
    ]
    scan.add(0, sample(0, [[1.0, 1.0], [2.0, 2.0], [3.0, 3.0], [4.0, 4.0]]), 0)
    rows = scan.build()
    assert rows.cube.tolist() == [0] and rows.frequency.tolist() == [[2.0, 2.0]]
    assert (scan.counts.unknown_cube, scan.counts.wrong_pads) == (3, 0)


def test_another_number_of_pads_names_both_and_invents_nothing():
    scan = ScanBuilder(1, [CubeAddress("a", 0, 0, None, 8), CubeAddress("b", 0, 1, None, 2)])
    (problem,) = scan.cubes.learn(0, hello([1, 2]))
    assert "cube a" in problem and "reports 2 pads" in problem and "layout has 8" in problem
    scan.add(0, sample(0, [[1.0, 2.0], [3.0, 4.0]]), 0)
    rows = scan.build()
    assert rows.cube.tolist() == [1] and scan.counts.wrong_pads == 1
    # narrower than the skin's widest cube: the rest is not measured
    assert rows.frequency[0, :2].tolist() == [3.0, 4.0] and np.isnan(rows.frequency[0, 2:]).all()


@pytest.mark.parametrize(
    ("address", "words"),
    [
        (CubeAddress("a", 0, 5, None, 2), ["index 5", "2 cubes"]),
        (CubeAddress("a", 0, None, 99, 2), ["a (uid 0x63)", "no cube of this uid"]),
        (CubeAddress("a", 1, None, 5, 2), ["uid 0x5", "on this link", "file on another"]),
    ],
)
def test_what_does_not_fit_is_said(address, words):
    scan = ScanBuilder(2, [address])
    text = scan.cubes.learn(0, hello([5, 6]))[0]
    for word in words:
        assert word in text


def test_a_repeated_hello_says_nothing_and_a_changed_one_counts():
    scan = ScanBuilder(1, [CubeAddress("a", None, None, 5, 2)])
    assert scan.cubes.learn(0, hello([5])) == []
    assert scan.cubes.learn(0, hello([5])) is None
    assert scan.cubes.learn(0, hello([4, 5])) == [
        "the hub's cube 0 (uid 0x4) not in the skin file: add it there"
    ]
    scan.add(0, sample(0, [[1.0, 1.0], [2.0, 2.0]]), 0)
    assert scan.build().frequency.tolist() == [[2.0, 2.0]]


def test_two_cubes_with_one_uid_give_rows_of_one():
    """On one hub, and on two: the second takes over only when the first is gone."""
    scan = ScanBuilder(2, [CubeAddress("a", None, None, 5, 2), CubeAddress("b", None, None, 6, 2)])
    (problem,) = scan.cubes.learn(0, hello([5, 5, 6]))
    assert problem == "the hub's cube 1 (uid 0x5) left out: an earlier one has the same uid"
    (problem, *_) = scan.cubes.learn(1, hello([5, 7]))
    assert problem == "cube a (uid 0x5) left out here: another link has a cube of the same uid"
    scan.add(0, sample(0, [[1.0, 1.0], [2.0, 2.0], [3.0, 3.0]]), 0)
    scan.add(1, sample(0, [[4.0, 4.0], [5.0, 5.0]]), 0)
    rows = scan.build()
    assert rows.cube.tolist() == [0, 1] and rows.frequency[:, 0].tolist() == [1.0, 3.0]
    assert scan.counts.unknown_cube == 3 and scan.count_rows_waiting() == 0
    assert scan.cubes.learn(1, hello([5, 7])) is None
    scan.forget(0)
    assert scan.cubes.learn(1, hello([5, 7])) == [
        "the hub's cube 1 (uid 0x7) not in the skin file: add it there"
    ]
    scan.add(1, sample(1, [[4.0, 4.0], [5.0, 5.0]]), 0)
    assert scan.build().cube.tolist() == [0]
    # the first comes back: now it is the second
    assert "cube a (uid 0x5) left out here" in scan.cubes.learn(0, hello([5, 5, 6]))[0]


def test_a_hub_of_unknown_cubes_is_one_line():
    scan = ScanBuilder(1, [CubeAddress("a", 0, 0, None, 2), CubeAddress("b", None, None, 1000, 2)])
    problems = scan.cubes.learn(0, hello(range(1, 41)))
    assert problems == [
        "the hub's cubes 1 (uid 0x2), 2 (uid 0x3), 3 (uid 0x4), 4 (uid 0x5), 5 (uid 0x6), "
        "6 (uid 0x7), 7 (uid 0x8), 8 (uid 0x9) and 31 more not in the skin file: add it there"
    ]


def test_batches_hold_the_first_samples_of_all_links_then_the_second_ones():
    scan = two_links()
    for number in range(3):
        for link in (0, 1):
            assert not scan.is_complete(3)
            scan.add(link, sample(number, [[10 * link + number + 1, 1.0]] * 2), 100 * number + link)
    assert scan.is_complete(3) and scan.is_complete(2) and not scan.is_complete(4)
    first, second = scan.build(max_scans=2), scan.build()
    assert first.stamp_ns.tolist() == [0, 0, 1, 1, 100, 100, 101, 101]
    assert first.frequency[:, 0].tolist() == [1, 1, 11, 11, 2, 2, 12, 12]
    assert second.sequence.tolist() == [2, 2, 2, 2]
    assert scan.build() is None and scan.count_rows_waiting() == 0


class LinesLog:
    """Keeps what is logged."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def info(self, message: str) -> None:
        self.lines.append(message)

    warning = error = info


def test_a_hub_that_is_ever_another_one_does_not_fill_the_log():
    """Each HELLO is taken in all the same: the last one counts."""
    log = LinesLog()
    links = [LinkConfig("a", "/dev/none"), LinkConfig("b", "/dev/none")]
    addresses = [CubeAddress("a", 0, None, 5000, 1), CubeAddress("b", 1, 0, None, 1)]
    live = LiveLinks(links, addresses, lambda rows: None, log=log)
    live.receive([LinkFrames(0, 0, [hello([uid], 1)]) for uid in range(1, 3001)])
    assert 20 <= len(log.lines) <= 25, log.lines[-1]
    assert live.cube_uids == {}
    live.receive([LinkFrames(0, 0, [hello([5000], 1)]), LinkFrames(1, 0, [hello([2], 1)])])
    assert live.cube_uids == {0: 5000, 1: 2}
    # Each link has its own bound.
    assert log.lines[-1] == "link b: hub 0x1 with 1 cubes of 1 pads"


def test_lines_that_were_left_out_are_counted_and_told():
    now = [0.0]
    log = LinesLog()
    link_log = LinkLogger("a", log, lambda: now[0])
    for number in range(50):
        link_log.error(str(number))
    assert len(log.lines) == 20 and link_log.left_out == 30
    now[0] = 1.0
    link_log.info("late")
    assert log.lines[-1] == "link a: late (30 lines about this link were left out before)"
    now[0] = 2.0
    link_log.warning("later")
    assert log.lines[-1] == "link a: later"


def test_a_link_that_pauses_often_is_one_line_a_minute():
    """Other states are logged at once, also right after a silence."""
    now = [0.0]
    log = LinesLog()
    link_log = LinkLogger("a", log, lambda: now[0])
    for _ in range(130):
        link_log.change(LinkState.SILENT, LinkError("no sample", "silent"))
        link_log.change(LinkState.OPEN, None)
        now[0] += 1.0
    silence, end = "link a: silent: no sample", "link a: open"
    assert [line.partition(" (")[0] for line in log.lines] == [silence, end] * 3
    assert link_log.left_out == 2 * 130 - len(log.lines)
    link_log.change(LinkState.SILENT, LinkError("no sample", "silent"))
    link_log.change(LinkState.WAITING, LinkError("unplugged", "lost"))
    link_log.change(LinkState.OPEN, None)
    shown = [line.partition(" (")[0] for line in log.lines[6:]]
    assert shown == ["link a: waiting: unplugged", end]


def test_stamps_use_the_arrival_of_their_own_read():
    """An earlier one would be earlier than true, and would spoil the fit of the clock."""
    links = [LinkConfig("a", "/dev/none"), LinkConfig("b", "/dev/none")]
    addresses = [CubeAddress("a", 0, 0, None, 1), CubeAddress("b", 1, 0, None, 1)]
    given = []
    live = LiveLinks(links, addresses, given.append)

    def samples(*numbers_and_us):
        return [sample_frame(number, us, n_pads=1) for number, us in numbers_and_us]

    live.receive([LinkFrames(0, 0, [hello([1], 1)]), LinkFrames(1, 0, [hello([2], 1)])])
    live.receive(
        [
            LinkFrames(0, 10_000, samples((0, 0), (1, 5))),
            LinkFrames(1, 20_000, samples((0, 0))),
            LinkFrames(0, 30_000, samples((2, 25))),
            LinkFrames(1, 40_000, samples((1, 15))),
        ]
    )
    stamps = {
        (int(cube), int(number)): int(stamp_ns)
        for rows in given
        for cube, number, stamp_ns in zip(rows.cube, rows.sequence, rows.stamp_ns, strict=True)
    }
    assert stamps == {
        (0, 0): 5_000,
        (0, 1): 10_000,
        (1, 0): 20_000,
        (0, 2): 30_000,
        (1, 1): 35_000,
    }
    assert live.count_rows() == RowCounts(delivered=5)


def live_links(on_rows, n_cubes=1):
    """One link whose hub has said HELLO."""
    addresses = [CubeAddress(f"c{index}", 0, index, None, 2) for index in range(n_cubes)]
    live = LiveLinks([LinkConfig("a", "/dev/none")], addresses, on_rows)
    live.receive([LinkFrames(0, 0, [hello(range(1, n_cubes + 1))])])
    return live


@pytest.mark.parametrize("strange", [{"n_pads": 3}, {"first": 7}, {"n_cubes": 0}])
def test_rows_that_are_left_out_do_not_pile_up(strange):
    """In bursts longer than one callback holds; healthy rows come at once after them."""
    given = []
    live = live_links(given.append)
    for burst in range(100):
        numbers = range(20 * burst, 20 * burst + 20)
        frames = [sample_frame(number, 1000 * number, **strange) for number in numbers]
        live.receive([LinkFrames(0, 1_000_000 * numbers[-1], frames)])
    assert not given
    left_out = 0 if "n_cubes" in strange else 2000
    counts = live.count_rows()
    assert (counts.unknown_cube + counts.wrong_pads, counts.unaccounted) == (left_out, 0)
    live.receive([LinkFrames(0, 2_000_000_000, [sample_frame(2000, 2_000_000)])])
    assert [rows.sequence.tolist() for rows in given] == [[2000]], "older ones come first"


def test_no_device_time_loses_a_row():
    """Hubs whose clocks lie, by all that 64 bits can hold, forward and back within one read."""
    given = []
    live = live_links(given.append)
    random = np.random.default_rng(7)
    arrival_ns, sequence = 1_700_000_000 * 10**9, 0
    for _ in range(200):
        arrival_ns += 50_000_000
        frames = []
        for _ in range(int(random.integers(1, 40))):
            device_us = int(random.integers(0, 2**63)) >> int(random.integers(0, 63))
            frames.append(sample_frame(sequence, device_us))
            sequence += 1
        live.receive([LinkFrames(0, arrival_ns, frames)])
    counts = live.count_rows()
    assert (counts.delivered, counts.lost, counts.unaccounted) == (sequence, 0, 0)
    for rows in given:
        assert rows.stamp_ns.max() <= arrival_ns
        assert rows.stamp_ns.max() - rows.stamp_ns.min() < 2**31, "a message holds no more"


def test_a_long_read_of_times_that_fall_back_is_taken():
    live = live_links(lambda rows: None)
    frames = [sample_frame(number, 2_000_000 * (5000 - number)) for number in range(5000)]
    live.receive([LinkFrames(0, 10**18, frames)])
    assert live.count_rows().delivered == 5000


def test_rows_far_apart_in_time_are_given_one_after_the_other():
    """A message holds 2.1 s: two hubs whose samples wait differently long do not share one."""
    given = []
    links = [LinkConfig("a", "/dev/none"), LinkConfig("b", "/dev/none")]
    addresses = [CubeAddress("a", 0, 0, None, 2), CubeAddress("b", 1, 0, None, 2)]
    live = LiveLinks(links, addresses, given.append)
    live.receive([LinkFrames(link, 0, [hello([link + 1])]) for link in (0, 1)])
    second = 10**9
    live.receive([LinkFrames(0, 0, [sample_frame(0, 0)]), LinkFrames(1, 0, [sample_frame(0, 0)])])
    waited = [sample_frame(1, 1_000_000), sample_frame(2, 5_000_000)]
    live.receive(
        [LinkFrames(0, 5 * second, waited), LinkFrames(1, 5 * second, [sample_frame(1, 5_000_000)])]
    )
    stamps = sorted((rows.stamp_ns / second).tolist() for rows in given[1:])
    assert stamps == [[1.0], [5.0, 5.0]]
    assert live.count_rows() == RowCounts(delivered=5)


def test_an_error_in_the_callback_is_counted_with_its_reason_and_the_next_rows_go_on():
    given = []

    def on_rows(rows):
        if rows.sequence[0] == 1:
            raise ValueError("full")
        given.append(rows)

    live = live_links(on_rows, n_cubes=3)
    for number in range(4):
        frames = [sample_frame(number, 1000 * number, n_cubes=3)] * 2
        live.receive([LinkFrames(0, 1_000_000 * number, frames)])
    assert [int(rows.sequence[0]) for rows in given] == [0, 2, 3]
    assert live.count_rows() == RowCounts(
        delivered=9, duplicate=12, lost=3, lost_reason="ValueError('full')"
    )
    assert live.callback_errors == 1


def test_rows_that_the_data_path_forgets_without_an_error_are_unaccounted(monkeypatch):
    """The account is not kept by the code that it checks."""
    live = live_links(lambda rows: None)
    monkeypatch.setattr(ScanBuilder, "add", lambda self, link, sample, stamp_ns, status: None)
    live.receive([LinkFrames(0, 0, [sample_frame(0, 0)])])
    assert live.count_rows() == RowCounts(unaccounted=1)


def test_rows_that_wait_for_their_scan_are_neither_lost_nor_unaccounted():
    links = [LinkConfig("a", "/dev/none"), LinkConfig("b", "/dev/none")]
    addresses = [CubeAddress("a", 0, 0, None, 2), CubeAddress("b", 1, 0, None, 2)]
    live = LiveLinks(links, addresses, lambda rows: None)
    live.receive([LinkFrames(link, 0, [hello([link + 1]), sample_frame(0, 0)]) for link in (0, 1)])
    live.receive([LinkFrames(0, 1_000_000, [sample_frame(1, 1000)])])
    assert live.count_rows() == RowCounts(delivered=2)
    live._count_error(OSError())
    assert live.count_rows().lost == 0
    live.receive([LinkFrames(1, 1_000_000, [sample_frame(1, 1000)])])
    assert live.count_rows() == RowCounts(delivered=4, lost_reason="OSError()")


@pytest.mark.parametrize("step_ns", [5_000_000, -3_600_000_000_000])
def test_setting_the_host_clock_shows_in_the_report_and_in_no_stamp(step_ns):
    set_ns = 0

    def clock_ns():
        return time.monotonic_ns() + set_ns + 10**18

    given = []
    address, config = CubeAddress("a", 0, 0, None, 2), LinkConfig("a", "/dev/none")
    live = LiveLinks([config], [address], given.append, clock_ns=clock_ns)
    live.start()
    live.receive([LinkFrames(0, clock_ns(), [hello([1])])])
    begun_ns = clock_ns()
    for number in range(60):
        sampled_us = (clock_ns() - set_ns - begun_ns) // 1000
        arrival_ns = clock_ns()  # of the last one before the clock was set: in the old time
        if number == 30:
            set_ns = step_ns
        live.receive([LinkFrames(0, arrival_ns, [sample_frame(number, sampled_us)])])
        (stamp_ns,) = given[-1].stamp_ns.tolist()
        assert abs(stamp_ns - (begun_ns + 1000 * sampled_us + set_ns)) < 1_000_000
    (report,) = live.report()
    live.close()
    assert any("the host's clock was set by" in note for note in report.notes)
    assert report.values["clock resets"] == 0
