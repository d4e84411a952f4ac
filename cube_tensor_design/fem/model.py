# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Model files of `./cube fem`: geometry, material and layout of one cube in its body.

A model is a YAML file in SI units. Every key may be left out; `config/fem/planar_slab.yaml` lists
all keys with their defaults, and docs/build.md describes them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from cube_tensor_driver.config.calibration import (
    find_calibration,
    find_named_layout,
    find_shipped_calibration,
    read_calibration,
)
from cube_tensor_driver.config.package_data import find_shipped
from cube_tensor_driver.config.schema import (
    TEXT,
    Schema,
    make_list_schema,
    make_mapping_schema,
    make_number_schema,
)
from cube_tensor_driver.config.yaml import read_yaml
from cube_tensor_driver.core.calibration import Calibration
from cube_tensor_driver.core.errors import (
    ConfigError,
    CubeError,
    ElasticError,
    LayoutError,
)
from cube_tensor_driver.core.layout import Layout
from cube_tensor_driver.core.symmetry import (
    choose_default_modes,
    find_largest_symmetry,
    find_structure,
)

from .body import Body, strip_layout

DEFAULT_LAYOUT = "planar"
"""Name of the layout (places of the pads) of a model file that names none."""

_NUMBER = make_number_schema("a number in SI units")
"""Schema of any quantity."""
_POSITIVE = make_number_schema("a positive number in SI units", exclusiveMinimum=0)
"""Schema of a length, modulus or density."""
_POISSON = make_number_schema(
    "a number in [0, 0.5), for rubber 0.48 to 0.4999",
    minimum=0,
    exclusiveMaximum=0.5,
)
"""Schema of Poisson's ratio. The elements do not lock close to 0.5, but at 0.5 pressure is no
longer a function of strain."""
_MODES = make_list_schema(TEXT, "names of modes") | {
    "minItems": 0,
    "description": "a list of modes",
}
"""Schema of the modes that the calibration takes as zero."""
_RIGID = {"type": "boolean", "description": "true or false"}
"""Schema of the choice whether the cube is rigid."""
_SYMMETRY = {
    "enum": ["full", "slab", "mirrors", "none"],
    "description": "full, slab, mirrors or none",
}
"""Schema of the symmetry group of the response."""
_PLANE = {"enum": ["strain", "stress"], "description": "strain or stress"}
"""Schema of the assumption of plane models."""
_MATERIAL = {"young": _POSITIVE, "poisson": _POISSON, "expansion": _NUMBER, "density": _POSITIVE}
"""Keys of an elastic material and their schemas."""
_BODY = {"width": _POSITIVE, "depth": _POSITIVE, "height": _POSITIVE, **_MATERIAL}
"""Keys of the box of elastomer and their schemas."""
_CUBE = {"side": _POSITIVE, "x": _NUMBER, "z": _NUMBER, **_MATERIAL, "rigid": _RIGID}
"""Keys of the cube in the box and their schemas."""
_PADS = {"width": _NUMBER, "centre": _NUMBER}
"""Keys of the pads and their schemas, both lengths in m."""
_SCHEMA = Schema(
    make_mapping_schema(
        (),
        {
            "layout": TEXT,
            "symmetry": _SYMMETRY,
            "plane": _PLANE,
            "neglect": _MODES,
            "calibration": TEXT,
            "body": make_mapping_schema((), _BODY),
            "cube": make_mapping_schema((), _CUBE),
            "pads": make_mapping_schema((), _PADS),
        },
    )
)
"""Schema of a model file of `./cube fem`."""


@dataclass(frozen=True, eq=False)
class Model:
    """Content of a model file of `./cube fem`.

    Attributes:
        body: Box of elastomer with the cube in it.
        layout: Pads of the cube.
        symmetry: Symmetry group whose coefficients describe the response.
        neglect: Names of modes (linear stress fields) that the calibration takes as zero.
        calibration: Calibration to which a computed response to weight is added; None: the
            shipped one of the layout, if there is one.
    """

    body: Body
    layout: Layout
    symmetry: str
    neglect: tuple[str, ...]
    calibration: Calibration | None


def read_model(name: str | None) -> Model:
    """Read and check a model file; without a name, take the default of every key.

    Raises:
        ConfigError: There is no such model, a key is unknown or a value is not allowed. The
            message is one line with the file and the key.
    """
    if name is None:
        return _build_model({}, Path())
    path = find_shipped(
        "fem/*.yaml",
        name,
        Path(),
        "a model file, or one of the shipped models",
    )
    content = read_yaml(path) or {}
    for _, mistake in _SCHEMA.find_mistakes(content):
        raise ConfigError(f"{path}: {mistake}")
    # The schema has checked the types of all values.
    data = cast("Mapping[str, Any]", content)
    try:
        return _build_model(data, path.parent)
    except CubeError as error:
        raise ConfigError(f"{path}: {error}") from None


def _build_model(data: Mapping[str, Any], folder: Path) -> Model:
    """Build a model from the checked content of its file; other files that it names are looked up
    in `folder`."""
    name = str(data.get("layout", DEFAULT_LAYOUT))
    is_file = name.endswith((".yaml", ".yml"))
    layout = find_named_layout(str(folder / name) if is_file else name)
    if "plane" in data and not layout.planar:
        raise ElasticError(
            f"plane is {data['plane']!r}, which is for layouts in a plane; "
            f"{layout.name!r} is computed in space, so leave the key out"
        )

    body = _build_body(data)
    layout = _place_pads(layout, data.get("pads", {}), body.side / 2)
    symmetry = data.get("symmetry") or find_largest_symmetry(layout)
    neglect = tuple(data.get("neglect", ()))
    # Both calls raise an error for a name that does not fit the layout, before any work.
    find_structure(layout, symmetry)
    choose_default_modes(layout).find_indices(neglect)
    calibration = find_shipped_calibration(layout)
    if "calibration" in data:
        calibration = read_calibration(find_calibration(data["calibration"], folder))
        calibration.check(layout)
    return Model(body, layout, symmetry, neglect, calibration)


def _build_body(data: Mapping[str, Any]) -> Body:
    """Build the body from the keys `body` and `cube` of a model file; values that the file leaves
    out have the defaults of `Body`."""
    values = dict(data.get("body", {}))
    # A body without a depth is square seen from above.
    values.setdefault("depth", values.get("width", Body.depth))
    cube = dict(data.get("cube", {}))
    if cube.pop("rigid", False):
        cube["young"] = math.inf
    for key, value in cube.items():
        is_material = f"cube_{key}" in Body.__annotations__
        values[f"cube_{key}" if is_material else key] = value
    if "plane" in data:
        values["plane"] = data["plane"]
    return Body(**values)


def _place_pads(
    layout: Layout,
    pads: Mapping[str, float],
    half_side: float,
) -> Layout:
    """Return the layout with the pads' width and centre distance (m) that the model asks for."""
    if not pads:
        return layout
    width = pads.get("width", layout.pad_size * half_side)
    # Without rounding, 0.0008 / 0.002 is not quite 0.4, and pads of the same size as those of a
    # built-in layout would make another layout.
    size = round(width / half_side, 12)
    try:
        if "centre" not in pads:
            return Layout(layout.name, layout.positions, layout.normals, size)
        return strip_layout(
            layout,
            size,
            round(pads["centre"] / half_side, 12),
        )
    except LayoutError as error:
        raise ElasticError(
            f"pads of {1e3 * width:g} mm: {error}, on a cube whose faces end at "
            f"{1e3 * half_side:g} mm from their centre; change pads.width or pads.centre"
        ) from None
