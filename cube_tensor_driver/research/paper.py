"""The paper's section 3 (Fig. 4) and section 4 (Figs. 7 and 8) on the virtual bench: numbers, no
pictures.

The pads are the paper's prototype, C1 .. C4 = V1 .. V4. Their foam is not given there: FOAM is
ours, stiff enough that no pad is crushed at 27 % compression.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from ..core.estimator import make_estimator
from ..core.layout import LAYOUTS
from ..core.modes import PLANE
from ..core.oscillator import pad_frequency
from ..elastic.body import Body
from ..elastic.fem import Progress, Response, compute_response
from .rod import Rod
from .virtual_bench import Bench, Step

Array = NDArray[np.float64]

FOAM = {"rest_frequency": 100e3, "beta": 0.3, "modulus": 3e6}
_SHEAR = np.array([-1.0, 1.0, 1.0, -1.0])  # signs of P_shear and P_grad, the paper's eqs. 9 and 10
_GRAD = np.array([1.0, -1.0, 1.0, -1.0])


@dataclass(frozen=True, eq=False)
class Experiment:
    """One experiment of section 4; a row per step, displacement in m.

    pads (n, 8) Pa; frequency (n, 4) Hz of C1 .. C4; prototype (n, 3): P_normal, P_shear, P_grad, Hz
    recovered, truth: (n, 7) plane modes in Pa, from all eight pads and from the body without the
    cube
    """

    name: str
    displacement: Array
    pads: Array
    frequency: Array
    prototype: Array
    recovered: Array
    truth: Array


def experiments(
    body: Body | None = None, finite: bool = False, progress: Progress | None = None
) -> list[Experiment]:
    """The three experiments, plates bonded and (where they do not shear) sliding."""
    body = body or Body()
    press = shear = np.linspace(0.25e-3, 3e-3, 12)
    rods = [Rod(depth, body.side / 4) for depth in press]
    both = np.concatenate([press, 3e-3 + shear])
    runs = [
        (
            "b, pressed 3 mm then sheared, bonded",
            both,
            [plates(body, p) for p in press] + [plates(body, 3e-3, s) for s in shear],
        ),
        (
            "b, pressed 3 mm by sliding plates that then grip, sheared",
            both,
            [plates(body, p, bonded=False) for p in press]
            + [plates(body, 3e-3, s, gripped=True) for s in shear],
        ),
        ("c, 5 mm rod above C2, bonded bottom", press, [dent(body, rod) for rod in rods]),
        (
            "c, 5 mm rod above C2, sliding bottom",
            press,
            [dent(body, rod, bonded=False) for rod in rods],
        ),
    ]
    calibration = compute_response(body, LAYOUTS["planar"], "slab", meshes=1)
    found, done, total = [], itertools.count(1), 2 * sum(len(steps) for *_, steps in runs)
    for name, displacement, steps in runs:

        def report(name: str = name) -> None:
            if progress is not None:
                progress(next(done), total, name)

        found.append(_experiment(name, displacement, steps, body, finite, calibration, report))
    # (a) is how (b) begins
    names = ("a, top plate pressed, bonded", "a, top plate pressed, sliding")
    return [
        _beginning(one, name, len(press)) for one, name in zip(found[:2], names, strict=True)
    ] + found


def _beginning(experiment: Experiment, name: str, steps: int) -> Experiment:
    return Experiment(
        name, *(getattr(experiment, field.name)[:steps] for field in fields(Experiment)[1:])
    )


def _experiment(
    name: str,
    displacement: Array,
    steps: Sequence[Step],
    body: Body,
    finite: bool,
    calibration: Response,
    report: Callable[[], None],
) -> Experiment:
    with_cube = Bench(body, finite=finite).run(steps, report)
    without = Bench(body, cube=False, finite=finite).run(steps, report)
    frequency = pad_frequency(
        with_cube.pads[:, :4], FOAM["rest_frequency"], FOAM["beta"], FOAM["modulus"]
    )
    recover = make_estimator(calibration.matrix, np.ones(8), PLANE, targets=np.eye(7)).matrix
    return Experiment(
        name=name,
        displacement=displacement,
        pads=with_cube.pads,
        frequency=frequency,
        prototype=prototype(frequency),
        recovered=with_cube.pads @ recover.T,
        truth=without.state,
    )


def prototype(frequency: Array) -> Array:
    """P_normal, P_shear, P_grad (n, 3) in Hz from frequencies (n, 4): the paper's eqs. 8 to 10 as
    printed."""
    change = frequency - FOAM["rest_frequency"]
    return np.stack([-change.sum(axis=1), change @ _SHEAR, change @ _GRAD], axis=1)


def plates(
    body: Body, pressed: float, sheared: float = 0.0, bonded: bool = True, gripped: bool = False
) -> Step:
    """The top plate pressed down and the bottom plate moved along x, in m; sliding plates leave x
    free.

    gripped: plates that slid before hold the body from now on, as it stands between them.
    """

    def prescribed(x: Array) -> Array:
        moved = _on_plate(body, x, bonded, sheared)
        top = x[1] > body.height / 2 - 1e-9
        moved[1, top] = -pressed
        if bonded:
            moved[0, top] = 0.0
        return moved

    return Step(prescribed, gripped=gripped, sliding=not bonded)


def dent(body: Body, rod: Rod, bonded: bool = True) -> Step:
    """A rod pressed into the top, the bottom bonded to its plate or sliding on it."""
    return Step(lambda x: _on_plate(body, x, bonded, 0.0), rod, sliding=not bonded)


def _on_plate(body: Body, x: Array, bonded: bool, sheared: float) -> Array:
    """What the bottom plate prescribes."""
    moved = np.full(x.shape, np.nan)
    bottom = x[1] < -body.height / 2 + 1e-9
    moved[1, bottom] = 0.0
    if bonded:
        moved[0, bottom] = sheared
    return moved


def rod_sweep(
    body: Body | None = None,
    places: Sequence[float] = tuple(np.arange(9) * 1e-3),
    pressed: float = 1e-3,
    progress: Progress | None = None,
) -> dict[str, list[float]]:
    """How much of the prototype's shear signal under a rod is shear; linear body on a bonded plate,
    per rod position.

    signal: -v1 + v2 + v3 - v4 in Pa; shear: what the true local sigma_zx would give, 4 (c+d)
    sigma_zx; the rest is cross-talk of how the stress varies over the cube, and of the plate that
    holds the body.
    """
    body = body or Body()
    with_cube, without = Bench(body), Bench(body, cube=False)
    row = compute_response(body, LAYOUTS["planar"], "slab", meshes=1).matrix[
        :4, PLANE.names.index("zx")
    ]
    table: dict[str, list[float]] = {
        "place": [],
        "signal": [],
        "shear": [],
        "crosstalk": [],
        "true_zx": [],
    }
    for number, place in enumerate(places):
        if progress is not None:
            progress(number, len(places), f"rod at {1e3 * place:g} mm")
        step = dent(body, Rod(pressed, place))
        pads = with_cube.run([step]).pads[0, :4]
        zx = without.run([step]).state[0, 1]
        signal, shear = float(_SHEAR @ pads), float(_SHEAR @ row * zx)
        values = (float(place), signal, shear, signal - shear, float(zx))
        for key, value in zip(table, values, strict=True):
            table[key].append(value)
    return table


def figure_4(body: Body | None = None) -> tuple[Bench, dict[str, tuple[Array, Array]]]:
    """Section 3: the body under shear only, and under a normal stress that varies linearly along x;
    10 kPa each."""
    bench = Bench(body or Body(), size=0.2)
    return bench, loaded_modes(bench, ("zx", "zz_x"))


def loaded_modes(bench: Bench, names: Sequence[str]) -> dict[str, tuple[Array, Array]]:
    """10 kPa of each plane mode: {name: (displacement (2, nodes) m, sigma_zz (elements,) Pa)}."""
    found = {}
    for name in names:
        mode = PLANE.names.index(name)
        stress = 1e4 * PLANE.stress[mode][np.ix_((0, 2), (0, 2))]
        gradient = 1e4 * PLANE.gradient[mode][np.ix_((0, 2), (0, 2), (0, 2))]
        found[name] = bench.loaded(stress, gradient)
    return found
