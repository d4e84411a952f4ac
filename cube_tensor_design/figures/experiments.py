"""Pictures of the source paper's experiments on the virtual bench."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from cube_tensor_driver.core.modes import PLANE
from cube_tensor_driver.views.figures.style import (
    curve_style,
    print_style,
    symbol,
)

from ..paper.experiments import ON_LOWER, Experiment, foam_frequency
from ..paper.rod_parts import RodParts
from ..paper.rod_shear import RodShear

PAD_LABELS = tuple(f"$f_{number}$ of pad C{number}" for number in range(1, 5))
"""Labels of the frequencies."""
SIGNAL_LABELS = tuple(rf"$P_\mathrm{{{name}}}$" for name in ("normal", "shear", "grad"))
"""Labels of the prototype's signals."""
UPPER_LABEL = "$P_\\mathrm{shear}$, C1 and C2\non the upper face"
"""Label of P_shear with the pads of the prototype on the other faces."""
PART_LABELS = (
    "signal",
    "uniform shear",
    "uniform normal stresses",
    "gradients",
    "second derivatives",
    "higher derivatives",
)
"""Labels of the signal and of its `PARTS`."""
SHEAR_LABELS = {
    "truth": "true, same rod without the cube",
    "same_load": "true, same pressure",
    "eq_4": "four pads, eq. 4",
    "points": "eight pads: tensor, points",
    "pads": "eight pads: influence functions",
}
"""Labels of the drawn attributes of RodShear."""
MIN_SHOWN_SHARE = 1e-3
"""Share of the largest stress below which a panel shows no values, because they are zero by
symmetry."""


@print_style()
def draw_experiment(result: Experiment, law: str) -> Figure:
    """Draw frequencies and prototype signals as in Figs. 7 and 8, beside stress and gradient.

    C1 and C2 are on the lower face; a dashed line is P_shear with both on the upper face. Stress
    and gradient are recovered from eight pads (full lines) or true (dashed).

    Args:
        result: The experiment.
        law: Model of the elastomer, "linear" or "finite".
    """
    figure = Figure(figsize=(13, 3.3))
    axes = figure.subplots(1, 4)
    x = 1e3 * result.displacement
    frequency = foam_frequency(result.pads)[:, ON_LOWER]
    for number, label in enumerate(PAD_LABELS):
        curve = frequency[:, number] / 1e3
        axes[0].plot(x, curve, label=label, **curve_style(number))
    axes[0].set(title="frequencies", ylabel="frequency / kHz")
    for number, label in enumerate(SIGNAL_LABELS):
        style = curve_style(number) | {"linestyle": "-"}
        curve = result.prototype[:, number] / 1e3
        axes[1].plot(x, curve, label=label, **style)
    axes[1].plot(
        x,
        result.upper[:, 1] / 1e3,
        label=UPPER_LABEL,
        color="tab:red",
        linestyle="--",
    )
    axes[1].set(title="prototype, eqs. 8 to 10", ylabel="signal / kHz")
    _draw_modes(axes[2], result, range(3))
    axes[2].set(title="stress (dashed: true)", ylabel=r"$\sigma$ / kPa")
    _draw_modes(axes[3], result, range(3, 7))
    axes[3].set(title="gradient (dashed: true)", ylabel=r"$d_0\,\partial\sigma$ / kPa")
    for axis in axes:
        axis.legend(fontsize="small", handlelength=3)
        axis.set_xlabel("displacement / mm")
    figure.suptitle(
        f"Experiment {result.name}: {law} model ($d_0$: half side; full lines: from eight pads)"
    )
    return figure


def _draw_modes(
    axis: Any,
    result: Experiment,
    modes: range,
) -> None:
    """Draw the recovered and the true amplitudes of some modes."""
    x = 1e3 * result.displacement
    for number, mode in enumerate(modes):
        style = curve_style(number)
        recovered = result.recovered[:, mode] / 1e3
        true = result.truth[:, mode] / 1e3
        label = symbol(PLANE.names[mode])
        axis.plot(x, recovered, label=label, **style | {"linestyle": "-"})
        axis.plot(x, true, **style | {"linestyle": "--"})
    # Rounding errors of modes that are zero must not fill a panel.
    both = np.stack([result.recovered, result.truth])
    shown = np.abs(both[:, :, list(modes)])
    floor = MIN_SHOWN_SHARE * float(np.abs(result.recovered).max())
    if shown.max() < floor:
        axis.set(ylim=(-1, 1), yticks=[0])
        text = f"zero by symmetry:\nall below {floor / 1e3:.1g} kPa"
        axis.text(0.5, 0.25, text, ha="center", transform=axis.transAxes)


@print_style()
def draw_rod_parts(found: dict[str, RodParts]) -> Figure:
    """Draw P_shear and its parts over the rod's place, for strips on two kinds of rod."""
    strips = {name: parts for name, parts in found.items() if name.endswith("strips")}
    figure = Figure(figsize=(10, 4.4))
    axes = figure.subplots(1, len(strips), sharey=True)
    for axis, (name, one) in zip(axes, strips.items(), strict=True):
        curves = np.column_stack([one.signal, one.parts]) / 1e3
        for number, label in enumerate(PART_LABELS):
            curve = curves[:, number]
            axis.plot(1e3 * one.place, curve, label=label, **curve_style(number))
        axis.set(
            title=name,
            xlabel="distance of the rod's centre from the cube's / mm",
        )
    axes[0].set_ylabel("$-v_1 + v_2 + v_3 - v_4$ / kPa")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(
        handles,
        labels,
        handlelength=4,
        ncols=3,
        loc="outside lower center",
    )
    figure.suptitle("Signal for shear and its parts; rod pressed 1 mm and held, bonded bottom")
    return figure


@print_style()
def draw_rod_shear(result: RodShear) -> Figure:
    """Draw the shear at the cube under the rod: true, and as each method recovers it."""
    figure = Figure(figsize=(6, 3.6))
    axis = figure.subplots()
    for number, (name, label) in enumerate(SHEAR_LABELS.items()):
        values = getattr(result, name)
        axis.plot(1e3 * result.place, values / 1e3, label=label, **curve_style(number))
    axis.set(
        title="Rod pressed 1 mm: shear at the cube over the rod's position",
        xlabel="distance of the rod's centre from the cube's / mm",
        ylabel=r"$\sigma_{zx}$ / kPa",
    )
    axis.legend(handlelength=4, fontsize=7)
    return figure


@print_style()
def draw_prototype(experiments: Sequence[Experiment]) -> Figure:
    """Draw P_normal, P_shear, P_grad over displacement, as the paper's Fig. 8 shows them."""
    figure = Figure(figsize=(9, 3.1))
    axes = figure.subplots(1, len(experiments), sharey=True)
    for axis, experiment in zip(axes, experiments, strict=True):
        x = 1e3 * experiment.displacement
        for number, style in enumerate(("o-", "s-", "^:")):
            signal = 1e-3 * experiment.prototype[:, number]
            label = SIGNAL_LABELS[number]
            axis.plot(
                x,
                signal,
                style,
                color="black",
                mfc="white",
                ms=4,
                label=label,
            )
        upper = 1e-3 * experiment.upper[:, 1]
        axis.plot(
            x,
            upper,
            color="black",
            lw=1,
            dashes=(2, 2),
            label=UPPER_LABEL,
        )
        axis.set(title=experiment.name, xlabel="displacement / mm")
        axis.title.set_fontsize(8)
    axes[0].set_ylabel(r"signal $\sum \pm\Delta f_i$ / kHz")
    axes[0].legend(fontsize=8)
    return figure
