"""Messages to arrays and back. Flat arrays are moved as bytes, never element by element."""

from __future__ import annotations

from array import array
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Pose, Quaternion, Vector3, WrenchStamped
from numpy.typing import NDArray
from std_msgs.msg import Header

from cube_tensor_driver.msg import (
    CubeInfo,
    SkinFrequencies,
    SkinInfo,
    SkinStress,
    StressTensor,
    StressTensorStamped,
)

from ..config.calibration import calibration_text
from ..config.skin import Skin
from ..core.errors import MessageError
from ..core.modes import COMPONENTS, STRESS
from ..core.pipeline import Pipeline, StressRows
from ..core.tensor import quaternion_from_rpy
from ..device.scan import Rows

SECOND = 1_000_000_000
N_STRESS, N_GRADIENT = len(STRESS), len(COMPONENTS) - len(STRESS)


class Times(NamedTuple):
    """When and of which cube rows are: header as it came, cube (N,), sequence (N,), time_offset
    (N,) ns."""

    header: Header
    cube: NDArray[np.uint16]
    sequence: NDArray[np.uint32]
    time_offset: NDArray[np.int32]

    @property
    def stamp_ns(self) -> NDArray[np.int64]:
        """(N,) ns of the node clock."""
        stamps: NDArray[np.int64] = to_ns(self.header.stamp) + self.time_offset.astype(np.int64)
        return stamps


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


def frequencies_message(rows: Rows, frame_id: str) -> SkinFrequencies:
    first_ns = int(rows.stamp_ns.min())
    return SkinFrequencies(
        header=Header(stamp=to_time(first_ns), frame_id=frame_id),
        cube=packed("H", rows.cube),
        sequence=packed("I", rows.sequence),
        time_offset=packed("i", rows.stamp_ns - first_ns),
        n_pads=rows.frequency.shape[1],
        frequency=packed("f", rows.frequency),
        temperature=packed("f", rows.temperature),
        pad_fault=packed("I", rows.pad_fault),
    )


def read_frequencies(
    message: SkinFrequencies,
) -> tuple[Times, NDArray[np.float32], NDArray[np.uint32], NDArray[np.float32]]:
    """Times, frequency (N, n_pads), pad_fault (N,), temperature (N,): views. MessageError: lengths
    that do not fit."""
    rows = len(message.cube)
    width = message.n_pads
    times = _times(message)
    fields = {"frequency": width, "temperature": 1, "pad_fault": 1}
    for name, per_row in fields.items():
        _check_length(message, name, rows * per_row)
    frequency = np.frombuffer(message.frequency, np.float32).reshape(rows, width)
    return (
        times,
        frequency,
        np.frombuffer(message.pad_fault, np.uint32),
        np.frombuffer(message.temperature, np.float32),
    )


def stress_message(times: Times, rows: StressRows) -> SkinStress:
    """Of rows that no pad was left out of."""
    return SkinStress(
        header=times.header,
        cube=packed("H", times.cube),
        sequence=packed("I", times.sequence),
        time_offset=packed("i", times.time_offset),
        stress=packed("f", rows.stress),
        gradient=packed("f", rows.gradient),
        residual=packed("f", rows.residual),
        status=packed("H", rows.status),
        observed=packed("H", rows.observed),
        left_out=array("I", bytes(4 * len(times.cube))),
    )


def read_stress(message: SkinStress) -> tuple[Times, StressRows]:
    """Times and rows, views. MessageError: lengths that do not fit."""
    rows = len(message.cube)
    times = _times(message)
    fields = {
        "stress": N_STRESS,
        "gradient": N_GRADIENT,
        "residual": 1,
        "status": 1,
        "observed": 1,
        "left_out": 1,
    }
    for name, per_row in fields.items():
        _check_length(message, name, rows * per_row)
    return times, StressRows(
        np.frombuffer(message.stress, np.float32).reshape(rows, N_STRESS),
        np.frombuffer(message.gradient, np.float32).reshape(rows, N_GRADIENT),
        np.frombuffer(message.residual, np.float32),
        np.frombuffer(message.status, np.uint16),
        np.frombuffer(message.observed, np.uint16),
    )


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


def _times(message: SkinFrequencies | SkinStress) -> Times:
    rows = len(message.cube)
    for name in ("sequence", "time_offset"):
        _check_length(message, name, rows)
    return Times(
        message.header,
        np.frombuffer(message.cube, np.uint16),
        np.frombuffer(message.sequence, np.uint32),
        np.frombuffer(message.time_offset, np.int32),
    )


def _check_length(message: Any, name: str, expected: int) -> None:
    found = len(getattr(message, name))
    if found != expected:
        raise MessageError(
            f"{type(message).__name__}.{name} has {found} values, {len(message.cube)} rows need {expected}"
        )
