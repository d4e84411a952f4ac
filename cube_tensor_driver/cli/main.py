"""The command line. Only here does an error become an exit code."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from . import commands as run


def positive(text: str) -> float:
    value = float(text)
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text} is not greater than 0")
    return value


def not_negative(text: str) -> float:
    value = float(text)
    if not 0 <= value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text} is less than 0")
    return value


def parser() -> argparse.ArgumentParser:
    top = argparse.ArgumentParser(
        prog="./cube",
        description="Driver for cubic stress tensor sensors on ROS 2.",
        formatter_class=lambda prog: argparse.HelpFormatter(prog, max_help_position=16, width=110),
    )
    commands = top.add_subparsers(dest="command", metavar="COMMAND", required=True)

    def command(
        name: str, function: Callable[[argparse.Namespace], int] | None, text: str
    ) -> argparse.ArgumentParser:
        added = commands.add_parser(name, help=text, description=text)
        added.set_defaults(run=function)
        return added

    sub = command(
        "demo", run.demo, "run simulated cubes, driver and reconstruction, with a live table"
    )
    sub.add_argument(
        "--config",
        type=Path,
        metavar="FILE",
        help="skin file to simulate (default: sixteen planar cubes)",
    )
    sub.add_argument(
        "--cubes", type=int, metavar="N", help="simulate a grid of N planar cubes instead"
    )
    sub.add_argument(
        "--load",
        type=Path,
        metavar="FILE",
        help="load script (default: something wanders over the skin)",
    )
    sub.add_argument(
        "--rate",
        type=positive,
        metavar="HZ",
        help="samples per second (default: the skin file's, 100)",
    )
    sub.add_argument(
        "--duration",
        type=positive,
        metavar="S",
        help="end after S seconds and print the figures (default: until Ctrl-C; 10 with --headless, --json, --figure)",
    )
    sub.add_argument("--headless", action="store_true", help="no live table")
    sub.add_argument(
        "--figure",
        type=Path,
        metavar="FILE",
        help="draw force and centre of pressure beside the script's",
    )
    sub.add_argument(
        "--view", action="store_true", help="show it in the browser too, as ./cube view does"
    )
    sub.add_argument(
        "--json",
        type=Path,
        metavar="FILE",
        help="write the figures to FILE instead of printing them",
    )

    configs = command("config", None, "make or check skin files").add_subparsers(
        metavar="WHAT", required=True
    )
    sub = configs.add_parser("grid", help="write the skin file of a flat grid of cubes")
    sub.set_defaults(run=run.config_grid)
    sub.add_argument("--nx", type=int, required=True, metavar="N", help="cubes along x")
    sub.add_argument("--ny", type=int, required=True, metavar="N", help="cubes along y")
    sub.add_argument(
        "--pitch",
        type=positive,
        default=0.012,
        metavar="M",
        help="distance of neighbours (0.012 m)",
    )
    sub.add_argument(
        "--links", type=int, default=1, metavar="N", help="hubs that share the cubes (1)"
    )
    sub.add_argument(
        "--rate", type=positive, default=100.0, metavar="HZ", help="samples per second (100)"
    )
    sub.add_argument("--name", default="skin", help="name of the skin (skin)")
    sub.add_argument(
        "--port", default="/dev/ttyACM{}", help="ports, {} is the link's number (/dev/ttyACM{})"
    )
    sub.add_argument(
        "--layout", default="planar", metavar="NAME", help="layout of the cubes (planar)"
    )
    sub.add_argument(
        "--calibration", default="planar", metavar="FILE", help="calibration file or name (planar)"
    )
    sub.add_argument(
        "-o", "--output", type=Path, required=True, metavar="FILE", help="skin file to write"
    )
    sub = configs.add_parser("check", help="say what is wrong with a skin file, or what it holds")
    sub.set_defaults(run=run.config_check)
    sub.add_argument("file", type=Path, metavar="FILE")

    sub = command(
        "torture",
        run.torture,
        "32 simulated cubes at 500 Hz under a random mix of all faults, judged",
    )
    sub.add_argument(
        "--duration", type=positive, default=60.0, metavar="S", help="of the faults, s (60)"
    )
    sub.add_argument("--seed", type=int, default=0, metavar="N", help="of the mix (0)")
    sub.add_argument("--json", type=Path, metavar="FILE", help="write the figures to FILE as well")

    sub = command(
        "inject",
        run.inject,
        "inject a fault into running simulated hubs: kind=unplug link=hub0 seconds=2",
    )
    sub.add_argument(
        "fault",
        nargs="+",
        metavar="KEY=VALUE",
        help="kind=… and what it needs; docs/reliability.md",
    )
    sub.add_argument(
        "--ports", type=Path, metavar="FOLDER", help="of the simulated ports (the newest demo's)"
    )

    sub = command(
        "urdf", run.urdf, "print a URDF of a skin: one link per cube under its parent frame"
    )
    sub.add_argument("file", type=Path, metavar="FILE")

    sub = command(
        "layout",
        run.layout,
        "what a layout's pads can tell: ranks, unobservable modes, noise; a picture",
    )
    sub.add_argument(
        "name", metavar="NAME", help="quad, planar, cube, or a YAML file with a layout"
    )
    sub.add_argument(
        "--symmetry", metavar="G", help="full, slab, mirrors or none (default: the calibration's)"
    )
    sub.add_argument(
        "--calibration", metavar="FILE", help="calibration file or name (default: the computed one)"
    )
    sub.add_argument("--json", type=Path, metavar="FILE", help="write the figures to FILE as well")
    sub.add_argument(
        "--figure", type=Path, metavar="FILE", help="picture of the cube (default: NAME.png)"
    )

    sub = command("fit", run.fit, "calibrate from a table of known loads and measured frequencies")
    sub.add_argument(
        "loads",
        type=Path,
        metavar="LOADS",
        help="CSV: pads (Hz), modes (Pa) or fx fy fz (N); or a bag",
    )
    sub.add_argument(
        "--reference",
        metavar="TOPIC",
        help="of a bag: WrenchStamped (with --area) or stress to fit to",
    )
    sub.add_argument("--cube", metavar="NAME", help="of a bag: which cube, if there are several")
    sub.add_argument(
        "--layout", required=True, metavar="NAME", help="quad, planar, cube, or a YAML file"
    )
    sub.add_argument(
        "--symmetry",
        default="full",
        metavar="G",
        help="full, slab, mirrors or none (default: full)",
    )
    sub.add_argument(
        "-o", "--output", type=Path, required=True, metavar="FILE", help="calibration file to write"
    )
    sub.add_argument(
        "--base",
        metavar="FILE",
        help="calibration with beta, modulus, half side (default: shipped)",
    )
    sub.add_argument(
        "--area", type=positive, metavar="M2", help="area that the forces fx fy fz act on, m²"
    )
    sub.add_argument(
        "--uid",
        type=lambda text: int(text, 0),
        metavar="UID",
        help="uid of the cube this holds for",
    )
    sub.add_argument(
        "--figure",
        type=Path,
        metavar="FILE",
        help="measured against fitted (default: beside -o, .png)",
    )
    sub.add_argument("--json", type=Path, metavar="FILE", help="write the figures to FILE as well")

    sub = command(
        "fem", run.fem, "compute a cube's response matrix by finite elements; lengths in mm"
    )
    sub.argument_default = argparse.SUPPRESS  # what is not given is left to view.fem.Options
    sub.add_argument(
        "--3d", dest="space", action="store_true", help="in space: 24 pads; minutes, and up to 6 GB"
    )
    sub.add_argument(
        "--layout",
        metavar="NAME",
        help="quad, planar, cube, or a YAML file (planar; cube with --3d)",
    )
    sub.add_argument(
        "--symmetry",
        metavar="G",
        help="full, slab, mirrors or none (the first that the layout has)",
    )
    sub.add_argument(
        "--plane", choices=["strain", "stress"], help="of a layout in a plane (strain)"
    )
    sub.add_argument(
        "--width", type=positive, metavar="MM", help="of the body along x, and y in space (60)"
    )
    sub.add_argument("--height", type=positive, metavar="MM", help="of the body along z (11)")
    sub.add_argument("--side", type=positive, metavar="MM", help="of the cube (4)")
    sub.add_argument(
        "--young", type=positive, metavar="PA", help="Young's modulus of the body, Pa (0.3e6)"
    )
    sub.add_argument(
        "--poisson", type=float, metavar="NU", help="Poisson's ratio of the body (0.48)"
    )
    sub.add_argument(
        "--rigid", action="store_true", help="a rigid cube (default: steel, 200 GPa, 0.30)"
    )
    sub.add_argument(
        "--pad",
        metavar="half|MM",
        help="pads: the halves of each face, or so wide (the layout's own)",
    )
    sub.add_argument(
        "--pad-centre",
        type=positive,
        metavar="MM",
        help="from the middle of the face (1 with --pad MM)",
    )
    sub.add_argument(
        "--neglect", nargs="+", metavar="MODE", help="modes that the calibration states to be zero"
    )
    sub.add_argument(
        "--meshes", type=int, choices=[1, 2, 3], help="fewer need less memory and say less (3)"
    )
    sub.add_argument("--json", type=Path, metavar="FILE", help="write the figures to FILE as well")
    sub.add_argument(
        "--figures",
        type=Path,
        metavar="DIR",
        help="pictures: convergence, response, stress of each load",
    )
    sub.add_argument("-o", "--output", type=Path, metavar="FILE", help="calibration file to write")

    sub = command(
        "study",
        run.study,
        "how wide a contact must be for each layout to be right, by indenter sweeps",
    )
    sub.add_argument("--json", type=Path, metavar="FILE", help="write the figures to FILE as well")
    sub.add_argument(
        "--figure", type=Path, default=Path("study.png"), metavar="FILE", help="(study.png)"
    )

    sub = command(
        "paper",
        run.paper,
        "the source paper's simulation and experiments on a virtual bench, as pictures",
    )
    sub.add_argument(
        "--out", type=Path, default=Path("paper"), metavar="DIR", help="folder to write to (paper)"
    )

    benches = command("bench", run.bench, "measure speed against bare floors").add_subparsers(
        dest="what", metavar="WHAT", required=True
    )
    for name, text in (
        ("pipeline", "the core against the same law and matrix product in bare numpy"),
        ("decode", "the decoder on all kinds of noise, beside clean frames"),
        ("echo", "bare rclpy: publish, echo, receive messages of a skin's sizes"),
        ("skin", "simulated hubs to received tensors, beside the echo"),
        ("scale", "skin for growing numbers of cubes, with a picture"),
    ):
        sub = benches.add_parser(name, help=text)
        sub.add_argument(
            "--json", type=Path, metavar="FILE", help="write the figures to FILE as well"
        )
        if name == "scale":
            sub.add_argument(
                "--counts",
                type=int,
                nargs="+",
                default=[1, 4, 16, 64, 256, 1024, 4096],
                metavar="N",
            )
            sub.add_argument(
                "--figure", type=Path, default=Path("scale.png"), metavar="FILE", help="(scale.png)"
            )
        elif name != "decode":
            sub.add_argument(
                "--cubes", type=int, default=1260 if name == "pipeline" else 64, metavar="N"
            )
        if name not in ("pipeline", "decode"):
            sub.add_argument(
                "--rate",
                type=positive,
                default=1000.0,
                metavar="HZ",
                help="scans per second (1000)",
            )
            sub.add_argument(
                "--duration",
                type=positive,
                default=10.0,
                metavar="S",
                help="seconds to measure (10)",
            )
        if name == "skin":
            sub.add_argument(
                "--composed", action="store_true", help="driver and reconstruction in one process"
            )
            sub.add_argument(
                "--publish-period",
                type=not_negative,
                default=0.0,
                metavar="S",
                help="time that one message covers (0: a message for each scan)",
            )

    sub = command(
        "record",
        run.record,
        "record the topics of a running skin into a bag that ros2 bag reads too",
    )
    sub.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="DIR",
        help="folder of the bag, a new one",
    )
    sub.add_argument(
        "--topics", nargs="+", default=[], metavar="T", help="frequencies stress info /diagnostics"
    )
    sub.add_argument(
        "--duration", type=positive, metavar="S", help="end after S seconds (default: Ctrl-C)"
    )
    sub.add_argument(
        "--storage", choices=["mcap", "sqlite3"], default="mcap", help="(default: mcap)"
    )
    sub.add_argument(
        "--split-size", type=positive, metavar="MB", help="begin a new file after so many megabytes"
    )
    sub.add_argument(
        "--split-time", type=positive, metavar="S", help="begin a new file after so many seconds"
    )

    sub = command(
        "replay", run.replay, "publish a bag: all but the stress, which a reconstruction makes anew"
    )
    sub.add_argument("bag", type=Path, metavar="BAG")
    sub.add_argument(
        "--rate", type=positive, default=1.0, metavar="R", help="times the recorded speed (1)"
    )
    sub.add_argument("--loop", action="store_true", help="begin anew at the end")
    sub.add_argument(
        "--start", type=not_negative, default=0.0, metavar="S", help="begin S seconds into the bag"
    )
    sub.add_argument(
        "--clock", action="store_true", help="publish /clock for nodes with use_sim_time"
    )
    sub.add_argument("--stress", action="store_true", help="publish the recorded stress too")
    sub.add_argument(
        "--view",
        action="store_true",
        help="show the recorded stress in the browser, with a time slider",
    )

    sub = command(
        "reprocess",
        run.reprocess,
        "make stress of recorded frequencies again, with what is known now",
    )
    sub.add_argument("bags", type=Path, nargs="+", metavar="BAG")
    sub.add_argument(
        "-o", "--output", type=Path, required=True, metavar="OUT", help="folder for the results"
    )
    sub.add_argument("--calibration", metavar="FILE", help="of all cubes (default: as recorded)")
    sub.add_argument(
        "--skin",
        type=Path,
        metavar="FILE",
        help="skin file whose calibrations to use, cubes by name",
    )
    sub.add_argument(
        "--tare-from",
        type=float,
        nargs=2,
        metavar=("T0", "T1"),
        help="no load then, s after the start",
    )
    sub.add_argument(
        "--format", choices=["bag", "parquet", "csv"], default="bag", help="(default: bag)"
    )
    sub.add_argument("--jobs", type=int, metavar="N", help="processes (default: one per core)")
    sub.add_argument(
        "--scheduler", metavar="ADDRESS", help="of a Dask cluster to run on, tcp://host:8786"
    )

    sub = command(
        "plot", run.plot, "draw frequencies, stress, gradient and residual of one cube of a bag"
    )
    sub.add_argument("bag", type=Path, metavar="BAG")
    sub.add_argument("--cube", metavar="NAME", help="(default: the first)")
    sub.add_argument(
        "--from", dest="start", type=float, metavar="S", help="seconds after the start of the bag"
    )
    sub.add_argument("--to", type=float, metavar="S", help="seconds after the start of the bag")
    sub.add_argument(
        "-o", "--output", type=Path, required=True, metavar="FILE.png", help="picture to write"
    )

    bags = command("bag", None, "look into a bag, or repair one").add_subparsers(
        metavar="WHAT", required=True
    )
    sub = bags.add_parser("info", help="print skin, cubes, calibrations, rates, gaps and counters")
    sub.set_defaults(run=run.bag_info)
    sub.add_argument("bag", type=Path, metavar="BAG")
    sub = bags.add_parser(
        "repair", help="make a bag readable that was cut off: killed, disk full, power lost"
    )
    sub.set_defaults(run=run.bag_repair)
    sub.add_argument("bag", type=Path, metavar="BAG")

    sub = command(
        "view", run.view, "show a running skin in the browser: 3-D, plots, tare, recording"
    )
    sub.add_argument(
        "--port", type=int, default=8080, metavar="N", help="of the page (8080, or the next free)"
    )
    sub.add_argument(
        "--depth",
        type=positive,
        default=0.004,
        metavar="M",
        help="cubes below the surface (0.004 m)",
    )

    sub = command("pictures", run.pictures, "make the pictures of the documentation anew")
    sub.add_argument(
        "-o", "--output", type=Path, default=run.ROOT / "docs" / "pictures", metavar="DIR"
    )
    sub = command("docs", run.docs, "build the documentation as HTML; a warning is an error")
    sub.add_argument(
        "-o", "--output", type=Path, default=Path(".cube/docs"), metavar="DIR", help="(.cube/docs)"
    )

    sub = command("test", run.test, "build and run the test suite; arguments go to pytest")
    sub.add_argument("arguments", nargs=argparse.REMAINDER)
    sub.prefix_chars = ""  # options are pytest's
    command("lint", run.lint, "check style and types (ruff, mypy)")
    # Run by tools/environment.py, before Python modules of the environment are needed; here for
    # --help.
    command("exec", None, "run any command inside the built environment: ./cube exec python -c '…'")
    return top


def main(arguments: list[str] | None = None) -> int:
    options = parser().parse_args(arguments)
    # Not before the arguments are read: --help works without the environment.
    from ..config.atomic_write import check_outputs
    from ..core.errors import CubeError

    figure = getattr(options, "figure", None)
    try:
        check_outputs({"--json": getattr(options, "json", None), "--figure": figure})
        if figure is not None:
            from ..plot.style import check_picture

            check_picture(figure)
        return int(options.run(options))
    except CubeError as error:
        print(f"cube: {error}", file=sys.stderr)
        return 1
    except ModuleNotFoundError as error:
        # Not every command needs every library; those without a rosdep key are installed by hand.
        print(
            f"cube: this command needs the Python module {error.name}: install it with pip",
            file=sys.stderr,
        )
        return 1
    except KeyboardInterrupt:
        return 130


def interrupt_again(lost: Any) -> None:
    """sys.unraisablehook: Ctrl-C that falls into a destructor or the end of an import would be
    lost; it comes again."""
    if lost.exc_type is KeyboardInterrupt:
        # At once it would be lost in here.
        threading.Timer(0.01, os.kill, (os.getpid(), signal.SIGINT)).start()
    else:
        sys.__unraisablehook__(lost)
