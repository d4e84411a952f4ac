# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Process that simulates all hubs of a skin on pseudo-terminals under a load.

The port of each link appears as PORTS/<link name>. On SIGINT or SIGTERM, the simulator ends and
writes its sample log, with which a check compares the samples that arrived.
"""

from __future__ import annotations

import argparse
import signal
import sys
from pathlib import Path

from ..config.skin import read_skin
from ..config.yaml import read_yaml
from ..core.errors import CubeError
from .cubes import PadErrors
from .faults import parse_faults
from .imperfections import NONE, read_imperfections
from .load import read_load
from .simulator import Simulator, StopRequest


def main(
    arguments: list[str] | None = None,
    simulator: type[Simulator] = Simulator,
) -> int:
    """Run the simulator until SIGINT or SIGTERM.

    Args:
        arguments: Command line arguments; None: those of the process.
        simulator: Class of the simulator; a subclass may connect its hubs in another way.

    Returns:
        Exit code: 0, or 1 if an input file cannot be used.
    """
    options = _make_parser().parse_args(arguments)
    stop = StopRequest()
    # The signal handlers exist before the files are read, so that a signal in this time also ends
    # the simulator properly.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop.request)
    try:
        hubs = _create_simulator(options, simulator)
        try:
            hubs.run(stop)
        finally:
            hubs.close()
        if options.log:
            hubs.log().write(options.log)
    except CubeError as error:
        print(f"simulator: {error}", file=sys.stderr)
        return 1
    return 0


def _make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line arguments."""
    parser = argparse.ArgumentParser(
        prog="simulator",
        description="Simulated hubs of a skin on pseudo-terminals.",
    )
    add = parser.add_argument
    add(
        "--config",
        type=Path,
        required=True,
        help="skin file",
    )
    add(
        "--ports",
        type=Path,
        required=True,
        help="folder in which the links' ports appear by name",
    )
    add(
        "--noise",
        type=float,
        help="relative standard deviation of a frequency, 0 for none (default: as the calibrations "
        "state)",
    )
    add(
        "--imperfections",
        type=Path,
        help="deviations of the pads from their calibrations: YAML; docs/simulation.md",
    )
    add(
        "--log",
        type=Path,
        help="file for the log of the samples (JSON), written at the end",
    )
    loads = parser.add_mutually_exclusive_group()
    loads.add_argument(
        "--load",
        type=Path,
        help="load script; docs/simulation.md (default: an indenter that wanders over the skin)",
    )
    loads.add_argument(
        "--mujoco",
        type=Path,
        help="MuJoCo scene that plays by itself; docs/simulation.md",
    )
    add(
        "--instants",
        type=int,
        default=0,
        help="compute the load only at this number of times, and repeat them",
    )
    add(
        "--faults",
        type=Path,
        help="faults to carry out: YAML, a list, see docs/reliability.md",
    )
    return parser


def _create_simulator(
    options: argparse.Namespace,
    simulator: type[Simulator],
) -> Simulator:
    """Read all files and create the simulator.

    Args:
        options: Command line options.
        simulator: Class of the simulator.

    Raises:
        CubeError: A file cannot be used.
    """
    faults = []
    if options.faults:
        faults = parse_faults(read_yaml(options.faults), str(options.faults))
    skin = read_skin(options.config)
    load = read_load(skin, options.load, options.mujoco)
    imperfections = NONE
    if options.imperfections:
        imperfections = read_imperfections(options.imperfections)
    return simulator(
        skin,
        load,
        options.ports,
        PadErrors(options.noise, imperfections=imperfections),
        instants=options.instants,
        faults=faults,
    )


if __name__ == "__main__":
    sys.exit(main())
