"""Table that finds the cubes of the skin in the samples of the hubs, from what HELLO reports.

Rows of cubes that the skin does not have, or has with another number of pads, are left out and
counted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..wire.protocol import Hello, Sample

MAX_NAMES = 8
"""Number of cubes that a message names; the number of the others follows."""
ABSENT = -1
"""Index of a cube that the skin does not have."""
_OTHER_LINK_HAS_IT = "left out here: another link has a cube of the same uid"


HubIndex = NDArray[np.int32]
"""Index in the skin of each cube of a hub (n_cubes,), or `ABSENT`."""
RowIndex = NDArray[np.uint16]
"""Index in the skin of the cube of each row of a sample (n_cubes,)."""


@dataclass(frozen=True)
class CubeAddress:
    """Place of a cube, as the skin file gives it: by uid, or by link and index.

    Attributes:
        name: Name of the cube.
        link: Index of the link; None if the cube may be on any link.
        index: Index of the cube on the hub; None if it is found by uid.
        uid: Unique number of the cube; None if it is found by index.
        n_pads: Number of pads of its layout.
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
    """The cubes of the hub of one link.

    Attributes:
        hello: Last HELLO; None before the first.
        is_present: Whether HELLO has come since the link was last closed or silent.
        waits_for_cube: Whether another hub has a cube of the same uid, which this one takes over
            when the other is gone.
        cubes: Index in the skin (n_cubes,), or `ABSENT`.
        complete: The same with the shape of a sample, if every cube of the hub is in the skin.
    """

    hello: Hello | None = None
    is_present: bool = False
    waits_for_cube: bool = False
    cubes: HubIndex = field(default_factory=lambda: np.empty(0, np.int32))
    complete: tuple[RowIndex, tuple[int, int]] | None = None


