"""From which contact width on each layout can be trusted, as a table."""

from __future__ import annotations

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from ..studies.layout_study import LayoutStudy


def show_study(result: LayoutStudy) -> None:
    rows = result.trusted()
    console = Console(highlight=False)
    console.print(
        "narrowest indenter, mm, from which on the error stays below 20 % "
        f"of the component's range; cube's centre {1e3 * result.depth:g} mm deep",
        soft_wrap=True,
    )
    table = Table("", box=SIMPLE_HEAD, pad_edge=False)
    heads = [(name, float(side)) for name in result.error for side in result.sides]
    for name, side in heads:
        table.add_column(f"{name}\n{1e3 * side:g} mm", justify="right")
    widths = {(name, side, component): width for name, side, component, width in rows}
    for component in dict.fromkeys(row[2] for row in rows):
        cells = [_cell(widths, (*head, component)) for head in heads]
        table.add_row(component, *cells)
    console.print(table)
    console.print("· not observed by the layout")


def _cell(widths: dict[tuple[str, float, str], float | None], key: tuple[str, float, str]) -> str:
    if key not in widths:
        return "·"
    width = widths[key]
    return "never" if width is None else f"{1e3 * width:g}"
