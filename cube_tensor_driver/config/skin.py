"""Skin files: which links there are, which cubes they carry, where the cubes sit, how they are
calibrated.

docs/config.md describes the keys. A file is checked whole before anything starts: every mistake is
one line with file, key, what was found and what is allowed.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..core.calibration import Calibration
from ..core.errors import ConfigError, CubeError
from .calibration import find_calibration, read_calibration
from .schema import NAME, TEXT, TRIPLE, Schema, real, several, table
from .yaml import read_yaml

_FRAME = {
    "type": "string",
    "pattern": r"^[A-Za-z][A-Za-z0-9_]*(/[A-Za-z0-9_]+)*\Z",
    "description": "a frame id of letters, digits, _ and /, a letter first",
}
# An integer, or a text such as 0x1f because uids are hexadecimal on labels.
_UID = {
    "anyOf": [
        {"type": "integer", "minimum": 1, "maximum": 2**64 - 1},
        {"type": "string", "pattern": r"^0x(?!0+\Z)[0-9a-fA-F]{1,16}\Z"},
    ],
    "description": "a uid: 1 to 2^64 - 1, or hexadecimal as in 0x1f",
}
_INDEX = {
    "type": "integer",
    "minimum": 0,
    "maximum": 65535,
    "description": "an integer from 0 to 65535",
}
_BAUD = {
    "type": "integer",
    "minimum": 1200,
    "maximum": 20_000_000,
    "description": "1200 to 20000000",
}
_LINK = table(("name", "port"), {"name": NAME, "port": TEXT, "baud": _BAUD, "hub_uid": _UID})
_CUBE = table(
    ("name", "pose", "layout", "calibration"),
    {
        "name": NAME,
        "link": NAME,
        "index": _INDEX,
        "uid": _UID,
        "pose": table(("xyz", "rpy"), {"xyz": TRIPLE, "rpy": TRIPLE}),
        "layout": TEXT,
        "calibration": TEXT,
    },
)
_SCHEMA = Schema(
    table(
        ("name", "parent_frame", "links", "cubes"),
        {
            "name": NAME,
            "parent_frame": _FRAME,
            "rate": real("samples per second, 0.1 to 10000", minimum=0.1, maximum=10_000),
            "links": several(_LINK, "links"),
            "cubes": several(_CUBE, "cubes"),
        },
    )
)


@dataclass(frozen=True)
class SkinLink:
    """A link of a skin: name, port (device path, pattern or socket://host:port), baud, uid of the
    hub or None."""

    name: str
    port: str
    baud: int
    hub_uid: int | None


@dataclass(frozen=True)
class SkinCube:
    """A cube of a skin.

    RecordedVerdicts on the wire by uid, or by link and index. xyz in m and rpy in rad (fixed axes
    x, y, z: REP 103) are its pose in the skin's parent frame.
    """

    name: str
    link: str | None
    index: int | None
    uid: int | None
    xyz: tuple[float, float, float]
    rpy: tuple[float, float, float]
    calibration: Calibration


@dataclass(frozen=True)
class Skin:
    """All cubes of one configuration file. rate: samples per second to ask of the hubs, None to
    leave it to them."""

    name: str
    parent_frame: str
    rate: float | None
    links: tuple[SkinLink, ...]
    cubes: tuple[SkinCube, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """The name of each cube."""
        return tuple(cube.name for cube in self.cubes)

    @property
    def calibrations(self) -> tuple[Calibration, ...]:
        """The calibration of each cube; cubes of one file share one object."""
        return tuple(cube.calibration for cube in self.cubes)

    @property
    def n_pads(self) -> int:
        """Pads of the widest cube: the width of a row."""
        return max(cube.calibration.layout.n_pads for cube in self.cubes)

    def frame(self, cube: SkinCube) -> str:
        """Frame id of a cube."""
        return f"{self.name}_{cube.name}"


def read_skin(path: Path) -> Skin:
    """Read and check a skin file.

    ConfigError: the first mistake (file, key, what was found, what is allowed) and how many more
    there are.
    """
    skin, mistakes = check_skin(path)
    if skin is None:
        more = (
            f" (and {len(mistakes) - 1} more: ./cube config check {path})"
            if len(mistakes) > 1
            else ""
        )
        raise ConfigError(f"{path}: {mistakes[0]}{more}")
    return skin


def check_skin(path: Path) -> tuple[Skin | None, list[str]]:
    """The skin of a file and no mistakes, or None and every mistake, one line each. ConfigError: it
    cannot be read."""
    data = read_yaml(path)
    found = _SCHEMA.mistakes(data)
    mistakes = [line for _, line in found]
    if not isinstance(data, dict) or not all(
        isinstance(data.get(key), list) for key in ("links", "cubes")
    ):
        return None, mistakes
    # Where an entry is malformed the others are looked at all the same.
    wrong = {where[:2] for where, _ in found}
    links = tuple(
        SkinLink(link["name"], link["port"], link.get("baud", 921_600), _uid(link.get("hub_uid")))
        for number, link in enumerate(data["links"])
        if ("links", number) not in wrong
    )
    mistakes += _twice("links", "name", [repr(link.name) for link in links])
    mistakes += _twice(
        "links", "hub_uid", [hex(link.hub_uid) for link in links if link.hub_uid is not None]
    )
    names = {link.name for link in links}
    whole = len(names) == len(data["links"])
    calibrations: dict[str, Calibration | CubeError] = {}
    cubes = []
    for number, item in enumerate(data["cubes"]):
        if ("cubes", number) in wrong:
            continue
        name = item["calibration"]
        if name not in calibrations:
            try:
                calibrations[name] = read_calibration(find_calibration(name, path.parent))
            except CubeError as error:
                calibrations[name] = error
                mistakes.append(f"cubes[{number}].calibration: {error}")
        calibration, uid = calibrations[name], _uid(item.get("uid"))
        if isinstance(calibration, CubeError):
            continue
        mistakes += [
            f"cubes[{number}]{line}"
            for line in _contradictions(item, uid, calibration, names if whole else None)
        ]
        xyz, rpy = (tuple(float(value) for value in item["pose"][part]) for part in ("xyz", "rpy"))
        cubes.append(
            SkinCube(item["name"], item.get("link"), item.get("index"), uid, xyz, rpy, calibration)  # type: ignore[arg-type]
        )
    mistakes += _twice("cubes", "name", [repr(cube.name) for cube in cubes])
    mistakes += _twice("cubes", "uid", [hex(cube.uid) for cube in cubes if cube.uid is not None])
    mistakes += _twice(
        "cubes",
        "link and index",
        [f"{cube.link!r}, {cube.index}" for cube in cubes if cube.index is not None],
    )
    for link in links:
        pads = {cube.calibration.layout.n_pads for cube in cubes if cube.link == link.name}
        if len(pads) > 1:
            both = " and ".join(map(str, sorted(pads)))
            mistakes.append(
                f"cubes: those on the link {link.name!r} have {both} pads; a hub reads one number of pads"
            )
    if mistakes:
        return None, mistakes
    rate = data.get("rate")
    return Skin(
        data["name"],
        data["parent_frame"],
        None if rate is None else float(rate),
        links,
        tuple(cubes),
    ), []


def _contradictions(
    item: dict[str, Any], uid: int | None, calibration: Calibration, names: set[str] | None
) -> Iterator[str]:
    """What the keys of a cube say against each other; names: of the links, None if not all are
    known."""
    link, index = item.get("link"), item.get("index")
    if link is not None and names is not None and link not in names:
        yield f".link: found {link!r}, allowed: one of the links {', '.join(sorted(names))}"
    if uid is None and (link is None or index is None):
        yield ": found neither uid nor both link and index, which say where the cube is; add one of them"
    if uid is not None and index is not None:
        yield ": found both uid and index; keep one, they might contradict each other"
    if item["layout"] != calibration.layout.name:
        yield (
            f".layout: found {item['layout']!r}, but the calibration {item['calibration']!r} "
            f"is for the layout {calibration.layout.name!r}"
        )
    if calibration.uid is not None and uid != calibration.uid:
        yield (
            f".calibration: {item['calibration']!r} was made for the cube with uid {calibration.uid:#x}, "
            f"this cube's uid is {'not given' if uid is None else hex(uid)}"
        )


def _uid(value: int | str | None) -> int | None:
    return int(value, 16) if isinstance(value, str) else value


def _twice(where: str, what: str, values: list[str]) -> Iterator[str]:
    for value, count in Counter(values).items():
        if count > 1:
            yield f"{where}: the {what} {value} is there {'twice' * (count == 2) or f'{count} times'}; keep one"
