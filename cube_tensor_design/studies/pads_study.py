"""What it gains to know the pads: contacts on a thin layer, with cubes as points and as pads.

The truth comes from influence functions of finite elements on a coarser mesh than those which the
inverse knows, integrated over the contact's point forces: neither the table's circular components
nor its Hankel transforms are in it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from cube_tensor_driver.config.influence import find_influence
from cube_tensor_driver.core.arrays import Array
from cube_tensor_driver.core.defaults import CONTACT_PRESSURE
from cube_tensor_driver.core.layout import LAYOUTS
from cube_tensor_driver.mechanics.influence import Influence
from cube_tensor_driver.mechanics.influence_file import read_influence
from cube_tensor_driver.touch.tracker.contact_tracker import ContactTracker

from ..fem.body import Body
from ..fem.reciprocity import compute_influence
from .field_study import FORCE, FRICTION, FieldExample
from .traction_study import CUBES, Bench, Errors, Setting

FORMS = ("points", "pads")
BODY = Body(width=80e-3, depth=80e-3, cube_young=np.inf, ground=True)
"""Of the shipped influence functions."""
THIN = tuple(
    Setting(
        cubes=cubes,
        depth=BODY.height / 2,
        thickness=BODY.height,
        known_thickness=BODY.height,
    )
    for cubes in CUBES
)
"""Pitch 8 mm, cubes in the middle of that layer, which is known."""


class LayerBench(Bench):
    """A skin in a layer, whose pads see what finite elements of the cube in it say.

    Parameters: setting: with the layer and depth of the influence functions. true: what the pads
    really see. known: as in Bench.
    """

    def __init__(
        self, setting: Setting, true: Influence, known: Influence | None = None, side: int = 4
    ) -> None:
        super().__init__(setting, side, known)
        given = true.layout.positions
        pads = self.calibration.layout.positions
        self._true = true
        self._pads = [int(np.argmin(np.abs(given - pad).max(axis=1))) for pad in pads]

    def pads_under(self, width: float, force: Array, centre: Array) -> Array:
        sources, forces = self._load(width, force, centre)
        turn = self.poses.rotation
        apart = np.einsum("nji,nsj->nsi", turn, sources - self.poses.position[:, None])
        seen = self._true.at(apart[..., :2].reshape(-1, 2))[self._pads]
        seen = seen.reshape(-1, len(turn), len(sources), 3)
        local = np.einsum("nji,sj->nsi", turn, forces)
        return np.asarray(np.einsum("pnsi,nsi->np", seen, local))


def coarse_influence() -> Influence:
    """What the pads really see: finite elements on the coarsest mesh. Takes minutes."""
    return compute_influence(BODY, LAYOUTS["cube"], 0)


def benches(setting: Setting, true: Influence, side: int = 4) -> dict[str, LayerBench]:
    """A bench for each of FORMS; pads are taken for those of the shipped influence functions."""
    known = read_influence(find_influence("cube_11mm"))
    return {
        form: LayerBench(setting, true, influence, side)
        for form, influence in zip(FORMS, (None, known), strict=True)
    }


def study_pads(
    true: Influence,
    widths: Sequence[float],
    cases: int,
    seed: int,
    settings: Sequence[Setting] = THIN,
    progress: Callable[[Setting, str, Errors], None] | None = None,
) -> dict[tuple[Setting, str], list[Errors]]:
    """Errors of each setting and each of FORMS at each width (m)."""
    results: dict[tuple[Setting, str], list[Errors]] = {}
    for setting in settings:
        for form, bench in benches(setting, true).items():
            results[setting, form] = []
            for width in widths:
                results[setting, form].append(bench.errors(width, cases, seed))
                if progress is not None:
                    progress(setting, form, results[setting, form][-1])
    return results


def layer_example(true: Influence) -> FieldExample:
    """A contact of 5 mm between 24-pad cubes: pressure at the cubes' depth as it is, and as the
    inverse with contacts computes it from points and from pads."""
    load, centre = FORCE * np.array([FRICTION, 0.0, -1.0]), np.array([2.4e-3, 1.6e-3])
    pressure = {}
    for form, bench in benches(THIN[0], true, side=10).items():
        points = bench.inverse.points
        pressure["truth"] = -bench.truth(points[:, :2], 5e-3, load, centre)[:, 2]
        values = bench.values(5e-3, load, centre, np.random.default_rng(1))
        tracker = ContactTracker(bench.inverse, CONTACT_PRESSURE)
        tracker.update(values)
        pressure[form] = tracker.field.depth_pressure
    return FieldExample(points, pressure, bench.poses.position, centre)
