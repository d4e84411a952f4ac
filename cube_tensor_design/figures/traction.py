"""Pictures and tables of the surface's traction from all cubes, and of its study."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from cube_tensor_driver.core.arrays import Array
from cube_tensor_driver.views.figures.style import print_style

from ..studies.field_study import FieldExample
from ..studies.pads_study import FORMS
from ..studies.traction_study import METHODS, Errors, Setting
from .field import VIEW_MM, draw_pressure, relative_rms


@print_style()
def draw_traction(example: FieldExample) -> Figure:
    """One contact: true pressure at the cubes' depth and that of each method; the error of the last
    one and the deviation that it states, on a scale of their own. The titles tell the rms of errors
    over that of the pressure."""
    figure = Figure(figsize=(9, 5.6), layout="constrained")
    axes = figure.subplots(2, 3, sharex=True, sharey=True)
    truth, stated = example.pressure["truth"], example.pressure["standard deviation"]
    errors = {name: np.abs(example.pressure[name] - truth) for name in METHODS}
    last = errors[METHODS[-1]]

    def share(values: Array) -> str:
        return f"{100 * np.sqrt((values**2).mean() / (truth**2).mean()):.1f} %"

    maps = {"truth": truth}
    maps |= {f"{name}: {share(errors[name])}": example.pressure[name] for name in METHODS}
    top = 1e-3 * truth.max()
    for axis, (title, pressure) in zip(axes.flat, maps.items(), strict=False):
        image = draw_pressure(axis, example, np.maximum(pressure, 0), top)
        axis.set_title(title)
    label = "pressure at the cubes' depth / kPa\n(contours: 4 kPa apart)"
    figure.colorbar(image, ax=axes[0], label=label)
    maps = {f"its error: {share(last)}": last, f"stated: {share(stated)}": stated}
    top = 1e-3 * max(last.max(), stated.max())
    for axis, (title, error) in zip(axes[1, 1:], maps.items(), strict=True):
        image = draw_pressure(axis, example, error, top)
        axis.set_title(title)
    figure.colorbar(image, ax=axes[1, 1:], label="error and stated deviation / kPa")
    limits = (-VIEW_MM, VIEW_MM)
    for axis in axes.flat:
        axis.set(aspect="equal", xlim=limits, ylim=limits)
        axis.grid(False)
    for axis in axes[1]:
        axis.set_xlabel("$x$ / mm")
    for axis in axes[:, 0]:
        axis.set_ylabel("$y$ / mm")
    axes[0, 0].legend(fontsize=7, loc="lower left", facecolor="0.3", labelcolor="white")
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
    """Markdown: per row and width the errors of interpolation, inverse, inverse with contacts; of
    the field with contacts, those over the stated deviation at the cubes' depth and on the surface.
    """
    lines = [
        "| cubes | width | field | force | place, mm | force, seen/stated | place, seen/stated "
        "| field, seen/stated |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, all_widths in rows.items():
        for one in all_widths:
            cells = [
                " / ".join(f"{value:.3f}" for value in one.field),
                " / ".join(f"{100 * value:.1f} %" for value in one.force),
                " / ".join(f"{1e3 * value:.2f}" for value in one.place),
                *(f"{before:.1f} / {now:.2f}" for before, now in one.seen.T),
                " / ".join(f"{value:.2f}" for value in one.seen_field),
            ]
            lines.append(f"| {name} | {1e3 * one.width:g} mm | {' | '.join(cells)} |")
    return "\n".join(lines)
