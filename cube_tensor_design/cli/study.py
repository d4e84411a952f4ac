# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""./cube study: the narrowest contact for which each layout can be trusted."""

from __future__ import annotations

import argparse
from pathlib import Path

from cube_tensor_driver.cli.parser import Parser


def add_arguments(parser: Parser) -> None:
    """Add the options of the command."""
    parser.add_json()
    parser.add_output(
        "--figure",
        kind="picture",
        default=Path("study.png"),
        help="picture to write (default: %(default)s)",
    )


def run(options: argparse.Namespace) -> int:
    """Find how wide a contact must be for each layout to be right."""
    from cube_tensor_driver.config.output_files import write_json
    from cube_tensor_driver.views.figures.style import save
    from cube_tensor_driver.views.terminal.output import show_progress_bar

    from ..figures.trust import draw_trust
    from ..reports import show_study
    from ..studies.layout_study import study_layouts

    with show_progress_bar() as report:
        result = study_layouts(progress=report)
    show_study(result)
    save(draw_trust(result), options.figure)
    if options.json is not None:
        write_json(options.json, result.to_dict())
    return 0
