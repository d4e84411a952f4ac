# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Reading of a SkinInfo message: elastomer of a skin, poses and calibrations of its cubes.

The message may be an object of rclpy or of the bag library.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from ..config.skin import Elastomer
from ..config.yaml import parse_yaml
from ..core.calibration import Calibration
from ..core.errors import CalibrationError, ConfigError, MessageError
from ..core.poses import CubePoses
from ..core.tensor import rotation_from_quaternion

if TYPE_CHECKING:
    from ..msg import SkinInfo


def read_cube_poses(info: SkinInfo) -> CubePoses:
    """Return the poses (in the skin's parent frame) and half sides of the cubes, in m.

    Args:
        info: SkinInfo message (names, poses and calibrations of the cubes).

    Raises:
        MessageError: The message has no cubes, or a position or half side is not finite, or a half
            side is not above 0.
    """
    if not info.cubes:
        raise MessageError(f"info of the skin {info.name}: it has no cubes")
    positions = []
    rotations = []
    for cube in info.cubes:
        position = cube.pose.position
        q = cube.pose.orientation
        rotation = rotation_from_quaternion([q.x, q.y, q.z, q.w])
        positions.append((position.x, position.y, position.z))
        rotations.append(rotation)
    half_sides = [cube.half_side for cube in info.cubes]
    poses = CubePoses(
        position=np.array(positions),
        rotation=np.array(rotations),
        half_side=np.array(half_sides),
    )
    # Invalid numbers are refused here, because otherwise an error would be raised only later, in a
    # solver, where its cause is hard to find.
    is_possible = np.isfinite(poses.position).all(axis=1)
    is_possible &= np.isfinite(poses.half_side)
    is_possible &= poses.half_side > 0
    for number in np.flatnonzero(~is_possible).tolist():
        raise MessageError(
            f"info of the skin {info.name}: cube {info.cubes[number].name} is at "
            f"{poses.position[number].tolist()} m with a half side of {poses.half_side[number]} m; "
            "it needs finite numbers and a size above 0"
        )
    return poses


def read_cube_calibrations(info: SkinInfo) -> tuple[Calibration, ...]:
    """Return the calibration of each cube. Cubes with the same calibration id share one object.

    Args:
        info: SkinInfo message (names, poses and calibrations of the cubes).

    Raises:
        MessageError: The calibration of a cube is missing in the message or is invalid.
    """
    texts = dict(zip(info.calibration_ids, info.calibrations, strict=False))
    used_ids = [cube.calibration_id for cube in info.cubes]
    calibrations: dict[str, Calibration] = {}
    try:
        # Most skins have one calibration for all cubes, so each text is parsed only once.
        for used_id in set(used_ids):
            calibrations[used_id] = _parse_calibration(used_id, texts[used_id])
    except (CalibrationError, ConfigError) as error:
        raise MessageError(f"info of the skin {info.name}: {error}") from None
    except KeyError as error:
        raise MessageError(
            f"info of the skin {info.name}: no calibration {error}, which a cube uses"
        ) from None
    return tuple(calibrations[used_id] for used_id in used_ids)


@lru_cache
def _parse_calibration(name: str, text: str) -> Calibration:
    """Return the calibration that a text describes.

    The result is cached, because many recordings of one skin contain the same text.

    Args:
        name: Id of the calibration, for error messages.
        text: The calibration as YAML.

    Raises:
        CalibrationError, ConfigError: The text is no valid calibration.
    """
    return Calibration.from_dict(parse_yaml(text, f"calibration {name}"))


def read_skin_elastomer(info: SkinInfo) -> Elastomer | None:
    """Return the elastomer around the cubes; None if the skin file does not describe it.

    Args:
        info: SkinInfo message (depth, thickness and Poisson's ratio of the elastomer).
    """
    numbers = (info.elastomer_depth, info.elastomer_thickness, info.elastomer_poisson)
    if np.isnan(numbers).any():
        return None
    return Elastomer(*numbers)


def describe_geometry(info: SkinInfo) -> list[object]:
    """Return the parts of a SkinInfo message that describe the geometry of the skin.

    They are the coordinate frame, the elastomer, and the name, pose and half side of each cube. If
    they differ from those of an earlier message, results that depend on the geometry must be
    computed anew.
    """
    cubes = [(cube.name, cube.pose, cube.half_side) for cube in info.cubes]
    return [info.header.frame_id, read_skin_elastomer(info), *cubes]
