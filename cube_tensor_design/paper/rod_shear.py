# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Shear that is recovered under the paper's rod, by eq. 4, a cube's tensor, points and pads.

The rod presses on the linear bench with a bonded bottom. *Points* and *pads* take the traction t on
the surface for a Gaussian process, as touch/posterior.py does, along x alone. The cube measures
y = int H(x) t(x) dx, and the shear at its place in the body without it is s = int h(x) t(x) dx::

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
from cube_tensor_driver.core.estimator import estimate_modes
from cube_tensor_driver.core.layout import LAYOUTS
from cube_tensor_driver.core.modes import PLANE
from cube_tensor_driver.mechanics.layer import Layer
from cube_tensor_driver.mechanics.traction_prior import PRIOR_LENGTHS, SHEAR_RATIO
from cube_tensor_driver.touch.posterior import MODEL_ERROR

from ..fem.body import Body
from ..fem.fem import Progress, compute_response, count_steps
from ..fem.line_load import compute_line_load
from ..fem.reciprocity import compute_influence
from .experiments import SHEAR_SIGNS, make_dent_step
from .rod import ROD_DEPTH, Rod
from .virtual_bench import VirtualBench

GRID_STEP = 1e-4
"""Distance between neighbouring points of the grid on the surface at which the traction is unknown,
in m."""


@dataclass(frozen=True, eq=False)
class RodShear:
    """Shear σzx at the cube's place, true and recovered, in Pa, for n positions of a rod.

    Attributes:
        place: (n,) position of the rod along x, from the cube's centre, in m.
        truth: (n,) true shear of the same rod on the body without a cube.
        same_load: (n,) true shear of the pressure that the rod has with the cube, acting on the
            layer without it.
        eq_4: (n,) shear from the four upper and lower pads by the paper's eq. 4.
        tensor: (n,) shear from the tensor of all eight pads.
        points: (n,) shear from the surface traction that the tensor gives.
        pads: (n,) shear from the surface traction that the pads give.
    """

    place: Array
    truth: Array
    same_load: Array
    eq_4: Array
    tensor: Array
    points: Array
    pads: Array


def recover_rod_shear(
    body: Body | None = None,
    places: Sequence[float] = tuple(np.arange(9) * 1e-3),
    progress: Progress | None = None,
) -> RodShear:
    """Recover the shear σzx at the cube's place for each position of a rod.

    Args:
        body: The body, by default that of the paper.
        places: Positions of the rod along x, in m.
        progress: Called as progress(done, total, what) before every position.
    """
    body = body or Body()
    layout = LAYOUTS["planar"]
    depth = body.height / 2
    with_cube = VirtualBench(body)
    without = VirtualBench(body, cube=False)
    response = compute_response(body, layout, "slab", meshes=1).matrix
    estimator = estimate_modes(response, PLANE).matrix
    zx = PLANE.names.index("zx")
    influence = compute_influence(replace(body, ground=True), layout)

    # Components of the tensor (7, m, 2) and stresses of the pads (8, m, 2) per traction at x.
    end = body.width / 2
    x = np.arange(-end, end + GRID_STEP / 2, GRID_STEP)
    layer = Layer(body.height, body.poisson)
    tensor_kernel = compute_line_load(layer, x, depth, body.side / 2)
    pad_kernel = influence.interpolate(x[:, None])
    shear_kernel = tensor_kernel[zx]
    from_tensor = _compute_shear_weights(
        tensor_kernel,
        shear_kernel,
        x,
        depth,
    )
    from_pads = _compute_shear_weights(pad_kernel, shear_kernel, x, depth)

    eq_4_gain = SHEAR_SIGNS @ response[:4, zx]
    report = count_steps(progress, len(places))
    rows = []
    for place in places:
        report(f"rod at {1e3 * place:g} mm")
        step = make_dent_step(body, Rod(ROD_DEPTH, place))
        # The same rod at the same depth; with the cube it needs more force.
        pads = with_cube.run([step]).pads[0]
        modes = estimator @ pads
        positions, force = with_cube.compute_rod_pressure(step)
        shear_at_rod = np.interp(positions, x, shear_kernel[:, 1])
        row = {
            "place": place,
            "truth": without.run([step]).state[0, zx],
            # The rod presses against z.
            "same_load": -shear_at_rod @ force,
            "eq_4": SHEAR_SIGNS @ pads[:4] / eq_4_gain,
            "tensor": modes[zx],
            "points": from_tensor @ modes,
            "pads": from_pads @ pads,
        }
        rows.append(row)
    columns = {}
    for name in rows[0]:
        columns[name] = np.array([row[name] for row in rows])
    return RodShear(**columns)


def _compute_shear_weights(
    kernel: Array,
    shear_kernel: Array,
    x: Array,
    depth: float,
) -> Array:
    """Return weights h S H' (H S H' + N)^-1 (n,) from n measurements to the shear at the cube's
    place.

    S is the prior covariance of the traction, and N the variance of the measurements' errors.

    Args:
        kernel: H (n, m, 2), measurements per traction along x and z at m points.
        shear_kernel: h (m, 2), shear per traction along x and z.
        x: (m,) positions on the surface, in m.
        depth: Depth of the cube's centre, in m.
    """
    square_distance = np.subtract.outer(x, x) ** 2
    gaussians = []
    for length in PRIOR_LENGTHS:
        square_length = (length * depth) ** 2
        gaussians.append(np.exp(-square_distance / 2 / square_length))
    prior = np.mean(gaussians, axis=0)

    n = len(kernel)
    total = np.zeros((n, n))
    cross = np.zeros(n)
    # The prior takes shear and pressure for independent, with these relative sizes.
    for component, size in enumerate((SHEAR_RATIO, 1.0)):
        own = kernel[:, :, component]
        smooth = size**2 * own @ prior
        total += smooth @ own.T
        cross += smooth @ shear_kernel[:, component]
    # The errors of the measurements are independent. Their standard deviation is a fixed fraction
    # of the one that the prior gives each measurement.
    total[np.diag_indices(n)] *= 1 + MODEL_ERROR**2
    return np.asarray(np.linalg.solve(total, cross), dtype=float)
