"""./cube urdf: print the frames of a skin for the description of a robot."""

from __future__ import annotations

import argparse
from pathlib import Path

from .parser import Parser


def arguments(parser: Parser) -> None:
    parser.add_argument("file", type=Path, metavar="FILE", help="skin file")


def run(options: argparse.Namespace) -> int:
    from ..config.skin import read_skin
    from ..config.urdf import skin_urdf

    print(skin_urdf(read_skin(options.file)), end="")
    return 0
