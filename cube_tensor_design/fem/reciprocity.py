# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Influence functions of the pads: their stress under a force anywhere on the surface.

With the stiffness K of body and cube, K_b of the body alone and the weights w of pads.py, the mean
normal stress P of a pad under nodal forces f is::

    P = w . K_b u,   K u = f      so      P = g . f,   K g = K_b w

So one solve for each pad gives its influence function: g on the surface is the pad's stress under a
unit force there, whatever the load. K_b w are the forces that open a gap of 1 / area between the
body and the pad; g is the displacement of the surface then.

Source: E. Betti, Il Nuovo Cimento 7 (1872) (reciprocity); M. F. Wheeler as in pads.py.
"""

from __future__ import annotations

import numpy as np

from cube_tensor_driver.core.arrays import Array
from cube_tensor_driver.core.errors import ElasticError
from cube_tensor_driver.core.layout import Layout
from cube_tensor_driver.mechanics.influence import Influence
from cube_tensor_driver.mechanics.layer import Layer

from .body import Body, check_pads, make_mesh
from .fem import iterate_parities, make_solid
from .memory import check_memory
from .solid import Solid, list_mirror_images


def compute_influence(
    body: Body,
    layout: Layout,
    level: int = 1,
) -> Influence:
    """Compute the influence functions of the pads in a body on rigid ground.

    Args:
        body: The body, with ground.
        layout: Pads of the cube.
        level: Level of the mesh, 0 to 2.

    Raises:
        ElasticError: The body has no ground, or the mesh does not fit into memory.
    """
    if not body.ground:
        raise ElasticError(
            "the body has no ground, so a force on its surface moves all of it; set ground=True"
        )
    check_pads(body, layout)
    grid = make_mesh(body, layout, level)
    check_memory(grid)
    solid = make_solid(body, layout, grid)
    d0 = body.side / 2
    place, pads = _compute_surface_influence(solid, layout)
    return Influence(
        layout=layout,
        side=body.side,
        layer=Layer(body.height, body.poisson),
        depth=body.depth_of_cube,
        place=place * d0,
        # With lengths in d0, a force of 1 causes a stress per 1/d0² in space. In a plane the force
        # is per length along y, and the stress per 1/d0.
        pads=pads / d0 ** (solid.dim - 1),
    )


def _compute_surface_influence(
    solid: Solid,
    layout: Layout,
) -> tuple[Array, Array]:
    """Return positions (n, dim - 1) of the nodes on the surface, and the stress (P, n, dim) of P
    pads under unit forces there; lengths in d0 (half the side of the cube)."""
    dim = solid.dim
    x = solid.basis.doflocs
    nodes = np.flatnonzero(x[-1] > x[-1].max() - 1e-12)
    # The components of one node are neighbours among the unknowns.
    dofs = dim * nodes[:, None] + np.arange(dim)

    total: Array | float = 0.0
    for parity in iterate_parities(solid):
        # One solve has the weights of all pads as its right-hand sides.
        gaps = solid.compute_pad_weights(layout, parity).T
        displacement = solid.solve(parity, solid.body @ gaps)
        on_surface = np.moveaxis(displacement[dofs], -1, 0)  # (P, n, dim)
        # Mirrored points have mirrored displacements: `images` changes the sign of the component
        # along a mirrored axis, and `weights` has the sign of the parity.
        images, weights = list_mirror_images(parity)
        flip = weights[:, None] * images
        total = total + on_surface[:, None] * flip[:, None]

    meshed = x[:-1, nodes].T
    places = (meshed * images[:, None, :-1]).reshape(-1, dim - 1)
    pads = np.reshape(total, (layout.n_pads, -1, dim))
    # A node on a mirror belongs to two parts of the body, with the same value.
    rounded = np.round(places, 9)
    places, first = np.unique(rounded, axis=0, return_index=True)
    return places, pads[:, first]
