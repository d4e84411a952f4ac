"""The log of a simulator: which samples its hubs took, when, and which faults were carried out.

The simulator writes it when it ends. Checks of what arrived read it.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..config.output_files import atomic_write
from ..core.errors import ConfigError
from .faults import Fault

ABSENT = -1
"""Index in the skin of a cube that the hub has and the skin has not."""
NEVER = -1
"""Time of a sample that no hub took."""
SEQUENCE_RANGE = 1 << 32
"""Sequence numbers on the wire begin again at 0 here; those in the log do not."""


@dataclass(frozen=True)
class SampleRun:
    """Samples of one hub at equal intervals.

    first, last: numbers of the first and the last one, counted on beyond 2^32
    start_us: simulated time of the first one
    period_us: time between two of them
    boot: how often the hub had restarted before
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
        """Simulated time of the sample that would follow the last one."""
        return self.start_us + len(self) * self.period_us


@dataclass(frozen=True)
class LinkLog:
    """What the hub of one link did.

    name: of the link
    cubes: index in the skin of each of the hub's cubes, ABSENT where the skin has none
    dropped: samples that the hub took and had no room to send, since its last restart
    runs: all samples that it took, in the order of time
    spoiled: boot and number of each sample that was harmed, or found no room on the line
    """

    name: str
    cubes: tuple[int, ...]
    dropped: int
    runs: tuple[SampleRun, ...]
    spoiled: tuple[tuple[int, int], ...] = ()

    @property
    def members(self) -> list[int]:
        """Index in the skin of each of its cubes that the skin has."""
        return [cube for cube in self.cubes if cube != ABSENT]


@dataclass(frozen=True)
class FaultRecord:
    """A fault that was carried out from start_us to end_us of simulated time, on `fault.link`."""

    start_us: int
    end_us: int
    fault: Fault


@dataclass(frozen=True)
class SampleLog:
    """What all hubs of a skin did.

    start_time_ns: wall clock at simulated time 0
    links: in the order of the skin file; links without cubes are left out
    faults: in the order in which they began
    """

    start_time_ns: int
    links: tuple[LinkLog, ...]
    faults: tuple[FaultRecord, ...] = ()

    def write(self, path: Path) -> None:
        """As JSON. ConfigError: the file cannot be written."""
        with atomic_write(path) as partial:
            partial.write_text(json.dumps(asdict(self)))

    @classmethod
    def read(cls, path: Path) -> SampleLog:
        """ConfigError: there is no such file, or it is no sample log."""
        try:
            return cls._parse(json.loads(path.read_text()))
        except OSError as error:
            raise ConfigError(
                f"{path}: {error.strerror}; a simulator writes its sample log when it ends"
            ) from None
        except (ValueError, TypeError, KeyError) as error:
            raise ConfigError(f"{path}: no sample log of this version ({error!r})") from None

    @classmethod
    def _parse(cls, data: dict[str, Any]) -> SampleLog:
        links = tuple(
            LinkLog(
                name=link["name"],
                cubes=tuple(link["cubes"]),
                dropped=link["dropped"],
                runs=tuple(SampleRun(**run) for run in link["runs"]),
                spoiled=tuple((boot, number) for boot, number in link["spoiled"]),
            )
            for link in data["links"]
        )
        faults = tuple(
            FaultRecord(record["start_us"], record["end_us"], Fault(**record["fault"]))
            for record in data["faults"]
        )
        return cls(data["start_time_ns"], links, faults)

    @property
    def dropped(self) -> int:
        """Samples that the hubs took and had no room to send."""
        return sum(link.dropped for link in self.links)

    def times_ns(self, run: SampleRun) -> NDArray[np.int64]:
        """(samples,) wall clock when each sample of a run was taken."""
        return self.start_time_ns + 1000 * (run.start_us + run.period_us * np.arange(len(run)))

    def samples(self) -> Iterator[tuple[LinkLog, SampleRun, NDArray[np.int64]]]:
        """Each run of each link with the wall clock (samples,) of its samples."""
        for link in self.links:
            for run in link.runs:
                yield link, run, self.times_ns(run)

    def rows_taken(self, start_ns: int, end_ns: int) -> int:
        """Rows (one cube, one sample) taken from start_ns to before end_ns of the wall clock."""
        rows = 0
        for link, _, times in self.samples():
            rows += len(link.members) * int(
                np.count_nonzero((times >= start_ns) & (times < end_ns))
            )
        return rows

    def taken_ns(
        self, cube: NDArray[Any], sequence: NDArray[Any], stamp_ns: NDArray[Any]
    ) -> NDArray[np.int64]:
        """When samples (N,) were taken, wall clock; NEVER for what no hub took.

        cube: index in the skin; sequence: as on the wire. A number may have been given again after
        a restart: then the sample is meant that was taken nearest to stamp_ns.
        """
        time_ns = np.full(len(cube), NEVER, np.int64)
        for link in self.links:
            rows = np.flatnonzero(np.isin(cube, link.members))
            for run in link.runs:
                ahead = (sequence[rows].astype(np.int64) - run.first) % SEQUENCE_RANGE
                there = ahead < len(run)
                taken = rows[there]
                moment = self.start_time_ns + 1000 * (run.start_us + ahead[there] * run.period_us)
                distance = np.abs(moment - stamp_ns[taken])
                best = np.abs(time_ns[taken] - stamp_ns[taken])
                nearer = (time_ns[taken] == NEVER) | (distance < best)
                time_ns[taken[nearer]] = moment[nearer]
        return time_ns
