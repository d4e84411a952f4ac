"""What an `info` says about a skin's cubes; of rclpy's message or of a bag's."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..config.yaml import parse_yaml
from ..core.calibration import Calibration
from ..core.errors import CalibrationError, ConfigError, MessageError
from ..core.poses import CubePoses
from ..core.tensor import rotation_from_quaternion


def cube_poses(info: Any) -> CubePoses:
    """Where the cubes of an `info` are, in m.

    MessageError: no cubes, or a pose or size that no cube can have.
    """
    if not info.cubes:
        raise MessageError(f"info of the skin {info.name}: it has no cubes")
    positions = [cube.pose.position for cube in info.cubes]
    orientations = [cube.pose.orientation for cube in info.cubes]
    rotations = [rotation_from_quaternion(np.array([q.x, q.y, q.z, q.w])) for q in orientations]
    poses = CubePoses(
        position=np.array([(p.x, p.y, p.z) for p in positions]),
        rotation=np.array(rotations),
        half_side=np.array([cube.half_side for cube in info.cubes]),
    )
    possible = np.isfinite(poses.position).all(axis=1) & (poses.half_side > 0)
    possible &= np.isfinite(poses.half_side)
    for number in np.flatnonzero(~possible).tolist():
        raise MessageError(
            f"info of the skin {info.name}: cube {info.cubes[number].name} is at "
            f"{poses.position[number].tolist()} m with a half side of {poses.half_side[number]} m; "
            "it needs finite numbers and a size above 0"
        )
    return poses


def cube_calibrations(info: Any) -> tuple[Calibration, ...]:
    """The calibration of each cube of an `info`; cubes with the same one share one object.

    MessageError: a cube's calibration is missing, or none.
    """
    texts = dict(zip(info.calibration_ids, info.calibrations, strict=False))
    known: dict[str, Calibration] = {}
    try:
        for name in {cube.calibration_id for cube in info.cubes}:
            known[name] = Calibration.from_dict(parse_yaml(texts[name], f"calibration {name}"))
    except (CalibrationError, ConfigError) as error:
        raise MessageError(f"info of the skin {info.name}: {error}") from None
    except KeyError as error:
        raise MessageError(
            f"info of the skin {info.name}: no calibration {error}, which a cube uses"
        ) from None
    return tuple(known[cube.calibration_id] for cube in info.cubes)


def geometry(info: Any) -> list[object]:
    """What of an `info` makes it another skin if it changes."""
    return [info.header.frame_id, *((cube.name, cube.pose, cube.half_side) for cube in info.cubes)]
