# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Log of a simulator: the samples that its hubs took, and the faults that were carried out.

The simulator writes the log when it ends. Checks compare it with the samples that arrived.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import TypedDict

import numpy as np

from ..config.output_files import write_atomically
from ..core.arrays import Index, Times
from ..core.errors import ConfigError
from ..core.matching import NO_MATCH, SampleKeys, SampleRows, match_rows
from ..core.rows import COUNTER_RANGE
from .faults import Fault

ABSENT = -1
"""Value in place of the index of a cube in the skin, if a cube of a hub is not in the skin."""

NO_LINK = -1
"""Value in place of the index of a cube's link, if the cube is on no link of the log."""

CUBE_RANGE = 1 << 16
"""Number of possible indices of a cube in a skin, which have 16 bits in messages."""


@dataclass
class SampleRun:
    """Samples of one hub at equal intervals.

    Attributes:
        first: Number of the first sample since the restart of the hub; it does not wrap at 2^32.
        last: Number of the last sample.
        start_us: Simulated time of the first sample in µs.
        period_us: Time between two samples in µs.
        boot: Number of restarts of the hub before the first sample.
    """

    first: int
    last: int
    start_us: int
    period_us: int
    boot: int = 0

    def __len__(self) -> int:
        return self.last - self.first + 1

    def is_followed_by(self, run: SampleRun) -> bool:
        """Return whether the first sample of another run is the one that follows this run."""
        end_us = self.start_us + len(self) * self.period_us
        follows = (self.last + 1, end_us, self.period_us, self.boot)
        return follows == (run.first, run.start_us, run.period_us, run.boot)


@dataclass(frozen=True)
class LinkLog:
    """Samples of the hub of one link.

    Attributes:
        name: Name of the link.
        cubes: Index in the skin of each of the hub's cubes, `ABSENT` where the skin has none.
        dropped: Number of samples since the last restart for which the line had no room.
        runs: All samples that the hub took, in the order of time.
        damaged: Samples whose frame was altered or not sent: for each, the number of restarts
            before (boot) and the number of the sample.
    """

    name: str
    cubes: tuple[int, ...]
    dropped: int
    runs: tuple[SampleRun, ...]
    damaged: tuple[tuple[int, int], ...] = ()

    @property
    def members(self) -> list[int]:
        """Indices in the skin of the hub's cubes, without those that are not in the skin."""
        return [cube for cube in self.cubes if cube != ABSENT]


@dataclass(frozen=True)
class FaultRecord:
    """A fault that was carried out on one link.

    Attributes:
        start_us: Simulated time in µs at which it began.
        end_us: Simulated time in µs at which it ended.
        fault: The fault, with the name of the link on which it was carried out.
    """

    start_us: int
    end_us: int
    fault: Fault


class _LinkContent(TypedDict):
    """A `LinkLog` in JSON."""

    name: str
    cubes: list[int]
    dropped: int
    runs: list[dict[str, int]]
    damaged: list[tuple[int, int]]


class _FaultRecordContent(TypedDict):
    """A `FaultRecord` in JSON; `Fault.parse` checks its fault."""

    start_us: int
    end_us: int
    fault: object


class _LogContent(TypedDict):
    """A `SampleLog` in JSON."""

    start_time_ns: int
    links: list[_LinkContent]
    faults: list[_FaultRecordContent]


