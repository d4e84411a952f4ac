"""./cube docs: the documentation as HTML."""

from __future__ import annotations

import argparse
import subprocess
import sys

from cube_tensor_driver.cli import ROOT
from cube_tensor_driver.cli.parser import Parser


def arguments(parser: Parser) -> None:
    parser.add_output(
        "-o",
        "--output",
        kind="folder",
        default=ROOT / ".cube" / "docs",
        help="folder to write to (default: .cube/docs)",
    )


def run(options: argparse.Namespace) -> int:
    """Sphinx; a warning is an error."""
    command = ["sphinx", "-W", "--keep-going", "-q", "docs", str(options.output.resolve())]
    return subprocess.run([sys.executable, "-m", *command], cwd=ROOT, check=False).returncode
