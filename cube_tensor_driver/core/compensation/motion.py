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

from ..arrays import Array, Single, Times, multiply
from ..kernel import run as kernel
from ..poses import CubePoses
from ..rows import FrequencyRows

MAX_EXTRAPOLATION_NS = 20_000_000
"""Longest time, in ns, by which the motion is extrapolated beyond the instants at which it is
known. If the nearest two instants are more than 10 ms apart, twice their interval is the limit.

The specific force of an arm that is shaken with 2 g at 5 Hz is then wrong by less than 4 m/s².
"""

MAX_INTERVAL_NS = 200_000_000
"""Longest interval between two instants, in ns, over which the motion is interpolated. Within a
longer one, the motion counts as unknown."""


class Motion(NamedTuple):
    """Motion of a skin at K instants, in the parent frame of the skin.

    Attributes:
        time_ns: The instants (K,), in ns on the clock of the rows, in rising order. If there are
            none (K = 0), the motion is unknown; a single one holds at all times.
        specific_force: Specific force at the origin of the frame (K, 3), in m/s².
        gradient: Derivatives of the components of the specific force with respect to position
            (K, 3, 3), in 1/s².
    """

    time_ns: Times
    specific_force: Array
    gradient: Array


UNKNOWN_MOTION = Motion(
    time_ns=np.zeros(0, np.int64),
    specific_force=np.zeros((0, 3)),
    gradient=np.zeros((0, 3, 3)),
)
"""Motion of a skin of which nothing is known."""


class ForcesAtCubes:
    """Computes the specific forces at the cubes of one skin, with the same bits on every processor.

    The specific force is what an accelerometer at the cube measures: acceleration minus gravity.
    The function `_interpolate` and the method `_find_forces` specify what the function in C does.
    """

    def __init__(self, poses: CubePoses) -> None:
        """Store the poses of the cubes in float32.

        Args:
            poses: Poses in the parent frame of the skin. The forces of a recording are reproduced
                bit for bit only with the poses of its SkinInfo message.
        """
        # The specific force at the origin is multiplied by 1, its derivatives by the coordinates.
        position = np.insert(poses.position, 0, 1, axis=1)
        self._position = np.ascontiguousarray(position, np.float32)
        self._rotation = np.ascontiguousarray(poses.rotation, np.float32)

    def add_to(self, rows: FrequencyRows, motion: Motion) -> FrequencyRows:
        """Return rows with a column of specific forces.

        Args:
            rows: N rows of frequencies (samples of cubes); those of unknown cubes get NaN.
            motion: Motion of the skin, at instants near the times of the rows.
        """
        # Specific force at the origin, and its derivatives along x, y and z (K, 4, 3).
        known = np.empty((len(motion.time_ns), 4, 3))
        known[:, 0] = motion.specific_force
        known[:, 1:] = motion.gradient.swapaxes(1, 2)
        columns = rows.columns()
        if kernel.native is None or rows.cube.dtype != np.uint16:
            force = self._find_forces(rows, motion.time_ns, known)
        else:
            force = np.empty((len(rows), 3), np.float32)
            cube = np.ascontiguousarray(rows.cube)
            stamp_ns = np.ascontiguousarray(rows.stamp_ns, np.int64)
            poses = self._position, self._rotation
            kernel.native.forces(motion.time_ns, known, *poses, cube, stamp_ns, force)
        columns["specific_force"] = force
        return FrequencyRows(**columns)

    def _find_forces(
        self,
        rows: FrequencyRows,
        time_ns: Times,
        known: Array,
    ) -> Single:
        """Return the specific forces (N, 3) of rows in the frames of their cubes; NaN: unknown.

        Args:
            rows: N rows of frequencies.
            time_ns: Instants (K,) at which the motion is known, in ns.
            known: Specific force at the origin, in m/s², and its derivatives along x, y and z, in
                1/s², at the instants (K, 4, 3).
        """
        n_cubes = len(self._position)
        cube = rows.cube.clip(0, n_cubes - 1).astype(np.intp)
        state = _interpolate(time_ns, known, rows.stamp_ns)
        in_parent = multiply(self._position[cube], state.astype(np.float32))
        # A vector in the parent frame is transformed to the frame of a cube by the transpose of the
        # rotation of the cube.
        in_cube: Single = multiply(in_parent, self._rotation[cube])
        in_cube[rows.cube != cube] = np.nan
        return in_cube


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
    # Number of the instant before the interval that each time lies in, or is nearest to.
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
