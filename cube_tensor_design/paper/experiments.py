# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The source paper's section 3 (Fig. 4) and section 4 (Figs. 7 and 8) on the virtual bench.

Numbers only; `figures/experiments.py` and `figures/deformation.py` draw them. The paper does not
say on which faces the prototype's pads C1 .. C4 are. Here C1 and C2 are on the lower face: then
P_shear and P_grad grow in its experiments as they do in the paper. With C1 and C2 on the upper face
P_shear has the other sign, and nothing else changes. The paper does not give the modulus of the
pads' foam either; `FOAM_MODULUS` is ours.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial

import numpy as np

from cube_tensor_driver.core.arrays import Array
from cube_tensor_driver.core.defaults import BETA, REST_FREQUENCY
from cube_tensor_driver.core.estimator import estimate_modes
from cube_tensor_driver.core.layout import LAYOUTS, Layout
from cube_tensor_driver.core.modes import PLANE
from cube_tensor_driver.core.oscillator import compute_pad_frequency

from ..fem.body import Body
from ..fem.fem import Progress, compute_response, count_steps
from .rod import Rod
from .virtual_bench import Deformation, LoadStep, VirtualBench

FOAM_MODULUS = 3e6
"""Modulus of the pads' foam, in Pa: stiff enough that no pad is crushed at 27 % compression."""
MODE_AMPLITUDE = 1e4
"""Amplitude, in Pa, of the mode (linear stress field) that deforms the body in a picture."""
ON_LOWER = [2, 3, 0, 1]
"""Columns of the planar layout's pads V1 .. V8 that are the prototype's pads C1 .. C4, if C1 and C2
are on the lower face."""
SHEAR_SIGNS = np.array([-1.0, 1.0, 1.0, -1.0])
"""Signs with which the frequency changes of the prototype's pads C1 .. C4 are added to its signal
for shear, P_shear (the paper's eq. 9)."""
GRAD_SIGNS = np.array([1.0, -1.0, 1.0, -1.0])
"""Signs with which the frequency changes of the prototype's pads C1 .. C4 are added to its signal
for the gradient, P_grad (the paper's eq. 10)."""
DISPLACEMENTS = np.linspace(0.25e-3, 3e-3, 12)
"""Displacements of plates and rods in the steps of an experiment, in m."""


@dataclass(frozen=True, eq=False)
class Experiment:
    """Result of one experiment of the paper's section 4, with a row for each step of the load.

    Attributes:
        name: Name of the experiment.
        displacement: (n,) displacement of the plate or rod that moves, in m.
        pads: (n, 8) stress of the pads, in Pa.
        prototype: (n, 3) signals P_normal, P_shear, P_grad of the paper's prototype, in Hz, with
            its pads C1 and C2 on the lower face.
        recovered: (n, 7) amplitudes of the plane modes (linear stress fields) that all eight pads
            give, in Pa.
        truth: (n, 7) amplitudes of the plane modes in the body without a cube, in Pa.
        rotation: (n,) rotation of the cube, in rad.
    """

    name: str
    displacement: Array
    pads: Array
    prototype: Array
    recovered: Array
    truth: Array
    rotation: Array


def run_experiments(
    finite: bool = False,
    progress: Progress | None = None,
) -> list[Experiment]:
    """Run the three experiments, with bonded plates and with plates that slide.

    Plates that shear the body must hold it, so plates that slid while they pressed grip after that.

    Args:
        finite: Whether the material is neo-Hookean.
        progress: Called as progress(done, total, name) after every step, with the number of steps
            before it.
    """
    body = Body()
    both = np.concatenate([DISPLACEMENTS, 3e-3 + DISPLACEMENTS])
    # The displacements (n,) and the steps of each experiment.
    protocols = {
        "b, pressed 3 mm then sheared, bonded": (both, _press_and_shear(body, bonded=True)),
        "b, pressed 3 mm by sliding plates that then grip, sheared": (
            both,
            _press_and_shear(body, bonded=False),
        ),
        "c, 5 mm rod above C2, bonded bottom": (DISPLACEMENTS, _press_rod(body, bonded=True)),
        "c, 5 mm rod above C2, sliding bottom": (DISPLACEMENTS, _press_rod(body, bonded=False)),
    }
    # The cube is calibrated in the same body, which has the symmetry of a slab.
    calibration = compute_response(body, LAYOUTS["planar"], "slab", meshes=1)
    to_modes = estimate_modes(calibration.matrix, PLANE).matrix.T
    # Every step is solved with the cube and without it.
    total = 2 * sum(len(steps) for _, steps in protocols.values())
    report = count_steps(progress, total)
    benches = [VirtualBench(body, cube=cube, finite=finite) for cube in (True, False)]
    found = []
    for name, (displacement, steps) in protocols.items():
        with_cube, without = (bench.run(steps, partial(report, name)) for bench in benches)
        frequency = compute_foam_frequency(with_cube.pads)
        experiment = Experiment(
            name=name,
            displacement=displacement,
            pads=with_cube.pads,
            prototype=compute_prototype_signals(frequency[:, ON_LOWER]),
            recovered=with_cube.pads @ to_modes,
            truth=without.state,
            rotation=with_cube.rotation,
        )
        found.append(experiment)
    # Experiment (a) is the first half of experiment (b).
    bonded, sliding = found[:2]
    return [
        _take_first_half(bonded, "a, top plate pressed, bonded"),
        _take_first_half(sliding, "a, top plate pressed, sliding"),
        *found,
    ]


