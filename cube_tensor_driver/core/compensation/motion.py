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

from ..arrays import Array, Single, Times, index_cubes
from ..poses import CubePoses
from ..rows import FrequencyRows

MAX_EXTRAPOLATION_NS = 20_000_000
"""Longest time, in ns, by which the motion is extrapolated beyond the instants at which it is
known, unless two intervals between instants are longer.

An arm that is shaken with 2 g at 5 Hz is then wrong by less than 4 m/s².
"""

MAX_INTERVAL_NS = 200_000_000
"""Longest interval between two instants, in ns, over which the motion is interpolated."""


class Motion(NamedTuple):
    """Motion of a skin at K instants, in the parent frame of the skin.

    Attributes:
        time_ns: The instants (K,), in ns on the clock of the rows, in rising order. If there are
            none (K = 0), the motion is unknown; a single one holds at all times.
        specific_force: Specific force at the origin of the frame (K, 3), in m/s².
        gradient: Derivatives of its components with respect to position (K, 3, 3), in 1/s².
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
    """

    def __init__(self, poses: CubePoses) -> None:
        """Store the poses of the cubes in float32.

        Args:
            poses: Poses in the parent frame of the skin. For the same bits as a recording, they
                must be those of its SkinInfo message.
        """
        # The axis of the cubes is the last one, so that numpy handles all rows in its inner loop.
        self._position = np.ascontiguousarray(poses.position.T, np.float32)
        # A vector in the parent frame is transformed to the frame of a cube by the transpose of the
        # rotation of the cube.
        to_cube = poses.rotation.transpose(2, 1, 0)
        self._to_cube = np.ascontiguousarray(to_cube, np.float32)

    def add_to(self, rows: FrequencyRows, motion: Motion) -> FrequencyRows:
        """Return rows with a column of specific forces.

        Args:
            rows: N rows of frequencies (samples of cubes); those of unknown cubes get NaN.
            motion: Motion of the skin, at instants near the times of the rows.
        """
        columns = rows.columns()
        columns["specific_force"] = self._find_forces(rows, motion)
        return FrequencyRows(**columns)

    def _find_forces(self, rows: FrequencyRows, motion: Motion) -> Single:
        """Return the specific forces (N, 3) of rows in the frames of their cubes; NaN: unknown."""
        n_cubes = self._position.shape[1]
        cube = index_cubes(rows.cube, n_cubes)
        origin, gradient = _interpolate(motion, rows.stamp_ns)
        in_parent = _multiply(gradient, self._position[:, cube])
        in_parent += origin
        to_cube = self._to_cube[:, :, cube]
        in_cube = _multiply(to_cube, in_parent)
        in_cube[:, rows.cube >= n_cubes] = np.nan
        return np.ascontiguousarray(in_cube.T)


def _interpolate(motion: Motion, stamp_ns: Times) -> tuple[Single, Single]:
    """Return the motion of a skin at N times, interpolated linearly between instants.

    Args:
        motion: The motion; if it is known at one instant only, it is the same at all times.
        stamp_ns: The times (N,), in ns.

    Returns:
        Specific forces at the origin (3, N), in m/s², and their gradients (3, 3, N), in 1/s²; NaN
        where they are unknown.
    """
    flat_gradient = motion.gradient.reshape(-1, 9)
    columns = np.hstack([motion.specific_force, flat_gradient])
    known = columns.T.astype(np.float32)
    n_instants = len(motion.time_ns)
    if n_instants < 2:
        shape = 12, len(stamp_ns)
        constant = known if n_instants else np.nan
        state = np.full(shape, constant, np.float32)
        return _split_motion(state)
    # Index of the interval between two instants that each row lies in, or is nearest to. With two
    # instants, which is usual, there is one interval only.
    inner_ns = motion.time_ns[1:-1]
    first = np.zeros(1, int)
    if len(inner_ns):
        first = np.searchsorted(inner_ns, stamp_ns, side="right")
    length_ns = np.diff(motion.time_ns)[first]
    elapsed_ns = stamp_ns - motion.time_ns[first]
    before_ns = -elapsed_ns
    after_ns = elapsed_ns - length_ns
    beyond_ns = np.maximum(before_ns, after_ns)
    max_beyond_ns = np.maximum(MAX_EXTRAPOLATION_NS, 2 * length_ns)
    is_near = beyond_ns <= max_beyond_ns
    # A damaged recording may state equal instants.
    is_usual = (length_ns > 0) & (length_ns <= MAX_INTERVAL_NS)
    is_known = is_near & is_usual
    share = elapsed_ns / np.maximum(length_ns, 1)
    share[~is_known] = np.nan
    change = np.diff(known)[:, first]
    state = change * share.astype(np.float32)
    state += known[:, first]
    return _split_motion(state)


def _split_motion(state: Single) -> tuple[Single, Single]:
    """Split N states (12, N) into specific forces (3, N) and their gradients (3, 3, N)."""
    force = state[:3]
    gradient = state[3:].reshape(3, 3, -1)
    return force, gradient


def _multiply(matrix: Single, vector: Single) -> Single:
    """Return products of matrices (3, 3, N) and vectors (3, N), summed in a fixed order."""
    product: Single = matrix[:, 0] * vector[0]
    product += matrix[:, 1] * vector[1]
    product += matrix[:, 2] * vector[2]
    return product
