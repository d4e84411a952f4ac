"""The topics of single cubes, `cubes/<name>/stress` and `cubes/<name>/wrench`.

They are sent only while somebody listens.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from geometry_msgs.msg import WrenchStamped
from numpy.typing import NDArray
from rclpy.lifecycle import LifecycleNode
from std_msgs.msg import Header

from ...config.skin import Skin
from ...core.reconstructor import Reconstructor
from ...core.rows import StressRows
from ...core.status import INVALID
from ...core.tensor import contact_wrench
from ...msg import StressTensorStamped
from ..messages import tensor_message, to_time, wrench_message

ALL_AT_ONCE = 64
"""Skins up to so many cubes announce all their topics; in larger ones a topic is announced once
somebody asks."""
COVARIANCES_KEPT = 4096
DEPTH = 10


class CubeTopics:
    """Publishers of single cubes. side: of the face that wrenches refer to, m, None for each cube's
    own."""

    def __init__(
        self, node: LifecycleNode, skin: Skin, reconstructor: Reconstructor, side: float | None
    ) -> None:
        self._node, self._skin, self._reconstructor = node, skin, reconstructor
        self._sides = np.array([side or 2 * cube.calibration.half_side for cube in skin.cubes])
        self._covariances: dict[tuple[int, int], NDArray[np.float64]] = {}
        self._tensors: dict[int, Any] = {}
        self._wrenches: dict[int, Any] = {}
        self._wanted: dict[str, tuple[type, dict[int, Any], int]] = {}
        for number, cube in enumerate(skin.cubes):
            for kind, publishers, what in (
                (StressTensorStamped, self._tensors, "stress"),
                (WrenchStamped, self._wrenches, "wrench"),
            ):
                name = node.resolve_topic_name(f"cubes/{cube.name}/{what}")
                self._wanted[name] = kind, publishers, number
        if len(skin.cubes) <= ALL_AT_ONCE:
            self._announce(set(self._wanted))
        self._listened: tuple[list[int], list[int]] = ([], [])

    def find_listeners(self) -> None:
        """Look up, from time to time, which topics anybody listens to."""
        if self._wanted:
            self._announce(
                {name for name, _ in self._node.get_topic_names_and_types()} & self._wanted.keys()
            )
        self._listened = (_heard(self._tensors), _heard(self._wrenches))

    def publish(self, rows: StressRows) -> None:
        """Send the rows of cubes that somebody listens to; wrenches of valid ones only."""
        tensors, wrenches = self._listened
        if wrenches:
            chosen = np.flatnonzero(np.isin(rows.cube, wrenches) & (rows.status & INVALID == 0))
            cubes = rows.cube[chosen].tolist()
            forces, torques = contact_wrench(
                rows.stress[chosen], rows.gradient[chosen], self._sides[cubes][:, None]
            )
            for row, cube, force, torque in zip(
                chosen.tolist(), cubes, forces, torques, strict=True
            ):
                self._wrenches[cube].publish(
                    wrench_message(self._header(rows, row, cube), force, torque)
                )
        if tensors:
            for row in np.flatnonzero(np.isin(rows.cube, tensors)).tolist():
                cube = int(rows.cube[row])
                covariance = self._covariance(cube, int(rows.left_out[row]))
                header = self._header(rows, row, cube)
                self._tensors[cube].publish(tensor_message(header, rows, row, covariance))

    def close(self) -> None:
        for publisher in (*self._tensors.values(), *self._wrenches.values()):
            self._node.destroy_publisher(publisher)

    def _announce(self, names: set[str]) -> None:
        for name in sorted(names):
            kind, publishers, number = self._wanted.pop(name)
            publishers[number] = self._node.create_publisher(kind, name, DEPTH)

    def _header(self, rows: StressRows, row: int, cube: int) -> Header:
        stamp = to_time(int(rows.stamp_ns[row]))
        return Header(stamp=stamp, frame_id=self._skin.frame(self._skin.cubes[cube]))

    def _covariance(self, cube: int, left_out: int) -> NDArray[np.float64]:
        key = cube, left_out
        if key not in self._covariances:
            if len(self._covariances) >= COVARIANCES_KEPT:
                self._covariances.clear()
            self._covariances[key] = self._reconstructor.covariance(cube, left_out)
        return self._covariances[key]


def _heard(publishers: dict[int, Any]) -> list[int]:
    return [
        number for number, publisher in publishers.items() if publisher.get_subscription_count()
    ]
