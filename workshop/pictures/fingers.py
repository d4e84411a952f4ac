"""A robot in simulation, and beside it what the skin of its fingers feels."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from cube_tensor_driver.core.modes import STRESS
from cube_tensor_driver.core.poses import CubePoses
from cube_tensor_driver.core.rows import StressRows
from cube_tensor_driver.touch.surface import Surface
from cube_tensor_driver.views.figures.style import print_style

ARROW_KPA = 2.0
"""Shear of the arrow in the key."""


@print_style()
def draw_fingers(
    pixels: NDArray[np.uint8],
    poses: CubePoses,
    rows: StressRows,
    fingers: Mapping[str, NDArray[np.intp]],
    depth: float,
) -> Figure:
    """Pressure between the cubes of each finger, and the shear on each of them as arrows.

    pixels: (height, width, 3) of the robot
    poses: in a parent frame whose x is across a finger and whose z is up; depth: of the cubes, m
    rows: one row per cube of the skin, in any order
    fingers: name -> numbers of its cubes
    """
    values = np.full((len(poses.position), 15), np.nan)
    values[rows.cube] = np.concatenate([rows.stress, rows.gradient], axis=1)
    maps = {}
    for name, cubes in fingers.items():
        part = CubePoses(*(column[cubes] for column in poses))
        surface = Surface(part, depth, side=6)
        maps[name] = (part, surface.points, 1e-3 * surface.field(values[cubes]).pressure)
    top = max(float(np.nanmax(pressure)) for *_, pressure in maps.values())

    figure = Figure(figsize=(9, 4))
    robot, *axes = figure.subplots(1, 1 + len(maps), width_ratios=[1.9] + [1.0] * len(maps))
    robot.imshow(pixels)
    robot.set_axis_off()
    for axis, (name, (part, points, pressure)) in zip(axes, maps.items(), strict=True):
        order = np.lexsort((points[:, 0].round(6), points[:, 2].round(6)))
        shape = (-1, len(np.unique(points[:, 0].round(6))))
        x, z = (1e3 * points[order, k].reshape(shape) for k in (0, 2))
        image = axis.pcolormesh(x, z, pressure[order].reshape(shape), vmin=0, vmax=top)
        image.set_rasterized(True)
        shear = 1e-3 * values[fingers[name]][:, [STRESS.index("zx"), STRESS.index("yz")]]
        along = np.einsum("nik,nk->ni", part.rotation[:, :, :2], shear)
        place = 1e3 * part.position
        axis.plot(place[:, 0], place[:, 2], "s", ms=3, mfc="none", mec="0.7", lw=0.5)
        arrows = axis.quiver(
            place[:, 0],
            place[:, 2],
            along[:, 0],
            along[:, 2],
            color="black",
            angles="xy",
            scale_units="xy",
            scale=ARROW_KPA / 5,
            width=0.012,
        )
        label = f"shear {ARROW_KPA:g} kPa"
        axis.quiverkey(arrows, 0.5, 1.04, ARROW_KPA, label, color="black", labelpos="N")
        axis.set(title=f"{name} finger\n\n", xlabel="$x$ / mm", aspect="equal")
        axis.grid(False)
    axes[0].set_ylabel("$z$ / mm")
    figure.colorbar(image, ax=axes, label="pressure in the cubes' plane / kPa")
    return figure
