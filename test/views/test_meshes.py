# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The cube of the 3-D view is a closed mesh whose triangles are seen from outside."""

from __future__ import annotations

import numpy as np

from cube_tensor_driver.views.meshes import CUBE_EDGES, make_cube


def test_the_cube_encloses_its_volume_and_has_its_edges():
    vertices, faces = make_cube()
    assert faces.shape == (12, 3) and np.abs(vertices).tolist() == [[1, 1, 1]] * 24
    corners = vertices[faces]
    # By the divergence theorem, a triangle with the wrong orientation would count negatively.
    assert np.linalg.det(corners).sum() / 6 == 8
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (np.einsum("fi,fi->f", normal, corners.mean(axis=1)) > 0).all()
    assert np.linalg.norm(CUBE_EDGES[:, 1] - CUBE_EDGES[:, 0], axis=1).tolist() == [2] * 12
