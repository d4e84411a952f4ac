# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The live source: an iterable of the rows that the hubs of a skin send, without ROS."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from pathlib import Path

from ..config.port import find_port_problem
from ..config.skin import Skin, as_skin
from ..core.arguments import check_number
from ..core.errors import ConfigError
from ..core.rows import FrequencyRows
from .chain import LiveLinks
from .links.link import LinkConfig
from .scans.cube_table import CubeAddress

QUEUE_S = 2.0
"""Longest time, in s, for which rows (samples of cubes) wait to be taken from a live source. Rows
that have waited longer are dropped and counted, so that a slow consumer does not fill the
memory."""
MIN_RATE = 0.1
"""Lowest sample rate that can be requested from a hub, in Hz."""
MAX_RATE = 10_000.0
"""Highest sample rate that can be requested from a hub, in Hz."""


def open_links(
    skin: Skin | str | Path,
    *,
    rate: float | None = None,
    port: str = "",
    port_directory: str | Path = "",
) -> LinkSource:
    """Open the links of a skin and start its hubs.

        with open_links(skin) as source:
            for rows in source:
                ...

    A port that does not exist yet is tried again until it can be opened or the source is closed.

    Args:
        skin: The skin: its cubes and links, as read from the skin file, or the path of this file.
        rate: Sample rate to request from the hubs, 0.1 to 10000 Hz; None takes that of the skin
            file.
        port: Port to use instead of the one in the skin file, for a skin with one link.
        port_directory: Folder in which the port of each link has the name of the link, such as the
            folder of simulated hubs.

    Raises:
        ConfigError: `rate` is out of its range, `port` was given for several links, or a port is
            neither a device path nor a TCP address.
    """
    skin = as_skin(skin)
    if rate is not None:
        allowed = f"{MIN_RATE:g} to {MAX_RATE:g} samples per second"
        check_number(
            "rate",
            rate,
            lambda x: MIN_RATE <= x <= MAX_RATE,
            allowed,
        )
    links = make_link_configs(skin, port, port_directory)
    return LinkSource(skin, links, skin.rate if rate is None else rate)


def make_link_configs(
    skin: Skin,
    port: str = "",
    port_directory: str | Path = "",
) -> list[LinkConfig]:
    """Return the port, baud rate and expected hub of each link of a skin.

    Args:
        skin: The skin, as read from the skin file.
        port: Port to use instead of the one in the skin file; empty for that of the skin file.
        port_directory: Folder in which the port of each link has the name of the link; empty for
            the ports of the skin file. `port` takes precedence.

    Raises:
        ConfigError: `port` was given for several links, or a port is neither a device path nor a
            TCP address.
    """
    if port and len(skin.links) > 1:
        raise ConfigError(
            f"port is {port!r}, but the skin {skin.name} has {len(skin.links)} links; "
            "write the ports into the skin file"
        )
    is_simulated = bool(port_directory) and not port
    configs = []
    for link in skin.links:
        path = port or link.port
        if is_simulated:
            path = str(Path(port_directory) / link.name)
        problem = find_port_problem(path)
        if problem:
            raise ConfigError(f"link {link.name}: port: {problem}")
        configs.append(LinkConfig(link.name, path, link.baud, link.hub_uid, is_simulated))
    return configs


def make_cube_addresses(skin: Skin) -> list[CubeAddress]:
    """Return how each cube of a skin is found on a hub, in the order of the skin.

    A cube is found by its unique number, or by its link and its index on the hub of this link.
    """
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
    """Source of the rows that the hubs of a skin send, from construction until `close`.

    Each step of an iteration returns the rows of complete scans (one sample of every cube), and
    waits until there are some. Rows that wait for longer than `QUEUE_S` are dropped, the oldest
    first; `statistics` counts them.

    Args:
        skin: The skin: its cubes and links, as read from the skin file.
        links: Port, baud rate and expected hub of each link.
        rate: Sample rate to request from the hubs, in Hz; with None they keep their own.

    Attributes:
        skin: The skin whose rows this source yields.
        is_live: True, because the rows are measured now, not read from a recording.

    Raises:
        LinkError: With the kind `bad_port`: a port is neither a device path nor a TCP address.
    """

    is_live = True

    def __init__(
        self,
        skin: Skin,
        links: Sequence[LinkConfig],
        rate: float | None,
    ) -> None:
        self.skin = skin
        # Each entry holds the monotonic time, in s, at which its rows were queued.
        self._queue: deque[tuple[float, FrequencyRows]] = deque()
        self._changed = threading.Condition()
        self._closed = False
        self._failure: Exception | None = None
        self._given = 0
        self._dropped = 0
        self._links = LiveLinks(
            links,
            make_cube_addresses(skin),
            self._put,
            rate=rate,
            on_end=self._on_end,
        )
        self._links.start()

    def __repr__(self) -> str:
        state = "closed" if self._closed else "open"
        sizes = f"{len(self.skin.cubes)} cubes on {len(self.skin.links)} links"
        return f"LinkSource({self.skin.name!r}: {sizes}, {state}, {self._given} rows given)"

    def statistics(self) -> dict[str, object]:
        """Return the numbers of rows, and the state, notes and counters of each link.

        Every received row is counted once: given to the consumer, waiting for it, dropped because
        the consumer was too slow, dropped because the host is too slow to read all rows, a
        duplicate, lost by an error of the driver, or left out because the skin does not have the
        cube or has it with another number of pads. The notes of a link include the problems since
        the last call.
        """
        counts = self._links.count_rows()
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
                **counts.count_not_delivered(),
                "links": links,
            }

    def close(self) -> None:
        """Send STOP to the hubs, close the links and end every iteration over this source.

        A second call does nothing.
        """
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._links.close()

    def __iter__(self) -> Iterator[FrequencyRows]:
        """Yield rows (samples of cubes) until the source is closed.

        If an error has ended the reader's thread, the rows that wait are yielded first, then the
        error is raised.
        """
        return iter(self._get, None)

    def __enter__(self) -> LinkSource:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _put(self, rows: FrequencyRows) -> None:
        """Queue rows (samples of cubes) for the consumer; drop those that waited over `QUEUE_S`.

        This method is called in the reader's thread.
        """
        now = time.monotonic()
        with self._changed:
            self._queue.append((now, rows))
            while now - self._queue[0][0] > QUEUE_S:
                _, oldest = self._queue.popleft()
                self._dropped += len(oldest)
            self._changed.notify()

    def _on_end(self) -> None:
        """Wake up a consumer that waits for rows, if an error has ended the reader's thread."""
        with self._changed:
            self._failure = self._links.failure
            self._changed.notify_all()

    def _get(self) -> FrequencyRows | None:
        """Wait for the next rows (samples of cubes); return None once the source is closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._queue or self._failure)
            if self._closed:
                return None
            if not self._queue and self._failure is not None:
                raise self._failure
            _, rows = self._queue.popleft()
            self._given += len(rows)
            return rows
