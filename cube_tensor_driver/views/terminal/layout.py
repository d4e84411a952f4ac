"""What a layout's pads can measure, as a table."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.table import Table

from ...core.layout import Layout
from ...core.symmetry import coefficient_counts


def show_layout(layout: Layout, symmetry: str, result: dict[str, Any], source: str) -> None:
    """Print what `core.estimator.summary` found; source: of the response. None: not known."""
    console = Console(highlight=False)
    console.print(
        f"layout {layout.name}: {layout.n_pads} pads   {' '.join(layout.pads)}", markup=False
    )
    counts = [
        f"{name} {'not possible' if count is None else count}"
        for name, count in coefficient_counts(layout).items()
    ]
    console.print(f"coefficients by symmetry: {', '.join(counts)}")
    console.print(f"symmetry {symmetry}; {source}", markup=False)
    for part in ("uniform", "gradient"):
        condition = result[f"condition_{part}"]
        text = "unknown" if condition is None else f"{condition:.3g}"
        console.print(f"{part + ':':10} rank {result[f'rank_{part}']}, condition {text}")
    console.print(f"unobservable: {', '.join(result['unobservable']) or 'nothing'}")
    console.print("noise of each mode per unit of pad noise (gradients times the half side):")
    table = Table("mode")
    table.add_column("noise", justify="right")
    for name in result["modes"]:
        table.add_row(name, _noise(result, name))
    console.print(table)


def _noise(result: dict[str, Any], mode: str) -> str:
    if mode in result["unobservable"]:
        return "not observed"
    noise = result["noise"][mode]
    return "unknown" if noise is None else f"{noise:.3f}"
