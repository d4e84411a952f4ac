# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""./cube urdf: print the frames of a skin for the description of a robot."""

from __future__ import annotations

import argparse
from pathlib import Path

from .parser import Parser


def add_arguments(parser: Parser) -> None:
    """Add the options of the command."""
    parser.add_value("file", "FILE", "skin file", Path)
    parser.add_value(
        "--frame-prefix",
        "TEXT",
        "text in front of all frame ids, as in the launch file's frame_prefix:=left_",
        default="",
    )


def run(options: argparse.Namespace) -> int:
    """Print the URDF of a skin: one link per cube under its parent frame."""
    from ..config.skin import read_skin
    from ..config.urdf import make_skin_urdf

    print(make_skin_urdf(read_skin(options.file, options.frame_prefix)), end="")
    return 0
