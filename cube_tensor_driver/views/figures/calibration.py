# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Pictures of the pads of a cube and of the fit of its calibration."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from ...calibrate.fit import Fit
from ...calibrate.thermal import ThermalFit
from ...core.arrays import Array
from ...core.layout import Layout
from ..meshes import CUBE_EDGES
from .style import MARKERS, print_style

_VIEW = np.array([0.75, -1.0, 0.75])
"""Direction, in the frame of the cube, from the cube to the viewer of the picture."""

_SQUARE = ((-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1))
"""Corners of a square with half a side of 1, as a closed line: the last is equal to the first."""

MAX_TWO_COLUMN_PADS = 12
"""Maximum number of pads for which the legend has two columns; for more pads it has three."""


@print_style()
def draw_layout(layout: Layout) -> Figure:
    """Draw a cube with its pads: visible pads are filled, hidden ones are a dashed outline.

    Args:
        layout: Names, centres and normals of the pads, which lie on the faces of the cube.
    """
    figure = Figure(figsize=(5, 4.6))
    # The code gives each part its drawing order (zorder). matplotlib would sort the parts by the
    # distance of their centres from the viewer, so that some visible parts would be hidden.
    axes: Axes3D = figure.add_subplot(projection="3d", computed_zorder=False)
    _draw_edges(axes)
    for name, centre, normal in zip(
        layout.pads,
        layout.positions,
        layout.normals,
        strict=True,
    ):
        if not normal.any():
            continue  # a dummy pad is on no face
        _draw_pad(
            axes,
            name,
            centre,
            normal,
            layout.pad_size,
        )
    # matplotlib needs the direction of view as two angles.
    x, y, z = _VIEW
    elevation = np.arctan2(z, np.hypot(x, y))
    azimuth = np.arctan2(y, x)
    axes.view_init(elev=np.degrees(elevation), azim=np.degrees(azimuth))
    axes.set(
        xlabel="$x$ / $d_0$",
        ylabel="$y$ / $d_0$",
        zlabel="$z$ / $d_0$ (out of the skin)",
        title=f"layout {layout.name} ($d_0$: half side; dashed: pads behind)",
    )
    axes.set_box_aspect((1, 1, 1))
    for set_ticks in (axes.set_xticks, axes.set_yticks, axes.set_zticks):
        set_ticks([-1, 0, 1])
    return figure


def _draw_edges(axes: Axes3D) -> None:
    """Draw the edges of a cube; the three edges at the corner that is hidden are dotted.

    Args:
        axes: The 3-D axes of matplotlib, in units of half the side of the cube.
    """
    # The hidden corner is the one opposite to the viewer.
    hidden = -np.sign(_VIEW)
    for edge in CUBE_EDGES:
        is_hidden = (edge == hidden).all(axis=1).any()
        color, dash = ("0.6", ":") if is_hidden else ("0.2", "-")
        axes.plot(*edge.T, color=color, ls=dash, lw=1)


def _draw_pad(
    axes: Axes3D,
    name: str,
    centre: Array,
    normal: Array,
    size: float,
) -> None:
    """Draw a square pad with its name; all lengths are in units of half the side of the cube.

    Args:
        axes: The 3-D axes of matplotlib.
        name: Name of the pad.
        centre: (3,) centre of the pad.
        normal: (3,) unit normal out of the cube; one coordinate is 1 or −1, the others are 0.
        size: Length of the sides of the pad.
    """
    in_plane = np.flatnonzero(normal == 0)
    u, w = np.eye(3)[in_plane] * size / 2
    outline = np.array([centre + a * u + b * w for a, b in _SQUARE])
    is_in_front = normal @ _VIEW > 0
    color, dash, order = "0.55", "--", 1
    if is_in_front:
        color, dash, order = "C0", "-", 3
    axes.plot(
        *outline.T,
        color=color,
        lw=1.2,
        ls=dash,
        zorder=order,
    )
    if is_in_front:
        area = Poly3DCollection(
            [outline],
            facecolor="C0",
            alpha=0.25,
            zorder=2,
        )
        axes.add_collection3d(area)
    axes.text(
        # The name is written a little above the face, so that the pad does not cover it.
        *(centre + 0.02 * normal),
        name,
        ha="center",
        va="center",
        fontsize=7,
        color="black" if is_in_front else "0.45",
        zorder=4,
    )


