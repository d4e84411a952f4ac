"""The simulator as a process: it plays all hubs of a skin on pseudo-terminals, under the load of a
script.

The port of each link appears as PORTS/<link name>; with --tcp, links that the skin file has on TCP
are played there. On SIGINT or SIGTERM it ends and writes its sample log, from which others can tell
what should have arrived.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from ..config.load_script import read_script
from ..config.skin import Skin, read_skin
from ..config.yaml import read_yaml
from ..core.errors import CubeError
from .faults import parse_faults
from .imperfections import read_imperfections
from .load import AnyLoad, Load, default_script
from .simulator import Simulator, StopSignal


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
        help="relative standard deviation of a frequency, 0 for none (default: as the calibrations "
        "state)",
    )
    parser.add_argument(
        "--drift", type=float, default=0.0, help="relative drift of the rest frequencies per second"
    )
    parser.add_argument(
        "--imperfections", type=Path, help="what is wrong with the pads: YAML; docs/simulation.md"
    )
    parser.add_argument(
        "--log", type=Path, help="file for the log of what was sampled (JSON), written at the end"
    )
    loads = parser.add_mutually_exclusive_group()
    loads.add_argument(
        "--load",
        type=Path,
        help="load script; docs/simulation.md (default: an indenter that wanders over the skin)",
    )
    loads.add_argument(
        "--mujoco", type=Path, help="MuJoCo scene that plays by itself; docs/simulation.md"
    )
    parser.add_argument(
        "--instants",
        type=int,
        default=0,
        help="compute the load at so many times only, and repeat them",
    )
    parser.add_argument(
        "--faults", type=Path, help="faults to carry out: YAML, a list, see docs/reliability.md"
    )
    parser.add_argument("--seed", type=int, default=0, help="of what is random in the faults")
    parser.add_argument(
        "--tcp", action="store_true", help="play links whose port is socket://host:port there"
    )
    options = parser.parse_args(arguments)
    stop = StopSignal()
    try:
        faults = (
            parse_faults(read_yaml(options.faults), str(options.faults)) if options.faults else []
        )
        skin = read_skin(options.config)
        load = _load(skin, options)
        simulator = Simulator(
            skin,
            load,
            options.ports,
            noise=options.noise,
            drift=options.drift,
            imperfections=read_imperfections(options.imperfections)
            if options.imperfections
            else None,
            instants=options.instants,
            faults=faults,
            seed=options.seed,
            tcp=options.tcp,
        )
    except CubeError as error:
        print(f"simulator: {error}", file=sys.stderr)
        return 1
    try:
        simulator.run(stop)
    finally:
        simulator.close()
    if options.log:
        try:
            simulator.log().write(options.log)
        except CubeError as error:
            print(f"simulator: {error}", file=sys.stderr)
            return 1
    return 0


def _load(skin: Skin, options: argparse.Namespace) -> AnyLoad:
    """What acts on the skin. CubeError: it cannot be used."""
    if options.mujoco:
        from .mujoco.scene import MujocoLoad

        return MujocoLoad(options.mujoco, skin)
    return Load(skin, read_script(options.load) if options.load else default_script())


if __name__ == "__main__":
    sys.exit(main())
