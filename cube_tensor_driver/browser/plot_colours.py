"""What the browser view plots, as a picture."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.figure import Figure

from ..core.arrays import Array
from ..views.figures.style import curve_style, print_style


@print_style()
def draw_lines(panels: Sequence[tuple[str, Array, dict[str, Array]]]) -> Figure:
    """Panels over one axis of time. Each: label of its values, times in s, values by name."""
    figure = Figure(figsize=(8, 3 * len(panels)))
    axes = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    for axis, (label, times, lines) in zip(axes, panels, strict=True):
        for number, (name, values) in enumerate(lines.items()):
            axis.plot(times, values, label=name, **curve_style(number) | {"marker": ""})
        axis.set_ylabel(label)
        axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8, handlelength=3)
    axes[-1].set_xlabel("time before now / s")
    return figure
