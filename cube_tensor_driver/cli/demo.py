"""./cube demo: simulated hubs, driver and reconstruction, checked against the simulated load."""

from __future__ import annotations

import argparse
from pathlib import Path

from .parser import Parser, count, not_negative, positive, sample_rate

MEASURE_S = 10.0
"""How long a demo that measures runs."""


def arguments(parser: Parser) -> None:
    parser.add_argument(
        "--config",
        type=Path,
        metavar="FILE",
        help="skin file to simulate (default: sixteen planar cubes)",
    )
    parser.add_argument(
        "--cubes", type=count, metavar="N", help="simulate a grid of N planar cubes instead"
    )
    parser.add_argument(
        "--load",
        type=Path,
        metavar="FILE",
        help="load script (default: a contact that wanders over the skin)",
    )
    parser.add_argument(
        "--mujoco",
        type=Path,
        metavar="SCENE",
        help="MuJoCo scene (.xml) that touches the skin, instead of a load script; it names its "
        "skin file itself (docs/simulation.md; scenes: config/mujoco)",
    )
    parser.add_argument(
        "--rate",
        type=sample_rate,
        metavar="HZ",
        help="samples per second (default: those of the skin file, else 100)",
    )
    parser.add_argument(
        "--noise",
        type=not_negative,
        metavar="X",
        help="noise of the pads relative to their frequencies, 0 for none "
        "(default: as the calibrations state)",
    )
    parser.add_argument(
        "--imperfections",
        type=Path,
        metavar="FILE",
        help="spread of the gains, dead pads and creep (docs/simulation.md; default: none)",
    )
    parser.add_argument(
        "--duration",
        type=positive,
        metavar="S",
        help="end after S seconds and print the figures (default: until Ctrl-C; "
        f"{MEASURE_S:g} with --headless, --json or --figure)",
    )
    parser.add_argument("--headless", action="store_true", help="show no live table")
    parser.add_argument(
        "--view", action="store_true", help="show the skin in the browser too, as ./cube view does"
    )
    parser.add_output(
        "--figure",
        kind="picture",
        help="draw force and centre of pressure together with those of the load script",
    )
    parser.add_output("--json", help="write the figures to FILE instead of printing them")


def run(options: argparse.Namespace) -> int:
    from ..demo.demo import run_demo

    duration = options.duration
    if duration is None and (options.headless or options.json or options.figure):
        duration = MEASURE_S
    return run_demo(
        config=options.config,
        cubes=options.cubes,
        load=options.load,
        mujoco=options.mujoco,
        rate=options.rate,
        noise=options.noise,
        imperfections=options.imperfections,
        duration=duration,
        headless=options.headless,
        view=options.view,
        json_path=options.json,
        figure=options.figure,
    )
