# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""./cube fem: the response of a cube's pads by finite elements, as tables, files and pictures."""

from __future__ import annotations

import argparse
import math
import shlex
from pathlib import Path
from typing import TYPE_CHECKING

from cube_tensor_driver.cli.parser import Parser

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rich.console import Console
    from rich.table import Table

    from cube_tensor_driver.core.arrays import Array
    from cube_tensor_driver.core.layout import Layout

    from ..fem.body import Body
    from ..fem.fem import Response
    from ..fem.model import Model
    from ..fem.thermal import ThermalStress
    from ..fem.weight import WeightResponse
    from ..studies.surface_study import SurfaceRow, SurfaceStudy

MAX_STRUCTURE_RESIDUAL = 1e-3
"""Largest part of the response (relative, Frobenius norm) that the coefficients of a calibration
may leave out. If more is left out, the calibration holds the whole matrix."""
MAX_MODE_COLUMNS = 7
"""Maximum number of modes (columns) in one printed table of the response matrix, so that the table
fits into 80 characters."""
LABEL_WIDTH = 9
"""Width of the first column of a printed response matrix, with the names of pads, in characters."""
MIN_NUMBER_WIDTH = 7
"""Width of a value in a printed response matrix, in characters."""
COLUMN_GAP = 2
"""Space between two columns of a printed table, in characters."""
MAX_COEFFICIENTS_SHOWN = 40
"""Maximum number of coefficients in the printed table of convergence; the file of --json has
all."""
THERMAL_HEADER = """Stress on each pad in Pa per K of the temperature P_k(s), k = 0, 1, ...:
P_k is the Legendre polynomial, s grows from -1 at the ground to 1 at the surface."""
"""Comment at the top of a file of thermal stress."""
SMALLEST_SHOWN_STRESS = 0.05
"""Stress by weight in Pa or by temperature in Pa/K (gradient in Pa/m or Pa/m/K) below which a
component is not printed."""
COMPUTATIONS = ("surface", "temperature", "weight")
"""Options that ask for another computation than the response to linear stress fields."""
MIN_SHOWN_SHARE = 0.05
"""Share of the largest stress under a load below which no ratio of measured to true stress is
printed, because it would be noise."""


def arguments(parser: Parser) -> None:
    parser.add_argument(
        "model",
        nargs="?",
        metavar="MODEL",
        help="YAML file of geometry and material, or the name of a shipped one in config/fem "
        "(default: a planar steel cube of 4 mm in a section of 60 x 11 mm)",
    )
    parser.add_argument(
        "--surface",
        action="store_true",
        help="bond the lower face to rigid ground, and compute the influence functions of the "
        "pads: their stress under forces on the upper face",
    )
    parser.add_argument(
        "--temperature",
        action="store_true",
        help="bond the lower face to rigid ground, take the width as the pitch of the cubes, and "
        "compute the stress of the pads per K, because the elastomer expands",
    )
    parser.add_argument(
        "--weight",
        action="store_true",
        help="bond the lower face to rigid ground, take the width as the pitch of the cubes, and "
        "compute the stress of the pads by weight and inertia, from the densities in the model",
    )
    parser.add_argument(
        "--base",
        type=Path,
        metavar="FILE",
        help="calibration to which --weight adds its result (default: the shipped one of the "
        "layout)",
    )
    parser.add_output(
        "-o",
        "--output",
        help="write the calibration (.yaml), with --surface the influence functions (.npz), or "
        "with --temperature the thermal stress for the simulator (.yaml)",
    )
    parser.add_output(
        "--figures",
        kind="folder",
        help="write pictures of convergence, response and each load",
    )
    parser.add_json()
    parser.add_argument(
        "--meshes",
        type=int,
        choices=[1, 2, 3],
        default=3,
        help="number of meshes; fewer need less memory and show less of the convergence "
        "(default: %(default)s)",
    )


