# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Recorded loads, the input of a fit: the frequencies of a cube in a bag (recording), and the loads
that a reference sensor measured at the same times."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..bags.read import Bag, read_stamp_ns
from ..bags.source import BagSource, open_bag
from ..core.arrays import Array, Real, Single, Times
from ..core.calibration import Calibration
from ..core.errors import BagError
from ..core.layout import Layout
from ..core.modes import COMPONENTS, STRESS
from ..core.rows import concatenate
from ..core.symmetry import choose_default_modes
from ..messages.codec import SECOND
from ..messages.types import STRESS_TYPE
from .fit import loads_from_forces
from .load_table import Loads

if TYPE_CHECKING:
    from geometry_msgs.msg import Vector3, WrenchStamped

    from ..msg import StressTensorStamped

WRENCH_TYPE = "geometry_msgs/msg/WrenchStamped"
"""ROS message type of a reference sensor that measures the force on the cube."""
TENSOR_TYPE = "cube_tensor_driver/msg/StressTensorStamped"
"""ROS message type of a reference sensor that is another calibrated cube."""

MAX_STEP_RATIO = 5.0
"""Longest time between two messages of the reference sensor over which its load is interpolated, as
a multiple of the median time between its messages.

Samples of the cube within a longer gap are not used.
"""

MAX_LOADS = 4000
"""Maximum number of loads that a fit gets, because the time of a fit grows with their number.

If there are more samples, groups of successive samples are averaged.
"""

MAX_LISTED_CUBES = 20
"""Maximum number of names of cubes that an error message lists."""


def read_recorded_loads(
    path: Path,
    name: str | None,
    reference: str,
    layout: Layout,
    area: float | None,
) -> tuple[Loads, Calibration]:
    """Read the loads of a cube, and its frequencies under them, from a bag (recording).

    A reference sensor measured the loads. Its messages and the samples of the cube are related by
    their time stamps; between two messages, the load is interpolated linearly. Modes (linear stress
    fields) that the reference does not measure are taken as 0.

    Args:
        path: Path of the bag.
        name: Name of the cube. None means the only cube; the bag must then have just one.
        reference: Topic on which the reference sensor published: a WrenchStamped (force on the face
            +z), a StressTensorStamped, or a SkinStress with a row for the cube.
        layout: Layout that the cube must have.
        area: Area that the force of a WrenchStamped acts on, in m²; None for other types.

    Returns:
        Loads, and the recorded calibration with the rest frequencies that were in use last.

    Raises:
        BagError: The bag has no such cube or topic, the area is missing, or no sample of the cube
            lies between messages of the reference.
        CalibrationError: The recorded calibration has another layout.
    """
    with open_bag(path) as source:
        number = find_cube(source, path, name)
        settings = source.recording.settings[-1]
        calibration = settings.calibrations[number]
        calibration.check(layout)
        rest = settings.rest_frequency[number, : layout.n_pads]
        stamp_ns, frequency, temperature = read_samples(
            source,
            number,
            layout.n_pads,
        )
        reference_ns, amplitudes = _read_reference(
            source.bag,
            reference,
            number,
            layout,
            area,
            calibration.half_side,
        )
    # `following` is the number of the first message of the reference sensor after each sample of
    # the cube. It is limited to 1 … last, so that every sample has a message before it and one
    # after it.
    following = np.searchsorted(reference_ns, stamp_ns)
    following = following.clip(1, len(reference_ns) - 1)
    steps = np.diff(reference_ns)
    max_step = MAX_STEP_RATIO * np.median(steps)
    is_close = steps[following - 1] <= max_step
    begin_ns, end_ns = reference_ns[[0, -1]]
    is_within = (stamp_ns >= begin_ns) & (stamp_ns <= end_ns)
    is_complete = np.isfinite(frequency).all(axis=1)
    used = is_within & is_close & is_complete
    if not used.any():
        raise BagError(
            f"{path}: the frequencies of {source.skin.cubes[number].name} and {reference} have no "
            "time in common"
        )

    # Times are computed in seconds from the first message, because a float does not hold the
    # nanoseconds since 1970 exactly.
    seconds = (stamp_ns[used] - begin_ns) / SECOND
    known = (reference_ns - begin_ns) / SECOND
    by_mode = [np.interp(seconds, known, amplitude) for amplitude in amplitudes.T]
    interpolated = np.stack(by_mode, axis=1)
    size = math.ceil(len(seconds) / MAX_LOADS)
    mean_temperature = average_neighbours(temperature[used], size)
    is_known = np.isfinite(mean_temperature)
    loads = Loads(
        amplitudes=average_neighbours(interpolated, size),
        frequency=average_neighbours(frequency[used], size),
        temperature=mean_temperature if is_known.all() else None,
    )
    return loads, replace(calibration, rest_frequency=rest)


def find_cube(
    source: BagSource,
    path: Path,
    name: str | None,
) -> int:
    """Return the number of the cube with a given name, or of the only cube if the name is None.

    Raises:
        BagError: No cube has the name, or the name is None and there are several cubes.
    """
    cubes = find_cubes(source, path, name)
    if len(cubes) > 1:
        listed = ", ".join(source.skin.names[:MAX_LISTED_CUBES])
        raise BagError(f"{path}: {len(cubes)} cubes; say which one with --cube: {listed}")
    return cubes[0]


