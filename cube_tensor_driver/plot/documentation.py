"""What ./cube pictures draws: the field and its study, the paper's Fig. 8 as we have it, the
markers as in RViz."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection
from numpy.typing import NDArray
from visualization_msgs.msg import Marker, MarkerArray

from ..core.tensor import rotation_from_quaternion
from ..elastic.surface import Surface
from ..research.field_study import DEPTH, FORCE, KINDS, FieldStudy, flat_skin, truth
from ..research.paper import Experiment

RVIZ_GREY = (40 / 255, 42 / 255, 46 / 255)
CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
FACES = np.array(
    [[0, 1, 3, 2], [4, 5, 7, 6], [0, 1, 5, 4], [2, 3, 7, 6], [0, 2, 6, 4], [1, 3, 7, 5]]
)
LIGHT = np.array([0.9, 0.7, 0.75, 0.65, 1.0, 0.55])
"""Of the faces −x, +x, −y, +y, −z, +z of boxes that stand on their heads, as the markers node draws
them."""


def draw_field(pitch: float = 0.010, width: float = 0.012) -> Figure:
    """One contact between the cubes: true pressure, and the field of values alone and of values and
    gradients."""
    skin, centre = flat_skin(pitch, 0.05), pitch * np.array([0.35, 0.25])
    side, load = 20, FORCE * np.array([0.3, 0.0, -1.0])
    surfaces = {
        "values alone": Surface(skin, DEPTH, side, False),
        "values and gradients": Surface(skin, DEPTH, side),
    }
    points = surfaces["values alone"].points
    maps = {"truth": -truth(points, width, load, centre)[:, 2]}
    values = truth(skin.position, width, load, centre)
    maps |= {name: surface.field(values).pressure for name, surface in surfaces.items()}
    figure, axes = plt.subplots(1, 3, figsize=(9, 3.2), sharey=True)
    order = np.lexsort((points[:, 0].round(9), points[:, 1].round(9)))
    n = round(np.sqrt(len(points)))
    x, y = (1e3 * points[order, k].reshape(n, n) for k in (0, 1))
    top = 1e-3 * max(pressure.max() for pressure in maps.values())
    for axis, (name, pressure) in zip(axes, maps.items(), strict=True):
        kilo = 1e-3 * pressure[order].reshape(n, n)
        image = axis.pcolormesh(x, y, kilo, vmin=0, vmax=top, shading="nearest", rasterized=True)
        axis.contour(x, y, kilo, levels=np.arange(2, top, 4), colors="white", linewidths=0.5)
        axis.plot(*(1e3 * skin.position[:, :2].T), "s", ms=4, mfc="none", mec="0.8", label="cube")
        axis.plot(*(1e3 * centre), "P", ms=7, mfc="red", mec="white", mew=0.8, label="load")
        rms = np.sqrt(((pressure - maps["truth"]) ** 2).mean() / (maps["truth"] ** 2).mean())
        axis.set(
            title=name if name == "truth" else f"{name}: {100 * rms:.0f} %",
            xlabel="x / mm",
            aspect="equal",
            xlim=(-22, 22),
            ylim=(-22, 22),
        )
        axis.grid(False)
    axes[0].set_ylabel("y / mm")
    axes[0].legend(fontsize=7, loc="lower left", facecolor="0.3", labelcolor="white")
    figure.colorbar(image, ax=axes, label="pressure in the cubes' plane / kPa")
    return figure


def draw_study(study: FieldStudy) -> Figure:
    """Error of the field over pitch for each width, dashed without gradients: of whole cubes, and
    of planar ones."""
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.8), sharey=True)
    for kind, axis in zip((1, 2), axes, strict=True):
        for row, (width, marker) in enumerate(zip(study.widths, "os^Dv", strict=True)):
            style = {
                "color": str(0.7 * row / len(study.widths)),
                "marker": marker,
                "ms": 4,
                "lw": 1,
            }
            axis.loglog(1e3 * study.pitches, study.error[row, :, 0], ls="--", mfc="none", **style)
            axis.loglog(
                1e3 * study.pitches,
                study.error[row, :, kind],
                label=f"{1e3 * width:.0f} mm",
                **style,
            )
        axis.set(
            xlabel="pitch of the cubes / mm",
            title=("cubes that see every gradient", "planar cubes")[kind - 1],
        )
        axis.set_xticks(
            1e3 * study.pitches, [f"{1e3 * pitch:.0f}" for pitch in study.pitches], minor=False
        )
        axis.minorticks_off()
    axes[0].set_ylabel("rms error / rms pressure")
    axes[0].legend(title="contact width\n(dashed: values alone)", fontsize=7, title_fontsize=7)
    return figure


def tables_text(study: FieldStudy) -> str:
    """Markdown: the field's error of each kind, place and force of a contact, cubes saved."""

    def table(cell: Callable[[int, int], str]) -> str:
        head = (
            "| width \\ pitch | "
            + " | ".join(f"{1e3 * pitch:.0f} mm" for pitch in study.pitches)
            + " |"
        )
        lines = [head, "|---" * (1 + len(study.pitches)) + "|"]
        for row, width in enumerate(study.widths):
            cells = " | ".join(cell(row, column) for column in range(len(study.pitches)))
            lines.append(f"| {1e3 * width:.0f} mm | {cells} |")
        return "\n".join(lines)

    error, position, force = study.error, 1e3 * study.position, study.force
    parts = [
        "field: " + " / ".join(KINDS),
        table(lambda i, j: " / ".join(f"{one:.2f}" for one in error[i, j])),
        "place, p95 in mm: all components / planar",
        table(lambda i, j: " / ".join(f"{one:.2g}" for one in position[i, j, 1:])),
        "force, rms: all components / planar",
        table(lambda i, j: " / ".join(f"{one:.2f}" for one in force[i, j, 1:])),
    ]
    for level in (0.1, 0.2, 0.3, 0.5):
        saved = study.cubes_saved(level)[:, 1:]
        parts.append(
            f"cubes saved at an error of {level}, per width, all / planar: {np.round(saved, 1).tolist()}"
        )
    return "\n\n".join(parts)


