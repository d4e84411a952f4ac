# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Results of `./cube fem` and `./cube study` as tables on the terminal, files and pictures."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.console import Console

from cube_tensor_driver.config.calibration import (
    find_shipped_calibration,
    write_calibration,
)
from cube_tensor_driver.config.yaml import write_yaml
from cube_tensor_driver.core.arrays import Array
from cube_tensor_driver.core.calibration import Calibration
from cube_tensor_driver.core.compensation.models import WeightModel
from cube_tensor_driver.core.compensation.weight import STANDARD_GRAVITY
from cube_tensor_driver.core.layout import Layout
from cube_tensor_driver.core.modes import COMPONENTS, STRESS
from cube_tensor_driver.core.pipeline import Pipeline
from cube_tensor_driver.mechanics.influence import write_influence
from cube_tensor_driver.views.terminal.output import print_table, say

from .fem.body import Body
from .fem.fem import Response, make_calibration_from_fem
from .fem.model import Model
from .fem.volume_loads import ThermalStress, VolumeResponse
from .studies.layout_study import DEPTH, LayoutStudy
from .studies.surface_study import SurfaceRow, SurfaceStudy

MAX_STRUCTURE_RESIDUAL = 1e-3
"""Largest part of the response (relative, Frobenius norm) that the coefficients of a calibration
may leave out. If more is left out, the calibration holds the whole matrix."""
MAX_MODE_COLUMNS = 7
"""Maximum number of modes (columns) in one printed table of the response matrix, so that the table
fits into 80 characters."""
LABEL_WIDTH = 9
"""Width of the first column of a printed response matrix, with the names of pads, in characters."""
MIN_COLUMN_WIDTH = 9
"""Width of a value in a printed response matrix and of the space before it, in characters."""
MAX_COEFFICIENTS_SHOWN = 40
"""Maximum number of coefficients in the printed table of convergence; the file of --json has
all."""
THERMAL_HEADER = """Stress on each pad in Pa per K of the temperature P_k(s), k = 0, 1, ...:
P_k is the Legendre polynomial, s grows from -1 at the ground to 1 at the surface."""
"""Comment at the top of a file of thermal stress."""
SMALLEST_SHOWN_STRESS = 0.05
"""Stress by weight in Pa or by temperature in Pa/K (gradient in Pa/m or Pa/m/K) below which a
component is not printed."""
MIN_SHOWN_SHARE = 0.05
"""Share of the largest stress under a load below which no ratio of measured to true stress is
printed, because it would be noise."""

Result = Response | SurfaceStudy | VolumeResponse
"""Result of a computation of `./cube fem`."""


def describe(body: Body, layout: Layout) -> str:
    """Return one line about the cube, its body and its place."""
    lengths = [body.width, body.depth, body.height]
    plane = ""
    if layout.planar:
        del lengths[1]
        plane = f", plane {body.plane}"
    size = " x ".join(f"{1e3 * length:g}" for length in lengths)
    cube = "steel"
    if math.isinf(body.cube_young):
        cube = "rigid"
    elif body.cube_young != Body.cube_young:
        cube = f"{body.cube_young / 1e9:g} GPa"
    where = ""
    if body.x or body.z:
        where = f", {1e3 * body.x:g} mm along x and {1e3 * body.z:g} mm along z off its centre"
    law = f"E {body.young / 1e6:g} MPa, nu {body.poisson:g}{plane}"
    return f"{cube} cube of {1e3 * body.side:g} mm in a body of {size} mm{where} ({law})"


def show(result: Result) -> None:
    """Print a result."""
    if isinstance(result, Response):
        _show_response(result)
    elif isinstance(result, SurfaceStudy):
        _show_surface(result)
    else:
        _show_volume(result)


def _show_response(result: Response) -> None:
    """Print the matrix, the coefficients on each mesh, and what they leave unexplained."""
    modes, layout = result.modes, result.layout
    labels = layout.pads
    if layout.planar:
        labels = tuple(f"V{number} {pad}" for number, pad in enumerate(labels, 1))
    title = "response, Pa per Pa; below, what the symmetry does not explain"
    # A narrow terminal gets several tables one below the other.
    column = max(MIN_COLUMN_WIDTH, *(2 + len(name) for name in modes))
    fitting = (Console().width - LABEL_WIDTH) // column
    count = max(1, min(MAX_MODE_COLUMNS, fitting))
    for start in range(0, len(modes), count):
        names = modes[start : start + count]
        numbers = result.matrix[:, start : start + count]
        left = [f"{100 * result.mode_residual[name]:.2f}" for name in names]
        rows = _make_rows(labels, numbers, 4)
        print_table(
            ("pad",),
            names,
            rows,
            title=title,
            footer=[["left, %", *left]],
        )
        title = ""
    _show_convergence(result)
    hidden = len(result.coefficients) - MAX_COEFFICIENTS_SHOWN
    if hidden > 0:
        say(f"and {hidden} coefficients more, in the --json file")
    say(
        f"symmetry {result.symmetry} leaves {100 * result.structure_residual:.3g} % "
        f"of the response unexplained; rank {result.rank} of {len(modes)}; "
        f"unobservable: {', '.join(result.unobservable) or 'nothing'}; {result.seconds:.1f} s"
    )