def _press_and_shear(body: Body, bonded: bool) -> list[LoadStep]:
    pressing = [make_plate_step(body, depth, bonded=bonded) for depth in DISPLACEMENTS]
    return pressing + [make_plate_step(body, 3e-3, x, gripped=not bonded) for x in DISPLACEMENTS]


def _press_rod(body: Body, bonded: bool) -> list[LoadStep]:
    return [make_dent_step(body, Rod(depth, body.side / 4), bonded) for depth in DISPLACEMENTS]


def _take_first_half(experiment: Experiment, name: str) -> Experiment:
    """Return the first half of the steps of an experiment, in which a plate presses, under another
    name."""
    count = len(DISPLACEMENTS)
    columns = {key: value[:count] for key, value in vars(experiment).items()}
    return Experiment(**columns | {"name": name})


def compute_foam_frequency(pads: Array) -> Array:
    """Return the frequencies in Hz of pads under a stress in Pa, by the pad law."""
    rest, beta, modulus = np.array([REST_FREQUENCY, BETA, FOAM_MODULUS])
    return compute_pad_frequency(pads, rest, beta, modulus)


def compute_prototype_signals(frequency: Array) -> Array:
    """Return the signals P_normal, P_shear, P_grad (n, 3) of the paper's prototype, in Hz, from the
    frequencies (n, 4) of its pads C1 .. C4 (the paper's eqs. 8 to 10)."""
    change = frequency - REST_FREQUENCY
    return np.stack(
        [
            -change.sum(axis=1),
            change @ SHEAR_SIGNS,
            change @ GRAD_SIGNS,
        ],
        axis=1,
    )


def make_plate_step(
    body: Body,
    pressed: float,
    sheared: float = 0.0,
    bonded: bool = True,
    gripped: bool = False,
    rod: Rod | None = None,
) -> LoadStep:
    """Press the top plate down, or a rod into the top, and move the bottom plate along x.

    Args:
        body: The body.
        pressed: Displacement of the top plate, in m.
        sheared: Displacement of the bottom plate, in m.
        bonded: Whether the plates hold the body; otherwise they slide and leave x free.
        gripped: Whether plates that slid in the steps before hold the body in this step. The body
            starts from where it has slid to.
        rod: Rod that presses in place of the top plate; None: the plate presses.
    """

    def prescribe(x: Array) -> Array:
        moved = np.full(x.shape, np.nan)
        bottom = x[1] < -body.height / 2 + 1e-9
        moved[1, bottom] = 0.0
        top = x[1] > body.height / 2 - 1e-9
        if rod is None:
            moved[1, top] = -pressed
        if bonded:
            moved[0, bottom] = sheared
        # Only the bottom plate moves along x, so a bonded top stays.
        if bonded and rod is None:
            moved[0, top] = 0.0
        return moved

    return LoadStep(prescribe, rod, gripped, sliding=not bonded)


def make_dent_step(
    body: Body,
    rod: Rod,
    bonded: bool = True,
) -> LoadStep:
    """Press a rod into the top, with the bottom bonded to its plate or sliding on it."""
    return make_plate_step(body, 0.0, bonded=bonded, rod=rod)


def compute_figure_4() -> dict[str, Deformation]:
    """Return the deformations of the paper's section 3: under shear only (key "zx"), and under a
    normal stress that grows along x (key "zz_x")."""
    return _compute_deformations(VirtualBench(Body(), size=0.2), ("zx", "zz_x"))


def compute_mode_deformations(
    body: Body,
    layout: Layout,
) -> dict[str, Deformation]:
    """Return the section deformed by `MODE_AMPLITUDE` of each plane mode (linear stress field), by
    the mode's name."""
    return _compute_deformations(VirtualBench(body, layout=layout, size=0.3), PLANE.names)


def _compute_deformations(
    bench: VirtualBench,
    names: Iterable[str],
) -> dict[str, Deformation]:
    axes = (0, 2)
    deformations = {}
    for name in names:
        mode = PLANE.names.index(name)
        stress = PLANE.stress[mode][np.ix_(axes, axes)]
        gradient = PLANE.gradient[mode][np.ix_(axes, axes, axes)]
        deformations[name] = bench.solve_field(MODE_AMPLITUDE * stress, MODE_AMPLITUDE * gradient)
    return deformations
