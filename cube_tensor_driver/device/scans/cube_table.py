# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Table that tells which cube of the skin each row of a hub's sample belongs to.

The HELLO frame of a hub lists the unique numbers (uids) of its cubes, and the skin file names each
cube by its uid, or by its link and its index on the hub. Rows of cubes that are not in the skin
file, or have another number of pads there, are left out and counted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ...core.arguments import join_names
from ..wire.protocol import Hello, Sample
from .row_counts import RowCounts

MAX_NAMES = 8
"""Largest number of cubes that one log message lists by name. If there are more, the message ends
with their number ("and 3 more")."""
ABSENT = -1
"""Value that stands for the index in the skin if a hub's cube is not in the skin file."""
_OTHER_LINK_HAS_IT = "left out here: another link has a cube of the same uid"
"""Text in the log for a cube that is left out because the hub of another link has a cube of the
same uid."""


HubIndex = NDArray[np.int32]
"""Array (n_cubes,) with the index in the skin of each cube of a hub; `ABSENT` for a cube that is
not in the skin file."""
RowIndex = NDArray[np.uint16]
"""Array (n_cubes,) that states, for each row of a sample, the index of its cube in the skin."""


@dataclass(frozen=True)
class CubeAddress:
    """How to find one cube of the skin file on a hub: by its uid, or by its link and index.

    Attributes:
        name: Name of the cube in the skin file.
        link: Index of the link whose hub has the cube; None if the hub of any link may have it.
        index: Index of the cube on its hub; None if the cube is found by its uid.
        uid: Unique number of the cube; None if the cube is found by its index.
        n_pads: Number of pads of the cube's layout in the skin file.
    """

    name: str
    link: int | None
    index: int | None
    uid: int | None
    n_pads: int

    def __str__(self) -> str:
        where = f"index {self.index}" if self.uid is None else f"uid {self.uid:#x}"
        return f"{self.name} ({where})"


@dataclass
class _HubCubes:
    """The cubes of the hub of one link, as its last HELLO frame lists them.

    Attributes:
        hello: Last HELLO frame; None before the first.
        is_present: Whether HELLO has come since the link was last closed or silent.
        waits_for_cube: Whether a cube of this hub is not used because the hub of another link has a
            cube of the same uid. If that link is closed or silent at the next HELLO of this hub
            (once a second), the cube of this hub is used.
        cubes: Index in the skin of each cube of the hub (n_cubes,); `ABSENT` for cubes that are not
            in the skin file.
        complete: The indices as uint16 and the shape (n_cubes, n_pads) of a sample of all cubes of
            the hub, if every one of them is in the skin; else None.
    """

    hello: Hello | None = None
    is_present: bool = False
    waits_for_cube: bool = False
    cubes: HubIndex = field(default_factory=lambda: np.empty(0, np.int32))
    complete: tuple[RowIndex, tuple[int, int]] | None = None