class CubeTable:
    """Finds the cubes of a skin in the samples of its hubs.

    Args:
        n_links: Number of links.
        addresses: Places of the cubes of the skin.

    Attributes:
        n_pads: Largest number of pads of a cube of the skin.
        uids: Unique number of each cube by its index in the skin, as the hubs report it.
        unknown_cube: Number of rows left out because the skin does not have the cube.
        wrong_pads: Number of rows left out because the skin has the cube with another number of
            pads.
    """

    def __init__(self, n_links: int, addresses: Sequence[CubeAddress]) -> None:
        self.n_pads = max(address.n_pads for address in addresses)
        self.uids: dict[int, int] = {}
        self.unknown_cube = 0
        self.wrong_pads = 0
        self._addresses = tuple(addresses)
        self._pads = np.array([address.n_pads for address in addresses])
        self._hubs = [_HubCubes() for _ in range(n_links)]

    def learn(self, link: int, hello: Hello) -> list[str] | None:
        """Learn the cubes of a link.

        Returns:
            What does not fit the skin, in words; None if nothing has changed.
        """
        hub = self._hubs[link]
        is_same = hub.hello is not None and _has_same_cubes(hub.hello, hello)
        if is_same and hub.is_present and not hub.waits_for_cube:
            return None
        hub.hello = hello
        hub.is_present = True
        cubes, problems = self._match(link, hello)
        if is_same and np.array_equal(cubes, hub.cubes):
            return None

        hub.cubes = cubes
        hub.complete = None
        is_known = cubes != ABSENT
        fits = self._pads[cubes] == hello.n_pads
        if is_known.all() and fits.all():
            shape = hello.n_cubes, hello.n_pads
            hub.complete = cubes.astype(np.uint16), shape

        known_uids = hello.cube_uids[is_known].tolist()
        uids = dict(self.uids)
        uids.update(zip(cubes[is_known].tolist(), known_uids, strict=True))
        # The table is replaced in one step, because other threads read it.
        self.uids = uids
        return problems

    def forget(self, link: int) -> None:
        """Let other links take over the cubes of a link, because it was closed or is silent."""
        self._hubs[link].is_present = False

    def find(self, link: int, sample: Sample) -> tuple[RowIndex, Sample] | None:
        """Find the cubes of the skin in a sample.

        Returns:
            Index in the skin of each cube, and the sample without all other rows; None if no row is
            left.
        """
        if not sample.n_cubes:
            return None
        hub = self._hubs[link]
        # The usual sample holds all cubes of the hub, and all of them are in the skin.
        if hub.complete is not None and sample.first_cube == 0:
            cubes, shape = hub.complete
            if sample.shape == shape:
                return cubes, sample
        return self._select(hub, sample)

    def _select(
        self,
        hub: _HubCubes,
        sample: Sample,
    ) -> tuple[RowIndex, Sample] | None:
        """Find the cubes of the skin in a sample that also has other rows, and count those."""
        end = sample.first_cube + sample.n_cubes
        cubes = hub.cubes[sample.first_cube : end]
        is_known = cubes != ABSENT
        fits = is_known & (self._pads[cubes] == sample.n_pads)
        if len(cubes) == sample.n_cubes and fits.all():
            return cubes.astype(np.uint16), sample

        # A sample may also hold more cubes than the hub has reported; they are unknown, too.
        n_known = int(is_known.sum())
        n_fitting = int(fits.sum())
        self.unknown_cube += sample.n_cubes - n_known
        self.wrong_pads += n_known - n_fitting
        if not fits.any():
            return None
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
        """Return the index in the skin of each cube of a hub, and what does not fit, in words."""
        uids = hello.cube_uids.tolist()
        index_of_uid: dict[int, int] = {}
        for index, uid in enumerate(uids):
            index_of_uid.setdefault(uid, index)

        claimed = self._claimed_by_others(link)
        cubes = np.full(hello.n_cubes, ABSENT, np.int32)
        names: dict[str, list[str]] = {}  # of the cubes of the skin, by what is wrong with them
        for number, address in enumerate(self._addresses):
            is_claimed = number in claimed
            found, problem = _locate(address, link, hello, index_of_uid, is_claimed)
            if found is not None:
                cubes[found] = number
            if problem:
                names.setdefault(problem, []).append(str(address))
        self._hubs[link].waits_for_cube = _OTHER_LINK_HAS_IT in names
        problems = [
            _join_names("cube", group, text)  # one line for all cubes with the same problem
            for text, group in names.items()
        ]

        # The other cubes of the hub are not in the skin, or their uid is not unique.
        repeated: list[str] = []
        unknown: list[str] = []
        for index in np.flatnonzero(cubes == ABSENT).tolist():
            uid = uids[index]
            is_first_of_uid = index_of_uid[uid] == index
            group = unknown if is_first_of_uid else repeated
            group.append(f"{index} (uid {uid:#x})")
        if repeated:
            text = "left out: an earlier one has the same uid"
            problems.append(_join_names("the hub's cube", repeated, text))
        if unknown:
            text = "not in the skin file: add it there"
            problems.append(_join_names("the hub's cube", unknown, text))
        return cubes, problems

    def _claimed_by_others(self, link: int) -> set[int]:
        """Return the cubes of the skin that present hubs of other links have."""
        claimed: set[int] = set()
        for other, hub in enumerate(self._hubs):
            if other != link and hub.is_present:
                claimed |= set(hub.cubes.tolist())
        return claimed


def _has_same_cubes(one: Hello, other: Hello) -> bool:
    """Return whether two HELLOs report the same cubes."""
    if one.n_pads != other.n_pads:
        return False
    return np.array_equal(one.cube_uids, other.cube_uids)


def _locate(
    address: CubeAddress,
    link: int,
    hello: Hello,
    index_of_uid: dict[int, int],
    is_claimed: bool,
) -> tuple[int | None, str]:
    """Find one cube of the skin on a hub.

    Args:
        address: Place of the cube, as the skin file gives it.
        link: Index of the link.
        hello: HELLO of the hub.
        index_of_uid: Index on the hub of each uid.
        is_claimed: Whether a hub of another link has the cube.

    Returns:
        Index on the hub, None if the cube is not there or another hub has it; and what is wrong, in
        words.
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


def _join_names(what: str, names: Sequence[str], text: str) -> str:
    """Return one line about several cubes, of which the first few are named."""
    plural = "s" if len(names) > 1 else ""
    listed = ", ".join(names[:MAX_NAMES])
    more = f" and {len(names) - MAX_NAMES} more" if len(names) > MAX_NAMES else ""
    return f"{what}{plural} {listed}{more} {text}"
