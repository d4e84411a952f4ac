# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Pictures of the source paper's experiments on the virtual bench."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cube_tensor_driver.core.modes import PLANE
from cube_tensor_driver.views.figures.style import format_symbol, print_style

from ..paper.experiments import ON_LOWER, Experiment, compute_foam_frequency
from ..paper.rod_parts import RodParts
from ..paper.rod_shear import RodShear
from .curves import add_legend_below, draw_curves

PAD_LABELS = tuple(f"$f_{number}$ of pad C{number}" for number in range(1, 5))
"""Labels of the frequencies of the prototype's pads C1 .. C4."""
SIGNAL_LABELS = tuple(rf"$P_\mathrm{{{name}}}$" for name in ("normal", "shear", "grad"))
"""Labels of the prototype's signals P_normal, P_shear and P_grad."""
UPPER_LABEL = "$P_\\mathrm{shear}$, C1 and C2\non the upper face"
"""Label of the signal P_shear of a prototype whose pads C1 and C2 are on the upper face."""
PART_LABELS = (
    "signal",
    "uniform shear",
    "uniform normal stresses",
    "gradients",
    "second derivatives",
    "higher derivatives",
)
"""Labels of the signal P_shear and of its parts, in the order of `rod_parts.PARTS`."""
SHEAR_LABELS = {
    "truth": "true, same rod without the cube",
    "same_load": "true, same pressure",
    "eq_4": "four pads, eq. 4",
    "points": "eight pads: tensor, points",
    "pads": "eight pads: influence functions",
}
"""Labels of the attributes of `RodShear` (shear at the cube under a rod) that are drawn."""
ROD_LABEL = "distance of the rod's centre from the cube's / mm"
"""Label of the axis on which the position of the rod is drawn."""
MIN_SHOWN_SHARE = 1e-3
"""Share of the largest stress of an experiment below which the amplitudes of a panel count as
rounding errors of values that are zero by symmetry, and are not shown."""


@print_style()
def draw_experiment(result: Experiment, law: str) -> Figure:
    """Draw frequencies and prototype signals as in Figs. 7 and 8, beside stress and gradient.

    C1 and C2 are on the lower face; a dashed line is P_shear with both on the upper face, which has
    the other sign. Stress and gradient are recovered from eight pads (full lines) or true (dashed).

    Args:
        result: The experiment.
        law: Model of the elastomer, "linear" or "finite".
    """
    figure = Figure(figsize=(13, 3.3))
    pads, signals, stress, gradient = figure.subplots(1, 4)
    x = result.displacement
    frequency = compute_foam_frequency(result.pads)[:, ON_LOWER]
    draw_curves(pads, x, dict(zip(PAD_LABELS, frequency.T, strict=True)))
    pads.set(title="frequencies", ylabel="frequency / kHz")
    by_label = dict(zip(SIGNAL_LABELS, result.prototype.T, strict=True))
    draw_curves(signals, x, by_label, linestyle="-")
    upper = {UPPER_LABEL: -result.prototype[:, 1]}
    draw_curves(signals, x, upper, color="tab:red", linestyle="--", marker="")
    signals.set(title="prototype, eqs. 8 to 10", ylabel="signal / kHz")
    _draw_modes(stress, result, slice(3))
    stress.set(title="stress (dashed: true)", ylabel=r"$\sigma$ / kPa")
    _draw_modes(gradient, result, slice(3, 7))
    gradient.set(title="gradient (dashed: true)", ylabel=r"$d_0\,\partial\sigma$ / kPa")
    for axis in figure.axes:
        axis.legend(fontsize="small", handlelength=3)
        axis.set_xlabel("displacement / mm")
    figure.suptitle(
        f"Experiment {result.name}: {law} model ($d_0$: half side; full lines: from eight pads)"
    )
    return figure


