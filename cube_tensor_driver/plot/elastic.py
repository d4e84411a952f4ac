"""Pictures of the elasticity results: what is below zero is dark and what is above is light, in
grey too."""

from __future__ import annotations

from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke
from matplotlib.ticker import NullFormatter
from matplotlib.tri import Triangulation
from numpy.typing import NDArray

from ..core.layout import Layout
from ..core.modes import COMPONENTS, PLANE
from ..elastic.body import Body
from ..elastic.fem import Response
from ..research.paper import Experiment, figure_4, loaded_modes
from ..research.study import Study
from ..research.virtual_bench import Bench
from . import plots  # noqa: F401  (its settings hold here too)

Array = NDArray[np.float64]

# told apart in grey too: the same colour never comes with the same marker and dashes
_COLOURS = (
    "black",
    "tab:red",
    "tab:blue",
    "tab:orange",
    "tab:green",
    "tab:purple",
    "tab:brown",
    "0.5",
)
_MARKERS = "os^Dv<>p"
_DASHES = ("-", "--", "-.", ":")
_SIGNED = "cividis"  # its lightness grows all the way, unlike that of red to blue


def _style(k: int) -> dict[str, Any]:
    """Colour, marker and dashes of the k-th curve of a panel."""
    return {
        "color": _COLOURS[k % 8],
        "marker": _MARKERS[k % 8],
        "linestyle": _DASHES[(k + k // 8) % 4],
        "markersize": 4,
        "markerfacecolor": "none",
        "linewidth": 1.2,
    }


def draw_trust(result: Study) -> Figure:
    """Error against indenter width, one panel per layout and cube side; grey: not better than a
    fifth.

    Full lines: stresses; dashed: gradients, the marker for the component and the colour for the
    direction.
    """
    names = list(result.error)
    figure, axes = plt.subplots(
        len(result.sides),
        len(names),
        figsize=(4 * len(names), 3 * len(result.sides)),
        sharex=True,
        sharey=True,
        squeeze=False,
    )
    for row, side in zip(axes, range(len(result.sides)), strict=True):
        for axis, name in zip(row, names, strict=True):
            axis.axhspan(0.2, 100, color="0.92")
            for k, component in enumerate(COMPONENTS):
                error = result.error[name][side, :, k]
                if error[0] == error[0]:  # not NaN: observed
                    axis.loglog(1e3 * result.widths, error, label=component, **_component_style(k))
            axis.set_title(f"{name}, side {1e3 * result.sides[side]:g} mm")
            axis.set_ylim(5e-3, 20)
    handles, labels = axes[0][-1].get_legend_handles_labels()
    figure.legend(handles, labels, ncols=1, loc="outside right center", handlelength=4)
    figure.supxlabel(f"width of the indenter, mm (cube's centre {1e3 * result.depth:g} mm deep)")
    figure.supylabel("largest error over all positions / range of the component")
    return figure


def _component_style(k: int) -> dict[str, Any]:
    """Of component k of 15: six stresses, then the gradients xx_x, xx_y, xx_z, yy_x, ..."""
    if k < 6:
        return _style(k) | {"linestyle": "-"}
    which, along = divmod(k - 6, 3)
    return _style(which) | {
        "linestyle": ("--", "-.", ":")[along],
        "color": ("0.0", "0.35", "tab:cyan")[along],
    }


def draw_convergence(result: Response) -> Figure:
    """How far each coefficient on the coarser meshes is from the finest, relative to the largest
    coefficient."""
    figure, axis = plt.subplots(figsize=(6, 4))
    rows = result.convergence
    last = rows[-1]["coefficients"]
    largest = max(map(abs, last.values()))
    unknowns = [row["unknowns"] for row in rows[:-1]]
    shown = sorted(last, key=lambda name: -abs(last[name]))[:12]
    for k, name in enumerate(shown):
        away = [100 * abs(row["coefficients"][name] - last[name]) / largest for row in rows[:-1]]
        axis.loglog(unknowns, away, label=name, **_style(k))
    axis.set(
        xlabel="unknowns", ylabel=f"distance from {rows[-1]['unknowns']} unknowns, % of the largest"
    )
    if unknowns:
        axis.set_xticks(unknowns, [str(n) for n in unknowns], minor=False)
        axis.xaxis.set_minor_formatter(NullFormatter())
        axis.yaxis.set_major_formatter("{x:g}")
        axis.yaxis.set_minor_formatter("{x:.2g}")
        axis.legend(fontsize="small", ncols=2, handlelength=4)
    return figure


def draw_response(result: Response) -> Figure:
    """The response matrix, pads down and modes across."""
    n_pads, n_modes = result.matrix.shape
    figure, axis = plt.subplots(figsize=(0.6 * n_modes + 2.5, 0.35 * n_pads + 1.5))
    limit = np.abs(result.matrix).max()
    image = axis.imshow(result.matrix, cmap=_SIGNED, vmin=-limit, vmax=limit, aspect="auto")
    axis.grid(False)
    axis.set_xticks(range(n_modes), result.modes, rotation=60 if n_modes > 7 else 0)
    axis.set_yticks(range(n_pads), [f"V{k + 1}  {pad}" for k, pad in enumerate(result.layout.pads)])
    for (pad, mode), value in np.ndenumerate(result.matrix):
        if abs(value) > 5e-3 * limit:
            color = "black" if value > -0.1 * limit else "white"
            axis.text(mode, pad, f"{value:.2f}", ha="center", va="center", fontsize=7, color=color)
    figure.colorbar(image, ax=axis, label="pad stress per mode, Pa per Pa")
    return figure


def draw_loads(body: Body, layout: Layout) -> Figure:
    """sigma_zz around the cube under 10 kPa of every plane mode, with pads, deformed outline and
    displacements."""
    bench = Bench(body, layout=layout, size=0.3)
    found = loaded_modes(bench, PLANE.names)
    figure, axes = plt.subplots(4, 2, figsize=(10, 12))
    for axis, (name, (moved, stress)) in zip(axes.flat, found.items(), strict=False):
        scale = _draw_field(axis, bench, moved, stress, 4)
        axis.set_title(f"{name}, 10 kPa (displacements times {scale:.2g})")
        d0 = 1e3 * body.side / 2
        for place, normal in zip(
            layout.positions[:, [0, 2]], layout.normals[:, [0, 2]], strict=True
        ):
            ends = place + np.outer((-0.5, 0.5), layout.pad_size * (1 - np.abs(normal)))
            axis.plot(*(d0 * ends.T), color="black", linewidth=7, solid_capstyle="butt")
            axis.plot(
                *(d0 * ends.T),
                color="white",
                linewidth=3.5,
                linestyle=(0, (0.5, 0.5)),
                dash_capstyle="butt",
            )
    axes.flat[-1].axis("off")
    axes.flat[-1].legend(
        handles=[Patch(facecolor="white", edgecolor="black", hatch="||||", label="pad")],
        loc="center",
        handlelength=4,
    )
    figure.supxlabel("x, mm")
    return figure


def draw_figure_4() -> Figure:
    """The z component of the normal stress around the cube, with the deformed outline and arrows of
    displacement."""
    figure, axes = plt.subplots(2, 1, figsize=(6, 6))
    titles = {
        "zx": "(a) shear only, 10 kPa",
        "zz_x": "(b) normal stress growing along x, 10 kPa per d0",
    }
    bench, found = figure_4()
    scale = 1.0
    for axis, (name, (moved, stress)) in zip(axes, found.items(), strict=True):
        scale = _draw_field(axis, bench, moved, stress, 6)
        axis.set(title=titles[name])
    axes[-1].set_xlabel(f"x, mm (displacements drawn times {scale:.2g})")
    return figure


def _draw_field(axis: Any, bench: Bench, moved: Array, stress: Array, window: float) -> float:
    """sigma_zz on the deformed body within `window` d0 of the cube; returns the scale of the
    displacements."""
    d0 = bench.body.side / 2
    near = np.abs(bench.mesh.p[0]) < window
    scale = 0.4 * d0 / np.hypot(*moved[:, near]).max()
    at = 1e3 * (d0 * bench.mesh.p + scale * moved)
    ring = np.abs(bench.mesh.p).max(axis=0)
    around = ring[bench.mesh.t].max(axis=0) > 1 + 1e-9
    around &= np.all(
        np.abs(bench.mesh.p[0, bench.mesh.t]) < window + 1, axis=0
    )  # labels of contours must be in view
    outside = bench.mesh.t[:, around]
    total = np.bincount(outside.ravel(), np.tile(stress[around] / 1e3, 3), len(ring))
    kilopascal = total / np.maximum(np.bincount(outside.ravel(), minlength=len(ring)), 1)
    limit = np.percentile(np.abs(kilopascal[near & (ring >= 1)]), 95)
    triangles = Triangulation(at[0], at[1], outside.T)
    image = axis.tripcolor(
        triangles, kilopascal, cmap=_SIGNED, vmin=-limit, vmax=limit, shading="gouraud"
    )
    steps = np.multiply.outer([1, 2, 3, 5], 10.0 ** np.arange(-9, 10)).ravel()
    step = steps[np.argmin(np.abs(np.log(4 * steps / limit)))]
    levels = step * (
        np.arange(-5, 5) + 0.5
    )  # none at 0 or at 10 kPa, which large parts of the body may have
    lines = axis.tricontour(
        triangles, kilopascal, levels, colors="black", linewidths=0.7
    )  # below zero dashed
    for label in axis.clabel(lines, fontsize=7, fmt="%g", inline=False):
        label.set_path_effects([withStroke(linewidth=2, foreground="white")])
        if np.abs(label.get_position()).max() < 1.5e3 * d0:  # too narrow beside the cube
            label.remove()
    tall = min(window, bench.body.height / 2 / d0) - 0.25
    grid = (
        np.mgrid[-window + 1 : window - 0.9, -tall : tall + 0.1 : tall / 2.5]
        .reshape(2, -1, 1)
        .swapaxes(0, 1)
    )
    few = [np.argmin(np.hypot(*(bench.mesh.p - point))) for point in grid]
    axis.quiver(
        *at[:, few],
        *moved[:, few],
        color="black",
        edgecolor="white",
        linewidth=0.3,
        width=0.004,
        angles="xy",
    )
    corners = 1e3 * d0 * np.array([[-1, 1, 1, -1, -1], [-1, -1, 1, 1, -1]])
    axis.plot(*corners, "k:", linewidth=0.8)
    face = np.flatnonzero(np.isclose(ring, 1))
    outline = at[:, face[np.argsort(np.arctan2(*bench.mesh.p[::-1, face]))]]
    axis.fill(*outline, facecolor="white", edgecolor="black", linewidth=1.2)
    edge, top = 1e3 * d0 * window, min(1e3 * d0 * window, 600 * bench.body.height)
    axis.set(xlim=(-edge, edge), ylim=(-top, top), aspect="equal", ylabel="z, mm")
    axis.grid(False)
    axis.figure.colorbar(image, ax=axis, label="sigma_zz, kPa (dashed: negative)").add_lines(lines)
    return float(scale)


def draw_experiment(result: Experiment) -> Figure:
    """Frequencies and P_normal, P_shear, P_grad as in Figs. 7 and 8, beside the reconstruction and
    the truth."""
    figure, axes = plt.subplots(1, 4, figsize=(13, 3.3))
    x = 1e3 * result.displacement
    for k, label in enumerate(("C1", "C2", "C3", "C4")):
        axes[0].plot(x, result.frequency[:, k] / 1e3, label=label, **_style(k))
    axes[0].set(title="frequencies", ylabel="kHz")
    for k, label in enumerate(("P_normal", "P_shear", "P_grad")):
        axes[1].plot(x, result.prototype[:, k] / 1e3, label=label, **_style(k))
    axes[1].set(title="prototype, eqs. 8 to 10", ylabel="kHz")
    for axis, modes, title in (
        (axes[2], range(3), "stress"),
        (axes[3], range(3, 7), "gradient times d0"),
    ):
        for k, mode in enumerate(modes):
            axis.plot(
                x,
                result.recovered[:, mode] / 1e3,
                label=PLANE.names[mode],
                **_style(k) | {"linestyle": "-"},
            )
            axis.plot(x, result.truth[:, mode] / 1e3, **_style(k) | {"linestyle": "--"})
        axis.set(title=f"{title} (dashed: true)", ylabel="kPa")
        floor = np.abs(result.recovered).max() / 1e5
        if max(map(abs, axis.get_ylim())) < floor:  # rounding, not a result
            axis.set_ylim(-floor, floor)
    for axis in axes:
        axis.legend(fontsize="small", handlelength=3)
        axis.set_xlabel("displacement, mm")
    figure.suptitle(result.name)
    return figure


def draw_rod_sweep(table: dict[str, list[float]]) -> Figure:
    """The prototype's shear signal over rod positions, split into true shear and cross-talk."""
    figure, axis = plt.subplots(figsize=(6, 3.6))
    place = 1e3 * np.array(table["place"])
    curves = {"signal": "P_shear", "shear": "of it: true local shear", "crosstalk": "cross-talk"}
    for k, (key, label) in enumerate(curves.items()):
        axis.plot(place, np.array(table[key]) / 1e3, label=label, **_style(k))
    axis.set(xlabel="rod's middle from the cube's middle, mm", ylabel="-v1 + v2 + v3 - v4, kPa")
    axis.legend(handlelength=4)
    return figure
