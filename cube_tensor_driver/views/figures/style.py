"""The style of all pictures: for print, readable in grey, made without a display.

A drawing function has the decorator `@print_style()`, makes a `Figure` and returns it; `save`
writes it. The global settings of matplotlib stay as they are.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import imsave
from numpy.typing import NDArray

from ...config.output_files import atomic_write
from ...core.errors import ConfigError

SETTINGS: Any = {
    "font.size": 9,
    "axes.grid": True,
    "grid.color": "0.85",
    "grid.linewidth": 0.5,
    "figure.constrained_layout.use": True,
    "savefig.dpi": 200,
}
"""Settings of matplotlib for a picture."""

MARKERS = "osD^v<>pP*hX"
"""Markers in the order in which they are used."""

SIGNED_COLOURS = "cividis"
"""Colour map of signed values. Its lightness grows from end to end, unlike that of a map from red
to blue, so that it can be read in grey."""

# The lists have different lengths, so that no two curves look the same in grey.
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
_CURVE_MARKERS = "os^Dv<>p"
_CURVE_DASHES = ("-", "--", "-.", ":")


@contextmanager
def print_style() -> Iterator[None]:
    """Apply `SETTINGS`, in a block or as a decorator."""
    with matplotlib.rc_context(SETTINGS):
        yield


def symbol(component: str) -> str:
    """Return a component or mode in mathematical type.

    Args:
        component: Such as zz, zz_x (its derivative along x) or xy_y-zx_z (a difference).
    """
    if "-" in component:
        return " − ".join(symbol(part) for part in component.split("-"))
    stress, _, direction = component.partition("_")
    if not direction:
        return rf"$\sigma_{{{stress}}}$"
    return rf"$\partial\sigma_{{{stress}}}/\partial {direction}$"


def curve_style(number: int) -> dict[str, Any]:
    """Return colour, marker and dashes of the curve with this number in a panel."""
    count = len(_CURVE_COLOURS)
    # The dashes move on by one each time the colours start again.
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
        path: The file; its suffix tells the format, and without one it is PNG.

    Raises:
        ConfigError: The format is unknown, or the file cannot be written.
    """
    check_picture(path)
    # A picture that was there before stays until the new one is complete.
    with atomic_write(path) as partial:
        figure.savefig(partial, format=path.suffix[1:] or "png")


@print_style()
def png(figure: Figure) -> bytes:
    """Return a figure as the content of a PNG file."""
    content = io.BytesIO()
    figure.savefig(content, format="png")
    return content.getvalue()


def png_of_pixels(pixels: NDArray[np.uint8]) -> bytes:
    """Return pixels (rows, columns, 4) as the content of a PNG file."""
    content = io.BytesIO()
    imsave(content, pixels, format="png")
    return content.getvalue()


def check_picture(path: Path) -> None:
    """Raise ConfigError if the suffix is no picture format that matplotlib can write."""
    # The list depends on the installed version of matplotlib.
    formats = FigureCanvasAgg.get_supported_filetypes()
    if path.suffix and path.suffix[1:].lower() not in formats:
        raise ConfigError(
            f"{path}: {path.suffix!r} is no format of a picture; take one of {', '.join(formats)}"
        )
