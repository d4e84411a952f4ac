"""Pictures of docs/stress_tensor.md: loads on a cube, what its pads show, what two pads mistake."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from cube_tensor_driver.core.calibration import Calibration
from cube_tensor_driver.views.figures.style import SIGNED_COLOURS, curve_style, print_style

from ..studies.pads_example import BALL_X, LOAD, Sweep, simple_loads

_ARROWS = np.linspace(-0.8, 0.8, 5)
"""Where arrows stand on a face, in half sides."""
_ARROW_LENGTH = 0.45
"""Of the stress LOAD, in half sides."""


@print_style()
def draw_pads(calibration: Calibration) -> Figure:
    """Three loads as arrows on a piece of the elastomer, and below what eight pads show of each."""
    loads = simple_loads(calibration)
    figure = Figure(figsize=(9, 5.6))
    axes = figure.subplots(2, len(loads))
    values = {title: calibration.response @ state for title, state in loads.items()}
    top = 1e-3 * max(np.abs(value).max() for value in values.values())
    colours, norm = colormaps[SIGNED_COLOURS], Normalize(-top, top)
    for column, (title, state) in enumerate(loads.items()):
        named = dict(zip(calibration.modes.names, state, strict=True))
        _draw_load(axes[0, column], named, title)
        _draw_cube(axes[1, column], calibration, 1e-3 * values[title], colours, norm)
    axes[0, 0].set_ylabel("$z\\,/\\,d_0$")
    axes[1, 0].set_ylabel("$z\\,/\\,d_0$")
    return figure


def _draw_load(axis: Any, state: dict[str, float], title: str) -> None:
    """The force that the surroundings exert on each face of a square around the cube."""
    axis.add_patch(Rectangle((-1, -1), 2, 2, fc="0.93", ec="black"))
    scale = _ARROW_LENGTH / abs(LOAD)
    for side in (1, -1):
        for x in _ARROWS:
            length = scale * abs(state["zz"] + state["zz_x"] * x)
            if length > 0.1:
                _arrow(axis, (x, side * (1 + length)), (x, side))
        if state["zx"]:
            near, far = 1.15 * side, 0.9 * side
            _arrow(axis, (-far, near), (far, near))
            _arrow(axis, (near, -far), (near, far))
    _frame(axis, title)


def _arrow(axis: Any, tail: tuple[float, float], tip: tuple[float, float]) -> None:
    style = {"arrowstyle": "-|>", "color": "tab:blue", "shrinkA": 0, "shrinkB": 0}
    axis.annotate("", xy=tip, xytext=tail, arrowprops=style)


def _draw_cube(axis: Any, calibration: Calibration, values: Any, colours: Any, norm: Any) -> None:
    """The section of the cube; each pad has the colour and the number of its stress in kPa."""
    axis.add_patch(Rectangle((-1, -1), 2, 2, fc="0.93", ec="black"))
    layout = calibration.layout
    for centre, normal, value in zip(layout.positions, layout.normals, values, strict=True):
        place, out = centre[[0, 2]], normal[[0, 2]]
        size = np.where(out == 0, 0.85, 0.22)
        corner = place + 0.11 * out - size / 2
        axis.add_patch(Rectangle(corner, *size, fc=colours(norm(value)), ec="black"))
        shown = place + 0.55 * out
        axis.text(*shown, f"{value:.1f}".replace("-", "−"), ha="center", va="center", fontsize=8)
    _frame(axis, "stress of the pads / kPa")
    axis.set_xlabel("$x\\,/\\,d_0$")


def _frame(axis: Any, title: str) -> None:
    axis.set(title=title, xlim=(-2, 2), ylim=(-2, 2), aspect="equal")
    axis.set_xticks((-1, 0, 1))
    axis.set_yticks((-1, 0, 1))
    axis.grid(False)


@print_style()
def draw_sweep(sweep: Sweep) -> Figure:
    """Left: the stress under a ball, with value and slope at the sensor. Right: true and found
    shear over the place of the ball."""
    figure = Figure(figsize=(9, 3.4))
    left, right = figure.subplots(1, 2)
    x = 1e3 * sweep.place
    left.plot(x, 1e-3 * sweep.profile, "k", label="$\\sigma_{zz}$ in the plane of the sensor")
    near = np.array([-2.5, 2.5])
    tangent = 1e-3 * (sweep.value + 1e-3 * sweep.slope * near)
    left.plot(near, tangent, "tab:red", lw=3, label="value and slope at a cube")
    left.plot(0, 1e-3 * sweep.value, "s", color="tab:red")
    left.axvline(1e3 * BALL_X, color="0.6", ls=":", label="the ball presses here")
    left.set(xlabel="$x$ / mm", ylabel="$\\sigma_{zz}$ / kPa")
    left.legend(fontsize=7)
    names = {"true": sweep.truth, "eight pads": sweep.cube, "two upper pads": sweep.pair}
    for number, (name, value) in enumerate(names.items()):
        style = curve_style(number) | {"markevery": (4 * number, 16)}
        right.plot(x, 1e-3 * value, label=name, **style)
    right.set(xlabel="place of the ball, $x$ / mm", ylabel="shear $\\sigma_{zx}$ / kPa")
    right.legend(fontsize=7)
    return figure
