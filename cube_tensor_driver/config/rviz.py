"""The configuration of RViz for a skin."""

from __future__ import annotations

from typing import Any

import numpy as np

from .package_data import package_data
from .skin import Skin
from .yaml import read_yaml

DISTANCE, LEAST_DISTANCE = 1.5, 0.05
"""Of the camera: in diagonals of the skin with its legend, and at least, in m."""
LEGEND = 0.8
"""Height of the legend of `markers`, below the skin, in widths of the skin."""


def rviz_view(skin: Skin) -> dict[str, Any]:
    """rviz/skin.rviz as it fits this skin: its parent frame, a view of all of it, and the wrench of
    the cube in its middle."""
    view: dict[str, Any] = read_yaml(package_data() / "rviz" / "skin.rviz")
    manager = view["Visualization Manager"]
    position = np.array([cube.xyz for cube in skin.cubes])
    low, high = position.min(axis=0), position.max(axis=0)
    middle = skin.cubes[int(np.linalg.norm(position - (low + high) / 2, axis=1).argmin())]
    low[1] -= LEGEND * (high[0] - low[0])
    centre, size = (low + high) / 2, float(np.linalg.norm(high - low))
    manager["Global Options"]["Fixed Frame"] = skin.parent_frame
    displays = {display["Name"]: display for display in manager["Displays"]}
    displays["Wrench"]["Topic"]["Value"] = f"cubes/{middle.name}/wrench"
    camera = manager["Views"]["Current"]
    camera["Focal Point"] = dict(zip("XYZ", centre.tolist(), strict=True))
    camera["Distance"] = max(LEAST_DISTANCE, DISTANCE * size)
    return view
