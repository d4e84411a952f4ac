# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Skin files: links (connections to hubs) of a skin, and its cubes with poses and calibrations.

docs/config.md describes the keys.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from glob import has_magic
from pathlib import Path
from typing import TypedDict, cast

import numpy as np

from ..core.calibration import Calibration
from ..core.defaults import POISSONS_RATIO
from ..core.errors import ConfigError, CubeError
from ..core.poses import CubePoses
from ..core.tensor import rotation_from_rpy
from .calibration import find_calibration, read_calibration
from .port import find_port_problem
from .schema import (
    NAME,
    TEXT,
    TRIPLE,
    JsonSchema,
    Schema,
    make_integer_schema,
    make_list_schema,
    make_mapping_schema,
    make_number_schema,
)
from .yaml import read_yaml

BAUD = 921_600
"""Default baud rate of a serial port, in bits per second, if the skin file states none."""

_FRAME: JsonSchema = {
    "type": "string",
    "pattern": r"^[A-Za-z][A-Za-z0-9_]*(/[A-Za-z0-9_]+)*\Z",
    "description": "a frame id of letters, digits, _ and /, a letter first",
}
"""Schema of a frame id of TF."""
_UID: JsonSchema = {
    "anyOf": [
        {
            "type": "integer",
            "minimum": 1,
            "maximum": 2**64 - 1,
        },
        {"type": "string", "pattern": r"^0x(?!0+\Z)[0-9a-fA-F]{1,16}\Z"},
    ],
    "description": "a uid: 1 to 2^64 - 1, or hexadecimal as in 0x1f",
}
"""Schema of a uid (unique number) of a cube or hub. A text such as 0x1f is accepted, too, because
the labels on cubes show the uid in hexadecimal."""
_INDEX = make_integer_schema(0, 65535, "an integer from 0 to 65535")
"""Schema of the index of a cube on its hub, which has 16 bits in the protocol."""
_BAUD = make_integer_schema(1200, 20_000_000, "1200 to 20000000")
"""Schema of a baud rate, in bits per second."""
_LINK = make_mapping_schema(
    ("name", "port"),
    {
        "name": NAME,
        "port": TEXT,
        "baud": _BAUD,
        "hub_uid": _UID,
    },
)
"""Schema of a link, the connection to one hub."""
_CUBE_ADDRESS: JsonSchema = {
    "oneOf": [{"required": ["uid"]}, {"required": ["index"]}],
    "dependencies": {"index": ["link"]},
    "description": "either a uid, or a link and an index",
}
"""Schema of the keys by which a cube is found: its uid, or its link and its index on the hub. A uid
and an index together are refused, because they might contradict each other after the cube is
replaced. With a uid, the link may be left out."""
_CUBE = make_mapping_schema(
    ("name", "pose", "layout", "calibration"),
    {
        "name": NAME,
        "link": NAME,
        "index": _INDEX,
        "uid": _UID,
        "pose": make_mapping_schema(("xyz", "rpy"), {"xyz": TRIPLE, "rpy": TRIPLE}),
        "layout": TEXT,
        "calibration": TEXT,
    },
) | {"allOf": [_CUBE_ADDRESS]}
"""Schema of a cube."""
_ELASTOMER = make_mapping_schema(
    ("depth", "thickness"),
    {
        "depth": make_number_schema("m, greater than 0", exclusiveMinimum=0),
        "thickness": make_number_schema("m, 0 or greater (0: a half space)", minimum=0),
        "poisson": make_number_schema("0 to 0.5", minimum=0, maximum=0.5),
    },
)
"""Schema of the elastomer in which the cubes are embedded: depth of their centres, thickness of the
layer, and Poisson's ratio."""
_SCHEMA = Schema(
    make_mapping_schema(
        ("name", "parent_frame", "links", "cubes"),
        {
            "name": NAME,
            "parent_frame": _FRAME,
            "rate": make_number_schema(
                "samples per second, 0.1 to 10000",
                minimum=0.1,
                maximum=10_000,
            ),
            "elastomer": _ELASTOMER,
            "links": make_list_schema(_LINK, "links"),
            "cubes": make_list_schema(_CUBE, "cubes"),
        },
    )
)
"""Schema of a skin file."""


class LinkEntry(TypedDict, total=False):
    """Keys of a link in a skin file, see `_LINK`."""

    name: str
    port: str
    baud: int
    hub_uid: int | str


class PoseEntry(TypedDict):
    """Keys of the pose of a cube in a skin file."""

    xyz: list[float]
    rpy: list[float]


