"""Pictures of the source paper's experiments on the virtual bench."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ..core.modes import PLANE
from ..research.paper import Experiment
from .style import curve_style, print_style

PADS = ("C1", "C2", "C3", "C4")
SIGNALS = ("P_normal", "P_shear", "P_grad")
_ROD_CURVES = {"signal": "P_shear", "shear": "of it: true local shear", "crosstalk": "cross-talk"}


@print_style()
def draw_experiment(result: Experiment) -> Figure:
    """Frequencies and P_normal, P_shear, P_grad as in Figs. 7 and 8, beside stress and gradient.

    Stress and gradient are reconstructed from eight pads (full lines) or true (dashed).
    """
    figure = Figure(figsize=(13, 3.3))
    axes = figure.subplots(1, 4)
    x = 1e3 * result.displacement
    _draw_columns(axes[0], x, result.frequency, PADS)
    axes[0].set(title="frequencies", ylabel="kHz")
    _draw_columns(axes[1], x, result.prototype, SIGNALS)
    axes[1].set(title="prototype, eqs. 8 to 10", ylabel="kHz")
    _draw_modes(axes[2], result, range(3), "stress")
    _draw_modes(axes[3], result, range(3, 7), "gradient times d0")
    for axis in axes:
        axis.legend(fontsize="small", handlelength=3)
        axis.set_xlabel("displacement, mm")
    figure.suptitle(result.name)
    return figure


def _draw_columns(axis: Any, x: np.ndarray, columns: np.ndarray, names: Sequence[str]) -> None:
    for number, name in enumerate(names):
        axis.plot(x, columns[:, number] / 1e3, label=name, **curve_style(number))


def _draw_modes(axis: Any, result: Experiment, modes: range, title: str) -> None:
    x = 1e3 * result.displacement
    for number, mode in enumerate(modes):
        recovered, true = result.recovered[:, mode] / 1e3, result.truth[:, mode] / 1e3
        style = curve_style(number)
        axis.plot(x, recovered, label=PLANE.names[mode], **style | {"linestyle": "-"})
        axis.plot(x, true, **style | {"linestyle": "--"})
    axis.set(title=f"{title} (dashed: true)", ylabel="kPa")
    floor = np.abs(result.recovered).max() / 1e5
    if max(map(abs, axis.get_ylim())) < floor:  # what is smaller is rounding, not a result
        axis.set_ylim(-floor, floor)


@print_style()
def draw_rod_sweep(table: dict[str, list[float]]) -> Figure:
    """The prototype's shear signal over rod positions, split into true shear and cross-talk."""
    figure = Figure(figsize=(6, 3.6))
    axis = figure.subplots()
    place = 1e3 * np.array(table["place"])
    for number, (key, label) in enumerate(_ROD_CURVES.items()):
        axis.plot(place, np.array(table[key]) / 1e3, label=label, **curve_style(number))
    axis.set(xlabel="rod's middle from the cube's middle, mm", ylabel="-v1 + v2 + v3 - v4, kPa")
    axis.legend(handlelength=4)
    return figure


@print_style()
def draw_prototype(experiments: Sequence[Experiment]) -> Figure:
    """P_normal, P_shear, P_grad over displacement, as the paper's Fig. 8 shows them."""
    figure = Figure(figsize=(9, 3.1))
    axes = figure.subplots(1, len(experiments))
    for axis, experiment in zip(axes, experiments, strict=True):
        x = 1e3 * experiment.displacement
        for values, name, style in zip(
            experiment.prototype.T, SIGNALS, ("o-", "s--", "^:"), strict=True
        ):
            axis.plot(x, 1e-3 * values, style, color="black", mfc="white", ms=4, label=name)
        axis.set(title=experiment.name, xlabel="displacement / mm")
        axis.title.set_fontsize(8)
    axes[0].set_ylabel("Σ ± Δf / kHz")
    axes[0].legend(fontsize=8)
    return figure
