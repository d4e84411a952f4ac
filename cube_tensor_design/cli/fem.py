# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""./cube fem: the response of a cube's pads by finite elements, as tables, files and pictures."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path
from typing import TYPE_CHECKING

from cube_tensor_driver.cli.parser import Parser

if TYPE_CHECKING:
    from ..fem.model import Model

COMPUTATIONS = {
    "surface": "bond the lower face to rigid ground, and compute the influence functions of the "
    "pads: their stress under forces on the upper face",
    "temperature": "bond the lower face to rigid ground, take the width as the pitch of the cubes, "
    "and compute the stress of the pads per K, because the elastomer expands",
    "weight": "bond the lower face to rigid ground, take the width as the pitch of the cubes, and "
    "compute the stress of the pads by weight and inertia, from the densities in the model",
}
"""Option that asks for another computation than the response to linear stress fields -> its help
text."""
DEFAULT_MESHES = 3
"""Number of meshes, from coarse to fine, that are computed without the option --meshes."""


def add_arguments(parser: Parser) -> None:
    """Add the options of the command."""
    parser.add_argument(
        "model",
        nargs="?",
        metavar="MODEL",
        help="YAML file of geometry and material, or the name of a shipped one in config/fem "
        "(default: a planar steel cube of 4 mm in a section of 60 x 11 mm)",
    )
    for name, text in COMPUTATIONS.items():
        parser.add_argument(f"--{name}", action="store_true", help=text)
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
        default=DEFAULT_MESHES,
        help="number of meshes; fewer need less memory and show less of the convergence "
        "(default: %(default)s)",
    )


def run(options: argparse.Namespace) -> int:
    """Compute a cube's response matrix by finite elements."""
    from cube_tensor_driver.config.output_files import write_json
    from cube_tensor_driver.views.terminal.output import progress_bar

    from .. import reports
    from ..fem.fem import compute_response
    from ..fem.model import read_model
    from ..fem.volume_loads import compute_thermal_stress, compute_weight
    from ..interrupt import ends_at_once
    from ..studies.surface_study import study_surface

    model = read_model(options.model)
    _check_options(options, model)
    body, layout, meshes = model.body, model.layout, options.meshes
    is_on_ground = options.surface or options.temperature or options.weight
    place = " on rigid ground" if is_on_ground else ""
    symmetry = "" if is_on_ground else f", symmetry {model.symmetry}"
    cube = reports.describe(body, layout)
    print(f"{cube}{place}; {layout.n_pads} pads{symmetry}", flush=True)
    result: reports.Result
    # The factorisation runs in C, where Ctrl-C would not be noticed.
    with ends_at_once(), progress_bar() as report:
        if options.surface:
            result = study_surface(body, layout, meshes, model.neglect, report)
        elif options.temperature:
            result = compute_thermal_stress(body, layout, meshes, report)
        elif options.weight:
            result = compute_weight(body, layout, meshes, report)
        else:
            result = compute_response(body, layout, model.symmetry, meshes, report)
    if options.json is not None:
        write_json(options.json, result.to_dict())
    reports.show(result)
    if options.figures is not None:
        reports.draw(result, options.figures)
    if options.output is not None:
        command = _command(options)
        reports.write(options.output, result, command, model.neglect, options.base)
    return 0


def _check_options(options: argparse.Namespace, model: Model) -> None:
    """Raise ConfigError before any work if options exclude each other, or -o names a file that
    cannot hold what is computed."""
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
    if path is not None and not options.surface:
        check_yaml("-o", path)
    elif path is not None and path.suffix != ".npz":
        raise ConfigError(
            f"-o {path}: with --surface it is a file of influence functions, which ends in .npz; "
            "name one, or leave out --surface for a calibration"
        )
    elif path is not None and model.layout.planar:
        raise ConfigError(
            f"-o {path}: layout {model.layout.name!r} lies in a plane, and influence functions for "
            "a skin are of a layout in space; take a model with layout: cube, or leave out -o"
        )


def _command(options: argparse.Namespace) -> str:
    """Return the command line that computes the same result, without options for output files."""
    words = ["./cube", "fem"]
    # Only what changes the result; the default number of meshes is left out.
    if options.model is not None:
        words.append(options.model)
    words += [f"--{name}" for name in COMPUTATIONS if getattr(options, name)]
    if options.meshes != DEFAULT_MESHES:
        words += ["--meshes", str(options.meshes)]
    return shlex.join(words)
