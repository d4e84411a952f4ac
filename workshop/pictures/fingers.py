# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""A robot in simulation, and beside it pressure and shear on the skin of its fingers."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from cube_tensor_driver.core.arrays import Array, Index
from cube_tensor_driver.core.modes import STRESS
from cube_tensor_driver.core.poses import CubePoses
from cube_tensor_driver.core.rows import StressRows
from cube_tensor_driver.touch.surface import Surface
from cube_tensor_driver.views.figures.style import print_style

ARROW_KPA = 1.0
"""Shear stress that the arrow in the key of the picture stands for, in kPa."""
ARROW_MM = 5.0
"""Length of the arrow in the key of the picture, in mm on the finger."""
COLOURS = "Wistia"
"""Colour map of the pressure. All of its colours are so light that black arrows are seen."""
SURFACE_SIDE = 6
"""Number of points along the side of the square around each cube in which pressure is drawn."""


@print_style()
def draw_fingers(
    pixels: NDArray[np.uint8],
    poses: CubePoses,
    rows: StressRows,
    fingers: Mapping[str, Index],
    depth: float,
) -> Figure:
    """Draw the pressure between the cubes of each finger, and the shear on each cube as arrows.

    Args:
        pixels: (height, width, 3) picture of the robot.
        poses: Poses in a parent frame whose x is across a finger and whose z is up.
        rows: One row per cube of the skin, in any order.
        fingers: Numbers of the cubes of each finger by its name.
        depth: Depth of the cubes, in m.
    """
    values = np.full((len(poses.position), 15), np.nan)
    values[rows.cube] = np.concatenate([rows.stress, rows.gradient], axis=1)
    parts = {}
    pressures = {}
    points = {}
    for name, cubes in fingers.items():
        parts[name] = CubePoses(*(column[cubes] for column in poses))
        surface = Surface(parts[name], depth, side=SURFACE_SIDE)
        points[name] = surface.points
        pressures[name] = 1e-3 * surface.field(values[cubes]).pressure
    # One scale for all fingers. It does not begin at zero, because the pressure hardly varies.
    values_kpa = np.concatenate(list(pressures.values()))
    lowest, highest = np.nanmin(values_kpa), np.nanmax(values_kpa)

    figure = Figure(figsize=(9, 4.4))
    robot, *axes = figure.subplots(
        1,
        1 + len(fingers),
        width_ratios=[1.9] + [1.0] * len(fingers),
    )
    robot.imshow(pixels)
    robot.set_axis_off()
    for axis, (name, cubes) in zip(axes, fingers.items(), strict=True):
        x, _, z = 1e3 * points[name].T
        image = axis.tripcolor(
            x,
            z,
            pressures[name],
            vmin=lowest,
            vmax=highest,
            shading="gouraud",
            cmap=COLOURS,
            rasterized=True,
        )
        _draw_shear(axis, parts[name], 1e-3 * values[cubes])
        axis.set(
            title=f"{name} finger\n\n",
            xlabel="$x$ / mm",
            aspect="equal",
        )
        axis.grid(False)
        # Room for the arrows at the edges.
        axis.margins(0.22, 0.1)
    axes[0].set_ylabel("$z$ / mm")
    figure.colorbar(
        image,
        ax=axes,
        label="pressure in the cubes' plane / kPa",
    )
    return figure


def _draw_shear(
    axis: Axes,
    poses: CubePoses,
    kilopascal: Array,
) -> None:
    """Draw the shear of cubes, whose components are (cubes, 15), as arrows."""
    shear = kilopascal[:, [STRESS.index("zx"), STRESS.index("yz")]]
    # The shear acts along the x and y axes of each cube.
    along = np.einsum("nik,nk->ni", poses.rotation[:, :, :2], shear)
    x, _, z = 1e3 * poses.position.T
    axis.plot(x, z, "s", ms=3, mfc="none", mec="0.4", lw=0.5)
    arrows = axis.quiver(
        x,
        z,
        along[:, 0],
        along[:, 2],
        color="black",
        angles="xy",
        scale_units="xy",
        scale=ARROW_KPA / ARROW_MM,
        width=0.012,
    )
    label = f"shear {ARROW_KPA:g} kPa"
    axis.quiverkey(
        arrows,
        0.5,
        1.04,
        ARROW_KPA,
        label,
        color="black",
        labelpos="N",
    )
