"""A computed response matrix, as tables."""

from __future__ import annotations

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from ..fem.fem import Response

MOST_MODES = 7
"""In one table: what fits 80 columns."""
LABEL_WIDTH, NUMBER_WIDTH, GAP = 9, 7, 2
COEFFICIENTS_SHOWN = 40


def show_response(result: Response) -> None:
    """Print the matrix, the coefficients on each mesh, and what they leave unexplained."""
    console = Console(highlight=False)
    column = GAP + max(NUMBER_WIDTH, *(len(name) for name in result.modes))
    count = max(1, min(MOST_MODES, (console.width - LABEL_WIDTH) // column))
    for start in range(0, len(result.modes), count):
        console.print(_matrix(result, start, count))
    console.print(_convergence(result))
    hidden = len(result.coefficients) - COEFFICIENTS_SHOWN
    if hidden > 0:
        console.print(f"and {hidden} coefficients more, in the --json file")
    console.print(
        f"symmetry {result.symmetry} leaves {100 * result.structure_residual:.3g} % "
        "of the response unexplained; "
        f"rank {result.rank} of {len(result.modes)}; "
        f"unobservable: {', '.join(result.unobservable) or 'nothing'}; "
        f"{result.seconds:.1f} s",
        soft_wrap=True,
    )


def _matrix(result: Response, start: int, count: int) -> Table:
    """Pads by `count` modes; the first table has the title of all."""
    title = "response, Pa per Pa; below, what the symmetry does not explain"
    table = _table("" if start else title)
    table.add_column("pad")
    names = result.modes[start : start + count]
    for name in names:
        table.add_column(name, justify="right")
    modes = slice(start, start + len(names))
    for number, (pad, row) in enumerate(zip(result.layout.pads, result.matrix, strict=True), 1):
        label = f"V{number} {pad}" if result.layout.planar else pad
        # Adding 0 makes 0 of -0.
        values = (f"{value + 0.0:.4f}" for value in row[modes])
        table.add_row(label, *values, end_section=number == len(result.layout.pads))
    table.add_row("left, %", *(f"{100 * result.mode_residual[name]:.2f}" for name in names))
    return table


def _convergence(result: Response) -> Table:
    meshes = result.convergence
    table = _table("coefficients on meshes of so many unknowns")
    table.add_column("unknowns")
    for mesh in meshes:
        table.add_column(str(mesh["unknowns"]), justify="right")
    table.add_column("last step", justify="right")
    names = list(result.coefficients)[:COEFFICIENTS_SHOWN]
    for name in names:
        values = [mesh["coefficients"][name] for mesh in meshes]
        step = ""
        if len(values) > 1 and values[-2]:
            step = f"{100 * abs(values[-1] / values[-2] - 1):.2g} %"
        numbers = (f"{value:.5f}" for value in values)
        table.add_row(name, *numbers, step, end_section=name == names[-1])
    changes = [mesh["change"] for mesh in meshes]
    shown = ["" if change is None else f"{100 * change:.2g} %" for change in changes]
    table.add_row("change to the next", *shown)
    table.add_row("seconds", *(f"{mesh['seconds']:.1f}" for mesh in meshes))
    return table


def _table(title: str) -> Table:
    return Table(title=title or None, title_justify="left", box=SIMPLE_HEAD, pad_edge=False)
