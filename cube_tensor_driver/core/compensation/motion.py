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

from ..arrays import Array, Single, Times
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
        force = np.full((len(rows), 3), np.nan, np.float32)
        n_cubes = self._position.shape[1]
        if not len(motion.time_ns):
            return force
        fields = np.array([self._at_cubes(motion, k) for k in range(len(motion.time_ns))])
        cube = np.clip(rows.cube, 0, n_cubes - 1).astype(np.intp)
        if len(fields) == 1:
            force[:] = fields[0, cube]
        else:
            k = np.searchsorted(motion.time_ns[1:-1], rows.stamp_ns, side="right")
            begin_ns, interval_ns = motion.time_ns[k], np.diff(motion.time_ns)[k]
            with np.errstate(all="ignore"):  # a damaged recording may state equal instants
                share = ((rows.stamp_ns - begin_ns) / interval_ns)[:, None]
            before, after = fields[k, cube], fields[k + 1, cube]
            force[:] = before + share * (after - before)
            beyond_ns = np.maximum(begin_ns - rows.stamp_ns, rows.stamp_ns - begin_ns - interval_ns)
            limit_ns = np.maximum(MAX_EXTRAPOLATION_NS, 2 * interval_ns)
            force[(beyond_ns > limit_ns) | (interval_ns > MAX_INTERVAL_NS)] = np.nan
        force[rows.cube != cube] = np.nan
        return force

    def _at_cubes(self, motion: Motion, k: int) -> Array:
        """Return the specific force at each cube in its frame (cubes, 3) at one instant.

        Sums have a fixed order. The results of the newest instants are kept, because successive
        messages use them again.

        Args:
            motion: Motion of the skin.
            k: Number of the instant.
        """
        force, gradient = motion.specific_force[k], motion.gradient[k]
        key = force.tobytes() + gradient.tobytes()
        if key not in self._known:
            if len(self._known) > MAX_KNOWN:
                self._known.clear()
            x, y, z = self._position
            parent = [
                s + (g[0] * x + g[1] * y + g[2] * z) for s, g in zip(force, gradient, strict=True)
            ]
            # The components in the frame of a cube are along the columns of its rotation.
            axes = self._rotation.transpose(1, 0, 2)
            in_cube = [a[0] * parent[0] + a[1] * parent[1] + a[2] * parent[2] for a in axes]
            self._known[key] = np.array(in_cube).T
        return self._known[key]
