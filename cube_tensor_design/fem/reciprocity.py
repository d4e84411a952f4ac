"""What each pad sees of traction on the surface: finite elements of the cube in its layer.

With the stiffness K of body and cube, K_b of the body alone and the weights w of pads.py, the mean
normal stress of a pad under nodal forces f is::

    P = w . K_b u,   K u = f      so      P = g . f,   K g = K_b w

So one solve for each pad gives its influence function: g on the surface is the pad's stress under a
force there, whatever the load. K_b w are the forces that open a gap of 1 / area between the body
and the pad; g is how the surface moves then. Source: E. Betti, Il Nuovo Cimento 7 (1872)
(reciprocity); M. F. Wheeler as in pads.py.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np

from cube_tensor_driver.core.arrays import Array
from cube_tensor_driver.core.errors import ElasticError
from cube_tensor_driver.core.layout import Layout
from cube_tensor_driver.mechanics.influence import Influence
from cube_tensor_driver.mechanics.layer import Layer

from .body import Body, check_pads, make_mesh
from .fem import make_solid, pad_weights, sees
from .memory import check_memory
from .solid import Solid


def compute_influence(
    body: Body, layout: Layout, level: int = 1, report: Callable[[str], None] = lambda _: None
) -> Influence:
    """Influence functions of the pads in a body on rigid ground, on the mesh of this level.

    report(what) is called before every solve. Raises ElasticError when the body has no ground or
    the mesh does not fit into memory.
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
    place, pads = _on_surface(solid, layout, report)
    return Influence(
        layout=layout,
        side=body.side,
        layer=Layer(body.height, body.poisson),
        depth=body.height / 2 - body.z,
        place=place * d0,
        pads=pads / d0 ** (solid.dim - 1),
    )


def _on_surface(solid: Solid, layout: Layout, report: Callable[[str], None]) -> tuple[Array, Array]:
    """Places (n, dim - 1) and influence (P, n, dim) of all nodes on the surface, in d0."""
    x, dim = solid.positions, solid.dim
    on_top = np.abs(x[-1] - x[-1].max()) < 1e-12
    dofs = [np.flatnonzero(on_top & (solid.component == k)) for k in range(dim)]
    dofs = [of[np.lexsort(x[:-1, of])] for of in dofs]  # the same nodes in the same order
    here = x[:-1, dofs[0]].T
    sides = [(1, -1) if sign else (1,) for sign in solid.parities[0]]
    quadrants = [np.array(signs) for signs in itertools.product(*sides)]
    total = np.zeros((len(quadrants), layout.n_pads, len(here), dim))
    for parity in sorted(solid.parities, key=lambda p: solid.with_sorted_axes(p)[0], reverse=True):
        report("parity " + "".join("-0+"[sign + 1] for sign in parity))
        gaps = np.zeros((solid.basis.N, layout.n_pads))
        for pad in range(layout.n_pads):
            if sees(layout, pad, parity):
                nodes, weights = pad_weights(solid, parity, layout, pad)
                gaps[nodes, pad] = weights
        moved = solid.solve(parity, solid.body @ gaps)
        of_parity = np.stack([moved[of].T for of in dofs], axis=-1)
        for number, signs in enumerate(quadrants):
            # An even field has an odd displacement along the axis.
            flip = np.prod(np.where(signs < 0, parity, 1)) * signs
            total[number] += of_parity * flip / len(quadrants)
    places = np.concatenate([here * signs[:-1] for signs in quadrants])
    pads = np.concatenate(list(total), axis=1)
    # A node on a mirror is there twice, with the same value.
    places, first = np.unique(np.round(places, 9), axis=0, return_index=True)
    return places, pads[:, first]