class CubeEntry(TypedDict, total=False):
    """Keys of a cube in a skin file, see `_CUBE`."""

    name: str
    link: str
    index: int
    uid: int | str
    pose: PoseEntry
    layout: str
    calibration: str


class SkinContent(TypedDict, total=False):
    """Content of a skin file, see `_SCHEMA`."""

    name: str
    parent_frame: str
    rate: float
    elastomer: dict[str, float]
    links: list[LinkEntry]
    cubes: list[CubeEntry]


@dataclass(frozen=True)
class SkinLink:
    """A link of a skin: the connection to one hub, which reads some of the cubes.

    Attributes:
        name: Name of the link.
        port: Device path, pattern of device paths such as /dev/ttyACM*, or socket://host:port.
        baud: Baud rate of a serial port, in bits per second.
        hub_uid: Uid (unique number) of the hub that must answer at the port; None: any hub may.
    """

    name: str
    port: str
    baud: int
    hub_uid: int | None


@dataclass(frozen=True)
class SkinCube:
    """A cube of a skin, identified either by its uid or by its link and its index in the hub.

    Attributes:
        name: Name of the cube.
        link: Name of the link of the cube; None: the cube is searched by its uid on all links.
        index: Index of the cube among the cubes of its hub; None: the uid identifies the cube.
        uid: Uid (unique number) of the cube; None: `link` and `index` identify the cube.
        xyz: Position of the centre of the cube in the parent frame of the skin, in m.
        rpy: Rotations about the fixed axes x, y and z of the parent frame (REP 103), in rad.
        calibration: Calibration of the cube.
    """

    name: str
    link: str | None
    index: int | None
    uid: int | None
    xyz: tuple[float, float, float]
    rpy: tuple[float, float, float]
    calibration: Calibration


@dataclass(frozen=True)
class Elastomer:
    """The layer of elastomer on rigid ground in which the cubes of a skin are embedded.

    Attributes:
        depth: Distance from the centres of the cubes to the surface, in m.
        thickness: Thickness of the layer in m; infinite for a half space.
        poisson: Poisson's ratio.
    """

    depth: float
    thickness: float
    poisson: float = POISSONS_RATIO


@dataclass(frozen=True, repr=False)
class Skin:
    """The content of a skin file.

    Attributes:
        name: Name of the skin.
        parent_frame: Frame id of the frame in which the poses of the cubes are given.
        rate: Sampling rate of each cube, in Hz, that the driver asks of the hubs; None: the hubs
            choose the rate.
        links: The links, in the order of the file.
        cubes: The cubes, in the order of the file. Index 0 in rows and messages is the first one.
        frame_prefix: Text in front of the frame ids of the cubes. `parent_frame` contains it.
        elastomer: The elastomer around the cubes; None: the file does not describe it.
    """

    name: str
    parent_frame: str
    rate: float | None
    links: tuple[SkinLink, ...]
    cubes: tuple[SkinCube, ...]
    frame_prefix: str = ""
    elastomer: Elastomer | None = None

    def __repr__(self) -> str:
        layouts = ", ".join(sorted({one.layout.name for one in self.calibrations}))
        rate = "" if self.rate is None else f", {self.rate:g} Hz"
        sizes = f"{len(self.cubes)} cubes ({layouts}) on {len(self.links)} links"
        return f"<Skin {self.name!r}: {sizes}{rate}>"

    @property
    def names(self) -> tuple[str, ...]:
        """Name of each cube, in the order of `cubes`."""
        return tuple(cube.name for cube in self.cubes)

    @property
    def calibrations(self) -> tuple[Calibration, ...]:
        """Calibration of each cube. Cubes with the same file share one object."""
        return tuple(cube.calibration for cube in self.cubes)

    @property
    def poses(self) -> CubePoses:
        """Positions, rotations and half sides of the cubes, in m, in the skin's parent frame."""
        half_sides = [calibration.half_side for calibration in self.calibrations]
        return CubePoses(
            position=np.array([cube.xyz for cube in self.cubes]),
            rotation=np.array([rotation_from_rpy(*cube.rpy) for cube in self.cubes]),
            half_side=np.array(half_sides),
        )

    @property
    def n_pads(self) -> int:
        """Largest number of pads of a cube, which is the number of columns of frequency arrays."""
        return max(calibration.layout.n_pads for calibration in self.calibrations)

    def make_frame_id(self, cube: SkinCube) -> str:
        """Return the frame id of a cube: the frame prefix, and the names of skin and cube, joined
        by an underscore."""
        return f"{self.frame_prefix}{self.name}_{cube.name}"


