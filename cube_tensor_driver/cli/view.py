"""./cube view: a page on this machine that shows a running skin."""

from __future__ import annotations

import argparse

from ..core.defaults import SURFACE_DEPTH
from .parser import Parser, positive, tcp_port


def arguments(parser: Parser) -> None:
    parser.add_argument(
        "--port",
        type=tcp_port,
        default=8080,
        metavar="N",
        help="TCP port of the page; the next free one if it is taken (default: %(default)s)",
    )
    parser.add_argument(
        "--depth",
        type=positive,
        default=SURFACE_DEPTH,
        metavar="M",
        help="depth of the cubes below the surface, m (default: %(default)s)",
    )


def run(options: argparse.Namespace) -> int:
    from ..browser.viewer import run_view

    return run_view(options.port, options.depth)
