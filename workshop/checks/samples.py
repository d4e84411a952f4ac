# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""All samples that the hubs took, and the faults that they had, from the sample log."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cube_tensor_driver.core.arrays import AnyArray, Mask
from cube_tensor_driver.simulation.faults import Fault
from cube_tensor_driver.simulation.sample_log import FaultRecord, SampleLog

from .record import Span

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


@dataclass(frozen=True, kw_only=True)
class HubFault(Span):
    """A fault of a simulated hub or pad, with the span of time for which it lasted.

    Attributes:
        fault: Kind and values of the fault.
        start_us: Simulated time of its begin, in µs.
        link: Index of the link in the log.
        cube: Index in the skin of the cube that a fault of a pad is on.
    """

    fault: Fault
    start_us: int
    link: int
    cube: int

    @property
    def kind(self) -> str:
        return self.fault.kind


class Samples:
    """Columns of all S samples that the hubs took: hub after hub, in the order of time.

    Attributes:
        log: The sample log.
        table: Columns that every simulated hub has.
        link, number, time_ns: As in the table (S,).
        time_us: Simulated time (S,), in µs.
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
        self.time_us = (self.time_ns - log.start_time_ns) // 1000
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

    def faults(self, *kinds: str) -> list[HubFault]:
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
            start_us=record.start_us,
            link=link,
            cube=self.log.links[link].cubes[fault.cube],
        )

    def is_near_fault(
        self,
        kinds: tuple[str, ...],
        before_s: float,
        after_s: float,
    ) -> Mask:
        """Find the samples (S,) whose link had such a fault, or less than a margin away."""
        near = np.zeros(len(self), bool)
        for fault in self.faults(*kinds):
            is_close = fault.contains(self.time_ns, before_s, after_s)
            near |= (self.link == fault.link) & is_close
        return near


def _join_keys(
    link: AnyArray,
    boot: AnyArray,
    number: AnyArray,
) -> AnyArray:
    """Join link, number of restarts and sample number, which identify a sample, in one integer
    each.

    Sample numbers are below 2**40.
    """
    return (link << 52) | (boot << 40) | number
