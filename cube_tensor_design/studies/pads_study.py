# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Contacts on a thin layer, with the cubes taken for points or for pads.

The true stress of the pads is the sum of influence functions (stress under a unit force) over the
point forces of the contact. These functions come from finite elements on a coarser mesh than those
that the inverse knows, so that none of the tables of the inverse is in the true stress.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cube_tensor_driver.config.influence import find_influence
from cube_tensor_driver.core.arrays import Array
from cube_tensor_driver.core.layout import LAYOUTS
from cube_tensor_driver.mechanics.influence import Influence, read_influence

from ..fem.body import Body
from ..fem.reciprocity import compute_influence
from .field_study import FieldExample
from .traction_study import CUBES, METHODS, Errors, Setting, TractionBench

FORMS = ("points", "pads")
"""Models of a cube that the inverse (traction from measurements) assumes: a point that measures the
stress there, or pads with influence functions."""
BODY = Body(
    width=80e-3,
    depth=80e-3,
    cube_young=np.inf,
    ground=True,
)
"""Body of the influence functions in the package: a rigid cube in the middle of a layer of 11
mm."""
THIN = tuple(
    Setting(
        cubes=cubes,
        depth=BODY.height / 2,
        thickness=BODY.height,
        known_thickness=BODY.height,
    )
    for cubes in CUBES
)
"""Skins in a thin layer of known thickness, with a pitch of 8 mm and the cubes in the middle of the
layer."""


class LayerBench(TractionBench):
    """A skin in a layer, whose pads have the stress that finite elements of a cube in the layer
    give."""

    def __init__(
        self,
        setting: Setting,
        true: Influence,
        known: Influence | None = None,
        side: int = 4,
    ) -> None:
        """Set up the inverse.

        Args:
            setting: Skin with the layer and the depth of the influence functions.
            true: Influence functions of the pads.
            known: Influence functions that the inverse assumes; None: cubes count as points.
            side: Number of points along the side of a cube's patch, the square grid around it.
        """
        super().__init__(setting, side, known)
        self._true = true
        # Each pad of a planar cube is also a pad of the 24-pad cube, with the same influence
        # function.
        self._pads = []
        for position in self.calibration.layout.positions:
            distance = np.abs(true.layout.positions - position).max(axis=1)
            self._pads.append(int(np.argmin(distance)))

    def compute_pads_under(
        self,
        width: float,
        force: Array,
        centre: Array,
    ) -> Array:
        sources, forces = self.compute_point_forces(width, force, centre)
        rotation = self.poses.rotation
        # Positions and forces in the frame of each cube.
        from_cube = sources - self.poses.position[:, None]
        place = np.einsum("nji,nsj->nsi", rotation, from_cube)[..., :2]
        local_forces = np.einsum("nji,sj->nsi", rotation, forces)

        influence = self._true.interpolate(place.reshape(-1, 2))[self._pads]
        influence = influence.reshape(-1, len(rotation), len(sources), 3)
        # The pads p of cube n add up the point forces s.
        return np.einsum("pnsi,nsi->np", influence, local_forces)


def compute_coarse_influence() -> Influence:
    """Compute influence functions on the coarsest mesh, which takes minutes.

    The study takes them as the true ones, while the inverse assumes those of a finer mesh.
    """
    return compute_influence(BODY, LAYOUTS["cube"], 0)


def _make_benches(
    setting: Setting,
    true: Influence,
    side: int = 4,
) -> dict[str, LayerBench]:
    """Return a bench for each of `FORMS`. For pads, the inverse assumes the influence functions in
    the package."""
    shipped = read_influence(find_influence("cube_11mm"))
    known = {"points": None, "pads": shipped}
    return {form: LayerBench(setting, true, known[form], side) for form in FORMS}


def study_pads(
    true: Influence,
    widths: Sequence[float],
    cases: int,
    seed: int,
) -> dict[tuple[Setting, str], list[Errors]]:
    """Return the errors of each of `THIN` and each of `FORMS` at each width (m)."""
    return {
        (setting, form): bench.study(widths, cases, seed)
        for setting in THIN
        for form, bench in _make_benches(setting, true).items()
    }


def compute_layer_example(true: Influence) -> FieldExample:
    """Return the pressure at the cubes' depth under a contact of 5 mm between 24-pad cubes.

    The pressure is the true one, and the one that the inverse with contacts computes for each of
    `FORMS`.
    """
    pressure = {}
    for form, bench in _make_benches(THIN[0], true, side=10).items():
        example = bench.compute_example(5e-3, np.array([2.4e-3, 1.6e-3]))
        pressure["truth"] = example.pressure["truth"]
        pressure[form] = example.pressure[METHODS[-1]]
    return replace(example, pressure=pressure)
