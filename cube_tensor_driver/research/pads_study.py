"""What it gains to know the pads: contacts on a thin layer, with cubes as points and as pads.

The truth comes from influence functions of finite elements on a coarser mesh than those which the
inverse knows, integrated over the contact's point forces: neither the table's circular components
nor its Hankel transforms are in it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from ..elastic.influence import Influence
from .traction_study import Bench, Errors, Setting

Array = NDArray[np.float64]

FORMS = ("points", "pads")


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

    def values(
        self, width: float, force: Array, centre: Array, random: np.random.Generator
    ) -> Array:
        sources, forces = self._load(width, force, centre)
        turn = self.poses.rotation
        apart = np.einsum("nji,nsj->nsi", turn, sources - self.poses.position[:, None])
        seen = self._true.at(apart[..., :2].reshape(-1, 2))[self._pads]
        seen = seen.reshape(-1, len(turn), len(sources), 3)
        local = np.einsum("nji,sj->nsi", turn, forces)
        return self.measured(np.einsum("pnsi,nsi->np", seen, local), random)


def study_pads(
    settings: Sequence[Setting],
    true: Influence,
    known: Influence,
    widths: Sequence[float],
    cases: int,
    progress: Callable[[str, Setting, Errors], None] | None = None,
    seed: int = 8,
) -> dict[tuple[Setting, str], list[Errors]]:
    """Errors of each setting and each of FORMS at each width (m)."""
    results: dict[tuple[Setting, str], list[Errors]] = {}
    for setting in settings:
        for form, influence in zip(FORMS, (None, known), strict=True):
            bench = LayerBench(setting, true, influence)
            results[setting, form] = []
            for width in widths:
                results[setting, form].append(bench.errors(width, cases, seed))
                if progress is not None:
                    progress(form, setting, results[setting, form][-1])
    return results
