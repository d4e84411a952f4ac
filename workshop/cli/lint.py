# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""./cube lint: style and types."""

from __future__ import annotations

import argparse
import subprocess
import sys

from cube_tensor_driver.cli import ROOT
from cube_tensor_driver.cli.parser import Parser

STRICT_MYPY = [
    "mypy",
    "--strict",
    # Some comments are needed with the rclpy of one distribution only.
    "--no-warn-unused-ignores",
    # Results of other options would replace each other in a common cache.
    "--cache-dir=.mypy_cache/strict",
    "cube_tensor_driver",
]
"""Check of the types of what runs on a robot: every annotation must be complete."""

TOOLS = (
    ["ruff", "check", "."],
    ["ruff", "format", "--check", "."],
    ["mypy"],
    STRICT_MYPY,
)
"""Modules that are run, with their arguments. The second check of types is the strict one."""


def arguments(parser: Parser) -> None:
    """Add no arguments."""


def run(options: argparse.Namespace) -> int:
    """Run all tools, also if one of them finds something."""
    codes = [
        subprocess.run([sys.executable, "-m", *tool], cwd=ROOT, check=False).returncode
        for tool in TOOLS
    ]
    return max(codes)
