# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Input of the checks: what the hubs did, what arrived, and what was done to the nodes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Generic

import numpy as np

from cube_tensor_driver.config.skin import Skin
from cube_tensor_driver.core.arrays import Integers, Mask, Times
from cube_tensor_driver.core.rows import FrequencyRows, StressRows
from cube_tensor_driver.messages.codec import AnyRows
from cube_tensor_driver.simulation.faults import Fault
from cube_tensor_driver.simulation.sample_log import FaultRecord, SampleLog

NS_PER_S = 1_000_000_000
"""Number of nanoseconds in a second."""

CUT_FAULTS = (
    "stall",
    "burst",
    "unplug",
    "rename",
    "reset",
    "wrap",
    "drift",
    "step",
    "uid",
    "pads",
    "version",
)
"""Kinds of faults that interrupt a link, restart its hub, change the hub's description of itself,
or disturb the hub's clock."""

DRIVER_KILLS = ("restart driver",)
"""Names of the actions that kill the driver and start it again."""

DRIVER_STOPS = ("cycle driver", *DRIVER_KILLS)
"""Names of the actions during which the driver does not read what the hubs send."""

RECONSTRUCTION_STOPS = ("restart reconstruction", "reconfigure reconstruction")
"""Names of the actions during which there is no reconstruction."""

NODE_STARTS = (*RECONSTRUCTION_STOPS, *DRIVER_KILLS)
"""Names of the actions after which a node has lost its state, such as the statistics of pads."""

DROPPED_BY_HOST = "rows dropped by a slow host"
"""Name of the driver's counter of rows (one cube at one sampling time) that it dropped because the
host was too slow. The counter does not tell which rows they were."""

UNFLUSHED_S = 0.5
"""Length, in seconds, of the span before a driver is killed whose messages may be lost.

They wait in its queues, which a busy host empties late.
"""

ROWS_AROUND_GAP = 100
"""Number of rows (one cube at one sampling time) before and after a gap in a topic whose stamps
give the start and the end of the gap."""

GAP_MARGIN_S = 0.05
"""Longest time, in seconds, between the stamp of a row in a missing message and the stamps of the
rows that arrived before and after the gap."""

EARLIEST_NS = np.iinfo(np.int64).min
"""Time in ns that is earlier than every stamp."""
LATEST_NS = np.iinfo(np.int64).max
"""Time in ns that is later than every stamp."""


@dataclass(frozen=True)
class Span:
    """A span of time from `begin_ns` to `end_ns` of the wall clock."""

    begin_ns: int
    end_ns: int

    def contains(
        self,
        time_ns: Integers | int,
        before_s: float = 0.0,
        after_s: float = 0.0,
    ) -> Mask:
        """Find the times (N,) that lie in the span, or less than a margin before or after it."""
        begin_ns = self.begin_ns - round(NS_PER_S * before_s)
        end_ns = self.end_ns + round(NS_PER_S * after_s)
        time_ns = np.asarray(time_ns)
        return (time_ns >= begin_ns) & (time_ns < end_ns)

    def overlaps(self, other: Span, margin_s: float) -> bool:
        """Return whether another span overlaps this one, or would if it were longer by a margin.

        Args:
            other: The other span.
            margin_s: Time, in s, that is added before and after.
        """
        margin_ns = round(NS_PER_S * margin_s)
        begins_before = self.begin_ns - margin_ns < other.end_ns
        return begins_before and self.end_ns + margin_ns > other.begin_ns


@dataclass(frozen=True, kw_only=True)
class HubFault(Span):
    """A fault of a simulated hub or pad, with the span of time for which it lasted.

    Attributes:
        fault: Kind and values of the fault.
        link: Index of the link in the log.
        cube: Index in the skin of the cube that a fault of a pad is on.
    """

    fault: Fault
    link: int
    cube: int

    @property
    def kind(self) -> str:
        """Kind of the fault."""
        return self.fault.kind


