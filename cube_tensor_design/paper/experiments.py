"""The source paper's section 3 (Fig. 4) and section 4 (Figs. 7 and 8) on the virtual bench.

Numbers only; `figures/experiments.py` and `figures/deformation.py` draw them. The paper does not
say on which faces the prototype's pads C1 .. C4 are. Here C1 and C2 are on the lower face: then
P_shear and P_grad grow in its experiments as they do in the paper. With C1 and C2 on the upper face
P_shear has the other sign, and nothing else changes. The paper does not give the modulus of the
pads' foam: FOAM is ours, stiff enough that no pad is crushed at 27 % compression.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import partial

import numpy as np

from cube_tensor_driver.core.arrays import Array
from cube_tensor_driver.core.defaults import BETA, REST_FREQUENCY
from cube_tensor_driver.core.estimator import make_estimator
from cube_tensor_driver.core.layout import LAYOUTS, Layout
from cube_tensor_driver.core.modes import PLANE
from cube_tensor_driver.core.oscillator import pad_frequency

from ..fem.body import Body
from ..fem.fem import Progress, Response, compute_response
from .rod import Rod
from .virtual_bench import Deformation, Step, VirtualBench

FOAM = {"rest_frequency": REST_FREQUENCY, "beta": BETA, "modulus": 3e6}
MODE_AMPLITUDE = 1e4
"""Of each mode in the pictures of deformation, Pa."""
ON_LOWER, ON_UPPER = [2, 3, 0, 1], [0, 1, 2, 3]
"""Columns of V1 .. V8 that are C1 .. C4, with C1 and C2 on the lower or on the upper face."""
# Signs of P_shear and P_grad, the paper's eqs. 9 and 10.
_SHEAR = np.array([-1.0, 1.0, 1.0, -1.0])
_GRAD = np.array([1.0, -1.0, 1.0, -1.0])


@dataclass(frozen=True, eq=False)
class Experiment:
    """One experiment of section 4, a row per step.

    displacement: (n,) m
    pads: (n, 8) Pa; frequency: (n, 4) Hz of C1 .. C4, with C1 and C2 on the lower face
    prototype: (n, 3) P_normal, P_shear, P_grad, Hz; upper: the same, C1 and C2 on the upper face
    recovered, truth: (n, 7) plane modes in Pa, from all eight pads, and of the body without a cube
    rotation: (n,) of the cube, rad
    """

    name: str
    displacement: Array
    pads: Array
    frequency: Array
    prototype: Array
    upper: Array
    recovered: Array
    truth: Array
    rotation: Array


@dataclass(frozen=True, eq=False)
class _Protocol:
    """Name and steps of an experiment; displacement: (n,) m of the plate or rod that moves."""

    name: str
    displacement: Array
    steps: list[Step]


def experiments(
    body: Body | None = None, finite: bool = False, progress: Progress | None = None
) -> list[Experiment]:
    """The three experiments, with bonded plates and, where they do not shear, sliding ones."""
    body = body or Body()
    protocols = _protocols(body)
    pressing = len(protocols[-1].steps)
    calibration = compute_response(body, LAYOUTS["planar"], "slab", meshes=1)
    done = itertools.count(1)
    total = 2 * sum(len(protocol.steps) for protocol in protocols)

    def report(name: str) -> None:
        if progress is not None:
            progress(next(done), total, name)

    found = [
        _experiment(protocol, body, finite, calibration, partial(report, protocol.name))
        for protocol in protocols
    ]
    # Experiment (a) is how (b) begins.
    bonded, sliding = found[:2]
    return [
        _beginning(bonded, "a, top plate pressed, bonded", pressing),
        _beginning(sliding, "a, top plate pressed, sliding", pressing),
        *found,
    ]


def _protocols(body: Body) -> list[_Protocol]:
    press = shear = np.linspace(0.25e-3, 3e-3, 12)
    both = np.concatenate([press, 3e-3 + shear])
    rods = [Rod(depth, body.side / 4) for depth in press]
    bonded = [plates(body, p) for p in press]
    sheared = [plates(body, 3e-3, s) for s in shear]
    sliding = [plates(body, p, bonded=False) for p in press]
    gripped = [plates(body, 3e-3, s, gripped=True) for s in shear]
    return [
        _Protocol("b, pressed 3 mm then sheared, bonded", both, bonded + sheared),
        _Protocol(
            "b, pressed 3 mm by sliding plates that then grip, sheared", both, sliding + gripped
        ),
        _Protocol("c, 5 mm rod above C2, bonded bottom", press, [dent(body, rod) for rod in rods]),
        _Protocol(
            "c, 5 mm rod above C2, sliding bottom",
            press,
            [dent(body, rod, bonded=False) for rod in rods],
        ),
    ]


def _beginning(experiment: Experiment, name: str, steps: int) -> Experiment:
    """The first steps of an experiment, under another name."""
    columns = {
        field.name: getattr(experiment, field.name)[:steps]
        for field in fields(Experiment)
        if field.name != "name"
    }
    return Experiment(name=name, **columns)


def _experiment(
    protocol: _Protocol,
    body: Body,
    finite: bool,
    calibration: Response,
    report: Callable[[], None],
) -> Experiment:
    with_cube = VirtualBench(body, finite=finite).run(protocol.steps, report)
    without = VirtualBench(body, cube=False, finite=finite).run(protocol.steps, report)
    frequency = pad_frequency(with_cube.pads, **FOAM)
    recover = make_estimator(calibration.matrix, np.ones(8), PLANE, targets=np.eye(7)).matrix
    return Experiment(
        name=protocol.name,
        displacement=protocol.displacement,
        pads=with_cube.pads,
        frequency=frequency[:, ON_LOWER],
        prototype=prototype(frequency[:, ON_LOWER]),
        upper=prototype(frequency[:, ON_UPPER]),
        recovered=with_cube.pads @ recover.T,
        truth=without.state,
        rotation=with_cube.rotation,
    )


def prototype(frequency: Array) -> Array:
    """P_normal, P_shear, P_grad (n, 3) in Hz from frequencies (n, 4) of C1 .. C4, eqs. 8 to 10."""
    change = frequency - FOAM["rest_frequency"]
    return np.stack([-change.sum(axis=1), change @ _SHEAR, change @ _GRAD], axis=1)


def plates(
    body: Body, pressed: float, sheared: float = 0.0, bonded: bool = True, gripped: bool = False
) -> Step:
    """The top plate pressed down and the bottom plate moved along x, in m.

    Plates that are not bonded slide: they leave x free. gripped: plates that slid before hold the
    body from now on, as it stands between them.
    """

    def prescribed(x: Array) -> Array:
        moved = _on_bottom(body, x, bonded, sheared)
        top = x[1] > body.height / 2 - 1e-9
        moved[1, top] = -pressed
        if bonded:
            moved[0, top] = 0.0
        return moved

    return Step(prescribed, gripped=gripped, sliding=not bonded)


def dent(body: Body, rod: Rod, bonded: bool = True) -> Step:
    """A rod pressed into the top, the bottom bonded to its plate or sliding on it."""
    return Step(lambda x: _on_bottom(body, x, bonded, 0.0), rod, sliding=not bonded)


def _on_bottom(body: Body, x: Array, bonded: bool, sheared: float) -> Array:
    """Displacements (2, n) that the bottom plate prescribes, NaN elsewhere."""
    moved = np.full(x.shape, np.nan)
    bottom = x[1] < -body.height / 2 + 1e-9
    moved[1, bottom] = 0.0
    if bonded:
        moved[0, bottom] = sheared
    return moved


def figure_4(body: Body | None = None) -> dict[str, Deformation]:
    """Section 3: shear only ("zx"), and a normal stress that grows along x ("zz_x"); 10 kPa."""
    return _deformations(VirtualBench(body or Body(), size=0.2), ("zx", "zz_x"))


def mode_deformations(body: Body, layout: Layout) -> dict[str, Deformation]:
    """The section under 10 kPa of each plane mode, by the mode's name."""
    return _deformations(VirtualBench(body, layout=layout, size=0.3), PLANE.names)


def _deformations(bench: VirtualBench, names: Sequence[str]) -> dict[str, Deformation]:
    axes = (0, 2)
    deformations = {}
    for name in names:
        mode = PLANE.names.index(name)
        stress = MODE_AMPLITUDE * PLANE.stress[mode][np.ix_(axes, axes)]
        gradient = MODE_AMPLITUDE * PLANE.gradient[mode][np.ix_(axes, axes, axes)]
        deformations[name] = bench.loaded(stress, gradient)
    return deformations
