"""Which cube of the skin each cube of each hub is, from what the hubs say in HELLO.

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
"""How many cubes a message names; of the others it gives the number."""
ABSENT = -1
_CLAIMED = "left out here: another link has a cube of the same uid"


@dataclass(frozen=True)
class CubeAddress:
    """Where the skin says that a cube is: by uid (on `link`, or on any link if that is None), or by
    link and index.

    n_pads: of its layout.
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
class _Hub:
    """What is known of the hub of one link.

    is_present: it has said HELLO since its link was last closed or silent.
    waits_for_cube: another hub has a cube of the same uid, which this one takes over when that hub
    is gone.
    cubes: (n_cubes,) index in the skin, or ABSENT.
    complete: the same and the shape of a sample, if every cube of the hub fits the skin.
    """

    hello: Hello | None = None
    is_present: bool = False
    waits_for_cube: bool = False
    cubes: NDArray[np.int32] = field(default_factory=lambda: np.empty(0, np.int32))
    complete: tuple[NDArray[np.uint16], tuple[int, int]] | None = None


class CubeTable:
    """Finds the cubes of a skin in the samples of its hubs.

    n_pads: of the widest cube of the skin.
    uids: of the skin's cubes by index, as the hubs say.
    unknown_cube, wrong_pads: rows left out because the skin does not have the cube, or has it with
    another number of pads.
    """

    def __init__(self, n_links: int, addresses: Sequence[CubeAddress]) -> None:
        self.n_pads = max(address.n_pads for address in addresses)
        self.uids: dict[int, int] = {}
        self.unknown_cube = 0
        self.wrong_pads = 0
        self._addresses = tuple(addresses)
        self._pads = np.array([address.n_pads for address in addresses])
        self._hubs = [_Hub() for _ in range(n_links)]

    def learn(self, link: int, hello: Hello) -> list[str] | None:
        """Learn which cubes a link carries.

        Returns what does not fit the skin, in words; None if nothing changed.
        """
        hub = self._hubs[link]
        same = hub.hello is not None and _same_cubes(hub.hello, hello)
        if same and hub.is_present and not hub.waits_for_cube:
            return None
        hub.hello = hello
        hub.is_present = True
        cubes, problems = self._match(link, hello)
        if same and np.array_equal(cubes, hub.cubes):
            return None
        hub.cubes = cubes
        hub.complete = None
        if (cubes != ABSENT).all() and (self._pads[cubes] == hello.n_pads).all():
            hub.complete = cubes.astype(np.uint16), (len(cubes), hello.n_pads)
        uids = dict(self.uids)
        for index in np.flatnonzero(cubes != ABSENT).tolist():
            uids[int(cubes[index])] = int(hello.cube_uids[index])
        # In one step, because other threads read it.
        self.uids = uids
        return problems

    def forget(self, link: int) -> None:
        """The link was closed or fell silent: another link may take over its cubes."""
        self._hubs[link].is_present = False

    def find(self, link: int, sample: Sample) -> tuple[NDArray[np.uint16], Sample] | None:
        """The skin's cubes in a sample, and the sample without all other rows; None if none is
        left."""
        if not sample.n_cubes:
            return None
        hub = self._hubs[link]
        if hub.complete is not None and sample.first_cube == 0:
            cubes, shape = hub.complete
            if sample.shape == shape:
                return cubes, sample
        return self._select(hub, sample)

    def _select(self, hub: _Hub, sample: Sample) -> tuple[NDArray[np.uint16], Sample] | None:
        cubes = hub.cubes[sample.first_cube : sample.first_cube + sample.n_cubes]
        known = cubes != ABSENT
        fits = known & (self._pads[cubes] == sample.n_pads)
        if len(cubes) == sample.n_cubes and fits.all():
            return cubes.astype(np.uint16), sample
        n_known = int(known.sum())
        self.unknown_cube += sample.n_cubes - n_known
        self.wrong_pads += n_known - int(fits.sum())
        if not fits.any():
            return None
        rows = np.flatnonzero(fits)
        kept = Sample(
            sample.sequence,
            sample.first_cube,
            sample.device_us,
            sample.frequency[rows],
            sample.pad_fault[rows],
            sample.temperature[rows],
        )
        return cubes[rows].astype(np.uint16), kept

    def _match(self, link: int, hello: Hello) -> tuple[NDArray[np.int32], list[str]]:
        """Index in the skin of each cube of a hub, and what does not fit."""
        uids = hello.cube_uids.tolist()
        index_of_uid: dict[int, int] = {}
        for at, uid in enumerate(uids):
            index_of_uid.setdefault(uid, at)
        claimed = self._claimed_by_others(link)
        cubes = np.full(hello.n_cubes, ABSENT, np.int32)
        names: dict[str, list[str]] = {}  # of the cubes, by what is wrong with them
        for number, address in enumerate(self._addresses):
            index, problem = _locate(address, link, hello, index_of_uid, number in claimed)
            if index is not None:
                cubes[index] = number
            if problem:
                names.setdefault(problem, []).append(str(address))
        self._hubs[link].waits_for_cube = _CLAIMED in names
        problems = [_about("cube", cubes_named, text) for text, cubes_named in names.items()]

        repeated: list[str] = []
        unknown: list[str] = []
        for at in np.flatnonzero(cubes == ABSENT).tolist():
            is_first_of_its_uid = index_of_uid[uids[at]] == at
            names_of = unknown if is_first_of_its_uid else repeated
            names_of.append(f"{at} (uid {uids[at]:#x})")
        if repeated:
            text = "left out: an earlier one has the same uid"
            problems.append(_about("the hub's cube", repeated, text))
        if unknown:
            problems.append(_about("the hub's cube", unknown, "not in the skin file: add it there"))
        return cubes, problems

    def _claimed_by_others(self, link: int) -> set[int]:
        """Cubes of the skin that present hubs of other links carry."""
        claimed: set[int] = set()
        for other, hub in enumerate(self._hubs):
            if other != link and hub.is_present:
                claimed |= set(hub.cubes.tolist())
        return claimed


def _same_cubes(one: Hello, other: Hello) -> bool:
    return one.n_pads == other.n_pads and np.array_equal(one.cube_uids, other.cube_uids)


def _locate(
    address: CubeAddress,
    link: int,
    hello: Hello,
    index_of_uid: dict[int, int],
    is_claimed: bool,
) -> tuple[int | None, str]:
    """Index on the hub of one cube of the skin, None if it is not there or another hub has it; and
    what is wrong, in words."""
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
            return None, _CLAIMED
    if index is not None and address.n_pads != hello.n_pads:
        return index, (
            f"left out: the hub reports {hello.n_pads} pads, its layout has {address.n_pads}; "
            "correct the layout and calibration in the skin file"
        )
    return index, ""


def _about(what: str, names: Sequence[str], text: str) -> str:
    """One line about several, the first few by name."""
    more = f" and {len(names) - MAX_NAMES} more" if len(names) > MAX_NAMES else ""
    plural = "s" if len(names) > 1 else ""
    return f"{what}{plural} {', '.join(names[:MAX_NAMES])}{more} {text}"
