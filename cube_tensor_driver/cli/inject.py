# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""./cube inject: inject a fault into simulated hubs that run in another process."""

from __future__ import annotations

import argparse
from pathlib import Path

from .parser import Parser


def add_arguments(parser: Parser) -> None:
    """Add the options of the command."""
    parser.add_value(
        "fault",
        "KEY=VALUE",
        "kind=... and what it needs, as in kind=unplug link=hub0 seconds=2; "
        "docs/reliability.md lists them",
        nargs="+",
    )
    parser.add_value(
        "--ports",
        "DIR",
        "folder of the simulated ports (default: that of the newest demo)",
        Path,
    )


def run(options: argparse.Namespace) -> int:
    """Inject a fault into running simulated hubs."""
    from ..simulation.inject import inject

    print(inject(options.ports, options.fault))
    return 0
