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

from ..arrays import Array, Index, Single, Times, index_cubes
from ..poses import CubePoses
from ..rows import FrequencyRows

MAX_EXTRAPOLATION_NS = 20_000_000
"""Longest time, in ns, by which the motion is extrapolated beyond the instants at which it is
known, unless two intervals between instants are longer.

An arm that is shaken with 2 g at 5 Hz is then wrong by less than 4 m/s².
"""

MAX_INTERVAL_NS = 200_000_000
"""Longest interval between two instants, in ns, over which the motion is interpolated."""

MAX_KNOWN = 16
"""Maximum number of instants whose specific forces at the cubes are kept to be used again."""


class Motion(NamedTuple):
    """Motion of a skin at K instants, in the parent frame of the skin.

    Attributes:
        time_ns: The instants (K,), in ns on the clock of the rows, in rising order. None: the
            motion is unknown; a single one holds for all rows.
        specific_force: Specific force at the origin of the frame (K, 3), in m/s².
        gradient: Derivatives of its components with respect to position (K, 3, 3), in 1/s².
    """

    time_ns: Times
    specific_force: Array
    gradient: Array


UNKNOWN_MOTION = Motion(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3)))
"""Motion of a skin of which nothing is known."""


class ForcesAtCubes:
    """Computes the specific forces at the cubes of one skin, with the same bits everywhere."""

    def __init__(self, poses: CubePoses) -> None:
        """Take the poses of the cubes.

        Args:
            poses: Poses in the parent frame of the skin. For the same bits as a recording, they
                must be those of its SkinInfo message.
        """
        self._position = np.ascontiguousarray(poses.position.T)
        self._rotation = np.ascontiguousarray(poses.rotation.transpose(1, 2, 0))
        self._known: dict[bytes, Array] = {}

    def add_to(self, rows: FrequencyRows, motion: Motion) -> FrequencyRows:
        """Return rows with a column of specific forces.

        Args:
            rows: N rows of frequencies (samples of cubes); those of unknown cubes get NaN.
            motion: Motion of the skin, at instants near the times of the rows.
        """
        columns = rows.columns()
        columns["specific_force"] = self._interpolate(rows, motion)
        return FrequencyRows(**columns)

    def _interpolate(self, rows: FrequencyRows, motion: Motion) -> Single:
        """Return the specific forces (N, 3) of rows in the frames of their cubes; NaN: unknown."""
        # With the axis first, numpy computes all rows in one loop.
        force = np.full((3, len(rows)), np.nan, np.float32)
        n_instants = len(motion.time_ns)
        n_cubes = self._position.shape[1]
        cube = index_cubes(rows.cube, n_cubes)
        if n_instants == 1:
            force[:] = self._at_cubes(motion, 0)[:, cube]
        elif n_instants:
            inner_ns = motion.time_ns[1:-1]
            number = np.searchsorted(inner_ns, rows.stamp_ns, side="right")
            # Few instants lie within the rows of a message, usually none.
            for k in range(n_instants - 1):
                between = self._interpolate_between(motion, k, rows.stamp_ns, cube)
                np.copyto(force, between, where=number == k, casting="same_kind")
        force[:, rows.cube >= n_cubes] = np.nan
        column: Single = force.T
        return column

    def _interpolate_between(
        self,
        motion: Motion,
        k: int,
        stamp_ns: Times,
        cube: Index | slice,
    ) -> Array:
        """Return the specific forces (3, N) by the instants k and k + 1; NaN: unknown.

        Args:
            motion: Motion of the skin.
            k: Number of the first instant.
            stamp_ns: Time stamps of the rows (N,), in ns.
            cube: Index of their cubes.
        """
        begin_ns, end_ns = motion.time_ns[k : k + 2].tolist()
        interval_ns = end_ns - begin_ns
        # A damaged recording may state equal instants.
        if not 0 < interval_ns <= MAX_INTERVAL_NS:
            return np.full((3, len(stamp_ns)), np.nan)
        elapsed_ns = stamp_ns - begin_ns
        beyond_ns = np.maximum(-elapsed_ns, elapsed_ns - interval_ns)
        max_beyond_ns = max(MAX_EXTRAPOLATION_NS, 2 * interval_ns)
        share = elapsed_ns / interval_ns
        share[beyond_ns > max_beyond_ns] = np.nan
        before = self._at_cubes(motion, k)[:, cube]
        after = self._at_cubes(motion, k + 1)[:, cube]
        force: Array = before + share * (after - before)
        return force

    def _at_cubes(self, motion: Motion, k: int) -> Array:
        """Return the specific force at each cube in its frame (3, cubes) at one instant.

        The results of the newest instants are kept, because successive
        messages use them again.

        Args:
            motion: Motion of the skin.
            k: Number of the instant.
        """
        force = motion.specific_force[k]
        gradient = motion.gradient[k]
        key = force.tobytes() + gradient.tobytes()
        if key in self._known:
            return self._known[key]
        if len(self._known) > MAX_KNOWN:
            self._known.clear()

        in_parent = force[:, None] + _multiply(gradient, self._position)
        # The components in the frame of a cube are along the columns of its rotation.
        axes = self._rotation.transpose(1, 0, 2)
        in_cube = _multiply(axes, in_parent)
        self._known[key] = in_cube
        return in_cube


def _multiply(matrix: Array, vector: Array) -> Array:
    """Return products of matrices (3, 3) or (3, 3, n) and vectors (3, n), summed in fixed order."""
    columns = matrix.reshape(3, 3, -1)
    product: Array = columns[:, 0] * vector[0]
    product += columns[:, 1] * vector[1]
    product += columns[:, 2] * vector[2]
    return product