def run(options: argparse.Namespace) -> int:
    from cube_tensor_driver.config.output_files import write_json
    from cube_tensor_driver.views.terminal.interrupt import ends_at_once
    from cube_tensor_driver.views.terminal.output import progress_bar

    from ..fem.fem import Response, compute_response
    from ..fem.model import read_model
    from ..fem.thermal import ThermalStress, compute_thermal_stress
    from ..fem.weight import WeightResponse, compute_weight
    from ..studies.surface_study import study_surface

    model = read_model(options.model)
    _check_output(options, model)
    body, layout = model.body, model.layout
    is_on_ground = options.surface or options.temperature or options.weight
    place = " on rigid ground" if is_on_ground else ""
    symmetry = "" if is_on_ground else f", symmetry {model.symmetry}"
    print(f"{describe(body, layout)}{place}; {layout.n_pads} pads{symmetry}", flush=True)
    result: Response | SurfaceStudy | ThermalStress | WeightResponse
    # The factorisation runs in C, where Ctrl-C would not be noticed.
    with ends_at_once(), progress_bar() as report:
        if options.surface:
            result = study_surface(body, layout, options.meshes, model.neglect, report)
        elif options.temperature:
            result = compute_thermal_stress(body, layout, options.meshes, report)
        elif options.weight:
            result = compute_weight(body, layout, options.meshes, report)
        else:
            result = compute_response(body, layout, model.symmetry, options.meshes, report)
    if options.json is not None:
        write_json(options.json, result.to_dict())
    if isinstance(result, Response):
        show_response(result)
    elif isinstance(result, ThermalStress):
        show_thermal_stress(result)
    elif isinstance(result, WeightResponse):
        show_weight(result)
    else:
        show_surface(result)
    if options.figures is not None and not isinstance(result, ThermalStress | WeightResponse):
        _draw(result, options.figures)
    if options.output is not None:
        _write(options, model, result)
    return 0


def _check_output(options: argparse.Namespace, model: Model) -> None:
    """Raise ConfigError before any work if --output cannot hold what is computed."""
    from cube_tensor_driver.config.output_files import check_yaml
    from cube_tensor_driver.core.errors import ConfigError

    chosen = [f"--{name}" for name in COMPUTATIONS if getattr(options, name)]
    if len(chosen) > 1:
        raise ConfigError(f"{' and '.join(chosen)} are different computations; give one of them")
    if options.base is not None and not options.weight:
        raise ConfigError("--base is for --weight, which adds its result to a calibration")
    if options.figures is not None and (options.temperature or options.weight):
        raise ConfigError(f"--figures: there are no pictures of {chosen[0]}; leave it out")
    path = options.output
    if path is None:
        return
    if not options.surface:
        check_yaml("-o", path)
    elif path.suffix != ".npz":
        raise ConfigError(
            f"-o {path}: with --surface it is a file of influence functions, which ends in .npz; "
            "name one, or leave out --surface for a calibration"
        )
    elif model.layout.planar:
        raise ConfigError(
            f"-o {path}: layout {model.layout.name!r} lies in a plane, and influence functions for "
            "a skin are of a layout in space; take a model with layout: cube, or leave out -o"
        )


def _draw(result: Response | SurfaceStudy, folder: Path) -> None:
    """Draw influence functions, or convergence, response and the loads of a layout in a plane."""
    from cube_tensor_driver.views.figures.style import save

    from ..fem.fem import Response
    from ..figures.deformation import draw_loads
    from ..figures.response import draw_convergence, draw_influence, draw_response
    from ..paper.experiments import mode_deformations

    folder.mkdir(parents=True, exist_ok=True)
    body, layout = result.body, result.layout
    if isinstance(result, Response):
        save(draw_convergence(result), folder / "convergence.png")
        save(draw_response(result), folder / "response.png")
        if layout.planar:
            save(draw_loads(layout, mode_deformations(body, layout)), folder / "loads.png")
    else:
        influence = draw_influence(result.influence, layout, body.side / 2)
        save(influence, folder / "influence.png")
    print(f"pictures in {folder}")


