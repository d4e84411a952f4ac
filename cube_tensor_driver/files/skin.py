"""Skin files: which links there are, which cubes they carry, where the cubes sit, how they are calibrated.

docs/config.md describes the keys. A file is checked whole before anything starts: `ConfigError` gives file, key, what
was found and what is allowed.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jsonschema

from ..core.calibration import Calibration
from ..core.errors import ConfigError
from .calibration import find_calibration, read_calibration
from .yaml import read_yaml

_NAME = {
    "type": "string",
    "pattern": "^[A-Za-z][A-Za-z0-9_]*$",
    "description": "a name of letters, digits and _, a letter first",
}
_FRAME = {
    "type": "string",
    "pattern": "^[A-Za-z][A-Za-z0-9_/]*$",
    "description": "a frame id of letters, digits, _ and /",
}
_TEXT = {"type": "string", "minLength": 1, "description": "a text that is not empty"}
_TRIPLE = {
    "type": "array",
    "items": {"type": "number", "description": "a number"},
    "minItems": 3,
    "maxItems": 3,
    "description": "three numbers",
}
# An integer, or a text such as 0x1f because uids are hexadecimal on labels.
_UID = {
    "anyOf": [
        {"type": "integer", "minimum": 1, "maximum": 2**64 - 1},
        {"type": "string", "pattern": "^0x[0-9a-fA-F]{1,16}$"},
    ],
    "description": "a uid: 1 to 2^64 - 1, or hexadecimal as in 0x1f",
}


def _object(required: Iterable[str], properties: dict[str, Any]) -> dict[str, Any]:
    return {
        "type": "object",
        "required": list(required),
        "properties": properties,
        "additionalProperties": False,
        "description": "the keys " + ", ".join(properties),
    }


def _several(item: dict[str, Any], what: str) -> dict[str, Any]:
    return {"type": "array", "items": item, "minItems": 1, "description": f"a list of {what}, at least one"}


SCHEMA = _object(
    ("name", "parent_frame", "links", "cubes"),
    {
        "name": _NAME,
        "parent_frame": _FRAME,
        "rate": {
            "type": "number",
            "minimum": 0.1,
            "maximum": 10_000,
            "description": "samples per second, 0.1 to 10000",
        },
        "links": _several(
            _object(
                ("name", "port"),
                {
                    "name": _NAME,
                    "port": _TEXT,
                    "baud": {
                        "type": "integer",
                        "minimum": 1200,
                        "maximum": 20_000_000,
                        "description": "1200 to 20000000",
                    },
                    "hub_uid": _UID,
                },
            ),
            "links",
        ),
        "cubes": _several(
            _object(
                ("name", "pose", "layout", "calibration"),
                {
                    "name": _NAME,
                    "link": _NAME,
                    "index": {
                        "type": "integer",
                        "minimum": 0,
                        "maximum": 65535,
                        "description": "an integer from 0 to 65535",
                    },
                    "uid": _UID,
                    "pose": _object(("xyz", "rpy"), {"xyz": _TRIPLE, "rpy": _TRIPLE}),
                    "layout": _TEXT,
                    "calibration": _TEXT,
                },
            ),
            "cubes",
        ),
    },
)
_VALIDATOR = jsonschema.Draft7Validator(SCHEMA)


@dataclass(frozen=True)
class SkinLink:
    """A link of a skin: name, port (device path, pattern or socket://host:port), baud, uid of the hub or None."""

    name: str
    port: str
    baud: int
    hub_uid: int | None


@dataclass(frozen=True)
class SkinCube:
    """A cube of a skin.

    Found on the wire by uid, or by link and index. xyz in m and rpy in rad (fixed axes x, y, z: REP 103) are its pose
    in the skin's parent frame.
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
    """All cubes of one configuration file. rate: samples per second to ask of the hubs, None to leave it to them."""

    name: str
    parent_frame: str
    rate: float | None
    links: tuple[SkinLink, ...]
    cubes: tuple[SkinCube, ...]

    @property
    def n_pads(self) -> int:
        """Pads of the widest cube: the width of a row."""
        return max(cube.calibration.layout.n_pads for cube in self.cubes)

    def frame(self, cube: SkinCube) -> str:
        """Frame id of a cube."""
        return f"{self.name}_{cube.name}"


def read_skin(path: Path) -> Skin:
    """Read and check a skin file. ConfigError names file, key, what was found and what is allowed."""
    data = read_yaml(path)
    _check_schema(data, path)
    links = tuple(
        SkinLink(link["name"], link["port"], link.get("baud", 921_600), _uid(link.get("hub_uid")))
        for link in data["links"]
    )
    _check_unique(((link.name,) for link in links), path, "links", "name")
    calibrations: dict[str, Calibration] = {}
    cubes = []
    for number, item in enumerate(data["cubes"]):
        key = f"cubes[{number}]"
        name = item["calibration"]
        if name not in calibrations:
            try:
                calibrations[name] = read_calibration(find_calibration(name, path.parent))
            except ConfigError as error:
                raise ConfigError(f"{path}: {key}.calibration: {error}") from None
        cubes.append(_cube(item, calibrations[name], links, f"{path}: {key}"))
    _check_unique(((cube.name,) for cube in cubes), path, "cubes", "name")
    _check_unique(((cube.uid,) for cube in cubes if cube.uid is not None), path, "cubes", "uid")
    _check_unique(
        ((cube.link, cube.index) for cube in cubes if cube.index is not None), path, "cubes", "link and index"
    )
    rate = data.get("rate")
    if rate is not None and not math.isfinite(rate):
        raise ConfigError(f"{path}: rate: found {rate}, allowed: {SCHEMA['properties']['rate']['description']}")
    return Skin(data["name"], data["parent_frame"], None if rate is None else float(rate), links, tuple(cubes))


def _cube(item: dict[str, Any], calibration: Calibration, links: tuple[SkinLink, ...], place: str) -> SkinCube:
    names = [link.name for link in links]
    link, index, uid = item.get("link"), item.get("index"), _uid(item.get("uid"))
    if link is not None and link not in names:
        raise ConfigError(f"{place}.link: found {link!r}, allowed: one of the links {', '.join(names)}")
    if uid is None and (link is None or index is None):
        raise ConfigError(
            f"{place}: found neither uid nor both link and index, which say where the cube is; add one of them"
        )
    if uid is not None and index is not None:
        raise ConfigError(f"{place}: found both uid and index; keep one, they might contradict each other")
    if item["layout"] != calibration.layout.name:
        raise ConfigError(
            f"{place}.layout: found {item['layout']!r}, but the calibration {item['calibration']!r} "
            f"is for the layout {calibration.layout.name!r}"
        )
    if calibration.uid is not None and uid != calibration.uid:
        raise ConfigError(
            f"{place}.calibration: {item['calibration']!r} was made for the cube with uid {calibration.uid:#x}, "
            f"this cube's uid is {'not given' if uid is None else hex(uid)}"
        )
    xyz, rpy = (tuple(float(value) for value in item["pose"][part]) for part in ("xyz", "rpy"))
    if not all(map(math.isfinite, (*xyz, *rpy))):
        raise ConfigError(f"{place}.pose: found {item['pose']}, allowed: finite numbers")
    return SkinCube(item["name"], link, index, uid, xyz, rpy, calibration)  # type: ignore[arg-type]


def _uid(value: int | str | None) -> int | None:
    return int(value, 16) if isinstance(value, str) else value


def _check_schema(data: Any, path: Path) -> None:
    error = jsonschema.exceptions.best_match(_VALIDATOR.iter_errors(data))
    if error is None:
        return
    key = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in error.absolute_path).lstrip(".")
    schema = error.schema
    if error.validator == "additionalProperties":
        unknown = ", ".join(repr(name) for name in error.instance if name not in schema["properties"])
        raise ConfigError(
            f"{path}: {key or 'top level'}: unknown key {unknown}, allowed: {', '.join(schema['properties'])}"
        )
    if error.validator == "required":
        missing = ", ".join(repr(name) for name in schema["required"] if name not in error.instance)
        raise ConfigError(f"{path}: {key or 'top level'}: the key {missing} is missing")
    found = repr(error.instance)
    found = found if len(found) <= 60 else found[:57] + "..."
    raise ConfigError(
        f"{path}: {key or 'top level'}: found {found}, allowed: {schema.get('description', error.message)}"
    )


def _check_unique(values: Iterable[tuple[Any, ...]], path: Path, where: str, what: str) -> None:
    seen: set[tuple[Any, ...]] = set()
    for value in values:
        if value in seen:
            shown = ", ".join(hex(part) if what == "uid" else repr(part) for part in value)
            raise ConfigError(f"{path}: {where}: the {what} {shown} is there twice; it must be unique")
        seen.add(value)
