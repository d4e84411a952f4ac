# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Bags of known content, made without ROS and without the code that reads them: by rosbags' own
serialiser."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from cube_tensor_driver.bags.metadata import describe_quality, make_typestore
from cube_tensor_driver.bags.write import BagWriter
from cube_tensor_driver.config.calibration import format_calibration
from cube_tensor_driver.config.skin import Elastomer, read_skin
from cube_tensor_driver.core.pipeline import Pipeline
from cube_tensor_driver.core.rows import FrequencyRows
from cube_tensor_driver.core.status import STUCK
from cube_tensor_driver.messages.types import FREQUENCIES_TYPE, INFO_TYPE, STRESS_TYPE

START_NS = 1_700_000_000_000_000_000
WRENCH = "geometry_msgs/msg/WrenchStamped"


def message(kind: str, **fields: object) -> object:
    return make_typestore().types[kind](**fields)


def header(stamp_ns: int, frame_id: str = "skin_base") -> object:
    stamp = message("builtin_interfaces/msg/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    return message("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id)


def info_of(
    skin: object,
    pipeline: Pipeline,
    stamp_ns: int,
    sender: str = "reconstruction",
    version: int = 4,
) -> object:
    kinds = {cube.calibration.id: cube.calibration for cube in skin.cubes}
    pose = message(
        "geometry_msgs/msg/Pose",
        position=message("geometry_msgs/msg/Point", x=0.0, y=0.0, z=0.0),
        orientation=message("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
    )
    cubes = [
        message(
            "cube_tensor_driver/msg/CubeInfo",
            name=cube.name,
            frame_id=skin.make_frame_id(cube),
            pose=pose,
            link=cube.link or "",
            index=cube.index or 0,
            uid=cube.uid or 0,
            layout=cube.calibration.layout.name,
            pads=list(cube.calibration.layout.pads),
            half_side=cube.calibration.half_side,
            calibration_id=cube.calibration.id,
            rest_frequency=rest[: cube.calibration.layout.n_pads],
        )
        for cube, rest in zip(skin.cubes, pipeline.rest_frequency, strict=True)
    ]
    elastomer = skin.elastomer or Elastomer(np.nan, np.nan, np.nan)
    return message(
        INFO_TYPE,
        version=version,
        header=header(stamp_ns),
        sender=sender,
        name=skin.name,
        cubes=cubes,
        calibration_ids=list(kinds),
        calibrations=[format_calibration(kind) for kind in kinds.values()],
        covariance=np.zeros(225 * len(kinds)),
        elastomer_depth=elastomer.depth,
        elastomer_thickness=elastomer.thickness,
        elastomer_poisson=elastomer.poisson,
    )


def frequencies_of(k: int, stamp_ns: int, frequency: np.ndarray) -> object:
    n = len(frequency)
    return message(
        FREQUENCIES_TYPE,
        header=header(stamp_ns),
        cube=np.arange(n, dtype=np.uint16),
        sequence=np.full(n, k, np.uint32),
        time_offset=np.arange(n, dtype=np.int32) * 100,
        n_pads=frequency.shape[1],
        frequency=frequency.astype(np.float32).ravel(),
        temperature=np.full(n, np.nan, np.float32),
        pad_fault=np.zeros(n, np.uint32),
        status=np.zeros(n, np.uint16),
    )


def stress_of(source: object, pipeline: Pipeline, left_out: np.ndarray) -> object:
    """Message by message, as the node does; left_out: pads that it found stuck."""
    n = len(source.cube)
    rows = pipeline.process(
        FrequencyRows.from_values(
            source.cube, source.frequency.reshape(n, -1), temperature=source.temperature
        ),
        left_out,
    )
    rows.status[:] |= np.where(left_out > 0, STUCK, 0).astype(np.uint16)
    return message(
        STRESS_TYPE,
        header=source.header,
        cube=source.cube,
        sequence=source.sequence,
        time_offset=source.time_offset,
        stress=np.ascontiguousarray(rows.stress).ravel(),
        gradient=np.ascontiguousarray(rows.gradient).ravel(),
        residual=rows.residual,
        status=rows.status,
        observed=rows.observed,
        left_out=left_out,
    )


def loads(pipeline: Pipeline, seconds: float) -> np.ndarray:
    """(cubes, P) Hz: every pad squeezed by up to 3 %, slowly and each in its own rhythm."""
    phase = np.arange(pipeline.rest_frequency.size).reshape(pipeline.rest_frequency.shape)
    return pipeline.rest_frequency * (1 - 0.015 * (1 - np.cos(3 * seconds + phase)))


def make_bag(
    folder: Path,
    skin_file: Path,
    messages: int = 300,
    rate: float = 100.0,
    left_out: Callable[[int], np.ndarray | int] = lambda k: 0,
    tare: tuple[int, float] | None = None,
    **options: object,
) -> Path:
    """info, frequencies, stress, and on /force what cube 0 was pressed with: fz = 0.1 N · sin(3 t).

    left_out: of each message, bits of the stuck pads of each cube; tare: from which message on all
    rest frequencies are so many times those of the calibration.
    """
    skin = read_skin(skin_file)
    pipeline = Pipeline([cube.calibration for cube in skin.cubes], np.float32)
    store = make_typestore()

    def put(topic: str, time_ns: int, one: object) -> None:
        writer.write(topic, time_ns, bytes(store.serialize_cdr(one, one.__msgtype__)))

    with BagWriter(folder, **options) as writer:
        for topic, kind in (
            ("/frequencies", FREQUENCIES_TYPE),
            ("/stress", STRESS_TYPE),
            ("/force", WRENCH),
        ):
            writer.add_topic(topic, kind, [describe_quality(depth=100)])
        writer.add_topic("/info", INFO_TYPE, [describe_quality(latched=True)])
        put("/info", START_NS, info_of(skin, pipeline, START_NS))
        made = Pipeline([cube.calibration for cube in skin.cubes], np.float32)
        for k in range(messages):
            stamp_ns = START_NS + round(k / rate * 1e9)
            if tare is not None and k == tare[0]:
                made.rest_frequency = tare[1] * pipeline.rest_frequency
                put("/info", stamp_ns, info_of(skin, made, stamp_ns))
            raw = frequencies_of(k, stamp_ns, loads(pipeline, k / rate))
            put("/frequencies", stamp_ns + 1000, raw)
            put(
                "/stress",
                stamp_ns + 2000,
                stress_of(raw, made, np.broadcast_to(left_out(k), len(raw.cube)).astype(np.uint32)),
            )
            force = message("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.1 * np.sin(3 * k / rate))
            zero = message("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
            wrench = message("geometry_msgs/msg/Wrench", force=force, torque=zero)
            put(
                "/force",
                stamp_ns + 3000,
                message(WRENCH, header=header(stamp_ns, "sensor"), wrench=wrench),
            )
    return folder
