"""Shear that is recovered under the paper's rod, by eq. 4, a cube's tensor, points and pads.

The rod presses on the linear bench with a bonded bottom. *Points* and *pads* take the traction t on
the surface for a Gaussian process, as touch/posterior.py does, along x alone. What the cube gives
is y = int H(x) t(x) dx, and the shear at its place, in the body without it, s = int h(x) t(x) dx::

    s = h S H' (H S H' + N)^-1 y

For points, y is the cube's tensor and H is that of a layer (layer.py); for pads, y are the pads'
stresses and H their influence functions. h is that of the layer in both. N is 1 % of the size that
the prior gives each y.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cube_tensor_driver.core.arrays import Array
from cube_tensor_driver.core.estimator import make_estimator
from cube_tensor_driver.core.layout import LAYOUTS
from cube_tensor_driver.core.modes import PLANE
from cube_tensor_driver.mechanics.kernels import PRIOR_LENGTHS, SHEAR_RATIO
from cube_tensor_driver.mechanics.layer import Layer
from cube_tensor_driver.touch.posterior import MODEL_ERROR

from ..fem.body import Body
from ..fem.fem import Progress, compute_response
from ..fem.line_load import line_load
from ..fem.reciprocity import compute_influence
from .experiments import dent
from .rod import Rod
from .virtual_bench import VirtualBench

_STEP = 1e-4
"""Of the grid on the surface, m."""
_SIGNAL = np.array([-1.0, 1.0, 1.0, -1.0])
"""Eq. 4 of the four upper and lower pads, tension positive."""


@dataclass(frozen=True, eq=False)
class RodShear:
    """A row per place of the rod; m and Pa.

    truth: sigma_zx at the cube's place, of the same rod on the body without a cube
    same_load: of the pressure that the rod has with the cube, on the layer without it
    eq_4, tensor, points, pads: what is recovered
    seen, predicted: (n, 8) mean stress of the pads on the bench, and by influence functions from
    the traction under the rod
    """

    place: Array
    truth: Array
    same_load: Array
    eq_4: Array
    tensor: Array
    points: Array
    pads: Array
    seen: Array
    predicted: Array


def rod_shear(
    body: Body | None = None,
    places: Sequence[float] = tuple(np.arange(9) * 1e-3),
    pressed: float = 1e-3,
    progress: Progress | None = None,
) -> RodShear:
    """Recover the shear for each place of the rod along x, m."""
    body = body or Body()
    layout, depth = LAYOUTS["planar"], body.height / 2
    with_cube, without = VirtualBench(body), VirtualBench(body, cube=False)
    response = compute_response(body, layout, "slab", meshes=1).matrix
    tensor = make_estimator(response, np.ones(8), PLANE, targets=np.eye(7)).matrix
    zx = PLANE.names.index("zx")
    influence = compute_influence(replace(body, ground=True), layout)

    x = np.arange(-body.width / 2, body.width / 2 + _STEP / 2, _STEP)
    of_points = line_load(Layer(body.height, body.poisson), x, depth, body.side / 2)  # (7, m, 2)
    of_pads = influence.at(x[:, None])  # (8, m, 2)
    shear = of_points[zx]
    from_points = _estimate(of_points, shear, x, depth)
    from_pads = _estimate(of_pads, shear, x, depth)

    rows = []
    for number, place in enumerate(places):
        if progress is not None:
            progress(number, len(places), f"rod at {1e3 * place:g} mm")
        step = dent(body, Rod(pressed, place))
        seen = with_cube.run([step]).pads[0]
        truth = without.run([step]).state[0, zx]
        modes = tensor @ seen
        four = _SIGNAL @ seen[:4] / (_SIGNAL @ response[:4, zx])
        at, force = with_cube.rod_pressure(step)
        predicted = -influence.at(at[:, None])[:, :, 1] @ force
        same_load = -np.interp(at, x, shear[:, 1]) @ force
        found_shear = four, modes[zx], from_points @ modes, from_pads @ seen
        rows.append((truth, same_load, *found_shear, seen, predicted))
    columns = [np.array(column) for column in zip(*rows, strict=True)]
    return RodShear(np.array(places), *columns)


def _estimate(seen: Array, shear: Array, x: Array, depth: float) -> Array:
    """(n,) weights of y for the shear; seen (n, m, 2), shear (m, 2): per traction at x (m,)."""
    apart = np.subtract.outer(x, x) ** 2
    prior = np.mean([np.exp(-apart / 2 / (l * depth) ** 2) for l in PRIOR_LENGTHS], axis=0)
    total, cross = np.zeros((len(seen),) * 2), np.zeros(len(seen))
    for component, size in enumerate((SHEAR_RATIO, 1.0)):
        smooth = size**2 * seen[:, :, component] @ prior
        total += smooth @ seen[:, :, component].T
        cross += smooth @ shear[:, component]
    total[np.diag_indices(len(seen))] *= 1 + MODEL_ERROR**2
    return np.asarray(np.linalg.solve(total, cross), dtype=float)
