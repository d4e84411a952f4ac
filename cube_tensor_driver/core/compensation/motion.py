# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The specific force at each cube from the motion of the skin, which moves as a rigid body.

    s(r) = s(0) + G r,   G = [alpha]x + [omega]x [omega]x

The specific force s (what an accelerometer measures: acceleration minus gravity) at the position r
follows from s at the origin of the skin's parent frame, the angular velocity omega and the angular
acceleration alpha; [a]x is the matrix of the cross product with a.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..arrays import AnyArray, Array, Single, Times, multiply
from ..kernel import run as kernel
from ..poses import CubePoses
from ..rows import FrequencyRows

MAX_EXTRAPOLATION_NS = 20_000_000
"""Longest time, in ns, by which the motion is extrapolated beyond the instants at which it is
known. If the nearest two instants are more than 10 ms apart, twice their interval is the limit.
Beyond the limit, the motion counts as unknown.

If an arm is shaken with 2 g at 5 Hz, its extrapolated specific force is wrong by less than 4 m/s².
"""

MAX_INTERVAL_NS = 200_000_000
"""Longest interval between two instants, in ns, over which the motion is interpolated. Within a
longer one, the motion counts as unknown."""


class Motion(NamedTuple):
    """Motion of a skin at K instants, in the parent frame of the skin.

    Attributes:
        time_ns: The instants (K,), in ns on the clock of the rows, in rising order. If there are
            none (K = 0), the motion is unknown; a single one holds at all times.
        state: Specific force at the origin of the frame, in m/s², then the three rows of G, the
            derivatives of each of its components with respect to position, in 1/s² (K, 4, 3).
    """

    time_ns: Times
    state: Array


UNKNOWN_MOTION = Motion(np.zeros(0, np.int64), np.zeros((0, 4, 3)))
"""Motion of a skin of which nothing is known."""


class ForcesAtCubes:
    """Computes the specific forces at the cubes of one skin, with the same bits on every processor.

    The specific force is what an accelerometer at the cube measures: acceleration minus gravity.
    The function `_find_forces` specifies what the function in C does.
    """

    def __init__(self, poses: CubePoses) -> None:
        """Store the poses of the cubes in float32.

        Args:
            poses: Poses in the parent frame of the skin. The forces of a recording are reproduced
                bit for bit only with the poses of its SkinInfo message.
        """
        self._position = np.ascontiguousarray(poses.position, np.float32)
        self._rotation = np.ascontiguousarray(poses.rotation, np.float32)

    def add_to(self, rows: FrequencyRows, motion: Motion) -> FrequencyRows:
        """Return rows with a column of specific forces.

        Args:
            rows: N rows of frequencies (samples of cubes); those of unknown cubes get NaN.
            motion: Motion of the skin, at instants near the times of the rows.
        """
        is_native = kernel.native is not None and rows.cube.dtype == np.uint16
        find_forces = kernel.native.forces if is_native else _find_forces
        cube = np.ascontiguousarray(rows.cube)
        stamp_ns = np.ascontiguousarray(rows.stamp_ns, np.int64)
        force = np.empty((len(rows), 3), np.float32)
        find_forces(
            *motion,
            self._position,
            self._rotation,
            cube,
            stamp_ns,
            force,
        )
        # A call of the class takes a third of the time of `dataclasses.replace`.
        return FrequencyRows(
            rows.cube,
            rows.sequence,
            rows.stamp_ns,
            rows.frequency,
            rows.temperature,
            rows.pad_fault,
            rows.status,
            force,
        )


def _find_forces(
    time_ns: Times,
    known: Array,
    position: Single,
    rotation: Single,
    cube: AnyArray,
    stamp_ns: Times,
    force: Single,
) -> None:
    """Compute the specific forces at N rows in the frames of their cubes; NaN: unknown.

    Args:
        time_ns: Instants (K,), in ns.
        known: Motion at the instants (K, 4, 3), the `state` of a `Motion`.
        position, rotation: Poses of the cubes, (C, 3) and (C, 3, 3).
        cube: Numbers of the cubes (N,).
        stamp_ns: Time stamps (N,), in ns.
        force: Array for the forces (N, 3), in m/s².
    """
    number = cube.clip(0, len(position) - 1).astype(np.intp)
    state = _interpolate(time_ns, known, stamp_ns).astype(np.float32)
    in_parent = state[:, 0]
    for axis in range(3):
        in_parent += state[:, 1:, axis] * position[number, axis, None]
    # A vector in the parent frame is transformed to the frame of a cube by the transpose of the
    # rotation of the cube.
    force[:] = multiply(in_parent, rotation[number])
    force[cube != number] = np.nan


def _interpolate(time_ns: Times, known: Array, stamp_ns: Times) -> Array:
    """Return the motion of a skin at N times, interpolated linearly between instants.

    Args:
        time_ns: Instants (K,), in ns; if there is only one, its motion holds at all times.
        known: Motion at the instants (K, 4, 3).
        stamp_ns: The times (N,), in ns.

    Returns:
        The motion at these times (N, 4, 3); NaN where it is unknown.
    """
    if len(time_ns) < 2:
        state = np.full((len(stamp_ns), 4, 3), np.nan)
        state[:] = known if len(known) else np.nan
        return state
    # For each time: number of the instant that begins the interval around it, or nearest to it.
    inner_ns = time_ns[1:-1]
    first = np.searchsorted(inner_ns, stamp_ns, side="right")
    length_ns = np.diff(time_ns)[first]
    elapsed_ns = stamp_ns - time_ns[first]
    limit_ns = np.maximum(MAX_EXTRAPOLATION_NS, 2 * length_ns)
    latest_ns = length_ns + limit_ns
    is_near = (elapsed_ns >= -limit_ns) & (elapsed_ns <= latest_ns)
    # A damaged recording may state equal instants.
    is_usual = (length_ns > 0) & (length_ns <= MAX_INTERVAL_NS)
    usable_length_ns = np.where(is_near & is_usual, length_ns, np.nan)
    share = elapsed_ns / usable_length_ns
    change = np.diff(known, axis=0)[first]
    interpolated: Array = known[first] + change * share[:, None, None]
    return interpolated
