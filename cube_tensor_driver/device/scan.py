"""From samples of hubs to rows of a skin: which cube a value belongs to, and when a scan of all
links is complete.

A row is one sample of one cube. Rows that belong to no cube of the skin, or to a cube with another
number of pads, are counted and left out. Nothing here looks at a value.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .protocol import NOT_MEASURED, TEMPERATURE_UNKNOWN, Hello, Sample, join

# °C of each of the 65536 bit patterns of a temperature.
_CELSIUS = np.arange(1 << 16, dtype=np.uint16).view(np.int16) * np.float32(0.01)
_CELSIUS[TEMPERATURE_UNKNOWN] = np.nan
NAMED = 8
"""Cubes that a message names; of more it says how many."""


@dataclass(frozen=True)
class CubeAddress:
    """Where the skin says a cube is: by uid on any link or on `link`, or by link and index. n_pads:
    of its layout."""

    name: str
    link: int | None
    index: int | None
    uid: int | None
    n_pads: int


class Rows(NamedTuple):
    """Rows of one scan, or of several: then first the first sample of every link, then the second …

    cube (N,) uint16 index in the skin; sequence (N,) uint32; stamp_ns (N,) int64, node clock;
    frequency (N, P) float32 Hz, NaN not measured; temperature (N,) float32 °C, NaN unknown;
    pad_fault (N,) uint32.
    """

    cube: NDArray[np.uint16]
    sequence: NDArray[np.uint32]
    stamp_ns: NDArray[np.int64]
    frequency: NDArray[np.float32]
    temperature: NDArray[np.float32]
    pad_fault: NDArray[np.uint32]


def room_for(rows: int, n_pads: int) -> Rows:
    """Arrays that `Scan.take` can fill."""
    return Rows(
        np.empty(rows, np.uint16),
        np.empty(rows, np.uint32),
        np.empty(rows, np.int64),
        np.empty((rows, n_pads), np.float32),
        np.empty(rows, np.float32),
        np.empty(rows, np.uint32),
    )


class Scan:
    """Gathers the samples of all links between two messages.

    rows: delivered so far; unknown_cube, wrong_pads: rows left out because the skin does not have
    the cube, or has it with another number of pads; added: all rows that came in; uids: of the
    skin's cubes, as the hubs say.
    """

    def __init__(self, n_links: int, places: Sequence[CubeAddress]) -> None:
        self.rows = self.unknown_cube = self.wrong_pads = self.added = 0
        self.uids: dict[int, int] = {}
        self.n_pads = max(place.n_pads for place in places)
        self._places = tuple(places)
        self._pads = np.array([place.n_pads for place in places])
        self._cubes: list[NDArray[np.int32]] = [np.empty(0, np.int32) for _ in range(n_links)]
        # Per link: the skin's cubes and a sample's shape where every cube of the hub fits; what
        # each would find again.
        self._whole: list[tuple[NDArray[np.uint16], tuple[int, int]] | None] = [None] * n_links
        self._hellos: list[Hello | None] = [None] * n_links
        self._live: set[int] = set()
        self._here = [False] * n_links  # has said HELLO since it was last closed or silent
        self._waits = [
            False
        ] * n_links  # has a cube that another link has too, and may have it alone later
        # The first sample of every link that gave one, with its time, the second …
        self._gathered: list[dict[int, tuple[Sample, int]]] = []
        self._count = [0] * n_links  # of each link's in there
        self._taken_ns = [0] * n_links  # when the newest sample that was taken was made

    def hello(self, link: int, frame: Hello) -> list[str] | None:
        """Learn which cubes a link carries. Returns what does not fit the skin, in words; None if
        nothing changed."""
        last = self._hellos[link]
        same = (
            last is not None
            and last.n_pads == frame.n_pads
            and np.array_equal(last.cube_uids, frame.cube_uids)
        )
        if same and self._here[link] and not self._waits[link]:
            return None
        self._hellos[link], self._here[link] = frame, True
        others = [
            self._cubes[other]
            for other in range(len(self._cubes))
            if other != link and self._here[other]
        ]
        taken = {cube for cubes in others for cube in cubes.tolist()}
        cubes = np.full(frame.n_cubes, -1, np.int32)
        first: dict[int, int] = {}
        wrong: dict[str, list[str]] = {}  # what is wrong: with which cubes
        twins = [
            at for at, uid in enumerate(frame.cube_uids.tolist()) if first.setdefault(uid, at) != at
        ]
        self._waits[link] = False
        index: int | None
        for number, place in enumerate(self._places):
            name = f"{place.name} ({f'index {place.index}' if place.uid is None else f'uid {place.uid:#x}'})"
            if place.uid is None:
                index = place.index if place.link == link else None
                if index is not None and index >= frame.n_cubes:
                    wrong.setdefault(f"not found: the hub has {frame.n_cubes} cubes", []).append(
                        name
                    )
                    continue
            else:
                index = first.get(place.uid)
                if index is None and place.link == link:
                    wrong.setdefault("not found: the hub has no cube of this uid", []).append(name)
                elif index is not None and place.link not in (None, link):
                    wrong.setdefault(
                        "left out: by uid on this link, by the skin file on another", []
                    ).append(name)
                    continue
                elif index is not None and number in taken:
                    self._waits[link] = True
                    wrong.setdefault(
                        "left out here: another link has a cube of the same uid", []
                    ).append(name)
                    continue
            if index is None:
                continue
            cubes[index] = number
            if place.n_pads != frame.n_pads:
                text = (
                    f"left out: the hub reports {frame.n_pads} pads, its layout has {place.n_pads}; "
                    "correct the layout and calibration in the skin file"
                )
                wrong.setdefault(text, []).append(name)
        twice, strangers = (
            [f"{at} (uid {frame.cube_uids[at]:#x})" for at in some if cubes[at] < 0]
            for some in (twins, first.values())
        )
        problems = [_named("cube", names, text) for text, names in wrong.items()]
        if twice:
            problems.append(
                _named("the hub's cube", twice, "left out: an earlier one has the same uid")
            )
        if strangers:
            problems.append(
                _named("the hub's cube", strangers, "not in the skin file: add it there")
            )
        if same and np.array_equal(cubes, self._cubes[link]):
            return None
        self._cubes[link] = cubes
        fits = (cubes >= 0).all() and (self._pads[cubes] == frame.n_pads).all()
        self._whole[link] = (cubes.astype(np.uint16), (len(cubes), frame.n_pads)) if fits else None
        found = {
            int(cube): int(frame.cube_uids[index]) for index, cube in enumerate(cubes) if cube >= 0
        }
        self.uids = {**self.uids, **found}
        return problems

    def live(self, link: int, live: bool) -> None:
        """Whether a link delivers samples now, so that a scan waits for it."""
        (self._live.add if live else self._live.discard)(link)
        self._here[link] &= live

    def add(self, link: int, samples: Sequence[Sample], stamps_ns: Sequence[int]) -> None:
        """Samples in order, with the times they were taken at in the node's clock."""
        self._live.add(link)
        for sample, stamp_ns in zip(samples, stamps_ns, strict=True):
            if self._count[link] == len(self._gathered):
                self._gathered.append({})
            self._gathered[self._count[link]][link] = sample, stamp_ns
            self._count[link] += 1
            self.added += sample.shape[0]

    def complete(self, turns: int = 1) -> bool:
        """Whether every live link has given `turns` samples, or one has given one more, or one
        comes late to a scan.

        It does where all who have given nothing since have given one nearer to it than to its own
        last: to wait for their next would keep it a sample behind from then on.
        """
        most = len(self._gathered)
        if most == 0 or most > turns:
            return most > 0
        missing = self._live - self._gathered[-1].keys() if most == turns else self._live
        if not missing or turns > 1:
            return not missing
        pending = [(made, self._taken_ns[link]) for link, (_, made) in self._gathered[0].items()]
        # A further part of the sample that was taken is late, too.
        middle = min((made + taken) / 2 if made > taken else 0.0 for made, taken in pending)
        return min(self._taken_ns[link] for link in missing) > middle

    def take(
        self, room: Callable[[int, int], Rows] = room_for, turns: int | None = None
    ) -> Rows | None:
        """The rows gathered since the last time, of at most so many samples of each link; None if
        there are none.

        What some live links have given one more of waits for the others: a link that was late once
        would else stay a sample behind. All is taken where a live link has given nothing.
        room: makes arrays for so many rows of so many pads to fill, the message's own where there
        is one.
        """
        parts: list[tuple[NDArray[np.uint16], Sample, int]] = []
        common = 0
        while common < len(self._gathered) and self._live <= self._gathered[common].keys():
            common += 1
        turns = min(common or len(self._gathered), turns or len(self._gathered))
        for scan in self._gathered[:turns]:
            for link in sorted(scan):
                sample, stamp_ns = scan[link]
                self._taken_ns[link] = stamp_ns
                self._count[link] -= 1
                whole = self._whole[link]
                if whole is not None and whole[1] == sample.shape and sample.first_cube == 0:
                    parts.append((whole[0], sample, stamp_ns))
                elif (part := self._select(link, sample)) is not None:
                    parts.append((*part, stamp_ns))
        del self._gathered[:turns]
        if not parts:
            return None
        rows = room(sum(len(cube) for cube, _, _ in parts), self.n_pads)
        self.rows += len(rows.cube)
        start = 0
        for _, alike in groupby(parts, lambda part: part[1].shape[1]):
            cubes, taken, stamps = zip(*alike, strict=True)
            end = start + sum(map(len, cubes))
            _fill(Rows._make(field[start:end] for field in rows), cubes, taken, stamps)
            start = end
        return rows

    def unaccounted(self) -> int:
        """Rows that came in and are neither delivered, nor gathered, nor counted as left out:
        always 0."""
        gathered = sum(sample.n_cubes for scan in self._gathered for sample, _ in scan.values())
        return self.added - gathered - self.rows - self.unknown_cube - self.wrong_pads

    def _select(self, link: int, sample: Sample) -> tuple[NDArray[np.uint16], Sample] | None:
        """The skin's cubes of a sample, and the sample without the rows that belong to none."""
        cubes = self._cubes[link][sample.first_cube : sample.first_cube + sample.n_cubes]
        known = cubes >= 0
        fits = known & (self._pads[cubes] == sample.n_pads)
        if len(cubes) == sample.n_cubes and fits.all():
            return cubes.astype(np.uint16), sample
        self.unknown_cube += sample.n_cubes - int(known.sum())
        self.wrong_pads += int(known.sum() - fits.sum())
        if not fits.any():
            return None
        rows = np.flatnonzero(fits)
        frequency, pad_fault, temperature = (
            sample.frequency[rows],
            sample.pad_fault[rows],
            sample.temperature[rows],
        )
        kept = Sample(
            sample.sequence, sample.first_cube, sample.device_us, frequency, pad_fault, temperature
        )
        return cubes[rows].astype(np.uint16), kept