def describe(body: Body, layout: Layout) -> str:
    """Return one line about the cube, its body and its place."""
    lengths = [body.width, body.height]
    plane = f", plane {body.plane}"
    if not layout.planar:
        lengths.insert(1, body.depth)
        plane = ""
    size = " x ".join(f"{1e3 * length:g}" for length in lengths)
    cube = "steel"
    if math.isinf(body.cube_young):
        cube = "rigid"
    elif body.cube_young != type(body).cube_young:
        cube = f"{body.cube_young / 1e9:g} GPa"
    where = ""
    if body.x or body.z:
        where = f", {1e3 * body.x:g} mm along x and {1e3 * body.z:g} mm along z off its centre"
    law = f"E {body.young / 1e6:g} MPa, nu {body.poisson:g}{plane}"
    return f"{cube} cube of {1e3 * body.side:g} mm in a body of {size} mm{where} ({law})"


def _command(options: argparse.Namespace) -> str:
    """Return the command line that computes the same result, without options for output files."""
    words = ["./cube", "fem"]
    # Only what changes the result; the default number of meshes is left out.
    if options.model is not None:
        words.append(options.model)
    words += [f"--{name}" for name in COMPUTATIONS if getattr(options, name)]
    if options.meshes != 3:
        words += ["--meshes", str(options.meshes)]
    return shlex.join(words)


def _write(
    options: argparse.Namespace,
    model: Model,
    result: Response | SurfaceStudy | ThermalStress | WeightResponse,
) -> None:
    """Write the calibration of a response, that of another with the response to weight, or the
    influence functions or the thermal stress of a cube on ground."""
    from cube_tensor_driver.config.yaml import write_yaml
    from cube_tensor_driver.mechanics.influence_file import write_influence

    from ..fem.fem import Response
    from ..fem.thermal import ThermalStress
    from ..fem.weight import WeightResponse

    if isinstance(result, Response):
        _write_calibration(options, model, result)
    elif isinstance(result, ThermalStress):
        header = f"Made by: {_command(options)} -o {options.output}\n{THERMAL_HEADER}"
        write_yaml(options.output, result.to_dict(), header)
        print(f"wrote {options.output}")
    elif isinstance(result, WeightResponse):
        _write_weight(options, result)
    else:
        write_influence(options.output, result.influence, _command(options))
        print(f"wrote {options.output}")


def _write_weight(options: argparse.Namespace, result: WeightResponse) -> None:
    """Write the calibration of --base, or the shipped one of the layout, with the response to
    specific force."""
    from dataclasses import replace

    from cube_tensor_driver.config.calibration import (
        read_calibration,
        shipped_calibration,
        write_calibration,
    )
    from cube_tensor_driver.core.compensation.models import WeightModel
    from cube_tensor_driver.core.errors import ConfigError

    base = read_calibration(options.base) if options.base else shipped_calibration(result.layout)
    if base is None or not base.layout.same_as(result.layout):
        raise ConfigError(
            f"--base: the weight is that of a cube with the layout {result.layout.name!r}, and "
            f"{'no calibration is shipped' if base is None else 'the calibration is not'} for it; "
            "name a calibration of the same layout"
        )
    calibration = replace(base, weight=WeightModel(result.pads))
    body = result.body
    header = (
        f"Made by: {_command(options)} -o {options.output}\n"
        f"The block weight is computed: {describe(body, result.layout)} on rigid ground, densities "
        f"{body.density:g} and {body.cube_density:g} kg/m³."
    )
    write_calibration(options.output, calibration, header)
    print(f"wrote {options.output}: calibration {calibration.id}")