def _draw_modes(axis: Axes, result: Experiment, modes: slice) -> None:
    """Draw recovered and true amplitudes of some modes (linear stress fields) of the plane."""
    recovered = result.recovered[:, modes]
    truth = result.truth[:, modes]
    labels = [format_symbol(name) for name in PLANE.names[modes]]
    # matplotlib puts no label with an underscore into the legend.
    hidden = [f"_{label}" for label in labels]
    x = result.displacement
    draw_curves(
        axis,
        x,
        dict(zip(labels, recovered.T, strict=True)),
        linestyle="-",
    )
    draw_curves(
        axis,
        x,
        dict(zip(hidden, truth.T, strict=True)),
        linestyle="--",
    )
    # Rounding errors of modes that are zero must not fill a panel.
    floor = MIN_SHOWN_SHARE * np.abs(result.recovered).max()
    if np.abs([recovered, truth]).max() < floor:
        axis.set(ylim=(-1, 1), yticks=[0])
        text = f"zero by symmetry:\nall below {floor / 1e3:.1g} kPa"
        axis.text(0.5, 0.25, text, ha="center", transform=axis.transAxes)


@print_style()
def draw_rod_parts(found: dict[str, RodParts]) -> Figure:
    """Draw P_shear and its parts over the position of the rod, in one panel for each kind of rod.

    The pads are the strips of `rod_parts.PADS`.
    """
    strips = {name: parts for name, parts in found.items() if name.endswith("strips")}
    figure = Figure(figsize=(10, 4.4))
    axes = figure.subplots(1, len(strips), sharey=True)
    for axis, (name, one) in zip(axes, strips.items(), strict=True):
        curves = np.vstack([one.signal, one.parts.T])
        draw_curves(
            axis,
            one.place,
            dict(zip(PART_LABELS, curves, strict=True)),
        )
        axis.set(title=name, xlabel=ROD_LABEL)
    axes[0].set_ylabel("$-v_1 + v_2 + v_3 - v_4$ / kPa")
    add_legend_below(figure)
    figure.suptitle("Signal for shear and its parts; rod pressed 1 mm and held, bonded bottom")
    return figure


@print_style()
def draw_rod_shear(result: RodShear) -> Figure:
    """Draw the shear at the cube under the rod: true, and as each method recovers it."""
    figure = Figure(figsize=(6, 3.6))
    axis = figure.subplots()
    curves = {label: getattr(result, name) for name, label in SHEAR_LABELS.items()}
    draw_curves(axis, result.place, curves)
    axis.set(
        title="Rod pressed 1 mm: shear at the cube over the rod's position",
        xlabel=ROD_LABEL,
        ylabel=r"$\sigma_{zx}$ / kPa",
    )
    axis.legend(handlelength=4, fontsize=7)
    return figure


@print_style()
def draw_prototype(experiments: Sequence[Experiment]) -> Figure:
    """Draw P_normal, P_shear, P_grad over displacement, as the paper's Fig. 8 shows them."""
    figure = Figure(figsize=(9, 4.4))
    axes = figure.subplots(2, len(experiments), sharex="col", sharey="row")
    for (upper, lower), experiment in zip(axes.T, experiments, strict=True):
        normal, shear, gradient = experiment.prototype.T
        names = (*SIGNAL_LABELS[1:], UPPER_LABEL)
        curves = (shear, gradient, -shear)
        # P_normal is some thirty times as large as the others, which have an axis of their own.
        draw_curves(
            upper,
            experiment.displacement,
            {SIGNAL_LABELS[0]: normal},
        )
        draw_curves(
            lower,
            experiment.displacement,
            dict(zip(names, curves, strict=True)),
        )
        upper.set_title(experiment.name, fontsize=8)
        lower.set_xlabel("displacement / mm")
    for axis in axes[:, 0]:
        axis.set_ylabel(r"$\sum \pm\Delta f_i$ / kHz")
        axis.legend(fontsize=8, handlelength=3)
    return figure
