"""What a cube says of balls on the surface, as a table."""

from __future__ import annotations

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from ..studies.surface_study import COMPONENTS, Said, SurfaceStudy

_SMALL = 0.05
"""Of the greatest stress of a load: below it a ratio says nothing."""


def show_surface(study: SurfaceStudy) -> None:
    """Print for each load what the cube says, what there is, and the ratio where it says much."""
    table = Table(
        title="stress in kPa under "
        f"{'1 N/mm' if study.layout.planar else '1 N'}: said by the cube, and there without it",
        title_justify="left",
        box=SIMPLE_HEAD,
        pad_edge=False,
    )
    table.add_column("load")
    table.add_column("width, mm", justify="right")
    table.add_column("beside, mm", justify="right")
    names = [name for name in COMPONENTS if name in study.rows[0].said]
    for name in names:
        for column in (f"{name} said", "there", "ratio"):
            table.add_column(column, justify="right")
    # Pa under 1 N/m are kPa under 1 N/mm.
    unit, places = (1.0, 1) if study.layout.planar else (1e3, 2)
    for row in study.rows:
        cells = [cell for name in names for cell in _cells(row, name, unit, places)]
        table.add_row(row.load, f"{1e3 * row.width:g}", f"{1e3 * row.place:g}", *cells)
    Console(highlight=False).print(table)


def _cells(row: Said, name: str, unit: float, places: int) -> tuple[str, str, str]:
    said, there = row.said[name], row.there[name]
    large = abs(there) > _SMALL * max(abs(value) for value in row.there.values())
    ratio = f"{said / there:.2f}" if large else ""
    # Adding 0 makes 0 of -0.
    numbers = (round(value / unit, places) + 0.0 for value in (said, there))
    said_text, there_text = (f"{value:.{places}f}" for value in numbers)
    return said_text, there_text, ratio
