"""./cube study: where each layout can be trusted, as a table, a file and a picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from ..plot.style import save
from ..plot.trust import draw_trust
from ..research.layout_study import LayoutStudy, layout_study
from ..terminal.output import progress_bar, write_json


def run_study(json_path: Path | None, figure: Path) -> int:
    """Sweep indenters over cubes, show from which width on each layout is right, draw the
    errors."""
    with progress_bar() as report:
        result = layout_study(progress=report)
    _show_study(result)
    save(draw_trust(result), figure)
    if json_path is not None:
        write_json(json_path, result.to_dict())
    return 0


def _show_study(result: LayoutStudy) -> None:
    rows = result.trusted()
    console = Console()
    console.print(
        f"narrowest indenter, mm, from which on the error stays below 20 % of the component's range; "
        f"cube's centre {1e3 * result.depth:g} mm deep",
        highlight=False,
        soft_wrap=True,
    )
    table = Table(box=SIMPLE_HEAD, pad_edge=False)
    table.add_column()
    heads = [(name, float(side)) for name in result.error for side in result.sides]
    for name, side in heads:
        table.add_column(f"{name}\n{1e3 * side:g} mm", justify="right")
    found = {(name, side, component): width for name, side, component, width in rows}
    for component in dict.fromkeys(row[2] for row in rows):
        cells = []
        for name, side in heads:
            width = found.get((name, side, component), np.nan)
            cells.append(
                "never" if width is None else "·" if np.isnan(width) else f"{1e3 * width:g}"
            )
        table.add_row(component, *cells)
    console.print(table)
    console.print("· not observed by the layout")
