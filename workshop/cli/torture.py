# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""./cube torture: real processes under all faults, checked against the simulator's log."""

from __future__ import annotations

import argparse

from cube_tensor_driver.cli.parser import Parser, positive, whole_number


def add_arguments(parser: Parser) -> None:
    """Add duration, seed and mutation."""
    parser.add_value(
        "--duration",
        "S",
        "how long faults are injected, s (default: %(default)g)",
        positive,
        default=60.0,
    )
    parser.add_value(
        "--seed",
        "N",
        "seed of the random mix (default: %(default)s)",
        whole_number,
        default=0,
    )
    parser.add_value(
        "--mutate",
        "NAME",
        "put a fault into the driver or the reconstruction that must be found; all: one after "
        "the other, each in a short torture of its own",
    )
    parser.add_json()


def run(options: argparse.Namespace) -> int:
    """Run a simulated skin under faults, with or without deliberate errors in its nodes."""
    from ..torture.torture import run_mutations, run_torture

    if options.mutate is not None:
        return run_mutations(
            options.mutate,
            seed=options.seed,
            json_path=options.json,
        )
    return run_torture(
        duration=options.duration,
        seed=options.seed,
        json_path=options.json,
    )