@dataclass(frozen=True)
class SampleLog:
    """Samples of all hubs of a skin, and their faults.

    Attributes:
        start_time_ns: Wall clock at simulated time 0, in ns since the Unix epoch.
        links: Logs of all links with cubes, in the order of the skin file.
        faults: Faults in the order in which they began.
    """

    start_time_ns: int
    links: tuple[LinkLog, ...]
    faults: tuple[FaultRecord, ...] = ()

    def write(self, path: Path) -> None:
        """Write the log as JSON.

        Raises:
            ConfigError: The file cannot be written.
        """
        with write_atomically(path) as partial:
            partial.write_text(json.dumps(asdict(self)))

    @classmethod
    def read(cls, path: Path) -> SampleLog:
        """Read a log.

        Raises:
            ConfigError: There is no such file, or it is no sample log.
        """
        try:
            return cls._parse(json.loads(path.read_text()))
        except OSError as error:
            raise ConfigError(
                f"{path}: {error.strerror}; a simulator writes its sample log when it ends"
            ) from None
        # A file with other JSON, or of another version, raises one of these errors.
        except (ValueError, TypeError, KeyError) as error:
            raise ConfigError(f"{path}: no sample log of this version ({error!r})") from None

    @classmethod
    def _parse(cls, data: _LogContent) -> SampleLog:
        """Create a log from the dictionary that its JSON file contains."""
        links = tuple(
            LinkLog(
                name=link["name"],
                cubes=tuple(link["cubes"]),
                dropped=link["dropped"],
                runs=tuple(SampleRun(**run) for run in link["runs"]),
                damaged=tuple((boot, number) for boot, number in link["damaged"]),
            )
            for link in data["links"]
        )
        faults = tuple(
            FaultRecord(one["start_us"], one["end_us"], Fault.parse(one["fault"], "fault"))
            for one in data["faults"]
        )
        return cls(data["start_time_ns"], links, faults)

    @property
    def dropped(self) -> int:
        """Number of samples of all hubs that were lost because their lines had no room."""
        return sum(link.dropped for link in self.links)

    @cached_property
    def table(self) -> SampleTable:
        """All samples of the log, link after link, in the order of time."""
        # The empty table gives the columns their type even if no hub has taken a sample.
        parts = [np.empty((3, 0), np.int64)]
        link_of_cube = np.full(CUBE_RANGE, NO_LINK, np.int64)
        for index, link in enumerate(self.links):
            link_of_cube[link.members] = index
            for run in link.runs:
                count = np.arange(len(run))
                time_us = run.start_us + run.period_us * count
                parts.append(np.array([0 * count + index, run.first + count, time_us]))
        links, numbers, times_us = np.hstack(parts)
        return SampleTable(
            link=links,
            number=numbers,
            time_ns=self.start_time_ns + 1000 * times_us,
            rows_per_sample=np.array([len(link.members) for link in self.links], int),
            link_of_cube=link_of_cube,
        )


@dataclass(frozen=True)
class SampleTable:
    """Table of all S samples that the hubs of a skin took.

    Attributes:
        link: (S,) index of the link whose hub took the sample.
        number: (S,) number of the sample, which does not wrap at 2^32.
        time_ns: (S,) wall clock at which the sample was taken, in ns since the Unix epoch.
        rows_per_sample: (links,) number of the skin's cubes on each link.
        link_of_cube: (`CUBE_RANGE`,) for each possible index of a cube in the skin, the index of
            the cube's link, or `NO_LINK`.
    """

    link: Index
    number: Times
    time_ns: Times
    rows_per_sample: Index
    link_of_cube: Index

    def __len__(self) -> int:
        return len(self.link)

    def match(
        self,
        rows: SampleRows,
        among: Index | None = None,
    ) -> Index:
        """Find the logged sample from which each of N received rows (samples of one cube) comes.

        A hub that restarts uses the same sample numbers again. So among the samples of the row's
        link with the row's number, the one whose time is nearest to the row's stamp is chosen.

        Args:
            rows: Cube, sequence number and stamp of the received rows.
            among: Indices of the samples to search; None: all samples.

        Returns:
            Index (N,) of the sample, or `NO_MATCH` for a row that comes from no logged sample.
        """
        if among is None:
            among = np.arange(len(self))
        # A sample contains all cubes of a hub, so it is identified by the link instead of the cube.
        number = self.number[among] % COUNTER_RANGE
        known = SampleKeys(
            self.link[among],
            number,
            self.time_ns[among],
        )
        wanted = SampleKeys(
            self.link_of_cube[rows.cube],
            rows.sequence,
            rows.stamp_ns,
        )
        found = match_rows(known, wanted)
        # A row without a match has the index `NO_MATCH`, which is -1 and selects the last element.
        return np.append(among, NO_MATCH)[found]

    def count_rows_taken(self, start_ns: int, end_ns: int) -> int:
        """Count the rows (samples of one cube) that the hubs took in an interval of time.

        Args:
            start_ns: Start of the interval, in ns since the Unix epoch.
            end_ns: End of the interval (exclusive), in ns since the Unix epoch.
        """
        is_within = (self.time_ns >= start_ns) & (self.time_ns < end_ns)
        links = self.link[is_within]
        return int(self.rows_per_sample[links].sum())
