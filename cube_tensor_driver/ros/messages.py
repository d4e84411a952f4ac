"""Messages of rclpy that are made or read one by one: info, single tensors and wrenches, times.

The batch messages go through `messages/codec.py`, as serialised bytes.
"""

from __future__ import annotations

import importlib
from array import array
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Pose, Quaternion, Vector3, WrenchStamped
from numpy.typing import NDArray
from std_msgs.msg import Header

from ..config.calibration import calibration_text
from ..config.skin import Skin
from ..core.errors import BagError
from ..core.pipeline import Pipeline
from ..core.rows import StressRows
from ..core.tensor import quaternion_from_rpy
from ..messages.codec import SECOND
from ..msg import CubeInfo, SkinInfo, StressTensor, StressTensorStamped


def message_class(topic: str, msgtype: str) -> Any:
    """The message class of pkg/msg/Name. BagError: not installed."""
    package, _, name = msgtype.split("/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError):
        raise BagError(
            f"{topic}: the messages of {package} are not installed here; "
            "source the workspace that has them"
        ) from None


def make_message(kind: str, **fields: Any) -> Any:
    """A message of rclpy from its type and its fields, whose arrays may be numpy's."""
    arrays = {
        name: packed(value.dtype.char, value)
        for name, value in fields.items()
        if isinstance(value, np.ndarray)
    }
    return message_class("make_message", kind)(**fields | arrays)


def to_time(stamp_ns: int) -> Time:
    return Time(sec=stamp_ns // SECOND, nanosec=stamp_ns % SECOND)


def to_ns(stamp: Time) -> int:
    return int(stamp.sec) * SECOND + int(stamp.nanosec)


def packed(code: str, values: NDArray[Any]) -> array[Any]:
    """A message's array field of the values, row-major; code is the field's type as `array` spells
    it."""
    field = array(code)
    field.frombytes(np.ascontiguousarray(values, dtype=code).tobytes())
    return field


def tensor_message(
    header: Header, rows: StressRows, row: int, covariance: NDArray[np.float64]
) -> StressTensorStamped:
    """One row as a message of its own; covariance (15, 15)."""
    xx, yy, zz, yz, zx, xy = rows.stress[row].tolist()
    tensor = StressTensor(
        normal=Vector3(x=xx, y=yy, z=zz),
        shear=Vector3(x=yz, y=zx, z=xy),
        normal_gradient=rows.gradient[row].astype(float),
        covariance=covariance.ravel(),
        residual=float(rows.residual[row]),
        status=int(rows.status[row]),
        observed=int(rows.observed[row]),
    )
    return StressTensorStamped(header=header, tensor=tensor)


def wrench_message(
    header: Header, force_n: NDArray[np.float64], torque_nm: NDArray[np.float64]
) -> WrenchStamped:
    """Force (3,) in N and torque (3,) in N m."""
    message = WrenchStamped(header=header)
    force, torque = message.wrench.force, message.wrench.torque
    force.x, force.y, force.z = force_n.tolist()
    torque.x, torque.y, torque.z = torque_nm.tolist()
    return message


def info_message(
    skin: Skin,
    pipeline: Pipeline,
    stamp_ns: int,
    uids: Mapping[int, int] = MappingProxyType({}),
    sender: str = "reconstruction",
) -> SkinInfo:
    """What is fixed about a skin, with the rest frequencies that the pipeline uses now.

    uids: of cubes by their index in the skin, as their hubs say, where the skin file does not.
    sender: driver or reconstruction.
    """
    message = SkinInfo(version=SkinInfo.VERSION, name=skin.name, sender=sender)
    message.header = Header(stamp=to_time(stamp_ns), frame_id=skin.parent_frame)
    rest_frequency = pipeline.rest_frequency
    covariance = []
    for number, cube in enumerate(skin.cubes):
        calibration = cube.calibration
        x, y, z, w = quaternion_from_rpy(*cube.rpy).tolist()
        pose = Pose(
            position=Point(x=cube.xyz[0], y=cube.xyz[1], z=cube.xyz[2]),
            orientation=Quaternion(x=x, y=y, z=z, w=w),
        )
        message.cubes.append(
            CubeInfo(
                name=cube.name,
                frame_id=skin.frame(cube),
                pose=pose,
                link=cube.link or "",
                index=cube.index or 0,
                uid=cube.uid or uids.get(number, 0),
                layout=calibration.layout.name,
                pads=list(calibration.layout.pads),
                half_side=calibration.half_side,
                calibration_id=calibration.id,
                rest_frequency=rest_frequency[number, : calibration.layout.n_pads].tolist(),
            )
        )
        if calibration.id not in message.calibration_ids:
            message.calibration_ids.append(calibration.id)
            message.calibrations.append(calibration_text(calibration))
            covariance.append(pipeline.covariance(number))
    message.covariance = packed("d", np.array(covariance))
    return message
