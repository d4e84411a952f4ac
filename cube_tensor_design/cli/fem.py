# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""./cube fem: the response of a cube's pads by finite elements, as tables, files and pictures."""

from __future__ import annotations

import argparse
import shlex
from typing import TYPE_CHECKING

from cube_tensor_driver.cli.parser import Parser

if TYPE_CHECKING:
    from ..fem.model import Model

LOADS = ("modes", "surface", "temperature", "weight")
"""Names of the loads under which the stress of the pads is computed. `modes` are linear stress
fields on the outer faces of the body. Under the others the lower face is bonded to rigid ground."""
DEFAULT_MESHES = 3
"""Number of meshes, from coarse to fine, that are computed without the option --meshes."""


def add_arguments(parser: Parser) -> None:
    """Add the options of the command."""
    parser.add_value(
        "model",
        "MODEL",
        "YAML file of geometry and material, or the name of a shipped one in config/fem "
        "(default: a planar steel cube of 4 mm in a section of 60 x 11 mm)",
        nargs="?",
    )
    parser.add_argument(
        "--load",
        choices=LOADS,
        default=LOADS[0],
        metavar="LOAD",
        help=f"one of {', '.join(LOADS)}. It computes the stress of the pads under linear stress "
        "fields, which is their response; under forces on the upper face (influence functions); "
        "under a temperature of 1 K; or under a specific force of 1 m/s². All but the first bond "
        "the lower face to rigid ground, and the last two take the width as the pitch of the cubes "
        "(default: %(default)s)",
    )
    parser.add_output(
        "-o",
        "--output",
        help="write the calibration (.yaml); of the load surface the influence functions (.npz), "
        "of temperature the thermal stress for the simulator (.yaml)",
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
    from cube_tensor_driver.views.terminal.output import show_progress_bar

    from .. import reports
    from ..fem.fem import compute_response
    from ..fem.model import read_model
    from ..fem.volume_loads import compute_thermal_stress, compute_weight
    from ..interrupt import end_at_once
    from ..studies.surface_study import study_surface

    model = read_model(options.model)
    _check_options(options, model)
    body, layout, meshes = model.body, model.layout, options.meshes
    place, symmetry = " on rigid ground", ""
    if options.load == "modes":
        place, symmetry = "", f", symmetry {model.symmetry}"
    cube = reports.describe(body, layout)
    print(f"{cube}{place}; {layout.n_pads} pads{symmetry}", flush=True)
    result: reports.Result
    # The factorisation runs in C, where Ctrl-C would not be noticed.
    with end_at_once(), show_progress_bar() as report:
        if options.load == "surface":
            result = study_surface(
                body,
                layout,
                meshes,
                model.neglect,
                report,
            )
        elif options.load == "temperature":
            result = compute_thermal_stress(body, layout, meshes, report)
        elif options.load == "weight":
            result = compute_weight(body, layout, meshes, report)
        else:
            result = compute_response(
                body,
                layout,
                model.symmetry,
                meshes,
                report,
            )
    if options.json is not None:
        write_json(options.json, result.to_dict())
    reports.show(result)
    if options.figures is not None:
        reports.draw(result, options.figures)
    if options.output is not None:
        reports.write(options.output, result, _format_command(options), model)
    return 0


def _check_options(options: argparse.Namespace, model: Model) -> None:
    """Raise ConfigError before any work if there are no pictures of the load, or -o names a file
    that cannot hold what is computed."""
    from cube_tensor_driver.config.output_files import check_yaml
    from cube_tensor_driver.core.errors import ConfigError

    if options.figures is not None and options.load in ("temperature", "weight"):
        raise ConfigError(f"--figures: there are no pictures of {options.load}; leave it out")
    path = options.output
    if path is not None and options.load == "weight" and model.calibration is None:
        raise ConfigError(
            f"-o {path}: the weight is added to a calibration, and none is shipped for the layout "
            f"{model.layout.name!r}; name one in the model (calibration: FILE)"
        )
    if path is not None and options.load != "surface":
        check_yaml("-o", path)
    elif path is not None and path.suffix != ".npz":
        raise ConfigError(
            f"-o {path}: with --load surface it is a file of influence functions, which ends in "
            ".npz; name one, or leave out --load for a calibration"
        )
    elif path is not None and model.layout.planar:
        raise ConfigError(
            f"-o {path}: layout {model.layout.name!r} lies in a plane, and influence functions for "
            "a skin are of a layout in space; take a model with layout: cube, or leave out -o"
        )


def _format_command(options: argparse.Namespace) -> str:
    """Return the command line that computes the same result, without options for output files."""
    words = ["./cube", "fem"]
    # Only what changes the result; the default number of meshes is left out.
    if options.model is not None:
        words.append(options.model)
    if options.load != LOADS[0]:
        words += ["--load", options.load]
    if options.meshes != DEFAULT_MESHES:
        words += ["--meshes", str(options.meshes)]
    return shlex.join(words)