class CubeTable:
    """Table that tells which cube of the skin each row of a hub's sample belongs to.

    Args:
        n_links: Number of links.
        addresses: For each cube of the skin, the uid, or the link and index, to find it by.
        counts: Counters of rows. Rows of unknown cubes, and of cubes with another number of pads,
            are added to them here.

    Attributes:
        n_pads: Largest number of pads of a cube of the skin.
        uids: Unique number of each cube by its index in the skin, as the hubs report it.
    """

    def __init__(
        self,
        n_links: int,
        addresses: Sequence[CubeAddress],
        counts: RowCounts,
    ) -> None:
        self.n_pads = max(address.n_pads for address in addresses)
        self.uids: dict[int, int] = {}
        self._counts = counts
        self._addresses = tuple(addresses)
        self._pads = np.array([address.n_pads for address in addresses])
        self._hubs = [_HubCubes() for _ in range(n_links)]

    def learn(self, link: int, hello: Hello) -> list[str] | None:
        """Store which cubes the hub of a link has, from its HELLO frame.

        Args:
            link: Index of the link.
            hello: HELLO frame of the hub, which lists the uids of its cubes.

        Returns:
            One text for each problem of cubes that do not fit the skin file, with the fix; None if
            nothing has changed since the last HELLO.
        """
        hub = self._hubs[link]
        before = hub.hello
        is_same = (
            before is not None
            and before.n_pads == hello.n_pads
            and np.array_equal(before.cube_uids, hello.cube_uids)
        )
        if is_same and hub.is_present and not hub.waits_for_cube:
            return None
        hub.hello = hello
        hub.is_present = True
        cubes, problems = self._match(link, hello)
        if is_same and np.array_equal(cubes, hub.cubes):
            return None

        hub.cubes = cubes
        is_known = cubes != ABSENT
        fits = self._pads[cubes] == hello.n_pads
        shape = hello.n_cubes, hello.n_pads
        hub.complete = None
        if (is_known & fits).all():
            hub.complete = cubes.astype(np.uint16), shape
        known_cubes = cubes[is_known].tolist()
        known_uids = hello.cube_uids[is_known].tolist()
        uids = dict(zip(known_cubes, known_uids, strict=True))
        # The dictionary is replaced, not changed in place, because other threads read it.
        self.uids = self.uids | uids
        return problems

    def forget(self, link: int) -> None:
        """Mark the hub of a link as absent, because the link was closed or is silent.

        If another hub has a cube with the same uid as one of the absent hub, the rows of the other
        hub are used from its next HELLO on.
        """
        self._hubs[link].is_present = False

    def find(self, link: int, sample: Sample) -> tuple[RowIndex, Sample]:
        """Find the cube of the skin for each row of a sample; leave out and count rows without one.

        Args:
            link: Index of the link that the sample came from.
            sample: The sample, with one row for each cube of the hub.

        Returns:
            Index in the skin of the cube of each kept row, and the sample with only these rows.
        """
        hub = self._hubs[link]
        # If the sample holds all cubes of the hub and all are in the skin, the indices that `learn`
        # has stored are returned without a search.
        if hub.complete is not None and sample.first_cube == 0:
            whole, shape = hub.complete
            if sample.shape == shape:
                return whole, sample
        end = sample.first_cube + sample.n_cubes
        cubes = hub.cubes[sample.first_cube : end]
        is_known = cubes != ABSENT
        fits = is_known & (self._pads[cubes] == sample.n_pads)
        if len(cubes) == sample.n_cubes and fits.all():
            return cubes.astype(np.uint16), sample

        # Cubes of a sample beyond the number that HELLO has reported also count as unknown.
        n_known = int(is_known.sum())
        n_fitting = int(fits.sum())
        self._counts.unknown_cube += sample.n_cubes - n_known
        self._counts.wrong_pads += n_known - n_fitting
        rows = np.flatnonzero(fits)
        kept = Sample(
            sequence=sample.sequence,
            first_cube=sample.first_cube,
            device_us=sample.device_us,
            frequency=sample.frequency[rows],
            pad_fault=sample.pad_fault[rows],
            temperature=sample.temperature[rows],
        )
        return cubes[rows].astype(np.uint16), kept

    def _match(self, link: int, hello: Hello) -> tuple[HubIndex, list[str]]:
        """Find each cube of a hub in the skin.

        Args:
            link: Index of the link of the hub.
            hello: HELLO frame of the hub, which lists the uids of its cubes.

        Returns:
            Index in the skin of each cube of the hub (n_cubes,), and one text for each problem of
            cubes that do not fit the skin file.
        """
        uids = hello.cube_uids.tolist()
        index_of_uid: dict[int, int] = {}
        for index, uid in enumerate(uids):
            index_of_uid.setdefault(uid, index)
        claimed = {
            cube
            for other, hub in enumerate(self._hubs)
            if other != link and hub.is_present
            for cube in hub.cubes.tolist()
        }

        cubes = np.full(hello.n_cubes, ABSENT, np.int32)
        # Cubes with the same problem share one line of the log. This dictionary holds their names
        # by the beginning of the line ("cube" or "the hub's cube") and the text of the problem.
        names: dict[tuple[str, str], list[str]] = {}
        for number, address in enumerate(self._addresses):
            is_claimed = number in claimed
            found, problem = _locate(
                address,
                link,
                hello,
                index_of_uid,
                is_claimed,
            )
            if found is not None:
                cubes[found] = number
            if problem:
                names.setdefault(("cube", problem), []).append(str(address))
        self._hubs[link].waits_for_cube = ("cube", _OTHER_LINK_HAS_IT) in names

        for index in np.flatnonzero(cubes == ABSENT).tolist():
            uid = uids[index]
            problem = "not in the skin file: add it there"
            if index_of_uid[uid] != index:
                problem = "left out: an earlier one has the same uid"
            names.setdefault(("the hub's cube", problem), []).append(f"{index} (uid {uid:#x})")
        problems = []
        for (noun, text), group in names.items():
            plural = "s" if len(group) > 1 else ""
            problems.append(f"{noun}{plural} {join_names(group, MAX_NAMES)} {text}")
        return cubes, problems


def _locate(
    address: CubeAddress,
    link: int,
    hello: Hello,
    index_of_uid: dict[int, int],
    is_claimed: bool,
) -> tuple[int | None, str]:
    """Find one cube of the skin on a hub.

    Args:
        address: The uid, or the link and index, by which the skin file names the cube.
        link: Index of the link of the hub.
        hello: HELLO frame of the hub.
        index_of_uid: Index on the hub of each of its cubes, by uid.
        is_claimed: Whether a present hub of another link has the cube.

    Returns:
        Index of the cube on the hub, None if the cube is not there or is used from another hub; and
        the text of the problem, empty if there is none.
    """
    if address.uid is None:
        index = address.index if address.link == link else None
        if index is not None and index >= hello.n_cubes:
            return None, f"not found: the hub has {hello.n_cubes} cubes"
    else:
        index = index_of_uid.get(address.uid)
        if index is None and address.link == link:
            return None, "not found: the hub has no cube of this uid"
        if index is not None and address.link not in (None, link):
            return None, "left out: by uid on this link, by the skin file on another"
        if index is not None and is_claimed:
            return None, _OTHER_LINK_HAS_IT
    if index is not None and address.n_pads != hello.n_pads:
        return index, (
            f"left out: the hub reports {hello.n_pads} pads, its layout has {address.n_pads}; "
            "correct the layout and calibration in the skin file"
        )
    return index, ""
