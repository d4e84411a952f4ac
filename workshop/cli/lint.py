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
    # Some `type: ignore` comments are needed only with the rclpy of one ROS distribution.
    "--no-warn-unused-ignores",
    # In a common cache, the results of this check and of the other one would replace each other.
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


def add_arguments(parser: Parser) -> None:
    """Add no arguments."""


def run(options: argparse.Namespace) -> int:
    """Run all tools, also if one of them finds something."""
    codes = [
        subprocess.run([sys.executable, "-m", *tool], cwd=ROOT, check=False).returncode
        for tool in TOOLS
    ]
    return max(codes)