def _write_calibration(
    options: argparse.Namespace,
    model: Model,
    result: Response,
) -> None:
    """Write the calibration; its first lines say what is computed and what is a placeholder."""
    from cube_tensor_driver.config.calibration import write_calibration

    from ..fem.fem import calibration_from_fem

    command = _command(options)
    # A body without the symmetry would lose a part of its response in the coefficients.
    needs_matrix = result.structure_residual > MAX_STRUCTURE_RESIDUAL
    calibration = calibration_from_fem(
        result, needs_matrix, model.neglect, source=f"computed by {command}"
    )
    # A pad is crushed where its stress reaches the modulus of its foam.
    column = result.matrix[:, result.modes.index("zz")]
    largest = float(abs(column).max())
    crushing_kpa = calibration.modulus.max() / largest / 1e3
    lines = [
        f"Made by: {command} -o {options.output}",
        f"The response is computed: {describe(result.body, result.layout)}.",
        "Rest frequencies, beta and modulus are not: they are placeholders until the cube is tared"
        " and fitted.",
        f"With this modulus a uniform sigma_zz of -{crushing_kpa:.3g} kPa crushes a pad, which is"
        " where its law ends.",
    ]
    if model.neglect:
        lines.append(
            "The modes under neglect must be small: too few pads to tell them from the others."
        )
    write_calibration(options.output, calibration, "\n".join(lines))
    text = f"wrote {options.output}: calibration {calibration.id}"
    if needs_matrix:
        text += f", with the whole matrix: symmetry {result.symmetry} does not explain it"
    print(text)


def show_response(result: Response) -> None:
    """Print the matrix, the coefficients on each mesh, and what they leave unexplained."""
    from rich.console import Console

    console = Console(highlight=False)
    # A narrow terminal gets several tables one below the other.
    column = COLUMN_GAP + max(MIN_NUMBER_WIDTH, *(len(name) for name in result.modes))
    fitting = (console.width - LABEL_WIDTH) // column
    count = max(1, min(MAX_MODE_COLUMNS, fitting))
    for start in range(0, len(result.modes), count):
        console.print(_matrix_table(result, start, count))
    console.print(_convergence_table(result))
    hidden = len(result.coefficients) - MAX_COEFFICIENTS_SHOWN
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


def _matrix_table(
    result: Response,
    start: int,
    count: int,
) -> Table:
    """Return the table of the response of all pads to `count` modes; the first table has the
    title."""
    title = "response, Pa per Pa; below, what the symmetry does not explain"
    names = result.modes[start : start + count]
    table = new_table("" if start else title, "pad", names)
    modes = slice(start, start + len(names))
    rows = zip(result.layout.pads, result.matrix, strict=True)
    for number, (pad, row) in enumerate(rows, 1):
        label = f"V{number} {pad}" if result.layout.planar else pad
        is_last = number == result.layout.n_pads
        table.add_row(
            label,
            *(format_number(value, 4) for value in row[modes]),
            end_section=is_last,
        )
    table.add_row(
        "left, %",
        *(f"{100 * result.mode_residual[name]:.2f}" for name in names),
    )
    return table


def _convergence_table(result: Response) -> Table:
    """Return the table of the coefficients on each mesh."""
    meshes = result.convergence
    unknowns = [str(mesh["unknowns"]) for mesh in meshes]
    title = "coefficients on each mesh"
    table = new_table(title, "unknowns", [*unknowns, "last step"])
    names = list(result.coefficients)[:MAX_COEFFICIENTS_SHOWN]
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


def show_thermal_stress(result: ThermalStress) -> None:
    """Print the stress of the pads per K, and what a cube with the shipped calibration measures."""
    from rich.console import Console

    console = Console(highlight=False)
    title = "stress of the pads, Pa per K of a temperature P0 (uniform), P1, ... of the height"
    table = new_table(title, "pad", [f"P{degree}" for degree in range(result.pads.shape[1])])
    for pad, row in zip(result.layout.pads, result.pads, strict=True):
        table.add_row(pad, *(format_number(value, 2) for value in row))
    console.print(table)
    _show_change(console, result.change)
    _show_measured(console, result.layout, result.pads[:, 0], "", "/K")


def _show_change(console: Console, change: float | None) -> None:
    """Print the change of a result from the mesh before, relative to its largest value."""
    if change is not None:
        console.print(f"change from the mesh before: {100 * change:.2g} %")


