"""Pictures for print: units on every axis, readable in grey, no display needed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from numpy.typing import NDArray

matplotlib.use("Agg")

import matplotlib.pyplot as plt
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from ..config.atomic_write import atomic_write
from ..core.errors import ConfigError
from ..core.fit import Fit
from ..core.layout import Layout
from ..simulation.verification import Forces

plt.rcParams |= {
    "font.size": 9,
    "axes.grid": True,
    "grid.color": "0.85",
    "grid.linewidth": 0.5,
    "figure.constrained_layout.use": True,
    "savefig.dpi": 200,
}
MARKERS = "osD^v<>pP*hX"


def save(figure: Figure, path: Path) -> None:
    """Write a figure, whole or not at all; the suffix says the format. ConfigError: cannot be, or
    no such format."""
    try:
        check_picture(path)
        with atomic_write(path) as partial:
            figure.savefig(partial, format=path.suffix[1:] or "png")
    finally:
        plt.close(figure)


def check_picture(path: Path) -> None:
    """ConfigError: the suffix is no format of a picture."""
    formats = FigureCanvasAgg.get_supported_filetypes()
    if path.suffix and path.suffix[1:].lower() not in formats:
        raise ConfigError(
            f"{path}: {path.suffix!r} is no format of a picture; take one of {', '.join(formats)}"
        )


def draw_layout(layout: Layout) -> Figure:
    """The cube with its pads: pads on the faces towards the viewer filled, those behind only
    outlined."""
    figure = plt.figure(figsize=(5, 4.6))
    axes: Any = figure.add_subplot(projection="3d", computed_zorder=False)
    view = np.array([0.75, -1.0, 0.75])
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    hidden = -np.sign(view)
    for i, a in enumerate(corners):
        for b in corners[i + 1 :]:
            if np.count_nonzero(a != b) == 1:
                behind = np.array_equal(a, hidden) or np.array_equal(b, hidden)
                axes.plot(
                    *np.stack([a, b], axis=1),
                    color="0.6" if behind else "0.2",
                    ls=":" if behind else "-",
                    lw=1,
                )
    for name, centre, normal in zip(layout.pads, layout.positions, layout.normals, strict=True):
        u, w = np.eye(3)[np.flatnonzero(normal == 0)] * layout.pad_size / 2
        outline = np.array(
            [centre + a * u + b * w for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1))]
        )
        front = normal @ view > 0
        axes.plot(
            *outline.T,
            color="C0" if front else "0.55",
            lw=1.2,
            ls="-" if front else "--",
            zorder=3 if front else 1,
        )
        if front:
            from mpl_toolkits.mplot3d.art3d import Poly3DCollection

            axes.add_collection3d(Poly3DCollection([outline], facecolor="C0", alpha=0.25, zorder=2))
        place = centre + 0.02 * normal
        axes.text(
            *place,
            name,
            ha="center",
            va="center",
            fontsize=7,
            color="black" if front else "0.45",
            zorder=4,
        )
    elevation, azimuth = (
        np.degrees(np.arctan2(view[2], np.hypot(*view[:2]))),
        np.degrees(np.arctan2(view[1], view[0])),
    )
    axes.view_init(elev=elevation, azim=azimuth)
    axes.set(
        xlabel="x / d0",
        ylabel="y / d0",
        zlabel="z / d0 (out of the skin)",
        title=f"layout {layout.name}",
    )
    axes.set_box_aspect((1, 1, 1))
    for set_ticks in (axes.set_xticks, axes.set_yticks, axes.set_zticks):
        set_ticks([-1, 0, 1])
    return figure


def draw_fit(fit: Fit, measured: NDArray[np.float64]) -> Figure:
    """Measured against fitted pad stresses and what is left; outliers crossed. measured: (N, P)
    Pa."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(8, 4))
    for pad, name in enumerate(fit.structure.layout.pads):
        keep = ~fit.outliers[:, pad]
        x, y = fit.fitted[keep, pad] * 1e-3, measured[keep, pad] * 1e-3
        grey = str(0.7 * pad / max(1, fit.structure.layout.n_pads - 1))
        style = {
            "marker": MARKERS[pad % len(MARKERS)],
            "color": grey,
            "ls": "",
            "ms": 4,
            "mfc": "none",
        }
        left.plot(x, y, label=name, **style)
        right.plot(x, (y - x) * 1e3, **style)
    out = fit.outliers
    if out.any():
        left.plot(
            fit.fitted[out] * 1e-3, measured[out] * 1e-3, "x", color="C3", ms=7, label="outlier"
        )
    ends = np.array([np.nanmin(fit.fitted), np.nanmax(fit.fitted)]) * 1e-3
    left.plot(ends, ends, color="0.5", lw=0.8, zorder=0)
    left.set(xlabel="fitted pad stress / kPa", ylabel="measured pad stress / kPa")
    left.legend(fontsize=7, ncols=2 if fit.structure.layout.n_pads <= 12 else 3)
    right.axhline(0, color="0.5", lw=0.8)
    right.set(xlabel="fitted pad stress / kPa", ylabel="measured − fitted / Pa")
    right.set_title(
        f"scatter {fit.scale:.2f} × stated noise, held-out error {100 * fit.held_out:.2g} %",
        fontsize=9,
    )
    return figure


