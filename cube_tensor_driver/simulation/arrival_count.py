"""What arrives of a skin, counted while it comes and compared with the simulator's book
afterwards."""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..bags.message_codec import stress_codec
from ..config.skin import Skin


class Tally:
    """Counts what arrives, per hub and sequence number, without keeping the rows."""

    def __init__(self, skin: Skin) -> None:
        links = [link.name for link in skin.links]
        link_of = np.array([links.index(cube.link or links[0]) for cube in skin.cubes])
        self._first = np.zeros(len(skin.cubes), bool)
        self._first[np.unique(link_of, return_index=True)[1]] = True
        self._link_of = link_of
        self.rows = 0
        self._arrived: list[tuple[NDArray[Any], NDArray[Any], int]] = []

    def take(self, data: bytes) -> None:
        """A message as it comes, serialised: whoever measures should not cost what is measured."""
        received_ns = time.time_ns()
        rows = stress_codec.decode(data).rows
        first = rows.select(self._first[rows.cube])
        self._arrived.append((self._link_of[first.cube], first.sequence, received_ns))
        self.rows += len(rows)

    def result(self, book: dict[str, Any], start_ns: int, end_ns: int) -> dict[str, object]:
        """Rows sent and received of samples taken from start_ns to end_ns (wall clock), latencies
        in ms."""
        sent = received = 0
        latency = []
        link = np.concatenate([part[0] for part in self._arrived])
        sequence = np.concatenate([part[1] for part in self._arrived]).astype(np.int64)
        arrival = np.repeat(
            [part[2] for part in self._arrived], [len(part[0]) for part in self._arrived]
        )
        for number, entry in enumerate(book["links"].values()):
            members = sum(cube >= 0 for cube in entry["cubes"])
            for run in entry["runs"]:
                begin_ns = book["start_time_ns"] + 1000 * run["start_us"]
                times = begin_ns + 1000 * run["period_us"] * np.arange(
                    run["last"] - run["first"] + 1
                )
                inside = (times >= start_ns) & (times < end_ns)
                sent += members * int(inside.sum())
                mine = (link == number) & (sequence >= run["first"]) & (sequence <= run["last"])
                place, at = np.unique(sequence[mine] - run["first"], return_index=True)
                kept = inside[place]
                received += members * int(kept.sum())
                latency.append(1e-6 * (arrival[mine][at][kept] - times[place[kept]]))
        values = np.concatenate(latency)
        p50, p99 = np.percentile(values, [50, 99]) if len(values) else (math.nan, math.nan)
        return {
            "samples_sent": sent,
            "tensors_received": received,
            "lost": sent - received,
            "skipped": sum(entry["dropped"] for entry in book["links"].values()),
            "latency_p50_ms": round(float(p50), 3),
            "latency_p99_ms": round(float(p99), 3),
        }