@print_style()
def draw_fit(fit: Fit, measured: Array) -> Figure:
    """Draw measured against fitted pad stresses, and their differences; crosses mark outliers.

    Args:
        fit: Result of the fit of a calibration to N loads.
        measured: (N, P) measured stresses of the P pads under each load, in Pa.
    """
    figure = Figure(figsize=(8, 4))
    left, right = figure.subplots(1, 2)
    pads = fit.structure.layout.pads
    for pad, name in enumerate(pads):
        is_used = ~fit.outliers[:, pad]
        x = fit.fitted[is_used, pad] * 1e-3
        y = measured[is_used, pad] * 1e-3
        style: dict[str, object] = {
            "marker": MARKERS[pad % len(MARKERS)],
            "color": str(0.7 * pad / max(1, len(pads) - 1)),
            "ls": "",
            "ms": 4,
            "mfc": "none",
        }
        left.plot(x, y, label=name, **style)
        right.plot(x, (y - x) * 1e3, **style)

    outliers = fit.outliers
    if outliers.any():
        x = fit.fitted[outliers] * 1e-3
        y = measured[outliers] * 1e-3
        left.plot(
            x,
            y,
            "x",
            color="C3",
            ms=7,
            label="outlier",
        )
    # The points of a perfect fit lie on the diagonal.
    lowest = np.nanmin(fit.fitted)
    highest = np.nanmax(fit.fitted)
    ends = np.array([lowest, highest]) * 1e-3
    left.plot(
        ends,
        ends,
        color="0.5",
        lw=0.8,
        zorder=0,
    )
    left.set(xlabel="fitted pad stress / kPa", ylabel="measured pad stress / kPa")
    left.legend(fontsize=7, ncol=2 if len(pads) <= MAX_TWO_COLUMN_PADS else 3)
    right.axhline(0, color="0.5", lw=0.8)
    right.set(xlabel="fitted pad stress / kPa", ylabel="measured − fitted / Pa")
    right.set_title(
        f"scatter {fit.scale:.2f} × stated noise, held-out error {100 * fit.held_out:.2g} %",
        fontsize=9,
    )
    return figure


@print_style()
def draw_thermal_fit(fit: ThermalFit) -> Figure:
    """Draw temperatures, and the pad stresses without load before and after the compensation.

    Args:
        fit: Result of the fit to the means of N successive blocks of samples of an unloaded cube.
    """
    data = fit.data
    figure = Figure(figsize=(7, 6))
    warm, before, after = figure.subplots(3, 1)
    # The times of the blocks begin at 0 in each bag. So the index of a block is drawn instead,
    # which puts the bags one after the other. A block lasts 1 s, so its index is a time in s.
    time = np.arange(len(data.seconds)) / 60
    warm.plot(
        time,
        data.temperature,
        "k-",
        label="thermometer of the hub",
    )
    elastomer = fit.level + float(fit.model.reference)
    warm.plot(
        time,
        elastomer,
        "C3--",
        label=f"mean of {len(fit.model.lag)} low-pass filters, up to {fit.model.lag.max():.0f} s",
    )
    warm.set(ylabel="temperature / °C")
    warm.legend(fontsize=7)
    _draw_pads(
        before,
        after,
        time,
        data.stress - fit.offset,
        fit.residual,
    )
    if fit.model.ramp is not None:
        # Predicted deviation of a typical pad (rms of all) while the temperature changes, because
        # the elastomer follows the thermometer with a lag.
        squared_slope = (fit.model.ramp**2).sum(axis=1)
        typical_slope = float(np.sqrt(squared_slope.mean()))
        bound = typical_slope * np.abs(data.temperature - elastomer)
        after.fill_between(
            time,
            -bound,
            bound,
            color="C0",
            alpha=0.25,
            label="deviation",
        )
        after.legend(fontsize=7)
    before.set_title(f"stress of the {data.stress.shape[1]} pads without load", fontsize=9)
    return figure


@print_style()
def draw_correction(
    title: str,
    seconds: Array,
    before: Array,
    after: Array,
) -> Figure:
    """Draw stresses of pads before and after the effect of creep or weight is removed by a fit.

    Args:
        title: Title of the picture, which names the stresses.
        seconds: Times (N,), in s.
        before, after: Stresses of P pads (N, P), in Pa.
    """
    figure = Figure(figsize=(7, 4))
    upper, lower = figure.subplots(2, 1, sharex=True)
    _draw_pads(
        upper,
        lower,
        seconds / 60,
        before,
        after,
    )
    upper.set_title(title, fontsize=9)
    return figure


def _draw_pads(
    upper: Axes,
    lower: Axes,
    minutes: Array,
    before: Array,
    after: Array,
) -> None:
    """Draw stresses of pads before and after a compensation.

    Args:
        upper: Axes of matplotlib for the stresses before the compensation.
        lower: Axes for those after it.
        minutes: Times (N,), in minutes.
        before, after: Stresses of P pads (N, P), in Pa.
    """
    for axes, stress, label in ((upper, before, "before / Pa"), (lower, after, "after / Pa")):
        for pad, values in enumerate(stress.T):
            shade = str(0.7 * pad / max(1, len(stress.T) - 1))
            axes.plot(minutes, values, color=shade, lw=0.8)
        axes.set(ylabel=label)
    lower.set(xlabel="time / min")