def draw_forces(forces: Forces, cubes: NDArray[np.float64]) -> Figure:
    """Force on a skin and its centre over time, the script's and as measured, and the centre's way
    over the cubes."""
    figure, axes = plt.subplot_mosaic(
        [["force", "way"], ["centre", "way"]], figsize=(9, 5), width_ratios=[2.2, 1]
    )
    seconds = forces.seconds - forces.seconds.min()
    for name, unit, truth, found in (
        ("force", 1.0, forces.force, forces.found_force),
        ("centre", 1e3, forces.centre, forces.found_centre),
    ):
        for axis, (letter, mark, color, dash) in enumerate(
            zip("xyz", "osD", ("C0", "C1", "black"), ("--", ":", "-"), strict=True)
        ):
            axes[name].plot(seconds, unit * truth[:, axis], color=color, lw=1, ls=dash)
            axes[name].plot(
                seconds, unit * found[:, axis], mark, color=color, mfc="none", ms=3, label=letter
            )
    handles, labels = axes["force"].get_legend_handles_labels()
    axes["force"].legend(
        handles,
        labels,
        title="lines: script, marks: measured",
        ncols=3,
        loc="lower left",
        bbox_to_anchor=(0, 1),
    )
    axes["force"].set(ylabel="force on the skin / N")
    axes["centre"].set(
        xlabel="time / s", ylabel="centre of pressure / mm", xlim=axes["force"].get_xlim()
    )
    axes["way"].plot(1e3 * cubes[:, 1], 1e3 * cubes[:, 0], "s", color="0.8", ms=3)
    axes["way"].plot(1e3 * forces.centre[:, 1], 1e3 * forces.centre[:, 0], color="black", lw=1)
    axes["way"].plot(
        1e3 * forces.found_centre[:, 1],
        1e3 * forces.found_centre[:, 0],
        "o",
        color="C3",
        mfc="none",
        ms=3,
    )
    axes["way"].set(xlabel="y / mm", ylabel="x / mm", aspect="equal")
    axes["way"].set_title("centre of pressure, cubes", fontsize=9)
    return figure


def draw_scale(rows: list[dict[str, Any]]) -> Figure:
    """CPU per frame of chain and floor, and latency, over the number of cubes; rows as `./cube
    bench skin` gives."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(8, 3.6))
    cubes = [row["cubes"] for row in rows]
    for name, style in (("driver", "o-"), ("reconstruction", "s-"), ("echo", "^:")):
        key = f"cpu_{name}_percent" if name != "echo" else "echo_cpu_percent"
        used = [1e4 * row[key] / row["rate_hz"] for row in rows]
        left.plot(
            cubes,
            used,
            style,
            color="0.55" if name == "echo" else "black",
            mfc="white",
            ms=5,
            label=name,
        )
    left.set(xscale="log", xlabel="cubes", ylabel="CPU per frame / µs", ylim=(0, None))
    left.legend()
    for name, style in (("p50", "o-"), ("p99", "s--")):
        right.plot(
            cubes,
            [row[f"latency_{name}_ms"] for row in rows],
            style,
            color="black",
            mfc="white",
            ms=5,
            label=name,
        )
    right.set(
        xscale="log",
        xlabel="cubes",
        ylabel="latency, pads read to tensor received / ms",
        ylim=(0, None),
    )
    for axis in (left, right):
        axis.set_xticks(cubes, [str(count) for count in cubes])
        axis.xaxis.minorticks_off()
    right.legend()
    return figure
