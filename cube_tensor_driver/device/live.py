"""Live frequencies without ROS: the links of a skin as a source to iterate over."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from pathlib import Path

from ..config.port import port_problem
from ..config.skin import Skin
from ..core.errors import ConfigError
from ..core.rows import FrequencyRows
from .chain import LiveLinks
from .links.link import LinkConfig
from .scans.cube_table import CubeAddress

QUEUE_S = 2.0
"""A consumer that is further behind loses the oldest rows."""
RATE_LIMITS = 0.1, 10_000.0


def open_links(
    skin: Skin,
    *,
    rate: float | None = None,
    port: str = "",
    port_directory: str | Path = "",
) -> LinkSource:
    """Open the links of a skin and start its hubs.

        with open_links(skin) as source:
            for rows in source:
                ...

    rate: samples per second to ask of the hubs, 0.1 to 10000; None: as the skin file says.
    port: instead of the one in the skin file, for a skin with one link.
    port_directory: folder with the links' ports under the links' names, as of simulated hubs.
    A port that is not there yet is waited for. ConfigError: an argument that cannot be used, or a
    port that can never be opened.
    """
    low, high = RATE_LIMITS
    if rate is not None and not low <= rate <= high:
        raise ConfigError(f"rate is {rate}, allowed: {low:g} to {high:g} samples per second")
    links = link_configs(skin, port, port_directory)
    return LinkSource(skin, links, skin.rate if rate is None else rate)


def link_configs(skin: Skin, port: str = "", port_directory: str | Path = "") -> list[LinkConfig]:
    """The links of a skin, with other ports if they are given; see `open_links`.

    ConfigError: one port for a skin with several links, or a port that can never be opened.
    """
    if port and len(skin.links) > 1:
        raise ConfigError(
            f"port is {port!r}, but the skin {skin.name} has {len(skin.links)} links; "
            "write the ports into the skin file"
        )
    configs = []
    for link in skin.links:
        path = str(Path(port_directory) / link.name) if port_directory else link.port
        chosen = port or path
        problem = port_problem(chosen)
        if problem:
            raise ConfigError(f"link {link.name}: port: {problem}")
        simulated = bool(port_directory) and not port
        configs.append(LinkConfig(link.name, chosen, link.baud, link.hub_uid, simulated))
    return configs


def cube_addresses(skin: Skin) -> list[CubeAddress]:
    """Where the cubes of a skin are, in its order."""
    number_of = {link.name: number for number, link in enumerate(skin.links)}
    return [
        CubeAddress(
            name=cube.name,
            link=None if cube.link is None else number_of[cube.link],
            index=cube.index,
            uid=cube.uid,
            n_pads=cube.calibration.layout.n_pads,
        )
        for cube in skin.cubes
    ]


class LinkSource:
    """A `Source` of what the links of a skin deliver, from now on until it is closed.

    Iterating gives the rows of one scan after the other, and waits for the next. A consumer that is
    more than QUEUE_S behind loses the oldest rows; `statistics` counts them.
    """

    def __init__(self, skin: Skin, links: Sequence[LinkConfig], rate: float | None) -> None:
        """LinkError `bad_port`: a port that can never be opened."""
        self._skin = skin
        self._queue: deque[tuple[float, FrequencyRows]] = deque()  # with their time of arrival
        self._changed = threading.Condition()
        self._closed = False
        self._ended = False
        self._given = 0
        self._dropped = 0
        self._links = LiveLinks(
            links, cube_addresses(skin), self._put, rate=rate, on_end=self._on_end
        )
        self._links.start()

    @property
    def skin(self) -> Skin:
        return self._skin

    @property
    def is_live(self) -> bool:
        return True

    def statistics(self) -> dict[str, object]:
        """Rows by what became of them, and of each link its state, notes and counters.

        Rows that came in were given to the consumer, wait for it, were dropped because it was too
        slow, came twice, were lost by an error of the driver, or were left out: of unknown cubes,
        or with another number of pads. Notes of a link
        include what happened since the last call.
        """
        counts = self._links.row_counts()
        links = {
            report.name: {
                "state": report.state.value,
                "notes": list(report.notes),
                **report.values,
            }
            for report in self._links.report()
        }
        with self._changed:
            waiting = sum(len(rows) for _, rows in self._queue)
            return {
                "rows given": self._given,
                "rows waiting": waiting,
                "rows dropped": self._dropped,
                "rows of unknown cubes": counts.unknown_cube,
                "rows with another number of pads": counts.wrong_pads,
                "rows that came twice": counts.duplicate,
                "rows lost by errors": counts.lost,
                "rows unaccounted": counts.unaccounted,
                "links": links,
            }

    def close(self) -> None:
        """Stop the hubs, close the links and end every iteration. Safe to call twice."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._links.close()

    def __iter__(self) -> Iterator[FrequencyRows]:
        """If an error ends the reader's thread, it is raised after the rows that came before."""
        while True:
            rows = self._get()
            if rows is None:
                return
            yield rows

    def __enter__(self) -> LinkSource:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _put(self, rows: FrequencyRows) -> None:
        """Reader's thread: rows have come."""
        now = time.monotonic()
        with self._changed:
            self._queue.append((now, rows))
            while now - self._queue[0][0] > QUEUE_S:
                _, oldest = self._queue.popleft()
                self._dropped += len(oldest)
            self._changed.notify()

    def _on_end(self) -> None:
        """Reader's thread: no rows will come any more."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def _get(self) -> FrequencyRows | None:
        """The next rows; None when closed."""
        with self._changed:
            while not self._closed:
                if self._queue:
                    _, rows = self._queue.popleft()
                    self._given += len(rows)
                    return rows
                if self._ended and self._links.failure is not None:
                    raise self._links.failure
                self._changed.wait()
        return None