def _show_convergence(result: Response) -> None:
    """Print the coefficients on each mesh."""
    meshes = result.convergence
    rows = []
    for name in list(result.coefficients)[:MAX_COEFFICIENTS_SHOWN]:
        values = [mesh["coefficients"][name] for mesh in meshes]
        step = ""
        if len(values) > 1 and values[-2]:
            step = f"{100 * abs(values[-1] / values[-2] - 1):.2g} %"
        rows.append([name, *(f"{value:.5f}" for value in values), step])
    # The last mesh has no next one.
    steps = [mesh["change"] for mesh in meshes]
    changes = [f"{100 * step:.2g} %" for step in steps if step is not None]
    seconds = [f"{mesh['seconds']:.1f}" for mesh in meshes]
    footer = [["change to the next", *changes], ["seconds", *seconds]]
    unknowns = [str(mesh["unknowns"]) for mesh in meshes]
    print_table(
        ("unknowns",),
        [*unknowns, "last step"],
        rows,
        title="coefficients on each mesh",
        footer=footer,
    )


def write(path: Path, result: Result, command: str, model: Model) -> None:
    """Write the file of --output.

    Args:
        path: The file.
        result: The result.
        command: Command line that computes the result.
        model: Model of the cube in its body.
    """
    if isinstance(result, Response):
        _write_response(path, result, command, model.neglect)
    elif isinstance(result, SurfaceStudy):
        write_influence(path, result.influence, command)
        print(f"wrote {path}")
    elif isinstance(result, ThermalStress):
        write_yaml(
            path,
            result.to_dict(),
            f"Made by: {command} -o {path}\n{THERMAL_HEADER}",
        )
        print(f"wrote {path}")
    elif model.calibration is not None:
        _write_weight(path, result, command, model.calibration)


def _write_response(
    path: Path,
    result: Response,
    command: str,
    neglect: tuple[str, ...],
) -> None:
    """Write a calibration; its first lines say what is computed and what is a placeholder."""
    # A body without the symmetry would lose a part of its response in the coefficients.
    needs_matrix = result.structure_residual > MAX_STRUCTURE_RESIDUAL
    source = f"computed by {command}"
    calibration = make_calibration_from_fem(
        result,
        needs_matrix,
        neglect,
        source,
    )
    # A pad is crushed where its stress reaches the modulus of its foam.
    to_pressure = result.matrix[:, result.modes.index("zz")]
    largest = np.abs(to_pressure).max()
    crushing_kpa = calibration.modulus.max() / largest / 1e3
    header = (
        f"Made by: {command} -o {path}\n"
        f"The response is computed: {describe(result.body, result.layout)}.\n"
        "Rest frequencies, beta and modulus are not: they are placeholders until the cube is tared"
        " and fitted.\n"
        f"With this modulus a uniform sigma_zz of -{crushing_kpa:.3g} kPa crushes a pad, which is"
        " where its law ends."
    )
    if neglect:
        header += (
            "\nThe modes under neglect must be small: too few pads to tell them from the others."
        )
    write_calibration(path, calibration, header)
    text = f"wrote {path}: calibration {calibration.id}"
    if needs_matrix:
        text += f", with the whole matrix: symmetry {result.symmetry} does not explain it"
    print(text)


def _show_surface(study: SurfaceStudy) -> None:
    """Print for each load the measured stress, the true one, and their ratio where it is large."""
    # Short headings let the table fit into 80 characters.
    names = study.rows[0].measured
    heads = [f"{name} {column}" for name in names for column in ("cube", "true", "ratio")]
    # A stress in Pa under 1 N/m has the same number in kPa under 1 N/mm.
    force, unit, digits = ("1 N/mm", 1.0, 1) if study.layout.planar else ("1 N", 1e3, 2)
    print_table(
        ("load",),
        ("width, mm", "at x, mm", *heads),
        [_make_surface_cells(row, unit, digits) for row in study.rows],
        title=f"stress in kPa under {force}: measured by the cube, and true",
    )


def _make_surface_cells(
    row: SurfaceRow,
    unit: float,
    digits: int,
) -> list[str]:
    """Return the load, and measured stress, true stress and their ratio for each component."""
    cells = [row.load, f"{1e3 * row.width:g}", f"{1e3 * row.offset:g}"]
    largest = max(map(abs, row.true.values()))
    for name, measured in row.measured.items():
        true = row.true[name]
        ratio = f"{measured / true:.2f}" if abs(true) > MIN_SHOWN_SHARE * largest else ""
        cells += [_format_number(value / unit, digits) for value in (measured, true)]
        cells.append(ratio)
    return cells


