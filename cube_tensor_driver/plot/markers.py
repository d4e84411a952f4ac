"""The picture of a skin's markers as RViz draws them."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection
from numpy.typing import NDArray
from visualization_msgs.msg import Marker, MarkerArray

from ..core.tensor import rotation_from_quaternion
from .style import print_style

Array = NDArray[np.float64]

_RVIZ_GREY = (108 / 255, 112 / 255, 118 / 255)
VISIBLE = 0.01
"""Of a colour: less is hidden."""
_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
_FACES = np.array(
    [[0, 1, 3, 2], [4, 5, 7, 6], [0, 1, 5, 4], [2, 3, 7, 6], [0, 2, 6, 4], [1, 3, 7, 5]]
)
_LIGHT = np.array([0.9, 0.7, 0.75, 0.65, 1.0, 0.55])
"""Of the faces −x, +x, −y, +y, −z, +z. The markers node draws boxes that stand on their heads."""


@print_style()
def draw_markers(message: MarkerArray) -> Figure:
    """Cubes with their colours, lines and text. Raises ValueError for another type of marker."""
    figure = Figure(figsize=(7, 5.2), facecolor=_RVIZ_GREY)
    axes: Any = figure.add_subplot(projection="3d", computed_zorder=False)
    axes.set_facecolor(_RVIZ_GREY)
    axes.set_axis_off()
    axes.view_init(elev=38, azim=-75)
    for order, marker in enumerate(message.markers):
        if marker.type == Marker.CUBE_LIST:
            _draw_cubes(axes, marker, order)
        elif marker.type == Marker.LINE_LIST:
            lines, colours = _points(marker).reshape(-1, 2, 3), _colours(marker)[::2]
            axes.add_collection3d(
                Line3DCollection(lines, colors=colours, linewidths=1.6, zorder=10 + order)
            )
        elif marker.type == Marker.TEXT_VIEW_FACING:
            _draw_text(axes, marker)
        else:
            raise ValueError(f"marker {marker.ns} has type {marker.type}")
    _set_limits(axes, message)
    return figure


def _draw_cubes(axes: Any, marker: Marker, order: int) -> None:
    scale = np.array([marker.scale.x, marker.scale.y, marker.scale.z])
    corners = _points(marker)[:, None] + _CORNERS * scale @ _rotation(marker).T
    faces = corners[:, _FACES].reshape(-1, 4, 3)
    shade = (_colours(marker)[:, None, :3] * _LIGHT[:, None]).reshape(-1, 3)
    axes.add_collection3d(Poly3DCollection(faces, facecolors=shade, zorder=order))


def _draw_text(axes: Any, marker: Marker) -> None:
    if marker.color.a < VISIBLE:
        return
    at = marker.pose.position
    axes.text(
        at.x,
        at.y,
        at.z,
        marker.text.strip(" ."),
        color=(marker.color.r, marker.color.g, marker.color.b),
        ha="center",
        va="center",
        fontsize=9,
        zorder=30,
    )


def _set_limits(axes: Any, message: MarkerArray) -> None:
    """Show every point and, since cubes reach beyond their centres, a cube's side around them."""
    points = np.concatenate([_points(marker) for marker in message.markers])
    margin = max(marker.scale.y for marker in message.markers if marker.type == Marker.CUBE_LIST)
    low, high = points.min(axis=0) - margin, points.max(axis=0) + margin
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect(high - low, zoom=1.45)


def _points(marker: Marker) -> Array:
    """(n, 3) in the marker's frame; for a text its position."""
    points = np.array([[p.x, p.y, p.z] for p in marker.points] or [[0.0, 0.0, 0.0]])
    at = marker.pose.position
    moved: Array = points @ _rotation(marker).T + [at.x, at.y, at.z]
    return moved


def _rotation(marker: Marker) -> Array:
    q = marker.pose.orientation
    return rotation_from_quaternion(np.array([q.x, q.y, q.z, q.w]))


def _colours(marker: Marker) -> Array:
    """(n, 4) of each point."""
    each = marker.colors or [marker.color] * len(marker.points)
    return np.array([[c.r, c.g, c.b, c.a] for c in each]).reshape(-1, 4)
