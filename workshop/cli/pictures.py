# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""./cube pictures: the pictures of the documentation, drawn again so that they stay true."""

from __future__ import annotations

import argparse

from cube_tensor_driver.cli import ROOT
from cube_tensor_driver.cli.parser import Parser


def add_arguments(parser: Parser) -> None:
    """Add the folder of the pictures."""
    parser.add_output(
        "-o",
        "--output",
        kind="folder",
        default=ROOT / "docs" / "pictures",
        help="folder to write to (default: docs/pictures)",
    )


def run(options: argparse.Namespace) -> int:
    """Draw all pictures."""
    from ..pictures.draw import make_pictures

    make_pictures(options.output)
    return 0