def _show_volume(result: VolumeResponse) -> None:
    """Print the stress of the pads per K or per m/s², and what a cube with the shipped calibration
    measures in a uniform temperature, or under the weight of each pose."""
    heads = [f"P{degree}" for degree in range(result.pads.shape[1])]
    title = "stress of the pads, Pa per K of a temperature P0 (uniform), P1, ... of the height"
    digits = 2
    cases = [("", result.pads[:, 0], "/K")]
    if not isinstance(result, ThermalStress):
        heads = [*"xyz"]
        title = "stress of the pads, Pa per m/s² of specific force"
        digits = 3
        by_axis = STANDARD_GRAVITY * result.pads.T
        cases = [(f"{axis} up, ", pads, "") for axis, pads in zip("xyz", by_axis, strict=True)]

    rows = _make_rows(result.layout.pads, result.pads, digits)
    print_table(("pad",), heads, rows, title=title)
    if result.change is not None:
        say(f"change from the mesh before: {100 * result.change:.2g} %")
    calibration = find_shipped_calibration(result.layout)
    if calibration is None:
        return
    matrix = Pipeline([calibration]).find_matrix(0)
    for label, pads, unit in cases:
        values = matrix @ pads
        for name, value in zip(COMPONENTS, values.tolist(), strict=True):
            # Symmetry makes most components vanish but for rounding.
            if abs(value) > SMALLEST_SHOWN_STRESS:
                text = f"{value:+.1f} Pa" if name in STRESS else f"{1e-3 * value:+.1f} Pa/mm"
                say(f"{label}measured with the shipped calibration: {name} {text}{unit}")


def _write_weight(
    path: Path,
    result: VolumeResponse,
    command: str,
    base: Calibration,
) -> None:
    """Write a calibration of the layout with the response to specific force."""
    body = result.body
    calibration = replace(base, weight=WeightModel(result.pads))
    header = (
        f"Made by: {command} -o {path}\n"
        f"The block weight is computed: {describe(body, result.layout)} on rigid ground, densities "
        f"{body.density:g} and {body.cube_density:g} kg/m³."
    )
    write_calibration(path, calibration, header)
    print(f"wrote {path}: calibration {calibration.id}")


def draw(result: Result, folder: Path) -> None:
    """Draw influence functions, or convergence, response and the loads of a layout in a plane."""
    from cube_tensor_driver.views.figures.style import save

    from .figures.deformation import draw_loads
    from .figures.response import draw_convergence, draw_influence, draw_response
    from .paper.experiments import compute_mode_deformations

    folder.mkdir(parents=True, exist_ok=True)
    body, layout = result.body, result.layout
    if isinstance(result, SurfaceStudy):
        figure = draw_influence(result.influence)
        save(figure, folder / "influence.png")
    elif isinstance(result, Response):
        save(draw_convergence(result), folder / "convergence.png")
        save(draw_response(result), folder / "response.png")
        if layout.planar:
            save(draw_loads(layout, compute_mode_deformations(body, layout)), folder / "loads.png")
    print(f"pictures in {folder}")


def show_study(result: LayoutStudy) -> None:
    """Print the narrowest trusted indenter for each component, layout and side of the cube."""
    say(
        "narrowest indenter, mm, from which on the error stays below 20 % "
        f"of the component's range; cube's centre {1e3 * DEPTH:g} mm deep"
    )
    columns = [(name, float(side)) for name in result.error for side in result.sides]
    heads = [f"{name}\n{1e3 * side:g} mm" for name, side in columns]
    widths = np.concatenate([result.find_trusted_widths(name) for name in result.error])
    rows = [
        [component, *map(_format_width, column)]
        for component, column in zip(COMPONENTS, widths.T.tolist(), strict=True)
    ]
    print_table(("",), heads, rows)
    say("· not observed by the layout")


def _format_width(width: float) -> str:
    """Format a width (m) in mm; infinite: no indenter is wide enough; NaN: not observed."""
    if math.isnan(width):
        return "·"
    return "never" if math.isinf(width) else f"{1e3 * width:g}"


def _make_rows(
    names: Iterable[str],
    values: Array,
    digits: int,
) -> list[list[str]]:
    """Return the cells of rows of numbers, with a name before each."""
    pairs = zip(names, values.tolist(), strict=True)
    return [[name, *(_format_number(value, digits) for value in row)] for name, row in pairs]


def _format_number(value: float, digits: int) -> str:
    """Format a number with this many digits after the point; -0 becomes 0."""
    return f"{round(value, digits) + 0.0:.{digits}f}"
