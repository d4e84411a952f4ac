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
from geometry_msgs.msg import (
    Point,
    Pose,
    Quaternion,
    Vector3,
    WrenchStamped,
)
from rclpy.node import Node
from std_msgs.msg import Header

from ..config.calibration import calibration_text
from ..config.skin import Skin, SkinCube
from ..core.arrays import AnyArray, Array
from ..core.errors import BagError, CubeError
from ..core.pipeline import Pipeline
from ..core.rows import StressRows
from ..core.tensor import quaternion_from_rpy
from ..messages.codec import SECOND
from ..msg import (
    CubeInfo,
    SkinInfo,
    StressTensor,
    StressTensorStamped,
)
from .callbacks import LOG_PERIOD_S


def log_refused_message(
    node: Node,
    topic: str,
    error: CubeError,
) -> None:
    """Log from time to time that messages of a topic are damaged or contradict themselves."""
    node.get_logger().error(f"{topic}: {error}", throttle_duration_sec=LOG_PERIOD_S)


def message_class(topic: str, type_name: str) -> Any:
    """Return the class of a message type.

    Args:
        topic: Topic of the message, for the error message.
        type_name: Full name of the type, as in std_msgs/msg/Header.

    Raises:
        BagError: The package of the message is not installed here.
    """
    package, _, name = type_name.split("/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError):
        raise BagError(
            f"{topic}: the messages of {package} are not installed here; "
            "source the workspace that has them"
        ) from None


def make_message(type_name: str, **fields: Any) -> Any:
    """Return a message of rclpy. Fields may be numpy arrays."""
    # The type code of numpy is that of the module array.
    arrays = {
        name: pack_array(value.dtype.char, value)
        for name, value in fields.items()
        if isinstance(value, np.ndarray)
    }
    return message_class("make_message", type_name)(**fields | arrays)


def pack_array(code: str, values: AnyArray) -> array[Any]:
    """Return values as an array field of a message, row by row.

    Args:
        code: Type of the field, as a type code of the module `array`.
        values: The values, which are converted to this type.
    """
    # rclpy takes an array of the field's type as it is; it looks at each item of a list.
    field = array(code)
    field.frombytes(np.ascontiguousarray(values, dtype=code).tobytes())
    return field


def to_time(stamp_ns: int) -> Time:
    """Return a time in ns as a message."""
    return Time(sec=stamp_ns // SECOND, nanosec=stamp_ns % SECOND)


def to_ns(stamp: Time) -> int:
    """Return the time of a message in ns."""
    return int(stamp.sec) * SECOND + int(stamp.nanosec)


def tensor_message(
    header: Header,
    rows: StressRows,
    row: int,
    covariance: Array,
) -> StressTensorStamped:
    """Return one row as a message of its own. The covariance is (15, 15)."""
    xx, yy, zz, yz, zx, xy = rows.stress[row].tolist()
    tensor = StressTensor(
        normal=Vector3(
            x=xx,
            y=yy,
            z=zz,
        ),
        shear=Vector3(
            x=yz,
            y=zx,
            z=xy,
        ),
        normal_gradient=rows.gradient[row].astype(float),
        covariance=covariance.ravel(),
        residual=float(rows.residual[row]),
        status=int(rows.status[row]),
        observed=int(rows.observed[row]),
    )
    return StressTensorStamped(header=header, tensor=tensor)


def wrench_message(
    header: Header,
    force_n: Array,
    torque_nm: Array,
) -> WrenchStamped:
    """Return a wrench of a force (3,) in N and a torque (3,) in N m."""
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
    """Return what is fixed about a skin, with the rest frequencies that the pipeline uses now.

    Args:
        skin: The skin.
        pipeline: Gives the rest frequencies and covariances.
        stamp_ns: Time from which on this holds, in ns.
        uids: Index of a cube in the skin -> the uid that its hub reports, which fills the gaps of
            the skin file.
        sender: driver or reconstruction.
    """
    message = SkinInfo(
        version=SkinInfo.VERSION,
        name=skin.name,
        sender=sender,
    )
    message.header = Header(stamp=to_time(stamp_ns), frame_id=skin.parent_frame)
    rest_frequency = pipeline.rest_frequency
    covariances = []
    for number, cube in enumerate(skin.cubes):
        calibration = cube.calibration
        n_pads = calibration.layout.n_pads
        info = _cube_info(cube, skin.frame(cube))
        info.uid = cube.uid or uids.get(number, 0)
        info.rest_frequency = rest_frequency[number, :n_pads].tolist()
        message.cubes.append(info)
        # Most skins have few calibrations, so that each is sent once and named by its id.
        if calibration.id not in message.calibration_ids:
            message.calibration_ids.append(calibration.id)
            message.calibrations.append(calibration_text(calibration))
            covariances.append(pipeline.covariance(number))
    message.covariance = pack_array("d", np.array(covariances))
    return message


def _cube_info(cube: SkinCube, frame_id: str) -> CubeInfo:
    """Return what the skin file says of a cube."""
    calibration = cube.calibration
    px, py, pz = cube.xyz
    x, y, z, w = quaternion_from_rpy(*cube.rpy).tolist()
    # A message has no word for what the skin file leaves out: it says 0, or an empty text.
    return CubeInfo(
        name=cube.name,
        frame_id=frame_id,
        pose=Pose(
            position=Point(x=px, y=py, z=pz),
            orientation=Quaternion(x=x, y=y, z=z, w=w),
        ),
        link=cube.link or "",
        index=cube.index or 0,
        layout=calibration.layout.name,
        pads=list(calibration.layout.pads),
        half_side=calibration.half_side,
        calibration_id=calibration.id,
    )
