"""Loads from a bag: a cube's frequencies and what a reference sensor measured at the same time, the
input of a fit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..bags.read import Bag
from ..bags.source import open_bag
from ..core.calibration import Calibration
from ..core.errors import BagError
from ..core.layout import Layout
from ..core.modes import COMPONENTS, STRESS
from ..core.symmetry import default_modes
from ..messages.codec import SECOND
from ..messages.types import STRESS as BATCH_TYPE
from .fit import traction_loads
from .load_table import Loads

WRENCH, TENSOR = "geometry_msgs/msg/WrenchStamped", "cube_tensor_driver/msg/StressTensorStamped"
GAP = 5.0
"""Times the reference's usual step: within longer ones nothing is interpolated."""
MOST = 4000
"""Loads that a fit is given; of more samples neighbours are averaged."""


def bag_loads(
    path: Path, name: str | None, reference: str, layout: Layout, area: float | None
) -> tuple[Loads, Calibration]:
    """Loads of a cube (None: the only one), and its recorded calibration with the rest frequencies
    in use.

    reference: topic of a WrenchStamped on the face +z (then area in m² is needed), of a
    StressTensorStamped, or of a SkinStress with a row for the cube; modes that it does not know are
    taken as 0. Samples and reference meet by their stamps; between two of the reference it is
    interpolated linearly.
    BagError: no such cube or topic, another layout, no time in common.
    """
    with open_bag(path) as source:
        bag = source.bag
        settings = source.recording.settings[-1]
        names = [cube.name for cube in source.skin.cubes]
        if name is None and len(names) > 1:
            raise BagError(
                f"{path}: {len(names)} cubes; say which one with --cube: {', '.join(names[:20])}"
            )
        if name is not None and name not in names:
            raise BagError(f"{path}: no cube {name!r}; there are {', '.join(names[:20])}")
        number = 0 if name is None else names.index(name)
        calibration, n_pads = settings.calibrations[number], layout.n_pads
        calibration.check(layout)
        rest = settings.rest_frequency[number, :n_pads]
        parts = []
        for rows in source:
            rows = rows.select((rows.cube == number) & (rows.pad_fault == 0))
            parts.append((rows.stamp_ns, rows.frequency[:, :n_pads], rows.temperature))
        times, frequency, temperature = (
            np.concatenate(column) for column in zip(*parts, strict=True)
        )
        at, state = _reference(bag, reference, number, layout, area, calibration.half_side)
    here = np.clip(np.searchsorted(at, times), 1, len(at) - 1)
    near = at[here] - at[here - 1] <= GAP * np.median(np.diff(at))
    used = (times >= at[0]) & (times <= at[-1]) & near & np.isfinite(frequency).all(axis=1)
    if not used.any():
        raise BagError(
            f"{path}: the frequencies of {names[number]} and {reference} have no time in common"
        )
    seconds, known = (times[used] - at[0]) / SECOND, (at - at[0]) / SECOND
    states = np.stack([np.interp(seconds, known, column) for column in state.T], axis=1)
    size = -(-len(seconds) // MOST)
    mean = [
        _means(values, size)
        for values in (states, frequency[used].astype(float), temperature[used].astype(float))
    ]
    warm = mean[2] if np.isfinite(mean[2]).all() else None
    return Loads(mean[0], mean[1], warm), replace(calibration, rest_frequency=rest)


def _reference(
    bag: Bag, topic: str, number: int, layout: Layout, area: float | None, half_side: float
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Times (N,) ns, rising, and states (N, M) in Pa."""
    types = {one.msgtype for one in bag.connections if one.topic == topic}
    msgtype = types.pop() if types else None
    if msgtype == BATCH_TYPE:
        parts = []
        for messages, _ in bag.stress(topic):
            rows = messages.rows.select(messages.rows.cube == number)
            parts.append((rows.stamp_ns, np.hstack([rows.stress, rows.gradient]).astype(float)))
        at, values = (np.concatenate(column) for column in zip(*parts, strict=True))
    elif msgtype in (WRENCH, TENSOR):
        measured = [bag.decode(entry) for entry in bag.entries({topic})]
        stamps = [one.header.stamp for one in measured]
        at = np.array([stamp.sec * SECOND + stamp.nanosec for stamp in stamps], np.int64)
        values = np.array(
            [_force(one) if msgtype == WRENCH else _components(one.tensor) for one in measured]
        )
    else:
        there = ", ".join(sorted({one.topic for one in bag.connections}))
        raise BagError(
            f"{bag.path}: --reference {topic} is {msgtype or 'not there'}; needed is a "
            f"WrenchStamped, a StressTensorStamped or a SkinStress. Topics: {there}"
        )
    at, first = np.unique(at, return_index=True)
    if len(at) < 2:
        raise BagError(
            f"{bag.path}: {len(at)} messages on {topic}; needed are two or more, with times"
        )
    values = values[first]
    modes = default_modes(layout)
    if msgtype == WRENCH:
        if area is None:
            raise BagError(
                f"{bag.path}: {topic} gives forces; give the area they act on in m² (--area)"
            )
        return at, traction_loads(modes, values, area)
    values[:, len(STRESS) :] *= half_side
    state = [
        values[:, COMPONENTS.index(mode)] if mode in COMPONENTS else np.zeros(len(at))
        for mode in modes.names
    ]
    return at, np.nan_to_num(np.stack(state, axis=1))


def _force(message: Any) -> list[float]:
    force = message.wrench.force
    return [force.x, force.y, force.z]


def _components(tensor: Any) -> list[float]:
    normal, shear = tensor.normal, tensor.shear
    return [normal.x, normal.y, normal.z, shear.x, shear.y, shear.z, *tensor.normal_gradient]


def _means(values: NDArray[np.float64], size: int) -> NDArray[np.float64]:
    """Means of `size` neighbours each along the first axis; what does not fill the last is left
    out."""
    complete = values[: len(values) // size * size]
    means: NDArray[np.float64] = complete.reshape(-1, size, *values.shape[1:]).mean(axis=1)
    return means
