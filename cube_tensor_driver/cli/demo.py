# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""./cube demo: run simulated hubs, driver and reconstruction, and compare them with the load."""

from __future__ import annotations

import argparse
from pathlib import Path

from .parser import Parser, count, not_negative, positive, sample_rate

DEFAULT_DURATION_S = 10.0
"""Duration, in seconds, of a demo with --headless, --json or --figure but without --duration."""


def add_arguments(parser: Parser) -> None:
    """Add the options of the command."""
    parser.add_value(
        "--config",
        "FILE",
        "skin file to simulate (default: sixteen planar cubes)",
        Path,
    )
    parser.add_value(
        "--cubes",
        "N",
        "simulate a grid of N planar cubes instead",
        count,
    )
    parser.add_value(
        "--load",
        "FILE",
        "load script (default: a contact that wanders over the skin)",
        Path,
    )
    parser.add_value(
        "--mujoco",
        "SCENE",
        "MuJoCo scene (.xml) that touches the skin, instead of a load script; it names its "
        "skin file itself (docs/simulation.md; scenes: config/mujoco)",
        Path,
    )
    parser.add_value(
        "--rate",
        "HZ",
        "samples per second (default: those of the skin file, else 100)",
        sample_rate,
    )
    parser.add_value(
        "--noise",
        "X",
        "noise of the pads relative to their frequencies, 0 for none "
        "(default: as the calibrations state)",
        not_negative,
    )
    parser.add_value(
        "--imperfections",
        "FILE",
        "how pads differ from their calibrations: gains, dead pads, creep, temperature, and weight "
        "in a moving skin (docs/simulation.md; default: not at all)",
        Path,
    )
    parser.add_value(
        "--duration",
        "S",
        "end after S seconds and print the figures (default: until Ctrl-C; "
        f"{DEFAULT_DURATION_S:g} with --headless, --json or --figure)",
        positive,
    )
    parser.add_switch("--headless", "show no live table")
    parser.add_switch("--view", "show the skin in the browser too, as ./cube view does")
    parser.add_output(
        "--figure",
        kind="picture",
        help="draw force and centre of pressure together with those of the load script",
    )
    parser.add_output("--json", help="write the figures to FILE instead of printing them")


def run(options: argparse.Namespace) -> int:
    """Run simulated cubes, driver and reconstruction, with a live table."""
    from dataclasses import fields

    from ..demo.demo import DemoSettings, run_demo

    # A demo that shows no table or writes a file must end by itself.
    measures = options.headless or options.json or options.figure
    if options.duration is None and measures:
        options.duration = DEFAULT_DURATION_S
    # Each field of DemoSettings has the value of the option with the same name.
    names = [field.name for field in fields(DemoSettings)]
    settings = {name: getattr(options, name) for name in names}
    return run_demo(DemoSettings(**settings))
