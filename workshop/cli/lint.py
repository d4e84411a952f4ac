"""./cube lint: style and types."""

from __future__ import annotations

import argparse
import subprocess
import sys

from cube_tensor_driver.cli import ROOT
from cube_tensor_driver.cli.parser import Parser

TOOLS = (
    ["ruff", "check", "."],
    ["ruff", "format", "--check", "."],
    ["mypy"],
)


def arguments(parser: Parser) -> None:
    """Add no arguments."""


def run(options: argparse.Namespace) -> int:
    """Run all tools, also if one of them finds something."""
    codes = [
        subprocess.run(
            [sys.executable, "-m", *tool],
            cwd=ROOT,
            check=False,
        ).returncode
        for tool in TOOLS
    ]
    return max(codes)