def _show_measured(
    console: Console,
    layout: Layout,
    pads: Array,
    label: str,
    unit: str,
) -> None:
    """Print what a cube with the shipped calibration of its layout measures, if there is one.

    Args:
        console: Where to print.
        layout: Layout of the cube.
        pads: Stress on each pad (P,), in Pa per `unit`.
        label: Text in front of each line, or "".
        unit: Text after Pa and Pa/mm, such as "/K".
    """
    from cube_tensor_driver.config.calibration import shipped_calibration
    from cube_tensor_driver.core.modes import COMPONENTS, STRESS
    from cube_tensor_driver.core.pipeline import Pipeline

    calibration = shipped_calibration(layout)
    if calibration is None:
        return
    measured = Pipeline([calibration]).matrix(0) @ pads
    for name, value in zip(COMPONENTS, measured.tolist(), strict=True):
        # Symmetry makes most components vanish but for rounding.
        if abs(value) > SMALLEST_SHOWN_STRESS:
            text = f"{value:+.1f} Pa" if name in STRESS else f"{1e-3 * value:+.1f} Pa/mm"
            console.print(f"{label}measured with the shipped calibration: {name} {text}{unit}")


def show_weight(result: WeightResponse) -> None:
    """Print the stress of the pads per m/s², and what a cube with the shipped calibration measures
    under the weight of each pose."""
    from rich.console import Console

    from cube_tensor_driver.core.compensation.weight import STANDARD_GRAVITY

    console = Console(highlight=False)
    table = new_table("stress of the pads, Pa per m/s² of specific force", "pad", "xyz")
    for pad, row in zip(result.layout.pads, result.pads, strict=True):
        table.add_row(pad, *(format_number(value, 3) for value in row))
    console.print(table)
    _show_change(console, result.change)
    for axis, pads in zip("xyz", result.pads.T, strict=True):
        _show_measured(console, result.layout, STANDARD_GRAVITY * pads, f"{axis} up, ", "")


def show_surface(study: SurfaceStudy) -> None:
    """Print for each load the measured stress, the true one, and their ratio where it is large."""
    from rich.console import Console

    is_plane = study.layout.planar
    names = list(study.rows[0].measured)
    # Short headings let the table fit into 80 characters.
    heads = [f"{name} {column}" for name in names for column in ("cube", "true", "ratio")]
    table = new_table(
        f"stress in kPa under {'1 N/mm' if is_plane else '1 N'}: measured by the cube, and true",
        "load",
        ["width, mm", "at x, mm", *heads],
    )
    # A stress in Pa under 1 N/m has the same number in kPa under 1 N/mm.
    unit, digits = (1.0, 1) if is_plane else (1e3, 2)
    for row in study.rows:
        cells = [cell for name in names for cell in _surface_cells(row, name, unit, digits)]
        table.add_row(row.load, f"{1e3 * row.width:g}", f"{1e3 * row.offset:g}", *cells)
    Console(highlight=False).print(table)


def _surface_cells(
    row: SurfaceRow,
    name: str,
    unit: float,
    digits: int,
) -> tuple[str, str, str]:
    """Return measured stress, true stress and their ratio, empty where the true one is small."""
    measured = row.measured[name]
    true = row.true[name]
    largest = max(abs(value) for value in row.true.values())
    ratio = f"{measured / true:.2f}" if abs(true) > MIN_SHOWN_SHARE * largest else ""
    return (
        format_number(measured / unit, digits),
        format_number(true / unit, digits),
        ratio,
    )


def new_table(
    title: str,
    first: str,
    columns: Iterable[str],
) -> Table:
    """Return an empty table with a first column of names and columns of numbers."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    table = Table(
        title=title or None,
        title_justify="left",
        box=SIMPLE_HEAD,
        pad_edge=False,
    )
    table.add_column(first)
    for name in columns:
        table.add_column(name, justify="right")
    return table


def format_number(value: float, digits: int) -> str:
    """Format a number with this many digits after the point; -0 becomes 0."""
    return f"{round(value, digits) + 0.0:.{digits}f}"
