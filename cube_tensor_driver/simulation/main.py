"""The simulator: one process that plays all hubs of a skin on pseudo-terminals, under the load of a
script.

Each link's port appears as PORTS/<link name>; with --tcp, links that the skin file has on TCP are
played there. On SIGINT or SIGTERM it ends and writes its book: what was sampled when, so that
others can tell what should have arrived.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from ..config.load_script import read_script
from ..config.skin import read_skin
from ..config.yaml import read_yaml
from ..core.errors import CubeError
from .faults import parse_faults
from .load import Load, default_script
from .simulator import Simulator, Stop


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="simulator", description="Simulated hubs of a skin on pseudo-terminals."
    )
    parser.add_argument("--config", type=Path, required=True, help="skin file")
    parser.add_argument(
        "--ports", type=Path, required=True, help="folder in which the links' ports appear by name"
    )
    parser.add_argument(
        "--noise",
        type=float,
        default=0.0,
        help="relative standard deviation of a frequency (8e-6 is usual)",
    )
    parser.add_argument(
        "--drift", type=float, default=0.0, help="relative drift of the rest frequencies per second"
    )
    parser.add_argument(
        "--book", type=Path, help="file for the book of what was sampled (JSON), written at the end"
    )
    parser.add_argument(
        "--load",
        type=Path,
        help="load script; docs/simulation.md (default: something that wanders)",
    )
    parser.add_argument(
        "--instants", type=int, help="compute the load at so many instants only, and go round them"
    )
    parser.add_argument(
        "--faults", type=Path, help="faults to carry out: YAML, a list, see simulation/faults.py"
    )
    parser.add_argument("--seed", type=int, default=0, help="of what is random in the faults")
    parser.add_argument(
        "--tcp", action="store_true", help="play links whose port is socket://host:port there"
    )
    options = parser.parse_args(arguments)
    stop = Stop()
    try:
        faults = (
            parse_faults(read_yaml(options.faults), str(options.faults)) if options.faults else []
        )
        skin = read_skin(options.config)
        load = Load(skin, read_script(options.load) if options.load else default_script())
        simulator = Simulator(
            skin,
            load,
            options.ports,
            options.noise,
            options.drift,
            options.instants,
            faults,
            options.seed,
            options.tcp,
        )
    except CubeError as error:
        print(f"simulator: {error}", file=sys.stderr)
        return 1
    try:
        simulator.run(stop)
    finally:
        simulator.close()
    if options.book:
        unfinished = options.book.with_suffix(".part")
        unfinished.write_text(json.dumps(simulator.book()))
        unfinished.replace(options.book)
    return 0


if __name__ == "__main__":
    sys.exit(main())
