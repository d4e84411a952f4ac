# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""./cube study: the narrowest contact for which each layout can be trusted."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from cube_tensor_driver.cli.parser import Parser

if TYPE_CHECKING:
    from ..studies.layout_study import LayoutStudy


def arguments(parser: Parser) -> None:
    parser.add_json()
    parser.add_output(
        "--figure",
        kind="picture",
        default=Path("study.png"),
        help="picture to write (default: %(default)s)",
    )


def run(options: argparse.Namespace) -> int:
    from cube_tensor_driver.config.output_files import write_json
    from cube_tensor_driver.views.figures.style import save
    from cube_tensor_driver.views.terminal.output import progress_bar

    from ..figures.trust import draw_trust
    from ..studies.layout_study import layout_study

    with progress_bar() as report:
        result = layout_study(progress=report)
    show_study(result)
    save(draw_trust(result), options.figure)
    if options.json is not None:
        write_json(options.json, result.to_dict())
    return 0


def show_study(result: LayoutStudy) -> None:
    """Print the narrowest trusted indenter for each component, layout and side of the cube."""
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    from ..studies.layout_study import DEPTH

    console = Console(highlight=False)
    console.print(
        "narrowest indenter, mm, from which on the error stays below 20 % "
        f"of the component's range; cube's centre {1e3 * DEPTH:g} mm deep",
        soft_wrap=True,
    )
    table = Table("", box=SIMPLE_HEAD, pad_edge=False)
    columns = [(name, float(side)) for name in result.error for side in result.sides]
    for name, side in columns:
        table.add_column(f"{name}\n{1e3 * side:g} mm", justify="right")
    rows = result.trusted()
    widths = {(row.layout, row.side, row.component): row.width for row in rows}
    for component in dict.fromkeys(row.component for row in rows):
        cells = []
        for name, side in columns:
            key = (name, side, component)
            cells.append(_format_width(widths[key]) if key in widths else "·")
        table.add_row(component, *cells)
    console.print(table)
    console.print("· not observed by the layout")


def _format_width(width: float | None) -> str:
    """Format a width (m) in mm; None means that no indenter is wide enough."""
    return "never" if width is None else f"{1e3 * width:g}"