def read_skin(path: str | Path, frame_prefix: str = "") -> Skin:
    """Read a skin file (YAML) with the calibrations that it names, and check both.

    docs/config.md describes the keys. No port is opened.

    Args:
        path: The skin file. A calibration that it names is searched among those of the package
            first, then as a file relative to the folder of the skin file.
        frame_prefix: Text in front of all frame ids, such as `left_`, by which the frames of two
            skins with the same file differ.

    Returns:
        The links and cubes in the order of the file.

    Raises:
        ConfigError: The file cannot be read or has mistakes. The message names the file, the key of
            the first mistake, the value found there, the allowed values, and the number of further
            mistakes. `check_skin` returns all of them. Or a frame id cannot begin with the prefix.
    """
    path = Path(path)
    skin, mistakes = check_skin(path)
    if skin is not None:
        parent_frame = frame_prefix + skin.parent_frame
        for _, mistake in Schema(_FRAME).find_mistakes(parent_frame):
            raise ConfigError(f"frame_prefix {frame_prefix!r}: {mistake.partition(': ')[2]}")
        return replace(
            skin,
            parent_frame=parent_frame,
            frame_prefix=frame_prefix,
        )
    others = len(mistakes) - 1
    more = f" (and {others} more: ./cube config check {path})" if others else ""
    raise ConfigError(f"{path}: {mistakes[0]}{more}")


def as_skin(skin: Skin | str | Path) -> Skin:
    """Return a skin as it is, or read the skin file with this path."""
    return read_skin(skin) if isinstance(skin, (str, Path)) else skin


def check_skin(path: Path) -> tuple[Skin | None, list[str]]:
    """Read a skin file and report all its mistakes.

    Returns:
        The skin and an empty list, or None and the mistakes (see `check_skin_data`).

    Raises:
        ConfigError: The file cannot be read or is not YAML.
    """
    return check_skin_data(read_yaml(path), path.parent)


def check_skin_data(
    content: object,
    folder: Path,
) -> tuple[Skin | None, list[str]]:
    """Check the content of a skin file.

    Args:
        content: The content of the file, as plain values (mappings, lists, numbers, texts).
        folder: The folder in which the file is or will be. Calibrations are named relative to it.

    Returns:
        The skin and an empty list, or None and the mistakes, one line each. If the JSON schema
        finds mistakes, only these are returned; otherwise those that concern several keys or files.
    """
    mistakes = [line for _, line in _SCHEMA.find_mistakes(content)]
    if mistakes:
        return None, mistakes
    # The schema has checked the types of all values.
    data = cast("SkinContent", content)
    links = tuple(
        SkinLink(
            item["name"],
            item["port"],
            item.get("baud", BAUD),
            _parse_uid(item.get("hub_uid")),
        )
        for item in data["links"]
    )
    elastomer = None
    if "elastomer" in data:
        numbers = {key: float(value) for key, value in data["elastomer"].items()}
        numbers["thickness"] = numbers["thickness"] or np.inf
        elastomer = Elastomer(**numbers)
        if elastomer.depth >= elastomer.thickness:
            mistakes.append(
                f"elastomer.depth: {elastomer.depth} m; it must be below the thickness, "
                f"{elastomer.thickness} m"
            )
    cubes, cube_mistakes = _read_cubes(
        data["cubes"],
        folder,
        [link.name for link in links],
    )
    mistakes += [
        *_find_link_mistakes(links),
        *cube_mistakes,
        *_find_cube_mistakes(cubes),
        *_find_pad_mistakes(links, cubes),
    ]
    if mistakes:
        return None, mistakes
    # YAML reads a rate without a decimal point as an integer.
    rate = None if data.get("rate") is None else float(data["rate"])
    skin = Skin(
        data["name"],
        data["parent_frame"],
        rate,
        links,
        cubes,
        elastomer=elastomer,
    )
    return skin, []


