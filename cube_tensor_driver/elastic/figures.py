"""Pictures of the elasticity results, with matplotlib."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import matplotlib

matplotlib.use("Agg")  # files only, no window

import matplotlib.pyplot as plt
import numpy as np

from ..core.modes import COMPONENTS, PLANE
from .paper import Experiment, experiments, figure_4, rod_sweep
from .study import Study


def plot_study(result: Study, path: Path) -> None:
    """Error against indenter width, one panel per layout and cube side; grey: not better than a fifth."""
    names = list(result.error)
    figure, axes = plt.subplots(
        len(result.sides), len(names), figsize=(4 * len(names), 3 * len(result.sides)), sharex=True, sharey=True,
        squeeze=False, layout="constrained",
    )  # fmt: skip
    for row, side in zip(axes, range(len(result.sides)), strict=True):
        for axis, name in zip(row, names, strict=True):
            axis.axhspan(0.2, 100, color="0.92")
            for k, component in enumerate(COMPONENTS):
                error = result.error[name][side, :, k]
                if error[0] == error[0]:  # not NaN: observed
                    style = "-" if k < 6 else "--"
                    axis.loglog(1e3 * result.widths, error, style, color=f"C{k % 10}", label=component)
            axis.set_title(f"{name}, side {1e3 * result.sides[side]:g} mm", fontsize="medium")
            axis.set_ylim(5e-3, 20)
    axes[0][-1].legend(fontsize="x-small", ncols=3)
    figure.supxlabel(f"width of the indenter, mm (cube's centre {1e3 * result.depth:g} mm deep)")
    figure.supylabel("largest error over all positions / range of the component")
    figure.savefig(path, dpi=120)
    plt.close(figure)


def plot_figure_4(path: Path) -> None:
    """The z component of the normal stress around the cube, with the deformed outline and arrows of displacement."""
    figure, axes = plt.subplots(2, 1, figsize=(7, 7), layout="constrained")
    titles = {"zx": "(a) shear only, 10 kPa", "zz_x": "(b) normal stress growing along x, 10 kPa per d0"}
    for axis, (name, (bench, moved, stress)) in zip(axes, figure_4().items(), strict=True):
        d0 = bench.body.side / 2
        window = 6 * d0
        near = np.abs(bench.mesh.p[0]) * d0 < window
        scale = 0.4 * d0 / np.hypot(*moved[:, near]).max()
        at = 1e3 * (d0 * bench.mesh.p + scale * moved)
        limit = np.percentile(np.abs(stress[near[bench.mesh.t].all(axis=0)]), 98) / 1e3
        image = axis.tripcolor(at[0], at[1], bench.mesh.t.T, stress / 1e3, cmap="RdBu_r", vmin=-limit, vmax=limit)
        ring = np.abs(bench.mesh.p).max(axis=0)
        grid = np.mgrid[-5:5.1:1, -2.5:2.6:1].reshape(2, -1, 1).swapaxes(0, 1)
        few = [np.argmin(np.hypot(*(bench.mesh.p - point))) for point in grid]
        axis.quiver(*at[:, few], *moved[:, few], color="0.25", width=0.002, angles="xy")
        corners = 1e3 * d0 * np.array([[-1, 1, 1, -1, -1], [-1, -1, 1, 1, -1]])
        axis.plot(*corners, "k:", linewidth=0.8)
        face = np.flatnonzero(np.isclose(ring, 1))
        outline = at[:, face[np.argsort(np.arctan2(*bench.mesh.p[::-1, face]))]]
        axis.plot(*np.append(outline, outline[:, :1], axis=1), "k-", linewidth=1.2)
        axis.set(xlim=(-1e3 * window, 1e3 * window), aspect="equal", title=titles[name], ylabel="z, mm")
        figure.colorbar(image, ax=axis, label="sigma_zz, kPa")
    axes[-1].set_xlabel(f"x, mm (displacements enlarged {scale:.3g} times)")
    figure.savefig(path, dpi=120)
    plt.close(figure)


def plot_experiment(result: Experiment, path: Path) -> None:
    """Frequencies and P_normal, P_shear, P_grad as in Figs. 7 and 8, beside the reconstruction and the truth."""
    figure, axes = plt.subplots(1, 4, figsize=(15, 3.6), layout="constrained")
    x = 1e3 * result.displacement
    axes[0].plot(x, result.frequency / 1e3, "o-", label=["C1", "C2", "C3", "C4"])
    axes[0].set(title="frequencies", ylabel="kHz")
    axes[1].plot(x, result.prototype / 1e3, "o-", label=["P_normal", "P_shear", "P_grad"])
    axes[1].set(title="prototype, eqs. 8 to 10", ylabel="kHz")
    for axis, modes, title in ((axes[2], range(3), "stress"), (axes[3], range(3, 7), "gradient times d0")):
        for k, mode in enumerate(modes):
            axis.plot(x, result.recovered[:, mode] / 1e3, "o-", color=f"C{k}", label=PLANE.names[mode])
            axis.plot(x, result.truth[:, mode] / 1e3, "--", color=f"C{k}")
        axis.set(title=f"{title} (dashed: true)", ylabel="kPa")
    for axis in axes:
        axis.legend(fontsize="x-small")
        axis.set_xlabel("displacement, mm")
    figure.suptitle(result.name)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def plot_rod_sweep(table: dict[str, list[float]], path: Path) -> None:
    """The prototype's shear signal over rod positions, split into true shear and cross-talk."""
    figure, axis = plt.subplots(figsize=(6, 3.6), layout="constrained")
    place = 1e3 * np.array(table["place"])
    for key, label in (("signal", "P_shear"), ("shear", "of it: true local shear"), ("crosstalk", "cross-talk")):
        axis.plot(place, np.array(table[key]) / 1e3, "o-", label=label)
    axis.set(xlabel="rod's middle from the cube's middle, mm", ylabel="-v1 + v2 + v3 - v4, kPa")
    axis.legend()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def make_paper(out: Path, progress: Callable[[int, int, str], None] | None = None) -> None:
    """All pictures of docs/paper.md, and their numbers as paper.json, into the folder `out`."""
    out.mkdir(parents=True, exist_ok=True)
    plot_figure_4(out / "figure_4.png")
    numbers: dict[str, object] = {}
    for finite, kind in ((False, "linear"), (True, "finite")):
        for number, result in enumerate(experiments(finite=finite, progress=progress)):
            plot_experiment(result, out / f"experiment_{number + 1}_{kind}.png")
            numbers[f"{result.name}, {kind}"] = {
                "displacement": result.displacement.tolist(),
                "prototype": result.prototype.tolist(),
                "pads": result.pads.tolist(),
                "recovered": result.recovered.tolist(),
                "truth": result.truth.tolist(),
            }
    table = rod_sweep()
    plot_rod_sweep(table, out / "rod_positions.png")
    numbers["rod positions"] = table
    (out / "paper.json").write_text(json.dumps(numbers, indent=1), encoding="utf-8")
