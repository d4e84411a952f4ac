# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""./cube paper: the pictures and numbers of docs/paper.md, except those of the study."""

from __future__ import annotations

import argparse
from pathlib import Path

from cube_tensor_driver.cli.parser import Parser


def add_arguments(parser: Parser) -> None:
    """Add the options of the command."""
    parser.add_output(
        "--out",
        kind="folder",
        default=Path("paper"),
        help="folder to write to (default: %(default)s)",
    )


def run(options: argparse.Namespace) -> int:
    """Repeat the source paper's experiments on a virtual bench."""
    from cube_tensor_driver.views.terminal.output import show_progress_bar

    from ..figures.paper import save_paper

    with show_progress_bar() as report:
        written = save_paper(options.out, report)
    names = ", ".join(path.name for path in written)
    print(f"wrote {names} into {options.out}")
    return 0
