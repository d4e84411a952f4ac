"""Pictures of what each pad sees of forces on the surface."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from cube_tensor_driver.core.layout import Layout
from cube_tensor_driver.mechanics.influence import Influence
from cube_tensor_driver.views.figures.style import curve_style, print_style

_POINTS = 201
_REACH = 8
"""How far the picture goes, in half sides of the cube."""


@print_style()
def draw_influence(influence: Influence, layout: Layout, half_side: float) -> Figure:
    """Stress of each pad over the place of a force along x, through the cube's middle.

    A panel for each direction of the force in the plane of x and z. Pads with the same curve share
    one.
    """
    dim = influence.place.shape[1]
    reach = min(_REACH * half_side, *np.abs([influence.place[0, 0], influence.place[-1, 0]]))
    x = np.linspace(-reach, reach, _POINTS)
    stress = influence.at(x[:, None] * np.eye(dim)[0])[:, :, [-1, 0]]  # forces along z and x
    unit, of_force = (1.0, "1 N/mm") if layout.planar else (1e3, "1 N")
    figure = Figure(figsize=(10, 4.5))
    panels = figure.subplots(1, 2)
    for number, pads in enumerate(_alike(stress)):
        label = ", ".join(layout.pads[pad] for pad in pads)
        for axis, curve in zip(
            panels, (-stress[pads[0], :, 0], stress[pads[0], :, 1]), strict=True
        ):
            axis.plot(1e3 * x, curve / unit, label=label, markevery=20, **curve_style(number))
    for axis, what in zip(panels, ("pressing", "along x"), strict=True):
        axis.set(
            xlabel="place of the force from the cube's middle, x / mm",
            ylabel="stress of the pad / kPa",
            title=f"a force of {of_force} {what}",
        )
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncol=3, fontsize="small")
    return figure


def _alike(stress: np.ndarray) -> list[list[int]]:
    """Numbers of pads (P, ...) with the same values, to a thousandth of the largest."""
    kinds: list[list[int]] = []
    close = 1e-3 * np.abs(stress).max()
    for pad, values in enumerate(stress):
        same = next((k for k in kinds if np.abs(stress[k[0]] - values).max() < close), None)
        if same is None:
            kinds.append([pad])
        else:
            same.append(pad)
    return kinds
