"""./cube layout: what a layout's pads can measure, in numbers and as a picture."""

from __future__ import annotations

import argparse
from pathlib import Path

from .parser import Parser


def arguments(parser: Parser) -> None:
    parser.add_argument(
        "name", metavar="NAME", help="quad, planar, cube, or a YAML file with a layout"
    )
    parser.add_argument(
        "--symmetry",
        metavar="G",
        help="full, slab, mirrors or none (default: that of the calibration)",
    )
    parser.add_argument(
        "--calibration", metavar="FILE", help="calibration file or name (default: the computed one)"
    )
    parser.add_json()
    parser.add_output(
        "--figure",
        kind="picture",
        default=lambda options: Path(f"{Path(options.name).stem}.png"),
        help="picture of the cube (default: NAME.png)",
    )


def run(options: argparse.Namespace) -> int:
    from ..config.calibration import find_calibration, read_calibration
    from ..config.layout import named_layout, shipped_calibration
    from ..config.output_files import write_json
    from ..core.estimator import summary
    from ..core.response import generic_response
    from ..core.symmetry import find_structure, largest_symmetry
    from ..views.figures.calibration import draw_layout
    from ..views.figures.style import save
    from ..views.terminal.layout import show_layout

    layout = named_layout(options.name)
    calibration = shipped_calibration(layout)
    if options.calibration is not None:
        calibration = read_calibration(find_calibration(options.calibration, Path()))
        calibration.check(layout)
    if options.symmetry is not None:
        symmetry = options.symmetry
    elif calibration is not None:
        symmetry = calibration.symmetry
    else:
        symmetry = largest_symmetry(layout)
    structure = find_structure(layout, symmetry)
    if calibration is None:
        # Any response of this structure has its ranks; conditions and noise are of one response.
        result = summary(structure, generic_response(structure))
        result |= {
            "condition_uniform": None,
            "condition_gradient": None,
            "noise": dict.fromkeys(result["noise"]),
        }
        source = "no calibration: conditions and noise unknown"
    else:
        result = summary(structure, calibration.response, calibration.neglect)
        source = f"calibration {calibration.id} ({calibration.source or 'no source given'})"
    show_layout(layout, symmetry, result, source)
    if options.json is not None:
        write_json(options.json, result)
    save(draw_layout(layout), options.figure)
    return 0
