"""The live source: the links of a skin as an iterable of rows, without ROS."""

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
"""Time, in s, by which a consumer may be late. One that is further behind loses the oldest rows."""
MIN_RATE = 0.1
"""Lowest sample rate that can be requested, in Hz."""
MAX_RATE = 10_000.0
"""Highest sample rate that can be requested, in Hz."""


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

    The source waits for a port that is not there yet.

    Args:
        skin: The skin.
        rate: Sample rate to request of the hubs, 0.1 to 10000 Hz; None takes that of the skin file.
        port: Port to use instead of the one in the skin file, for a skin with one link.
        port_directory: Folder that holds the ports under the names of the links, as those of
            simulated hubs.

    Raises:
        ConfigError: An argument cannot be used, or a port can never be opened.
    """
    if rate is not None and not MIN_RATE <= rate <= MAX_RATE:
        raise ConfigError(
            f"rate is {rate}, allowed: {MIN_RATE:g} to {MAX_RATE:g} samples per second"
        )
    links = link_configs(skin, port, port_directory)
    return LinkSource(skin, links, skin.rate if rate is None else rate)


def link_configs(
    skin: Skin,
    port: str = "",
    port_directory: str | Path = "",
) -> list[LinkConfig]:
    """Return the place of each link of a skin.

    Args:
        skin: The skin.
        port: Port to use instead of the one in the skin file.
        port_directory: Folder that holds the ports under the names of the links.

    Raises:
        ConfigError: One port was given for several links, or a port can never be opened.
    """
    if port and len(skin.links) > 1:
        raise ConfigError(
            f"port is {port!r}, but the skin {skin.name} has {len(skin.links)} links; "
            "write the ports into the skin file"
        )
    configs = []
    for link in skin.links:
        path = port or link.port
        if port_directory and not port:
            path = str(Path(port_directory) / link.name)
        problem = port_problem(path)
        if problem:
            raise ConfigError(f"link {link.name}: port: {problem}")
        is_simulated = bool(port_directory) and not port
        configs.append(LinkConfig(link.name, path, link.baud, link.hub_uid, is_simulated))
    return configs


def cube_addresses(skin: Skin) -> list[CubeAddress]:
    """Return the place of each cube of a skin, in its order."""
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
    """Source of the rows that the links of a skin deliver, from now on until it is closed.

    Each iteration gives the rows of complete scans, or waits for them. A consumer that is more than
    `QUEUE_S` late loses the oldest rows; `statistics` counts them.

    Args:
        skin: The skin.
        links: Place of each link.
        rate: Sample rate to request of the hubs, in Hz; None leaves it to them.

    Raises:
        LinkError: `bad_port`: a port can never be opened.
    """

    def __init__(
        self,
        skin: Skin,
        links: Sequence[LinkConfig],
        rate: float | None,
    ) -> None:
        self._skin = skin
        self._queue: deque[tuple[float, FrequencyRows]] = deque()  # with their arrival
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
        """The skin."""
        return self._skin

    @property
    def is_live(self) -> bool:
        """True: rows come as they are measured."""
        return True

    def statistics(self) -> dict[str, object]:
        """Return the numbers of rows, and the state, notes and counters of each link.

        Received rows were given to the consumer, wait for it, were dropped because it was too slow,
        came twice, were lost by an error of the driver, or were left out because the skin does not
        have their cube or has it with another number of pads. The notes of a link include what
        happened since the last call.
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
        """Stop the hubs, close the links and end every iteration; a second call does nothing."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._links.close()

    def __iter__(self) -> Iterator[FrequencyRows]:
        """Yield rows. An error that ends the reader's thread is raised after the rows before it."""
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
        """Queue rows, in the reader's thread."""
        now = time.monotonic()
        with self._changed:
            self._queue.append((now, rows))
            while now - self._queue[0][0] > QUEUE_S:
                _, oldest = self._queue.popleft()
                self._dropped += len(oldest)
            self._changed.notify()

    def _on_end(self) -> None:
        """Wake up the consumer, because the reader's thread ends."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def _get(self) -> FrequencyRows | None:
        """Return the next rows; None if the source is closed."""
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
