# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""One instant of a skin: rows of the topic `stress`, with the contacts and the field of these rows.

Everything that the page shows at a time comes from one `Scan`.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple, TypeVar

from ..core.arrays import Array, Index, StatusBits
from ..core.latest_stress import LatestStress
from ..core.rows import StressRows
from ..touch.surface import Contact
from .history import SampleRate
from .surface_field import SurfaceField

MAX_RESULT_DELAY_NS = 1_000_000_000
"""Maximum difference, in ns, between the stamp of the newest `stress` message and the stamp of the
newest message of the node `contacts`.

The node gives its messages the stamp of the `stress` message from which it has computed them. A
larger difference means that the node has ended.
"""

MAX_WAITING_MESSAGES = 300
"""Maximum number of `stress` messages that are kept until the node `contacts` has processed them.

It bounds the memory if the node does not keep up: 30 MB for a skin of 1260 cubes. With more
messages, the page shows the newest stress without results of the node.
"""

MAX_RESULTS = 64
"""Number of newest messages that are kept of each topic of the node `contacts`."""


Links = tuple[tuple[str, int], ...]
"""For each link (connection to a hub), a line of text and the level of its diagnostics."""


class Scan(NamedTuple):
    """Values of the N cubes at one instant, with the field and the contacts of the same rows.

    Attributes:
        values: (N, 15) 6 stress components in Pa and 9 gradients in Pa/m, in the frames of the
            cubes; NaN where a cube has no usable tensor.
        residual: (N,) misfit between pads and tensor relative to the noise; 1 for noise alone.
        health: (N,) health of the cubes (fine, doubtful, faulty or stale), coded as in
            core/latest_stress.py.
        status: (N,) status bits, as in core/status.py.
        rate: (N,) samples per second of each cube, in Hz; 0 where it is unknown.
        field: Pressure and shear at the points of the surface.
        contacts: The contacts, strongest first.
        links: For each link (connection to a hub), one line of text with its name and state, and
            the level of its diagnostics (0 ok, 1 warning, 2 error, 3 stale).
    """

    values: Array
    residual: Array
    health: Index
    status: StatusBits
    rate: Array
    field: SurfaceField
    contacts: list[Contact]
    links: Links = ()


class ScanSynchronizer:
    """Pairs rows (samples of one cube each) with the contacts that were found in the same rows.

    The node `contacts` publishes contacts and traction some time after the rows in which it found
    them, with the stamp of these rows. While the node runs, newer rows wait here until it has
    processed one of them. So rows, contacts and traction are always of the same instant.

    Attributes:
        stamp_ns: Stamp of the newest `stress` message at this instant, in ns; 0 before the first.
        latest: Latest row of each cube at this instant.
        sample_rate: Samples per second of each cube at this instant.
        contacts: Contacts in these rows; None if the node does not run.
        cloud: Points (M, 6) of the topic `traction` for these rows: position in m, pressure, shear
            and standard deviation of the pressure in Pa; None if it is not published.
    """

    def __init__(self, n_cubes: int) -> None:
        self.stamp_ns = 0
        self.latest = LatestStress(n_cubes)
        self.sample_rate = SampleRate(n_cubes)
        self.contacts: list[Contact] | None = None
        self.cloud: Array | None = None
        self._waiting: deque[tuple[int, StressRows, float]] = deque()
        self._contacts: dict[int, list[Contact]] = {}
        self._clouds: dict[int, Array] = {}

    def add_rows(
        self,
        stamp_ns: int,
        rows: StressRows,
        now: float,
    ) -> None:
        """Add the rows (one sample of one cube each) of a `stress` message.

        Args:
            stamp_ns: Stamp of the message, in ns.
            rows: Rows of the message. Those of cubes that the skin does not have are ignored.
            now: Time of arrival, in s, on any clock that all calls share.
        """
        is_known = rows.cube < len(self.latest.status)
        self._waiting.append((stamp_ns, rows.select(is_known), now))

    def add_contacts(self, stamp_ns: int, contacts: list[Contact]) -> None:
        """Add the contacts that were found from the `stress` message with this stamp, in ns."""
        _add_result(self._contacts, stamp_ns, contacts)

    def add_cloud(self, stamp_ns: int, cloud: Array) -> None:
        """Add the points (M, 6) of the topic `traction` that were computed from the `stress`
        message with this stamp, in ns."""
        _add_result(self._clouds, stamp_ns, cloud)

    def advance(self) -> bool:
        """Make the newest waiting rows the present ones, with the results for them.

        While the node `contacts` runs, only rows that it has processed are taken.

        Returns:
            Whether rows were taken.
        """
        if not self._waiting:
            return False
        # A node whose last result is much older than the newest rows has ended. Results that are
        # much newer are from the time before a replay jumped back.
        newest_ns = self._waiting[-1][0]
        required = [
            results
            for results in (self._contacts, self._clouds)
            if results and abs(newest_ns - next(reversed(results))) < MAX_RESULT_DELAY_NS
        ]
        if len(self._waiting) > MAX_WAITING_MESSAGES:
            required = []
        # All messages up to the newest one with a result on every required topic are taken.
        n_taken = 0
        for number, (stamp_ns, _, _) in enumerate(self._waiting, 1):
            if all(stamp_ns in results for results in required):
                n_taken = number
        if not n_taken:
            return False
        for _ in range(n_taken):
            self.stamp_ns, rows, arrival = self._waiting.popleft()
            self.latest.update(rows, arrival)
            self.sample_rate.update(rows)
        # A topic that is not published has no result for this stamp.
        self.contacts = self._contacts.get(self.stamp_ns)
        self.cloud = self._clouds.get(self.stamp_ns)
        return True


_Result = TypeVar("_Result")


def _add_result(
    results: dict[int, _Result],
    stamp_ns: int,
    result: _Result,
) -> None:
    """Store a result under its stamp, and forget the oldest of more than `MAX_RESULTS`."""
    # After a jump of a replay, the same stamp can come again. A dict would keep its old position,
    # so the old result is removed first.
    results.pop(stamp_ns, None)
    results[stamp_ns] = result
    if len(results) > MAX_RESULTS:
        del results[next(iter(results))]
