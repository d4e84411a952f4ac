# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""./cube view: show a running skin in the browser."""

from __future__ import annotations

import argparse
from pathlib import Path

from .parser import Parser, tcp_port

RECORDINGS = Path("~/cube_recordings")
"""Default folder for the bags that users record from the page; --recordings names another one."""


def add_arguments(parser: Parser) -> None:
    """Add the options of the command."""
    parser.add_value(
        "--host",
        "ADDRESS",
        "where the page is served; on any other than this machine's own (0.0.0.0: on all) "
        "browsers need the token in the printed address (default: %(default)s)",
        default="127.0.0.1",
    )
    parser.add_value(
        "--port",
        "N",
        "TCP port of the page; the next free one if it is taken (default: %(default)s)",
        tcp_port,
        default=8080,
    )
    parser.add_value(
        "--recordings",
        "DIR",
        "folder for the bags that are recorded from the page (default: %(default)s)",
        Path,
        default=RECORDINGS,
    )


def run(options: argparse.Namespace) -> int:
    """Show a running skin in the browser: 3-D, plots, tare, recording."""
    # The module imports viser, which the other commands do not need.
    from ..browser.viewer import run_view

    return run_view(
        options.host,
        options.port,
        options.recordings.expanduser(),
    )