def _fill(
    rows: Rows,
    cubes: Sequence[NDArray[np.uint16]],
    samples: Sequence[Sample],
    stamps_ns: Sequence[int],
) -> None:
    """Rows of samples with the same number of pads, one after the other; pads that a cube has not
    are NaN."""
    frequency, pad_fault, temperature = join(samples)
    width, counts = frequency.shape[1], [len(cube) for cube in cubes]
    np.concatenate(cubes, out=rows.cube)
    numbers = np.array([[sample.sequence for sample in samples], stamps_ns], np.int64).repeat(
        counts, axis=1
    )
    rows.sequence[:], rows.stamp_ns[:] = numbers
    rows.pad_fault[:] = pad_fault
    _CELSIUS.take(temperature.view(np.uint16), out=rows.temperature, mode="clip")
    # In double precision: 1 mHz of 100 kHz is below what float32 multiplies exactly.
    np.multiply(frequency, 1e-3, out=rows.frequency[:, :width], casting="same_kind")
    if width < rows.frequency.shape[1]:
        rows.frequency[:, width:] = np.nan
    if frequency.size and frequency.min() == NOT_MEASURED:
        rows.frequency[:, :width][frequency == NOT_MEASURED] = np.nan


def _named(what: str, names: Sequence[str], text: str) -> str:
    """One line about several, the first few by name."""
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return f"{what}{'s' * (len(names) > 1)} {', '.join(names[:NAMED])}{more} {text}"
