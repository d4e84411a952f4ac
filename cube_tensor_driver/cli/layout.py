"""./cube layout: what a layout's pads can tell, in numbers and as a picture."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from ..config.calibration import find_calibration, read_calibration
from ..config.package_data import package_data
from ..config.yaml import read_yaml
from ..core.calibration import Calibration
from ..core.errors import SymmetryError
from ..core.estimator import summary
from ..core.layout import LAYOUTS, Layout, find_layout
from ..core.response import response
from ..core.symmetry import GENERATORS, find_structure
from ..plot.calibration import draw_layout
from ..plot.style import save
from ..terminal.output import write_json


def named_layout(name: str) -> Layout:
    """A built-in layout, or the one in a YAML file. LayoutError: neither."""
    path = Path(name)
    return (
        Layout.from_dict(read_yaml(path)) if path.suffix in (".yaml", ".yml") else find_layout(name)
    )


def shipped_calibration(layout: Layout) -> Calibration | None:
    """The computed calibration of a built-in layout, with no mode neglected; None for other
    layouts."""
    known = LAYOUTS.get(layout.name)
    if known is None or not known.same_as(layout):
        return None
    return replace(
        read_calibration(package_data() / "config" / "calibration" / f"{layout.name}.yaml"),
        neglect=(),
    )


def run_layout(
    name: str,
    symmetry: str | None,
    calibration_name: str | None,
    json_path: Path | None,
    figure: Path | None,
) -> int:
    """Print, draw and, if asked, write the figures of a layout. CubeError: what is wrong."""
    layout = named_layout(name)
    calibration = shipped_calibration(layout)
    if calibration_name is not None:
        calibration = read_calibration(find_calibration(calibration_name, Path()))
        calibration.check(layout)
    counts = coefficient_counts(layout)
    symmetry = symmetry or (
        calibration.symmetry if calibration else next(g for g, count in counts.items() if count)
    )
    structure = find_structure(layout, symmetry)
    if calibration is not None:
        result = summary(structure, calibration.response, calibration.neglect)
    else:
        # Ranks are those of any response of this structure; conditions and noise are not.
        names = structure.names
        generic = dict(
            zip(names, np.random.default_rng(0).uniform(0.5, 1.5, len(names)), strict=True)
        )
        result = summary(structure, response(structure, generic))
        result |= {
            "condition_uniform": None,
            "condition_gradient": None,
            "noise": dict.fromkeys(result["noise"]),
        }
    source = "no calibration: conditions and noise unknown"
    if calibration is not None:
        source = f"calibration {calibration.id} ({calibration.source or 'no source given'})"
    _show(layout, symmetry, counts, result, source)
    if json_path is not None:
        write_json(json_path, result)
    if figure is not None:
        save(draw_layout(layout), figure)
    return 0


def coefficient_counts(layout: Layout) -> dict[str, int | None]:
    """Number of coefficients per symmetry, None where the layout does not have it."""
    counts: dict[str, int | None] = {}
    for name in GENERATORS:
        try:
            counts[name] = find_structure(layout, name).n_coefficients
        except SymmetryError:
            counts[name] = None
    return counts


def _show(
    layout: Layout, symmetry: str, counts: dict[str, int | None], result: dict, source: str
) -> None:
    console = Console()
    console.print(
        f"layout {layout.name}: {layout.n_pads} pads   {' '.join(layout.pads)}", markup=False
    )
    shown = "   ".join(
        f"{name} {'not possible' if count is None else count}" for name, count in counts.items()
    )
    console.print(f"coefficients of the response matrix per symmetry:   {shown}")
    console.print(f"symmetry {symmetry}; {source}", highlight=False)
    for part in ("uniform", "gradient"):
        condition = result[f"condition_{part}"]
        text = "unknown" if condition is None else f"{condition:.3g}"
        console.print(f"{part + ':':10} rank {result[f'rank_{part}']}, condition {text}")
    console.print(
        f"unobservable: {', '.join(result['unobservable']) or 'nothing'}", highlight=False
    )
    console.print("noise of each mode per unit of pad noise (gradients times the half side):")
    table = Table()
    table.add_column("mode")
    table.add_column("noise", justify="right")
    for name in result["modes"]:
        noise = result["noise"][name]
        seen = name not in result["unobservable"]
        table.add_row(
            name, "not observed" if not seen else "unknown" if noise is None else f"{noise:.3f}"
        )
    console.print(table)
