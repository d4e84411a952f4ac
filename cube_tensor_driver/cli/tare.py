# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""./cube tare: take the present load of a running skin as zero load, or clear all tares."""

from __future__ import annotations

import argparse
import sys

from .parser import Parser


def add_arguments(parser: Parser) -> None:
    """Add the options of the command."""
    parser.add_value(
        "cubes",
        "CUBE",
        "names of cubes to tare (default: all)",
        nargs="*",
    )
    parser.add_switch(
        "--clear",
        "go back to the rest frequencies of the calibration, for all cubes",
    )


def run(options: argparse.Namespace) -> int:
    """Request the tare, and return the exit code: 1 if a node refuses it, otherwise 0.

    Raises:
        TareError: Cubes are named together with --clear, which applies to all cubes.
    """
    from ..core.errors import TareError
    from ..ros.commands.services import request_tare

    # The service that clears a tare has no field for names of cubes.
    if options.clear and options.cubes:
        raise TareError(
            f"--clear with {' '.join(options.cubes)}: it clears the tare of all cubes; "
            "leave out their names"
        )
    what = "clearing the tare" if options.clear else "tare"
    answers = request_tare(options.cubes, options.clear)
    for answer in answers:
        if answer.success:
            print(f"{answer.node}: {what} done: {answer.message}")
        else:
            print(f"cube: {answer.node}: {what} refused: {answer.message}", file=sys.stderr)
    return 0 if all(answer.success for answer in answers) else 1
