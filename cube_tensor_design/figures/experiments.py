"""Pictures of the source paper's experiments on the virtual bench."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from cube_tensor_driver.core.modes import PLANE
from cube_tensor_driver.views.figures.style import curve_style, print_style, symbol

from ..paper.experiments import Experiment
from ..paper.rod_parts import RodParts
from ..paper.rod_shear import RodShear

PADS = tuple(f"$f_{number}$ of pad C{number}" for number in range(1, 5))
SIGNALS = tuple(rf"$P_\mathrm{{{name}}}$" for name in ("normal", "shear", "grad"))
UPPER = "$P_\\mathrm{shear}$, C1 and C2\non the upper face"
_PARTS = (
    "uniform shear",
    "uniform normal stresses",
    "gradients",
    "second derivatives",
    "higher derivatives",
)
_RECOVERED = {
    "truth": "true, same rod without the cube",
    "same_load": "true, same pressure",
    "eq_4": "four pads, eq. 4",
    "points": "eight pads: tensor, points",
    "pads": "eight pads: influence functions",
}
_SMALL = 1e-3
"""Of the greatest stress: panels whose curves are all below it show no axis of values."""


@print_style()
def draw_experiment(result: Experiment, law: str) -> Figure:
    """Frequencies and P_normal, P_shear, P_grad as in Figs. 7 and 8, beside stress and gradient.

    C1 and C2 are on the lower face; a dashed line is P_shear with both on the upper face.
    Stress and gradient are reconstructed from eight pads (full lines) or true (dashed).
    law: linear or finite, of the elastomer's model
    """
    figure = Figure(figsize=(13, 3.3))
    axes = figure.subplots(1, 4)
    x = 1e3 * result.displacement
    _draw_columns(axes[0], x, result.frequency, PADS)
    axes[0].set(title="frequencies", ylabel="frequency / kHz")
    for number, name in enumerate(SIGNALS):
        style = curve_style(number) | {"linestyle": "-"}
        axes[1].plot(x, result.prototype[:, number] / 1e3, label=name, **style)
    axes[1].plot(x, result.upper[:, 1] / 1e3, label=UPPER, color="tab:red", linestyle="--")
    axes[1].set(title="prototype, eqs. 8 to 10", ylabel="signal / kHz")
    _draw_modes(axes[2], result, range(3), "stress", r"$\sigma$ / kPa")
    _draw_modes(axes[3], result, range(3, 7), "gradient", r"$d_0\,\partial\sigma$ / kPa")
    for axis in axes:
        axis.legend(fontsize="small", handlelength=3)
        axis.set_xlabel("displacement / mm")
    figure.suptitle(
        f"Experiment {result.name}: {law} model ($d_0$: half side; full lines: from eight pads)"
    )
    return figure


def _draw_columns(axis: Any, x: np.ndarray, columns: np.ndarray, names: Sequence[str]) -> None:
    for number, name in enumerate(names):
        axis.plot(x, columns[:, number] / 1e3, label=name, **curve_style(number))


def _draw_modes(axis: Any, result: Experiment, modes: range, title: str, label: str) -> None:
    x = 1e3 * result.displacement
    for number, mode in enumerate(modes):
        recovered, true = result.recovered[:, mode] / 1e3, result.truth[:, mode] / 1e3
        style = curve_style(number)
        axis.plot(x, recovered, label=symbol(PLANE.names[mode]), **style | {"linestyle": "-"})
        axis.plot(x, true, **style | {"linestyle": "--"})
    axis.set(title=f"{title} (dashed: true)", ylabel=label)
    shown = np.abs(np.stack([result.recovered, result.truth])[:, :, list(modes)])
    floor = _SMALL * float(np.abs(result.recovered).max())
    if shown.max() < floor:
        axis.set(ylim=(-1, 1), yticks=[0])
        axis.text(
            0.5,
            0.25,
            f"zero by symmetry:\nall below {floor / 1e3:.1g} kPa",
            ha="center",
            transform=axis.transAxes,
        )


@print_style()
def draw_rod_parts(found: dict[str, RodParts]) -> Figure:
    """The signal for shear over the rod's place and its parts, for strips on two kinds of rod."""
    shown = {name: one for name, one in found.items() if name.endswith("strips")}
    figure = Figure(figsize=(10, 4.4))
    axes = figure.subplots(1, len(shown), sharey=True)
    for axis, (name, one) in zip(axes, shown.items(), strict=True):
        for number, values in enumerate((one.signal, *one.parts.T)):
            label = ("signal", *_PARTS)[number]
            axis.plot(1e3 * one.place, values / 1e3, label=label, **curve_style(number))
        axis.set(title=name, xlabel="distance of the rod's middle from the cube's / mm")
    axes[0].set_ylabel("$-v_1 + v_2 + v_3 - v_4$ / kPa")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, handlelength=4, ncols=3, loc="outside lower center")
    figure.suptitle("Signal for shear and its parts; rod pressed 1 mm and held, bonded bottom")
    return figure


@print_style()
def draw_rod_shear(result: RodShear) -> Figure:
    """Shear at the cube under the rod, as each way of recovering it has it, and true."""
    figure = Figure(figsize=(6, 3.6))
    axis = figure.subplots()
    for number, (name, label) in enumerate(_RECOVERED.items()):
        values = getattr(result, name)
        axis.plot(1e3 * result.place, values / 1e3, label=label, **curve_style(number))
    axis.set(
        title="Rod pressed 1 mm: shear at the cube over the rod's position",
        xlabel="distance of the rod's middle from the cube's / mm",
        ylabel=r"$\sigma_{zx}$ / kPa",
    )
    axis.legend(handlelength=4, fontsize=7)
    return figure


@print_style()
def draw_prototype(experiments: Sequence[Experiment]) -> Figure:
    """P_normal, P_shear, P_grad over displacement, as the paper's Fig. 8 shows them."""
    figure = Figure(figsize=(9, 3.1))
    axes = figure.subplots(1, len(experiments))
    signals = [(experiment.prototype, experiment.upper) for experiment in experiments]
    values = 1e-3 * np.concatenate([rows for both in signals for rows in both])
    margin = 0.05 * np.ptp(values)
    limits = (values.min() - margin, values.max() + margin)
    for axis, experiment in zip(axes, experiments, strict=True):
        x = 1e3 * experiment.displacement
        for values, name, style in zip(
            experiment.prototype.T, SIGNALS, ("o-", "s-", "^:"), strict=True
        ):
            axis.plot(x, 1e-3 * values, style, color="black", mfc="white", ms=4, label=name)
        axis.plot(x, 1e-3 * experiment.upper[:, 1], color="black", lw=1, dashes=(2, 2), label=UPPER)
        axis.set(title=experiment.name, xlabel="displacement / mm", ylim=limits)
        axis.title.set_fontsize(8)
    axes[0].set_ylabel(r"signal $\sum \pm\Delta f_i$ / kHz")
    axes[0].legend(fontsize=8)
    return figure
