# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The style of all pictures: for print, readable in grey, made without a display.

A drawing function has the decorator `@print_style()`, makes a `Figure` and returns it; `save`
writes it. The global settings of matplotlib stay as they are.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from ...config.output_files import write_atomically
from ...core.errors import ConfigError

if TYPE_CHECKING:
    from matplotlib.typing import RcKeyType

SETTINGS: dict[RcKeyType, object] = {
    "font.size": 9,
    "axes.grid": True,
    "grid.color": "0.85",
    "grid.linewidth": 0.5,
    "figure.constrained_layout.use": True,
    "savefig.dpi": 200,
}
"""Settings of matplotlib (rcParams) that all pictures share."""

MARKERS = "osD^v<>pP*hX"
"""Markers of matplotlib, in the order in which the curves of a picture use them."""

SIGNED_COLOURS = "cividis"
"""Name of the colour map of matplotlib for signed values.

Its lightness grows from end to end, so that it can be read in grey. In a colour map from red to
blue, both ends would have the same grey.
"""

_CURVE_COLOURS = (
    "black",
    "tab:red",
    "tab:blue",
    "tab:orange",
    "tab:green",
    "tab:purple",
    "tab:brown",
    "0.5",
)
"""Colours of matplotlib of successive curves. Curves with different colours also have different
markers, so that they can be distinguished in grey."""
_CURVE_MARKERS = "os^Dv<>p"
"""Markers of successive curves, one for each colour."""
_CURVE_DASHES = ("-", "--", "-.", ":")
"""Line styles of successive curves, chosen so that curves with the same colour differ."""


@contextmanager
def print_style() -> Iterator[None]:
    """Apply `SETTINGS` to matplotlib inside a `with` block or a decorated function."""
    with matplotlib.rc_context(SETTINGS):
        yield


def format_symbol(component: str) -> str:
    """Return the symbol of a component or mode in matplotlib's notation for mathematics.

    Args:
        component: Name such as zz (stress σzz), zz_x (derivative of σzz along x) or xy_y-zx_z
            (difference of two derivatives).
    """
    if "-" in component:
        return " − ".join(format_symbol(part) for part in component.split("-"))
    stress, _, direction = component.partition("_")
    if not direction:
        return rf"$\sigma_{{{stress}}}$"
    return rf"$\partial\sigma_{{{stress}}}/\partial {direction}$"


def choose_curve_style(number: int) -> dict[str, object]:
    """Return the style of one curve as arguments of matplotlib's `plot`.

    Args:
        number: Number of the curve in its panel, from 0.
    """
    count = len(_CURVE_COLOURS)
    # When the colours repeat, the line styles are shifted by one, so that no style occurs twice.
    dashes = (number + number // count) % len(_CURVE_DASHES)
    return {
        "color": _CURVE_COLOURS[number % count],
        "marker": _CURVE_MARKERS[number % count],
        "linestyle": _CURVE_DASHES[dashes],
        "markersize": 4,
        "markerfacecolor": "none",
        "linewidth": 1.2,
    }


@print_style()
def save(figure: Figure, path: Path) -> None:
    """Write a figure, completely or not at all.

    Args:
        figure: The figure.
        path: The file; its suffix determines the format, and without a suffix it is PNG.

    Raises:
        ConfigError: The format is unknown, or the file cannot be written.
    """
    check_picture(path)
    # An existing file stays until the new picture is complete and replaces it.
    with write_atomically(path) as partial:
        figure.savefig(partial, format=path.suffix[1:] or "png")


@print_style()
def render_png(figure: Figure) -> bytes:
    """Return a figure as the content of a PNG file."""
    content = io.BytesIO()
    figure.savefig(content, format="png")
    return content.getvalue()


def check_picture(path: Path) -> None:
    """Check that matplotlib can write the picture format that the suffix of a file names.

    Raises:
        ConfigError: matplotlib does not know the format.
    """
    # Which formats matplotlib can write depends on its version.
    formats = FigureCanvasAgg.get_supported_filetypes()
    if path.suffix and path.suffix[1:].lower() not in formats:
        raise ConfigError(
            f"{path}: {path.suffix!r} is no format of a picture; take one of {', '.join(formats)}"
        )
