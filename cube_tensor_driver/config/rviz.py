# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The configuration file of RViz, adapted to the frame and the size of a skin."""

from __future__ import annotations

from typing import TypedDict, cast

import numpy as np

from .package_data import find_package_data
from .skin import Skin
from .yaml import read_yaml

CAMERA_DISTANCE = 1.5
"""Distance of RViz's camera from the skin, divided by the diagonal of the box around the skin and
its legend."""

MIN_CAMERA_DISTANCE_M = 0.05
"""Minimum distance of RViz's camera from the skin, in m. It is needed for a skin of a single cube:
the box around the centres of its cubes has the diagonal 0."""

LEGEND_HEIGHT = 0.8
"""Height (along y) of the legend that the node `markers` draws beside the skin, divided by the
width of the skin (along x)."""


class _Display(TypedDict):
    """Those keys of a display in RViz's file that are read or changed here."""

    Name: str
    Topic: dict[str, str]


_Camera = TypedDict("_Camera", {"Focal Point": dict[str, float], "Distance": float})
"""Those keys of the camera in RViz's file that are changed here."""
_Manager = TypedDict(
    "_Manager",
    {
        "Global Options": dict[str, str],
        "Displays": list[_Display],
        "Views": dict[str, _Camera],
    },
)
"""Those parts of RViz's file that are changed here."""


def make_rviz_view(skin: Skin) -> dict[str, object]:
    """Return the content of rviz/skin.rviz, adapted to a skin, as plain values for `write_yaml`.

    The fixed frame is the parent frame of the skin, the camera shows the whole skin and its legend,
    and the wrench of the cube closest to the centre is displayed.
    """
    positions = np.array([cube.xyz for cube in skin.cubes])
    low = positions.min(axis=0)
    high = positions.max(axis=0)
    # RViz shows the wrench of one cube only; the central one is the most likely to be touched.
    centre = (low + high) / 2
    distance = np.linalg.norm(positions - centre, axis=1)
    central_cube = skin.cubes[int(distance.argmin())]

    # The box around the skin is extended in the direction -y, where the node `markers` draws the
    # legend.
    width = high[0] - low[0]
    low[1] -= LEGEND_HEIGHT * width
    diagonal = float(np.linalg.norm(high - low))
    focal_point = (low + high) / 2

    content = read_yaml(find_package_data() / "rviz" / "skin.rviz")
    view = cast("dict[str, object]", content)
    manager = cast(_Manager, view["Visualization Manager"])
    manager["Global Options"]["Fixed Frame"] = skin.parent_frame
    displays = {display["Name"]: display for display in manager["Displays"]}
    displays["Wrench"]["Topic"]["Value"] = f"cubes/{central_cube.name}/wrench"
    camera = manager["Views"]["Current"]
    camera["Focal Point"] = dict(zip("XYZ", focal_point.tolist(), strict=True))
    camera["Distance"] = max(MIN_CAMERA_DISTANCE_M, CAMERA_DISTANCE * diagonal)
    return view
