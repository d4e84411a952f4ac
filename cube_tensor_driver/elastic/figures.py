"""Pictures of the elasticity results, with matplotlib."""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")  # files only, no window

import matplotlib.pyplot as plt

from ..core.modes import COMPONENTS
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
