# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""./cube docs: the documentation as HTML."""

from __future__ import annotations

import argparse
import subprocess
import sys

from cube_tensor_driver.cli import ROOT
from cube_tensor_driver.cli.parser import Parser


def add_arguments(parser: Parser) -> None:
    """Add the folder of the pages."""
    parser.add_output(
        "-o",
        "--output",
        kind="folder",
        default=ROOT / ".cube" / "docs",
        help="folder to write to (default: .cube/docs)",
    )


def run(options: argparse.Namespace) -> int:
    """Run Sphinx, with warnings as errors."""
    command = [
        "sphinx",
        "-W",
        "--keep-going",
        "-q",
        "docs",
        str(options.output.resolve()),
    ]
    code = subprocess.run([sys.executable, "-m", *command], cwd=ROOT, check=False).returncode
    if code == 0:
        print(f"wrote {options.output / 'index.html'}")
    return code
