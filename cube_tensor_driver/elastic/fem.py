"""The response matrix of a cube in a body, computed: what each pad feels under each mode."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..core.errors import ElasticError
from ..core.layout import Layout
from ..core.symmetry import default_modes
from .mesh import block, section
from .solid import Solid, lame

Array = NDArray[np.float64]
Progress = Callable[[int, int, str], None]


@dataclass(frozen=True)
class Body:
    """A box of elastomer with a cube bonded in its middle; lengths m, moduli Pa.

    width, depth, height along x, y, z (depth only in 3-D); side of the cube; cube_young inf is a rigid cube.
    plane: "strain" or "stress", for planar layouts.
    """

    width: float = 60e-3
    depth: float = 60e-3
    height: float = 11e-3
    side: float = 4e-3
    young: float = 0.3e6
    poisson: float = 0.48
    cube_young: float = 200e9
    cube_poisson: float = 0.30
    plane: str = "strain"


def response(body, layout, level, progress=None):
    modes = default_modes(layout)
    axes = (0, 2) if layout.planar else (0, 1, 2)
    d0 = body.side / 2
    half = [s / body.side for s in (body.width, body.depth, body.height)]
    half = [half[k] for k in axes]
    size = layout.pad_size / 2
    stops = sorted({round(abs(c + s), 12) for x, n in zip(layout.positions, layout.normals) for k in axes if not n[k] for c in [x[k]] for s in (-size, size)})
    mesh = section(half, stops, level) if layout.planar else block(half, stops, *level)
    unit = body.young
    rigid = np.isinf(body.cube_young)
    solid = Solid(mesh, lame(1.0, body.poisson, body.plane if layout.planar else "strain"),
                  None if rigid else lame(body.cube_young / unit, body.cube_poisson, body.plane))
    S = modes.stress[np.ix_(range(modes.n_modes), axes, axes)]
    G = modes.gradient[np.ix_(range(modes.n_modes), axes, axes, axes)]
    dim = len(axes)
    A = np.zeros((layout.n_pads, modes.n_modes))
    e = np.eye(dim, dtype=int)
    for c, parity in enumerate(itertools.product((1, -1), repeat=dim)):
        odd = np.array(parity) < 0
        ms = np.all((e[:, None] + e[None, :]) % 2 == odd, axis=-1)
        mg = np.all((e[:, None, None] + e[None, :, None] + e[None, None, :]) % 2 == odd, axis=-1)
        s, g = S * ms, G * mg
        used = np.flatnonzero(np.any(s, axis=(1, 2)) | np.any(g, axis=(1, 2, 3)))
        if not len(used): continue
        R = solid.reactions(solid.solve(parity, [(s[m], g[m]) for m in used]))
        for p, (x, n) in enumerate(zip(layout.positions[:, axes], layout.normals[:, axes])):
            a = int(np.flatnonzero(n)[0])
            sign = parity[a] if n[a] < 0 else 1
            A[p, used] += sign * solid.mean_stress(R, parity, a, [(x[k] - size, x[k] + size) for k in range(dim) if k != a])
    return A, solid.basis.N
