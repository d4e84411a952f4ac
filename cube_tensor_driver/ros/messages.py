# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Makes and reads rclpy messages: SkinInfo, tensors and wrenches of single cubes, time stamps.

The messages SkinFrequencies and SkinStress, which hold the rows of all cubes, are not made here:
`messages/codec.py` writes and reads them as serialised bytes.
"""

from __future__ import annotations

import importlib
from array import array
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import (
    Point,
    Pose,
    Quaternion,
    Vector3,
    Wrench,
    WrenchStamped,
)
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from std_msgs.msg import Header

from ..config.calibration import format_calibration
from ..config.skin import Elastomer, Skin, SkinCube
from ..core.arrays import AnyArray, Array, Real
from ..core.errors import BagError
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
    error: Exception,
) -> None:
    """Log that a message of a topic was refused, at most every `LOG_PERIOD_S`.

    Args:
        node: The node that writes the log message.
        topic: The topic.
        error: States what is wrong with the message.
    """
    node.get_logger().error(f"{topic}: {error}", throttle_duration_sec=LOG_PERIOD_S)


class CheckedSubscription:
    """A subscription that decodes at most one damaged message per `LOG_PERIOD_S`.

    The libraries of ROS print a line about each message that they cannot decode, so that a faulty
    publisher would fill the log. After a damaged message no message is decoded for this period.
    Then the newest message that arrived during the period is decoded.
    """

    def __init__(
        self,
        node: Node,
        kind: type,
        topic: str,
        callback: Callable[[Any], None],
        profile: QoSProfile | int,
    ) -> None:
        """Subscribe.

        Args:
            node: The node that subscribes.
            kind: Type of the messages.
            topic: Name of the topic.
            callback: Called with each message.
            profile: Quality of service of the subscription, or the depth of its queue.
        """
        self._node = node
        self._kind = kind
        self._topic = topic
        self._callback = callback
        self._waiting: bytes | None = None
        self._is_closed = False
        # The timer runs only during the pause that follows a damaged message.
        self._pause = node.create_timer(LOG_PERIOD_S, self._end_pause)
        self._pause.cancel()
        self._subscription = node.create_subscription(
            kind,
            topic,
            self._receive,
            profile,
            raw=True,
        )

    def close(self) -> None:
        """End the subscription. `callback` is not called any more."""
        self._is_closed = True
        self._node.destroy_subscription(self._subscription)
        self._node.destroy_timer(self._pause)

    def _receive(self, data: bytes) -> None:
        # rclpy also calls with a message that it took just before the subscription was destroyed.
        if self._is_closed:
            return
        if self._pause.is_canceled():
            self._decode(data)
        else:
            self._waiting = data

    def _decode(self, data: bytes) -> None:
        try:
            message: Any = deserialize_message(data, self._kind)
        # rclpy raises RMWError, which derives from RuntimeError, if the bytes cannot be decoded.
        except RuntimeError as error:
            self._pause.reset()
            log_refused_message(self._node, self._topic, error)
        else:
            self._callback(message)

    def _end_pause(self) -> None:
        self._pause.cancel()
        data = self._waiting
        self._waiting = None
        if data is not None:
            self._decode(data)


def find_message_class(topic: str, type_name: str) -> Any:
    """Return the class of a message type.

    Args:
        topic: Topic of the message, for the error message.
        type_name: Full name of the type, as in std_msgs/msg/Header.

    Raises:
        BagError: The ROS package of the message is not installed, or does not contain the type.
    """
    package, _, name = type_name.split("/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError):
        raise BagError(
            f"{topic}: the messages of {package} are not installed here; "
            "source the workspace that has them"
        ) from None


def make_message(type_name: str, **fields: object) -> Any:
    """Return an rclpy message.

    Args:
        type_name: Full name of the type, as in std_msgs/msg/Header.
        fields: Values of the fields. The value of a field that is an array of numbers or of bool
            may be a numpy array.
    """
    # numpy and the module `array` have the same type codes, such as "d" for float64. Only for bool
    # the module `array` has none, so these values become a list.
    arrays = {
        name: value.tolist() if value.dtype == bool else pack_array(value.dtype.char, value)
        for name, value in fields.items()
        if isinstance(value, np.ndarray)
    }
    return find_message_class("make_message", type_name)(**fields | arrays)


def pack_array(code: str, values: AnyArray) -> array[Any]:
    """Return values as an `array.array`, which rclpy takes for a field that is a list of numbers.

    Args:
        code: Type of the field, as a type code of the module `array`, such as "d" for float64.
        values: The values, of any shape, which are converted to this type and stored row by row.
    """
    # rclpy checks every item of a list but none of an `array.array` of the right type.
    field = array(code)
    field.frombytes(np.ascontiguousarray(values, dtype=code).tobytes())
    return field


def to_time(stamp_ns: int) -> Time:
    """Convert a time in ns since the Unix epoch to a message builtin_interfaces/Time."""
    return Time(sec=stamp_ns // SECOND, nanosec=stamp_ns % SECOND)


def to_ns(stamp: Time) -> int:
    """Convert a time of a message to ns since the Unix epoch."""
    return int(stamp.sec) * SECOND + int(stamp.nanosec)


def make_tensor_message(
    header: Header,
    rows: StressRows,
    row: int,
    covariance: Array,
) -> StressTensorStamped:
    """Return the stress of one cube at one instant as a message.

    Args:
        header: Header of the message.
        rows: Rows of stress; a row is the stress of one cube at one instant.
        row: Index of the row that the message is to contain.
        covariance: Covariance of the 6 stress components and 9 gradients, (15, 15), in SI units.
    """
    stress = rows.stress[row]
    tensor = StressTensor(
        normal=_make_vector(Vector3, stress[:3]),
        shear=_make_vector(Vector3, stress[3:]),
        normal_gradient=rows.gradient[row].astype(float),
        covariance=covariance.ravel(),
        residual=float(rows.residual[row]),
        status=int(rows.status[row]),
        observed=int(rows.observed[row]),
    )
    return StressTensorStamped(header=header, tensor=tensor)


def make_wrench_message(
    header: Header,
    force_n: Array,
    torque_nm: Array,
) -> WrenchStamped:
    """Return a message with a wrench.

    Args:
        header: Header of the message.
        force_n: Force (3,), in N.
        torque_nm: Torque (3,), in N m.
    """
    force = _make_vector(Vector3, force_n)
    torque = _make_vector(Vector3, torque_nm)
    return WrenchStamped(header=header, wrench=Wrench(force=force, torque=torque))


def _make_vector(kind: type, values: Real) -> Any:
    """Return a message with the fields x, y, z, or x, y, z, w if there are four values."""
    return kind(**dict(zip("xyzw", values.tolist(), strict=False)))


def make_info_message(
    skin: Skin,
    pipeline: Pipeline,
    stamp_ns: int,
    uids: Mapping[int, int] = MappingProxyType({}),
    sender: str = "reconstruction",
) -> SkinInfo:
    """Return a SkinInfo message, which contains all that is needed to compute the stress of a skin.

    Args:
        skin: The skin.
        pipeline: Computes the stress, and provides the present rest frequencies (frequencies
            without load) and the covariances of the stress.
        stamp_ns: Time from which on the content is valid, in ns since the Unix epoch.
        uids: Index of a cube in the skin -> the uid that its hub reports. It is used for cubes
            whose uid is not in the skin file.
        sender: Name of the node that publishes the message: driver or reconstruction.
    """
    elastomer = skin.elastomer or Elastomer(np.nan, np.nan, np.nan)
    message = SkinInfo(
        version=SkinInfo.VERSION,
        name=skin.name,
        sender=sender,
        elastomer_depth=elastomer.depth,
        elastomer_thickness=elastomer.thickness,
        elastomer_poisson=elastomer.poisson,
    )
    message.header = Header(stamp=to_time(stamp_ns), frame_id=skin.parent_frame)
    rest_frequency = pipeline.rest_frequency
    covariances = []
    for number, cube in enumerate(skin.cubes):
        calibration = cube.calibration
        n_pads = calibration.layout.n_pads
        info = _make_cube_info(cube, skin.make_frame_id(cube))
        info.uid = cube.uid or uids.get(number, 0)
        info.rest_frequency = rest_frequency[number, :n_pads].tolist()
        message.cubes.append(info)
        # Cubes usually share few calibrations, so each calibration is sent once, and cubes refer to
        # it by its id.
        if calibration.id not in message.calibration_ids:
            message.calibration_ids.append(calibration.id)
            message.calibrations.append(format_calibration(calibration))
            covariances.append(pipeline.compute_covariance(number))
    message.covariance = pack_array("d", np.array(covariances))
    return message


def _make_cube_info(cube: SkinCube, frame_id: str) -> CubeInfo:
    """Return the part of a SkinInfo message about one cube (name, pose, layout, hub), as stated in
    the skin file."""
    calibration = cube.calibration
    position = _make_vector(Point, np.array(cube.xyz))
    orientation = _make_vector(Quaternion, quaternion_from_rpy(*cube.rpy))
    # Fields of a message cannot be None, so a link that the skin file leaves out is sent as an
    # empty text, and an index as 0.
    return CubeInfo(
        name=cube.name,
        frame_id=frame_id,
        pose=Pose(position=position, orientation=orientation),
        link=cube.link or "",
        index=cube.index or 0,
        layout=calibration.layout.name,
        pads=list(calibration.layout.pads),
        half_side=calibration.half_side,
        calibration_id=calibration.id,
    )