def find_cubes(
    source: BagSource,
    path: Path,
    name: str | None,
) -> list[int]:
    """Return the index of the cube with a given name, or the indices of all cubes if it is None.

    Raises:
        BagError: No cube has the name.
    """
    names = source.skin.names
    if name is None:
        return list(range(len(names)))
    if name not in names:
        listed = ", ".join(names[:MAX_LISTED_CUBES])
        raise BagError(f"{path}: no cube {name!r}; there are {listed}")
    return [names.index(name)]


def read_samples(
    source: BagSource,
    number: int,
    n_pads: int,
) -> tuple[Times, Single, Single]:
    """Return the samples of a cube. Those in which the device reports a broken pad are left out.

    Args:
        source: The opened bag.
        number: Number of the cube in the skin.
        n_pads: Number P of the cube's pads.

    Returns:
        Time stamps (N,) in ns, frequencies (N, P) in Hz and temperatures (N,) in °C.
    """
    parts = []
    for rows in source:
        is_of_cube = rows.cube == number
        is_good = rows.pad_fault == 0
        parts.append(rows.select(is_of_cube & is_good))
    samples = concatenate(parts)
    return samples.stamp_ns, samples.frequency[:, :n_pads], samples.temperature


def _read_reference(
    bag: Bag,
    topic: str,
    number: int,
    layout: Layout,
    area: float | None,
    half_side: float,
) -> tuple[Times, Array]:
    """Read the loads that a reference sensor measured.

    Args:
        bag: The bag.
        topic: Topic of the reference sensor.
        number: Number of the cube in the skin.
        layout: Layout of the cube.
        area: Area that a force acts on, in m²; None for topics without forces.
        half_side: Half side of the cube, in m.

    Returns:
        Times (N,) in ns, in rising order, and amplitudes of the modes (N, M), in Pa.

    Raises:
        BagError: The topic is missing or has another type, has fewer than two messages with
            different times, or holds forces and no area is given.
    """
    types = {one.topic: one.msgtype for one in bag.connections}
    msgtype = types.get(topic)
    if msgtype == STRESS_TYPE:
        stamp_ns, values = _read_batches(bag, topic, number)
    elif msgtype in (WRENCH_TYPE, TENSOR_TYPE):
        entries = bag.read_decoded({topic})
        messages: list[WrenchStamped | StressTensorStamped] = [message for _, message in entries]
        stamps = [read_stamp_ns(message) for message in messages]
        stamp_ns = np.array(stamps, np.int64)
        if msgtype == WRENCH_TYPE:
            rows = [_find_axes(message.wrench.force) for message in messages]
        else:
            tensors = [message.tensor for message in messages]
            # The 15 components in the order of `COMPONENTS`, in Pa and Pa/m.
            rows = []
            for tensor in tensors:
                normal = _find_axes(tensor.normal)
                shear = _find_axes(tensor.shear)
                rows.append([*normal, *shear, *tensor.normal_gradient])
        values = np.array(rows)
    else:
        topics = ", ".join(sorted(types))
        raise BagError(
            f"{bag.path}: --reference {topic} is {msgtype or 'not there'}; needed is a "
            f"WrenchStamped, a StressTensorStamped or a SkinStress. Topics: {topics}"
        )

    # The order of messages with equal times is unknown, so only the first of them is used.
    stamp_ns, first = np.unique(stamp_ns, return_index=True)
    if len(stamp_ns) < 2:
        raise BagError(
            f"{bag.path}: {len(stamp_ns)} messages on {topic}; needed are two or more, with times"
        )
    values = values[first]
    modes = choose_default_modes(layout)
    if msgtype == WRENCH_TYPE:
        if area is None:
            raise BagError(
                f"{bag.path}: {topic} gives forces; give the area they act on in m² (--area)"
            )
        return stamp_ns, loads_from_forces(modes, values, area)

    # Columns after the stresses are gradients, in Pa/m. The amplitude of the mode (linear stress
    # field) that belongs to a gradient is the gradient times half the side of the cube.
    values[:, len(STRESS) :] *= half_side
    shape = (len(values), modes.n_modes)
    amplitudes = np.zeros(shape)
    for column, mode in zip(amplitudes.T, modes.names, strict=True):
        if mode in COMPONENTS:
            column[:] = values[:, COMPONENTS.index(mode)]
    # Components that the reference does not measure (NaN) are taken as 0, like the modes for which
    # it has no component.
    return stamp_ns, np.nan_to_num(amplitudes)


def _read_batches(
    bag: Bag,
    topic: str,
    number: int,
) -> tuple[Times, Array]:
    """Return the stress of a cube that SkinStress messages hold.

    Args:
        bag: The bag.
        topic: Topic of the messages.
        number: Number of the cube in the skin.

    Returns:
        Time stamps (N,), in ns, and the 15 components (N, 15), in Pa and Pa/m.
    """
    parts = []
    for messages, _ in bag.read_stress(topic):
        parts.append(messages.rows.select(messages.rows.cube == number))
    rows = concatenate(parts)
    return rows.stamp_ns, rows.components.astype(float)


def _find_axes(vector: Vector3) -> list[float]:
    """Return the numbers x, y, z of a Vector3 message."""
    return [vector.x, vector.y, vector.z]


def average_neighbours(values: Real, size: int) -> Array:
    """Return the means of groups of successive values along the first axis.

    Args:
        values: Values (N, ...).
        size: Number of values in a group. Values at the end that do not fill a group are ignored.

    Returns:
        Means (N // size, ...).
    """
    n_groups = len(values) // size
    complete = values[: n_groups * size].astype(float)
    shape = (n_groups, size, *values.shape[1:])
    groups = complete.reshape(shape)
    means: Array = groups.mean(axis=1)
    return means
