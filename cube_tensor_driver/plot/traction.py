"""Pictures and tables of the surface's traction from all cubes, and of its study."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from ..research.field_study import FieldExample
from ..research.pads_study import FORMS
from ..research.traction_study import METHODS, Errors, Setting
from .field import VIEW_MM, draw_pressure, relative_rms
from .style import print_style


@print_style()
def draw_traction(example: FieldExample) -> Figure:
    """One contact: true pressure at the cubes' depth, that of each method, and what the inverse
    says about its error. The titles tell the rms of the error over the rms of the pressure."""
    figure = Figure(figsize=(9, 6.2))
    axes = figure.subplots(2, 3, sharex=True, sharey=True).ravel()
    names = ("truth", *METHODS, "standard deviation")
    truth = example.pressure["truth"]
    top = 1e-3 * truth.max()
    for axis, name in zip(axes, names, strict=False):
        pressure = example.pressure[name]
        image = draw_pressure(axis, example, np.maximum(pressure, 0), top)
        title = name
        if name in METHODS:
            title = f"{name}: {100 * relative_rms(pressure, truth):.0f} %"
        if name == "standard deviation":
            stated = np.sqrt((pressure**2).mean() / (truth**2).mean())
            title = f"stated error (inverse): {100 * stated:.0f} %"
        limits = (-VIEW_MM, VIEW_MM)
        axis.set(title=title, aspect="equal", xlim=limits, ylim=limits)
        axis.grid(False)
    axes[-1].set_visible(False)
    for axis in axes[2:5]:
        axis.set_xlabel("$x$ / mm")
        axis.tick_params(labelbottom=True)
    for axis in axes[::3]:
        axis.set_ylabel("$y$ / mm")
    axes[0].legend(fontsize=7, loc="lower left", facecolor="0.3", labelcolor="white")
    label = "pressure at the cubes' depth / kPa (white contours: 4 kPa apart)"
    figure.colorbar(image, ax=axes, label=label)
    return figure


@print_style()
def draw_layer(example: FieldExample) -> Figure:
    """One contact on a thin layer: true pressure at the cubes' depth, and that of the inverse with
    cubes as points and as pads. The titles tell the rms of the error over that of the pressure."""
    figure = Figure(figsize=(9, 3.6))
    truth = example.pressure["truth"]
    axes = figure.subplots(1, len(example.pressure), sharex=True, sharey=True)
    for axis, (name, pressure) in zip(axes, example.pressure.items(), strict=True):
        image = draw_pressure(axis, example, np.maximum(pressure, 0), 1e-3 * truth.max())
        error = "" if name == "truth" else f": {100 * relative_rms(pressure, truth):.0f} %"
        title = name if name == "truth" else f"cubes as {name}{error}"
        limits = (-VIEW_MM, VIEW_MM)
        axis.set(title=title, aspect="equal", xlim=limits, ylim=limits, xlabel="$x$ / mm")
        axis.grid(False)
    axes[0].set_ylabel("$y$ / mm")
    axes[0].legend(fontsize=7, loc="lower left", facecolor="0.3", labelcolor="white")
    figure.colorbar(image, ax=axes, label="pressure at the cubes' depth / kPa", shrink=0.8)
    return figure


def pads_table(rows: Mapping[tuple[Setting, str], Sequence[Errors]]) -> str:
    """Markdown: per cubes and width the errors of contacts with cubes as points and as pads."""
    lines = [
        "| cubes | width | field | force | place, mm | force, seen/stated | place, seen/stated |",
        "|---|---|---|---|---|---|---|",
    ]
    for setting in dict.fromkeys(setting for setting, _ in rows):
        forms = zip(*(rows[setting, form] for form in FORMS), strict=True)
        for both in forms:
            cells = [
                " / ".join(f"{one.field[2]:.3f}" for one in both),
                " / ".join(f"{100 * one.force[1]:.1f} %" for one in both),
                " / ".join(f"{1e3 * one.place[1]:.2f}" for one in both),
                *(" / ".join(f"{one.seen[1, k]:.2f}" for one in both) for k in (0, 1)),
            ]
            lines.append(f"| {setting.cubes} | {1e3 * both[0].width:g} mm | {' | '.join(cells)} |")
    return "\n".join(lines)


def traction_table(rows: Mapping[str, Sequence[Errors]]) -> str:
    """Markdown: per row and width the errors of interpolation, inverse, inverse with contacts."""
    lines = [
        "| cubes | width | field | force | place, mm | force seen/stated | place seen/stated |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, all_widths in rows.items():
        for one in all_widths:
            cells = [
                " / ".join(f"{value:.3f}" for value in one.field),
                " / ".join(f"{100 * value:.1f} %" for value in one.force),
                " / ".join(f"{1e3 * value:.2f}" for value in one.place),
                *(" / ".join(f"{value:.1f}" for value in column) for column in one.seen.T),
            ]
            lines.append(f"| {name} | {1e3 * one.width:g} mm | {' | '.join(cells)} |")
    return "\n".join(lines)