def _read_cubes(
    items: list[CubeEntry],
    folder: Path,
    links: list[str],
) -> tuple[tuple[SkinCube, ...], list[str]]:
    """Make cubes from their entries in a skin file, and read each calibration file only once.

    Args:
        items: The entry of each cube in the skin file: its keys and values.
        folder: The folder of the skin file, in which calibration files are searched.
        links: Names of all links of the file.

    Returns:
        The cubes whose calibration could be read, and the mistakes, one line each.
    """
    cubes: list[SkinCube] = []
    mistakes: list[str] = []
    # A calibration that cannot be read is None. It is reported once, for its first cube.
    calibrations: dict[str, Calibration | None] = {}
    for number, item in enumerate(items):
        name = item["calibration"]
        if name not in calibrations:
            calibrations[name] = None
            try:
                calibrations[name] = read_calibration(find_calibration(name, folder))
            except CubeError as error:
                mistakes.append(f"cubes[{number}].calibration: {error}")
        calibration = calibrations[name]
        if calibration is None:
            continue
        cube = SkinCube(
            name=item["name"],
            link=item.get("link"),
            index=item.get("index"),
            uid=_parse_uid(item.get("uid")),
            xyz=_to_triple(item["pose"]["xyz"]),
            rpy=_to_triple(item["pose"]["rpy"]),
            calibration=calibration,
        )
        cubes.append(cube)
        for line in _find_contradictions(cube, item, links):
            mistakes.append(f"cubes[{number}].{line}")
    return tuple(cubes), mistakes


def _find_contradictions(
    cube: SkinCube,
    item: CubeEntry,
    links: list[str],
) -> Iterator[str]:
    """Yield a mistake for each key of a cube that contradicts a link or the calibration.

    Args:
        cube: The cube.
        item: The entry of the cube in the skin file.
        links: Names of all links of the file.
    """
    if cube.link is not None and cube.link not in links:
        allowed = ", ".join(sorted(links))
        yield f"link: found {cube.link!r}, allowed: one of the links {allowed}"
    calibration = cube.calibration
    if item["layout"] != calibration.layout.name:
        yield (
            f"layout: found {item['layout']!r}, but the calibration {item['calibration']!r} "
            f"is for the layout {calibration.layout.name!r}"
        )
    # A calibration with a uid was measured on that cube. A computed one has none and is valid
    # for all cubes of its layout.
    if calibration.uid not in (None, cube.uid):
        found = "not given" if cube.uid is None else hex(cube.uid)
        yield (
            f"calibration: {item['calibration']!r} was made for the cube with uid "
            f"{calibration.uid:#x}, this cube's uid is {found}"
        )


def _find_link_mistakes(links: tuple[SkinLink, ...]) -> Iterator[str]:
    for link in links:
        problem = find_port_problem(link.port)
        if problem:
            yield f"links: port of {link.name}: {problem}"
    yield from _find_repeated(
        "links",
        "name",
        [repr(link.name) for link in links],
    )
    # The labels on hubs show the uid in hexadecimal, so the error message does, too.
    hub_uids = [hex(link.hub_uid) for link in links if link.hub_uid is not None]
    yield from _find_repeated("links", "hub_uid", hub_uids)
    # Two links may have the same pattern of device paths: the driver tries all devices that match.
    ports = [link.port for link in links]
    fixed_ports = [repr(port) for port in ports if "://" in port or not has_magic(port)]
    yield from _find_repeated("links", "port", fixed_ports)


def _find_cube_mistakes(cubes: tuple[SkinCube, ...]) -> Iterator[str]:
    yield from _find_repeated(
        "cubes",
        "name",
        [repr(cube.name) for cube in cubes],
    )
    uids = [hex(cube.uid) for cube in cubes if cube.uid is not None]
    yield from _find_repeated("cubes", "uid", uids)
    addresses = [f"{cube.link!r}, {cube.index}" for cube in cubes if cube.index is not None]
    yield from _find_repeated("cubes", "link and index", addresses)


def _find_pad_mistakes(
    links: tuple[SkinLink, ...],
    cubes: tuple[SkinCube, ...],
) -> Iterator[str]:
    """Yield a mistake for each link whose cubes differ in their number of pads.

    The cubes of a link must have equal numbers of pads, because a SAMPLE frame of the hubs'
    protocol has the same number of pads for each cube.
    """
    for link in links:
        pads = {cube.calibration.layout.n_pads for cube in cubes if cube.link == link.name}
        if len(pads) > 1:
            numbers = " and ".join(map(str, sorted(pads)))
            yield (
                f"cubes: those on the link {link.name!r} have {numbers} pads; "
                "a hub reads one number of pads"
            )


def _find_repeated(
    where: str,
    what: str,
    values: list[str],
) -> Iterator[str]:
    for value, count in Counter(values).items():
        if count > 1:
            times = "twice" if count == 2 else f"{count} times"
            yield f"{where}: the {what} {value} appears {times}; keep one"


def _parse_uid(value: int | str | None) -> int | None:
    return int(value, 16) if isinstance(value, str) else value


def _to_triple(values: list[float]) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z
