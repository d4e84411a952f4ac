"""Recorded loads: the frequencies of a cube in a bag, and what a reference sensor measured at the
same time. They are the input of a fit."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..bags.read import Bag
from ..bags.source import BagSource, open_bag
from ..core.arrays import AnyArray, Array, Times
from ..core.calibration import Calibration
from ..core.errors import BagError
from ..core.layout import Layout
from ..core.modes import COMPONENTS, STRESS
from ..core.symmetry import default_modes
from ..messages.codec import SECOND
from ..messages.types import STRESS as BATCH_TYPE
from .fit import loads_from_forces
from .load_table import Loads

WRENCH_TYPE = "geometry_msgs/msg/WrenchStamped"
TENSOR_TYPE = "cube_tensor_driver/msg/StressTensorStamped"

MAX_STEP_RATIO = 5.0
"""Longest step between two messages of the reference, as a multiple of the median step.

Nothing is interpolated over a longer one.
"""

MAX_LOADS = 4000
"""Maximum number of loads that a fit is given, because its time grows with them.

If there are more samples, neighbouring samples are averaged.
"""

MAX_LISTED_CUBES = 20
"""Number of cubes that an error message lists."""


def read_recorded_loads(
    path: Path,
    name: str | None,
    reference: str,
    layout: Layout,
    area: float | None,
) -> tuple[Loads, Calibration]:
    """Read the loads of a cube from a bag.

    Samples and reference are related by their time stamps. Between two messages of the reference,
    its load is interpolated linearly. Modes that the reference does not measure are taken as 0.

    Args:
        path: The bag.
        name: Name of the cube; None means the only one.
        reference: Topic of a WrenchStamped on the face +z, of a StressTensorStamped, or of a
            SkinStress with a row for the cube.
        layout: Layout of the cube.
        area: Area that a WrenchStamped acts on, in m².

    Returns:
        Loads, and the recorded calibration with the rest frequencies in use.

    Raises:
        BagError: There is no such cube or topic, the layout is another, or cube and reference have
            no time in common.
    """
    with open_bag(path) as source:
        number = _find_cube(source, path, name)
        settings = source.recording.settings[-1]
        calibration = settings.calibrations[number]
        calibration.check(layout)
        rest = settings.rest_frequency[number, : layout.n_pads]
        stamp_ns, frequency, temperature = _read_samples(source, number, layout.n_pads)
        reference_ns, state = _read_reference(
            source.bag, reference, number, layout, area, calibration.half_side
        )
    # Number of the message after each sample; the first and the last have no neighbour.
    following = np.searchsorted(reference_ns, stamp_ns)
    following = following.clip(1, len(reference_ns) - 1)
    steps = np.diff(reference_ns)
    is_close = steps[following - 1] <= MAX_STEP_RATIO * np.median(steps)
    is_after_start = stamp_ns >= reference_ns[0]
    is_before_end = stamp_ns <= reference_ns[-1]
    is_complete = np.isfinite(frequency).all(axis=1)
    used = is_after_start & is_before_end & is_close & is_complete
    if not used.any():
        raise BagError(
            f"{path}: the frequencies of {source.skin.cubes[number].name} and {reference} have no "
            "time in common"
        )

    # Seconds from the first message, because a float does not hold nanoseconds since 1970.
    seconds = (stamp_ns[used] - reference_ns[0]) / SECOND
    known = (reference_ns - reference_ns[0]) / SECOND
    by_mode = [np.interp(seconds, known, amplitude) for amplitude in state.T]
    size = math.ceil(len(seconds) / MAX_LOADS)
    mean_temperature = _average_neighbours(temperature[used].astype(float), size)
    has_temperature = np.isfinite(mean_temperature).all()
    loads = Loads(
        state=_average_neighbours(np.stack(by_mode, axis=1), size),
        frequency=_average_neighbours(frequency[used].astype(float), size),
        temperature=mean_temperature if has_temperature else None,
    )
    return loads, replace(calibration, rest_frequency=rest)


def _find_cube(
    source: BagSource,
    path: Path,
    name: str | None,
) -> int:
    """Return the number of a cube. BagError: there is no such cube, or more than one."""
    names = [cube.name for cube in source.skin.cubes]
    listed = ", ".join(names[:MAX_LISTED_CUBES])
    if name is None and len(names) > 1:
        raise BagError(f"{path}: {len(names)} cubes; say which one with --cube: {listed}")
    if name is not None and name not in names:
        raise BagError(f"{path}: no cube {name!r}; there are {listed}")
    return 0 if name is None else names.index(name)


def _read_samples(
    source: BagSource,
    number: int,
    n_pads: int,
) -> tuple[Times, AnyArray, AnyArray]:
    """Return time stamps (N,), frequencies (N, P) and temperatures (N,) of a cube.

    Samples with a pad that the device reports as broken are left out.
    """
    parts = []
    for rows in source:
        is_good = (rows.cube == number) & (rows.pad_fault == 0)
        chosen = rows.select(is_good)
        parts.append((chosen.stamp_ns, chosen.frequency[:, :n_pads], chosen.temperature))
    stamp_ns, frequency, temperature = (
        np.concatenate(column) for column in zip(*parts, strict=True)
    )
    return stamp_ns, frequency, temperature


def _read_reference(
    bag: Bag,
    topic: str,
    number: int,
    layout: Layout,
    area: float | None,
    half_side: float,
) -> tuple[Times, Array]:
    """Read the loads that a reference sensor measured.

    Returns:
        Times (N,), rising, in ns, and states (N, M), in Pa.

    Raises:
        BagError: There is no such topic, it has another type, or there are fewer than two messages.
    """
    types = {one.msgtype for one in bag.connections if one.topic == topic}
    msgtype = types.pop() if types else None
    if msgtype == BATCH_TYPE:
        stamp_ns, values = _read_batches(bag, topic, number)
    elif msgtype in (WRENCH_TYPE, TENSOR_TYPE):
        messages = [bag.decode(entry) for entry in bag.entries({topic})]
        stamps = [message.header.stamp for message in messages]
        read = _read_force if msgtype == WRENCH_TYPE else _read_components
        times = [stamp.sec * SECOND + stamp.nanosec for stamp in stamps]
        stamp_ns = np.array(times, np.int64)
        values = np.array([read(message) for message in messages])
    else:
        topics = ", ".join(sorted({one.topic for one in bag.connections}))
        raise BagError(
            f"{bag.path}: --reference {topic} is {msgtype or 'not there'}; needed is a "
            f"WrenchStamped, a StressTensorStamped or a SkinStress. Topics: {topics}"
        )

    # Several messages of one time have no order, so the first of them is taken.
    stamp_ns, first = np.unique(stamp_ns, return_index=True)
    if len(stamp_ns) < 2:
        raise BagError(
            f"{bag.path}: {len(stamp_ns)} messages on {topic}; needed are two or more, with times"
        )
    values = values[first]
    modes = default_modes(layout)
    if msgtype == WRENCH_TYPE:
        if area is None:
            raise BagError(
                f"{bag.path}: {topic} gives forces; give the area they act on in m² (--area)"
            )
        return stamp_ns, loads_from_forces(modes, values, area)

    # Amplitudes of gradients are times the half side.
    values[:, len(STRESS) :] *= half_side
    state = np.zeros((len(values), modes.n_modes))
    for column, mode in zip(state.T, modes.names, strict=True):
        if mode in COMPONENTS:
            column[:] = values[:, COMPONENTS.index(mode)]
    # Components that the reference does not observe are taken as 0, as missing modes are.
    return stamp_ns, np.nan_to_num(state)


def _read_batches(
    bag: Bag,
    topic: str,
    number: int,
) -> tuple[Times, Array]:
    """Return times (N,), in ns, and components (N, 15) of a cube in SkinStress messages."""
    parts = []
    for messages, _ in bag.stress(topic):
        rows = messages.rows.select(messages.rows.cube == number)
        components = np.hstack([rows.stress, rows.gradient])
        parts.append((rows.stamp_ns, components.astype(float)))
    stamp_ns, values = (np.concatenate(column) for column in zip(*parts, strict=True))
    return stamp_ns, values


def _read_force(message: Any) -> list[float]:
    """Return the force of a WrenchStamped."""
    force = message.wrench.force
    return [force.x, force.y, force.z]


def _read_components(message: Any) -> list[float]:
    """Return the 15 components of a StressTensorStamped."""
    tensor = message.tensor
    normal, shear = tensor.normal, tensor.shear
    normal_stress = [normal.x, normal.y, normal.z]
    shear_stress = [shear.x, shear.y, shear.z]
    return [*normal_stress, *shear_stress, *tensor.normal_gradient]


def _average_neighbours(values: Array, size: int) -> Array:
    """Return the means of `size` neighbours each along the first axis.

    Values at the end that do not fill a group are left out.
    """
    n_groups = len(values) // size
    complete = values[: n_groups * size]
    groups = complete.reshape(n_groups, size, *values.shape[1:])
    means: Array = groups.mean(axis=1)
    return means