class Samples:
    """Columns of all S samples that the hubs took: hub after hub, in the order of time.

    Attributes:
        log: The sample log.
        table: Columns that every simulated hub has.
        link, number, time_ns: As in the table (S,).
        boot: Number of restarts of the hub before the sample (S,).
        period_us: Time from sample to sample (S,), in µs.
        row_count: Number of the skin's cubes on the link, so the number of rows (S,).
        is_damaged: Whether the frame of the sample was damaged or dropped on purpose (S,).
    """

    def __init__(self, log: SampleLog) -> None:
        self.log = log
        self.table = log.table
        self.link = self.table.link
        self.number = self.table.number
        self.time_ns = self.table.time_ns
        self.row_count = self.table.rows_per_sample[self.link]

        runs = [run for link in log.links for run in link.runs]
        values = [(len(run), run.boot, run.period_us) for run in runs]
        # One column each; the shape is stated because there may be no runs.
        columns = np.array(values, int).reshape(-1, 3)
        lengths, boots, periods_us = columns.T
        self.boot = np.repeat(boots, lengths)
        self.period_us = np.repeat(periods_us, lengths)

        damaged = [
            (link, boot, number)
            for link, link_log in enumerate(log.links)
            for boot, number in link_log.damaged
        ]
        damaged_columns = np.array(damaged, int).reshape(-1, 3).T
        damaged_keys = _join_keys(*damaged_columns)
        self.is_damaged: Mask = np.isin(
            _join_keys(self.link, self.boot, self.number),
            damaged_keys,
        )

    def __len__(self) -> int:
        return len(self.link)

    def select_faults(self, *kinds: str) -> list[HubFault]:
        """Return the faults of the given kinds, in the order of time."""
        records = [record for record in self.log.faults if record.fault.kind in kinds]
        return [self._convert(record) for record in records]

    def _convert(self, record: FaultRecord) -> HubFault:
        """Convert a fault of the log to times of the wall clock and indices of the skin."""
        fault, start_ns = record.fault, self.log.start_time_ns
        names = [link.name for link in self.log.links]
        link = names.index(fault.link)
        return HubFault(
            begin_ns=start_ns + 1000 * record.start_us,
            end_ns=start_ns + 1000 * record.end_us,
            fault=fault,
            link=link,
            cube=self.log.links[link].cubes[fault.cube],
        )

    def is_near_fault(
        self,
        kinds: tuple[str, ...],
        before_s: float,
        after_s: float,
    ) -> Mask:
        """Find the samples (S,) whose link had a fault of some kinds, or nearly so.

        Args:
            kinds: Kinds of faults.
            before_s: Time, in s, before the start of a fault in which samples count, too.
            after_s: Time, in s, after its end in which samples count, too.
        """
        near = np.zeros(len(self), bool)
        for fault in self.select_faults(*kinds):
            is_close = fault.contains(self.time_ns, before_s, after_s)
            near |= (self.link == fault.link) & is_close
        return near


def _join_keys(
    link: Integers,
    boot: Integers,
    number: Integers,
) -> Integers:
    """Join link, number of restarts and sample number, which identify a sample, in one integer
    each.

    Sample numbers are below 2**40.
    """
    return (link << 52) | (boot << 40) | number


@dataclass(frozen=True)
class Received(Generic[AnyRows]):
    """The rows (one cube at one sampling time each) of a topic, in the order of arrival.

    Attributes:
        rows: All rows (N).
        sent_ns: Wall clock at which the message of each row was sent (N,), as DDS states it.
        gaps: For each gap in the numbers that DDS gives to messages: index of the row that arrived
            after it, and number of messages that did not arrive. Their rows cannot be checked.
        unreadable: Number of messages that could not be decoded, or had a wrong frame.
    """

    rows: AnyRows
    sent_ns: Times
    gaps: tuple[tuple[int, int], ...] = ()
    unreadable: int = 0

    @property
    def missed(self) -> int:
        """Number of messages that were sent and did not arrive here."""
        return sum(messages for _, messages in self.gaps)

    def is_in_gap(self, stamp_ns: Times) -> Mask:
        """Find the stamps (N,) whose rows may have been in messages that did not arrive."""
        stamps = self.rows.stamp_ns
        inside = np.zeros(len(stamp_ns), bool)
        for row, _ in self.gaps:
            # Late rows may be on the other side of the gap, so several rows are looked at.
            first = max(0, row - ROWS_AROUND_GAP)
            before = stamps[first:row].min(initial=LATEST_NS)
            after = stamps[row : row + ROWS_AROUND_GAP].max(initial=EARLIEST_NS)
            begin_ns = min(int(before), int(after))
            # A gap before the first row that arrived has no beginning.
            if not row:
                # It is half of the earliest time, because a margin is subtracted from it.
                begin_ns = EARLIEST_NS // 2
            gap = Span(begin_ns, int(after))
            inside |= gap.contains(stamp_ns, GAP_MARGIN_S, GAP_MARGIN_S)
        return inside


@dataclass(frozen=True, kw_only=True)
class NodeAction(Span):
    """Something that was done to the nodes, with the span of time from the request to its end.

    Attributes:
        kind: Name of the action in `torture/cycle.yaml`.
        succeeded: Whether the node did what was requested.
        answer: Answer of the node.
        cubes: Indices of the cubes that were tared.
    """

    kind: str
    succeeded: bool
    answer: str = ""
    cubes: tuple[int, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Record(Span):
    """All that arrived from a skin. Samples taken within its span of time are checked.

    Attributes:
        skin: The skin.
        frequencies: Rows of the topic `frequencies`.
        stress: Rows of the topic `stress`.
        actions: What was done to the nodes, in order.
        counters: Last counters of the driver, summed over all links and all of its processes.
        messages_lost: Number of messages that the reconstruction states to have lost.
    """

    skin: Skin
    frequencies: Received[FrequencyRows]
    stress: Received[StressRows]
    actions: tuple[NodeAction, ...]
    counters: Mapping[str, int]
    messages_lost: int

    def select_actions(self, *kinds: str) -> list[NodeAction]:
        """Return the actions of the given kinds, in the order of time."""
        return [action for action in self.actions if action.kind in kinds]

    def is_during(
        self,
        kinds: tuple[str, ...],
        time_ns: Times,
        before_s: float = 0.0,
        after_s: float = 0.0,
    ) -> Mask:
        """Find the times (N,) within actions of some kinds, or less than a margin before or after
        one."""
        during = np.zeros(len(time_ns), bool)
        for action in self.select_actions(*kinds):
            during |= action.contains(time_ns, before_s, after_s)
        return during
