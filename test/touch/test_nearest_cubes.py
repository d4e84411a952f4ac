# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The nearest cubes of each cube, on a grid in a rotated frame, by hand."""

from __future__ import annotations

import numpy as np

from cube_tensor_driver.core.poses import CubePoses
from cube_tensor_driver.touch.nearest_cubes import find_nearest_cubes


def test_cubes_at_equal_distances_are_sorted_by_index_or_position():
    x, y = np.meshgrid(np.arange(4.0), np.arange(3.0))
    local = np.column_stack([x.ravel(), y.ravel(), np.zeros(12)])
    rotation = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    poses = CubePoses(local @ rotation.T * 0.012, np.tile(rotation, (12, 1, 1)), np.full(12, 2e-3))
    assert find_nearest_cubes(poses, 5)[5].tolist() == [5, 1, 4, 6, 9]
    assert find_nearest_cubes(poses, 5, by_position=True)[5].tolist() == [5, 4, 1, 9, 6]
    assert find_nearest_cubes(poses, 2, by_position=True)[5].tolist() == [5, 4]
    assert sorted(find_nearest_cubes(poses, 50)[5]) == list(range(12))
