"""The configuration of RViz for a skin."""

from __future__ import annotations

from typing import Any

import numpy as np

from .package_data import package_data
from .skin import Skin
from .yaml import read_yaml

CAMERA_DISTANCE = 1.5
"""Distance of the camera from the skin, in diagonals of the skin with its legend."""

MIN_CAMERA_DISTANCE_M = 0.05
"""Minimum distance of the camera, in m. A single cube has no diagonal."""

LEGEND_HEIGHT = 0.8
"""Height of the legend of `markers`, which is drawn below the skin, in widths of the skin."""


def rviz_view(skin: Skin) -> dict[str, Any]:
    """Return the content of rviz/skin.rviz, fitted to a skin.

    It has the skin's parent frame, a view of the whole skin, and the wrench of its central cube.
    """
    positions = np.array([cube.xyz for cube in skin.cubes])
    low, high = positions.min(axis=0), positions.max(axis=0)
    # The wrench of one cube is shown; the central one is most likely touched.
    to_centre = np.linalg.norm(positions - (low + high) / 2, axis=1)
    central_cube = skin.cubes[int(to_centre.argmin())]

    # The legend stands beside the skin, towards -y.
    low[1] -= LEGEND_HEIGHT * (high[0] - low[0])
    diagonal = float(np.linalg.norm(high - low))
    focal_point = (low + high) / 2

    view: dict[str, Any] = read_yaml(package_data() / "rviz" / "skin.rviz")
    manager = view["Visualization Manager"]
    manager["Global Options"]["Fixed Frame"] = skin.parent_frame
    displays = {display["Name"]: display for display in manager["Displays"]}
    displays["Wrench"]["Topic"]["Value"] = f"cubes/{central_cube.name}/wrench"
    camera = manager["Views"]["Current"]
    camera["Focal Point"] = dict(zip("XYZ", focal_point.tolist(), strict=True))
    camera["Distance"] = max(MIN_CAMERA_DISTANCE_M, CAMERA_DISTANCE * diagonal)
    return view
