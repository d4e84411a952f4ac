# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""./cube layout: show what the pads of a layout can measure, in numbers and as a picture."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from .parser import Parser

if TYPE_CHECKING:
    from ..core.estimator import ResponseSummary
    from ..core.layout import Layout


def add_arguments(parser: Parser) -> None:
    """Add the options of the command."""
    parser.add_value(
        "name",
        "NAME",
        "quad, planar, cube, or a YAML file with a layout",
    )
    parser.add_value(
        "--symmetry",
        "G",
        "full, slab, mirrors or none (default: that of the calibration)",
    )
    parser.add_value(
        "--calibration",
        "FILE",
        "calibration file or name (default: the computed one)",
    )
    parser.add_json()
    parser.add_output(
        "--figure",
        kind="picture",
        default=lambda options: Path(f"{Path(options.name).stem}.png"),
        help="picture of the cube (default: NAME.png)",
    )


def run(options: argparse.Namespace) -> int:
    """Show what the pads of a layout can measure, in numbers and as a picture."""
    from ..config.calibration import (
        find_calibration,
        find_named_layout,
        find_shipped_calibration,
        read_calibration,
    )
    from ..config.output_files import write_json
    from ..core.estimator import summarize_response
    from ..core.response import make_generic_response
    from ..core.symmetry import find_largest_symmetry, find_structure
    from ..views.figures.calibration import draw_layout
    from ..views.figures.style import save

    layout = find_named_layout(options.name)
    calibration = find_shipped_calibration(layout)
    if options.calibration is not None:
        calibration = read_calibration(find_calibration(options.calibration, Path()))
        # A calibration for another layout is refused.
        calibration.check(layout)
    if options.symmetry is not None:
        symmetry = options.symmetry
    elif calibration is not None:
        symmetry = calibration.symmetry
    else:
        symmetry = find_largest_symmetry(layout)
    # The symmetry determines how many independent coefficients the response matrix has.
    structure = find_structure(layout, symmetry)
    if calibration is None:
        # Almost every response matrix with this symmetry has the same ranks, so they can be given
        # without a calibration. Condition numbers and noise depend on the values of the matrix.
        result = summarize_response(structure, make_generic_response(structure))
        result |= {
            "condition_uniform": None,
            "condition_gradient": None,
            "noise": dict.fromkeys(result["noise"]),
        }
        source = "no calibration: conditions and noise unknown"
    else:
        result = summarize_response(
            structure,
            calibration.response,
            calibration.neglect,
        )
        source = f"calibration {calibration.id} ({calibration.source or 'no source given'})"
    show_layout(layout, symmetry, result, source)
    if options.json is not None:
        write_json(options.json, result)
    save(draw_layout(layout), options.figure)
    print(f"wrote {' and '.join(str(path) for path in (options.figure, options.json) if path)}")
    return 0


def show_layout(
    layout: Layout,
    symmetry: str,
    result: ResponseSummary,
    source: str,
) -> None:
    """Print what the pads of a layout can measure: ranks, condition numbers and noise.

    Args:
        layout: The layout of the pads.
        symmetry: Name of the symmetry that the response matrix is assumed to have.
        result: Result of `core.estimator.summarize_response`; unknown values are None.
        source: Origin of the response matrix, in words.
    """
    from ..core.symmetry import count_coefficients
    from ..views.terminal.output import print_table, say

    pads = " ".join(layout.pads)
    say(f"layout {layout.name}: {layout.n_pads} pads   {pads}")
    counts = [
        f"{name} {'not possible' if count is None else count}"
        for name, count in count_coefficients(layout)
    ]
    say(f"coefficients by symmetry: {', '.join(counts)}")
    say(f"symmetry {symmetry}; {source}")

    parts = (
        ("uniform:", result["rank_uniform"], result["condition_uniform"]),
        ("gradient:", result["rank_gradient"], result["condition_gradient"]),
    )
    for part, rank, condition in parts:
        text = "unknown" if condition is None else f"{condition:.3g}"
        say(f"{part:10} rank {rank}, condition {text}")
    say(f"unobservable: {', '.join(result['unobservable']) or 'nothing'}")
    say("noise of each mode per unit of pad noise (gradients times the half side):")
    rows = [(name, describe_noise(result, name)) for name in result["modes"]]
    print_table(("mode",), ("noise",), rows)


def describe_noise(result: ResponseSummary, mode: str) -> str:
    """Return the standard deviation of a mode per unit of pad noise as text, or why it is unknown.

    Args:
        result: Result of `core.estimator.summarize_response`; unknown values are None.
        mode: Name of the mode, which is a linear stress field whose amplitude a cube measures.
    """
    if mode in result["unobservable"]:
        return "not observed"
    noise = result["noise"][mode]
    return "unknown" if noise is None else f"{noise:.3f}"
