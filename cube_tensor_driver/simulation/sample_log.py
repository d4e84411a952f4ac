"""Log of a simulator: the samples that its hubs took, and the faults that were carried out.

The simulator writes it when it ends. Checks of what arrived read it.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ..config.output_files import atomic_write
from ..core.arrays import Index, Times
from ..core.errors import ConfigError
from ..core.matching import NO_MATCH, SampleKeys, SampleRows, match_rows
from .faults import Fault

ABSENT = -1
"""Index in the skin of a cube of a hub that the skin does not have."""

NO_LINK = -1
"""Index of the link of a cube that is on no link."""

CUBE_RANGE = 1 << 16
"""Number of possible indices of a cube, which are 16 bits wide in messages."""

SEQUENCE_RANGE = 1 << 32
"""Number of different sequence numbers on the wire, where they wrap. Those in the log do not."""


@dataclass(frozen=True)
class SampleRun:
    """Samples of one hub at equal intervals.

    Attributes:
        first: Number of the first sample; numbers do not wrap at 2^32.
        last: Number of the last sample.
        start_us: Simulated time of the first sample in µs.
        period_us: Time between two samples in µs.
        boot: Number of restarts of the hub before.
    """

    first: int
    last: int
    start_us: int
    period_us: int
    boot: int = 0

    def __len__(self) -> int:
        return self.last - self.first + 1

    @property
    def end_us(self) -> int:
        """Simulated time in µs of the sample that would follow the last one."""
        return self.start_us + len(self) * self.period_us


@dataclass(frozen=True)
class LinkLog:
    """Samples of the hub of one link.

    Attributes:
        name: Name of the link.
        cubes: Index in the skin of each of the hub's cubes, `ABSENT` where the skin has none.
        dropped: Number of samples since the last restart for which the line had no room.
        runs: All samples that it took, in the order of time.
        damaged: Boot and number of each sample that was altered, or for which the line had no room.
    """

    name: str
    cubes: tuple[int, ...]
    dropped: int
    runs: tuple[SampleRun, ...]
    damaged: tuple[tuple[int, int], ...] = ()

    @property
    def members(self) -> list[int]:
        """Index in the skin of each of its cubes that the skin has."""
        return [cube for cube in self.cubes if cube != ABSENT]


@dataclass(frozen=True)
class FaultRecord:
    """A fault that was carried out on one link.

    Attributes:
        start_us: Simulated time in µs at which it began.
        end_us: Simulated time in µs at which it ended.
        fault: The fault; its `link` is set.
    """

    start_us: int
    end_us: int
    fault: Fault


@dataclass(frozen=True)
class SampleLog:
    """Samples of all hubs of a skin, and their faults.

    Attributes:
        start_time_ns: Wall clock at simulated time 0, in ns.
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
        with atomic_write(path) as partial:
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
        except (ValueError, TypeError, KeyError) as error:  # other JSON, or another version
            raise ConfigError(f"{path}: no sample log of this version ({error!r})") from None

    @classmethod
    def _parse(cls, data: dict[str, Any]) -> SampleLog:
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
            FaultRecord(
                record["start_us"],
                record["end_us"],
                Fault(**record["fault"]),
            )
            for record in data["faults"]
        )
        return cls(data["start_time_ns"], links, faults)

    @property
    def dropped(self) -> int:
        """Number of samples for which the lines had no room."""
        return sum(link.dropped for link in self.links)

    @cached_property
    def table(self) -> SampleTable:
        """All samples of the log, link after link, in the order of time."""
        # Runs become columns: one row per sample.
        runs = [(number, run) for number, link in enumerate(self.links) for run in link.runs]
        lengths = np.array([len(run) for _, run in runs], int)
        number = [np.arange(run.first, run.last + 1) for _, run in runs]
        time_us = [run.start_us + run.period_us * np.arange(len(run)) for _, run in runs]
        # It gives the columns their type if there are no runs.
        no_samples = np.empty(0, np.int64)

        link_of_cube = np.full(CUBE_RANGE, NO_LINK, np.int64)
        for index, link in enumerate(self.links):
            link_of_cube[link.members] = index
        return SampleTable(
            start_time_ns=self.start_time_ns,
            link=np.repeat(np.array([link for link, _ in runs], int), lengths),
            number=np.concatenate([no_samples, *number]),
            time_ns=self.start_time_ns + 1000 * np.concatenate([no_samples, *time_us]),
            rows_per_sample=np.array([len(link.members) for link in self.links], int),
            link_of_cube=link_of_cube,
        )


@dataclass(frozen=True)
class SampleTable:
    """Columns of all samples (S,) that the hubs of a skin took.

    Attributes:
        start_time_ns: Wall clock at time 0 of the hubs, in ns.
        link: Index of the link whose hub took the sample (S,).
        number: Number of the sample (S,); it does not wrap around.
        time_ns: Wall clock at which it was taken (S,), in ns.
        rows_per_sample: Number of the skin's cubes on each link (links,).
        link_of_cube: Link of each possible index of a cube (`CUBE_RANGE`,), or `NO_LINK`.
    """

    start_time_ns: int
    link: Index
    number: Times
    time_ns: Times
    rows_per_sample: Index
    link_of_cube: Index

    def __len__(self) -> int:
        return len(self.link)

    def match(self, rows: SampleRows, among: Index | None = None) -> Index:
        """Find the sample of each row (N,), or `NO_MATCH` for what no hub took.

        A hub that restarts gives its numbers again. Among the samples with the number of the row,
        the one whose time is nearest to the row's stamp is chosen.

        Args:
            rows: The rows.
            among: Indices of the samples to search, all of them by default.
        """
        if among is None:
            among = np.arange(len(self))
        # Cubes of one hub are sampled together: samples are identified by link instead of cube.
        number = self.number[among] % SEQUENCE_RANGE
        known = SampleKeys(self.link[among], number, self.time_ns[among])
        wanted = SampleKeys(self.link_of_cube[rows.cube], rows.sequence, rows.stamp_ns)
        found = match_rows(known, wanted)
        # `NO_MATCH` is -1, so it selects the appended element.
        return np.append(among, NO_MATCH)[found]

    def rows_taken(self, start_ns: int, end_ns: int) -> int:
        """Count the rows (one cube, one sample) taken from `start_ns` to before `end_ns`."""
        is_within = (self.time_ns >= start_ns) & (self.time_ns < end_ns)
        return int(self.rows_per_sample[self.link[is_within]].sum())