def draw_prototype(experiments: Sequence[Experiment]) -> Figure:
    """P_normal, P_shear, P_grad over displacement in the paper's experiments a, b, c, as its Fig. 8
    shows them."""
    figure, axes = plt.subplots(1, len(experiments), figsize=(9, 3.1))
    for axis, one in zip(axes, experiments, strict=True):
        for values, name, style in zip(
            one.prototype.T, ("P_normal", "P_shear", "P_grad"), ("o-", "s--", "^:"), strict=True
        ):
            axis.plot(
                1e3 * one.displacement,
                1e-3 * values,
                style,
                color="black",
                mfc="white",
                ms=4,
                label=name,
            )
        axis.set(title=one.name, xlabel="displacement / mm")
        axis.title.set_fontsize(8)
    axes[0].set_ylabel("Σ ± Δf / kHz")
    axes[0].legend(fontsize=8)
    return figure


def draw_markers(message: MarkerArray) -> Figure:
    """A MarkerArray as RViz draws it: cubes with their colours, lines, text. Raises ValueError:
    another marker type."""
    figure = plt.figure(figsize=(7, 5.2), facecolor=RVIZ_GREY)
    axes: Any = figure.add_subplot(projection="3d", computed_zorder=False)
    axes.set_facecolor(RVIZ_GREY)
    axes.set_axis_off()
    axes.view_init(elev=38, azim=-75)
    for order, marker in enumerate(message.markers):
        points, colours = _points(marker), _colours(marker)
        if marker.type == Marker.CUBE_LIST:
            scale = np.array([marker.scale.x, marker.scale.y, marker.scale.z])
            faces = (points[:, None] + CORNERS * scale @ _turn(marker).T)[:, FACES].reshape(
                -1, 4, 3
            )
            shade = (colours[:, None, :3] * LIGHT[:, None]).reshape(-1, 3)
            axes.add_collection3d(Poly3DCollection(faces, facecolors=shade, zorder=order))
        elif marker.type == Marker.LINE_LIST:
            lines = points.reshape(-1, 2, 3)
            axes.add_collection3d(
                Line3DCollection(lines, colors=colours[::2], linewidths=1.6, zorder=10 + order)
            )
        elif marker.type == Marker.TEXT_VIEW_FACING:
            at = marker.pose.position
            text = marker.text.strip(" .")
            axes.text(
                at.x,
                at.y,
                at.z,
                text,
                color="white",
                ha="center",
                va="center",
                fontsize=9,
                zorder=30,
            )
        else:
            raise ValueError(f"marker {marker.ns} has type {marker.type}")
    every = np.concatenate([_points(marker) for marker in message.markers])
    # Clipped at its box: cubes reach beyond their centres.
    margin = max(marker.scale.y for marker in message.markers if marker.type == Marker.CUBE_LIST)
    low, high = every.min(axis=0) - margin, every.max(axis=0) + margin
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect(high - low, zoom=1.45)
    return figure


def _points(marker: Marker) -> NDArray[np.float64]:
    """(n, 3) in the marker's frame, of a text its place."""
    points = np.array([[p.x, p.y, p.z] for p in marker.points] or [[0.0, 0.0, 0.0]])
    at = marker.pose.position
    moved: NDArray[np.float64] = points @ _turn(marker).T + [at.x, at.y, at.z]
    return moved


def _turn(marker: Marker) -> NDArray[np.float64]:
    q = marker.pose.orientation
    return rotation_from_quaternion(np.array([q.x, q.y, q.z, q.w]))


def _colours(marker: Marker) -> NDArray[np.float64]:
    """(n, 4) of each point."""
    each = marker.colors or [marker.color] * len(marker.points)
    return np.array([[c.r, c.g, c.b, c.a] for c in each]).reshape(-1, 4)
