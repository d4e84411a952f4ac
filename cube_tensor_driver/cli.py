"""The command line. Only here does an error become an exit code."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def demo(options: argparse.Namespace) -> int:
    from .view.demo import Options, run_demo

    duration = options.duration
    if duration is None and (options.headless or options.json):
        duration = 10.0
    return run_demo(Options(options.config, options.cubes, options.rate, duration, options.headless, options.json))


def config_grid(options: argparse.Namespace) -> int:
    from .files.grid import grid
    from .files.yaml import write_yaml

    skin = grid(options.name, options.nx, options.ny, options.pitch, options.links, options.calibration,
                options.layout, options.rate, options.port)  # fmt: skip
    text = f"{options.nx} x {options.ny} cubes, {1e3 * options.pitch:g} mm apart, on {options.links} links"
    write_yaml(options.output, skin, f"{text}. docs/config.md describes the keys.")
    print(f"wrote {options.output}: {text}")
    return 0


def config_check(options: argparse.Namespace) -> int:
    from collections import Counter

    from .files.skin import read_skin

    skin = read_skin(options.file)
    layouts = Counter(cube.calibration.layout.name for cube in skin.cubes)
    kinds = ", ".join(f"{count} {name}" for name, count in layouts.items())
    rate = "as the hubs have it" if skin.rate is None else f"{skin.rate:g} Hz"
    print(f"{options.file}: skin {skin.name}, {kinds} on {len(skin.links)} links, {rate}: nothing wrong")
    return 0


def urdf(options: argparse.Namespace) -> int:
    from .files.skin import read_skin
    from .files.urdf import skin_urdf

    print(skin_urdf(read_skin(options.file)), end="")
    return 0


def layout(options: argparse.Namespace) -> int:
    from .view.layout import run_layout

    figure = options.figure or Path(f"{Path(options.name).stem}.png")
    return run_layout(options.name, options.symmetry, options.calibration, options.json, figure)


def fit(options: argparse.Namespace) -> int:
    from .view.fit import Options, run_fit

    figure = options.figure or options.output.with_suffix(".png")
    return run_fit(
        Options(
            options.loads,
            options.layout,
            options.symmetry,
            options.output,
            options.base,
            options.area,
            options.uid,
            figure,
            options.json,
        )
    )


def bench(options: argparse.Namespace) -> int:
    from .view import bench

    if options.what == "pipeline":
        return bench.bench_pipeline(options.cubes, options.json)
    if options.what == "echo":
        return bench.bench_echo(options.cubes, options.rate, options.duration, options.json)
    if options.what == "skin":
        return bench.bench_skin(options.cubes, options.rate, options.duration, options.composed, options.json)
    return bench.bench_scale(options.counts, options.rate, options.duration, options.json, options.figure)


def record(options: argparse.Namespace) -> int:
    from .view.record import Options, run_record

    return run_record(Options(options.output, options.topics, options.duration, options.storage,
                              round((options.split_size or 0) * 1e6), options.split_time or 0.0))  # fmt: skip


def reprocess(options: argparse.Namespace) -> int:
    from .view.reprocess import Options, run_reprocess

    tare = tuple(options.tare_from) if options.tare_from else None
    return run_reprocess(Options(options.bags, options.output, options.format, options.calibration, options.skin,
                                 tare, options.jobs, options.scheduler))  # fmt: skip


def bag_repair(options: argparse.Namespace) -> int:
    from .view.bag import run_repair

    return run_repair(options.bag)


def test(options: argparse.Namespace) -> int:
    os.chdir(ROOT)
    os.execv(sys.executable, [sys.executable, "-m", "pytest", *(options.arguments or ["test"])])


def lint(options: argparse.Namespace) -> int:
    commands = (["ruff", "check", "."], ["ruff", "format", "--check", "."], ["mypy"])
    return max(
        subprocess.run([sys.executable, "-m", *command], cwd=ROOT, check=False).returncode for command in commands
    )


def positive(text: str) -> float:
    value = float(text)
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text} is not greater than 0")
    return value


def parser() -> argparse.ArgumentParser:
    top = argparse.ArgumentParser(prog="./cube", description="Driver for cubic stress tensor sensors on ROS 2.")
    commands = top.add_subparsers(dest="command", metavar="COMMAND", required=True)

    def command(name: str, run: Callable[[argparse.Namespace], int] | None, text: str) -> argparse.ArgumentParser:
        added = commands.add_parser(name, help=text, description=text)
        added.set_defaults(run=run)
        return added

    sub = command("demo", demo, "run simulated cubes, driver and reconstruction, with a live table")
    sub.add_argument(
        "--config", type=Path, metavar="FILE", help="skin file to simulate (default: sixteen planar cubes)"
    )
    sub.add_argument("--cubes", type=int, metavar="N", help="simulate a grid of N planar cubes instead")
    sub.add_argument("--rate", type=positive, metavar="HZ", help="samples per second (default: the skin file's, 100)")
    sub.add_argument(
        "--duration",
        type=positive,
        metavar="S",
        help="end after S seconds and print the figures (default: until Ctrl-C; 10 with --headless or --json)",
    )
    sub.add_argument("--headless", action="store_true", help="no live table")
    sub.add_argument("--json", type=Path, metavar="FILE", help="write the figures to FILE instead of printing them")

    configs = command("config", None, "make or check skin files").add_subparsers(metavar="WHAT", required=True)
    sub = configs.add_parser("grid", help="write the skin file of a flat grid of cubes")
    sub.set_defaults(run=config_grid)
    sub.add_argument("--nx", type=int, required=True, metavar="N", help="cubes along x")
    sub.add_argument("--ny", type=int, required=True, metavar="N", help="cubes along y")
    sub.add_argument("--pitch", type=positive, default=0.012, metavar="M", help="distance of neighbours (0.012 m)")
    sub.add_argument("--links", type=int, default=1, metavar="N", help="hubs that share the cubes (1)")
    sub.add_argument("--rate", type=positive, default=100.0, metavar="HZ", help="samples per second (100)")
    sub.add_argument("--name", default="skin", help="name of the skin (skin)")
    sub.add_argument("--port", default="/dev/ttyACM{}", help="ports, {} is the link's number (/dev/ttyACM{})")
    sub.add_argument("--layout", default="planar", metavar="NAME", help="layout of the cubes (planar)")
    sub.add_argument("--calibration", default="planar", metavar="FILE", help="calibration file or name (planar)")
    sub.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="skin file to write")
    sub = configs.add_parser("check", help="say what is wrong with a skin file, or what it holds")
    sub.set_defaults(run=config_check)
    sub.add_argument("file", type=Path, metavar="FILE")

    sub = command("urdf", urdf, "print a URDF of a skin: one link per cube under its parent frame")
    sub.add_argument("file", type=Path, metavar="FILE")

    sub = command("layout", layout, "what a layout's pads can tell: ranks, unobservable modes, noise; a picture")
    sub.add_argument("name", metavar="NAME", help="quad, planar, cube, or a YAML file with a layout")
    sub.add_argument("--symmetry", metavar="G", help="full, slab, mirrors or none (default: the calibration's)")
    sub.add_argument("--calibration", metavar="FILE", help="calibration file or name (default: illustrative)")
    sub.add_argument("--json", type=Path, metavar="FILE", help="write the figures to FILE as well")
    sub.add_argument("--figure", type=Path, metavar="FILE", help="picture of the cube (default: NAME.png)")

    sub = command("fit", fit, "calibrate from a table of known loads and measured frequencies")
    sub.add_argument("loads", type=Path, metavar="LOADS.csv", help="columns: pads (Hz), modes (Pa) or fx fy fz (N)")
    sub.add_argument("--layout", required=True, metavar="NAME", help="quad, planar, cube, or a YAML file")
    sub.add_argument("--symmetry", default="full", metavar="G", help="full, slab, mirrors or none (default: full)")
    sub.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="calibration file to write")
    sub.add_argument("--base", metavar="FILE", help="calibration with beta, modulus, half side (default: illustrative)")
    sub.add_argument("--area", type=positive, metavar="M2", help="area that the forces fx fy fz act on, m²")
    sub.add_argument("--uid", type=lambda text: int(text, 0), metavar="UID", help="uid of the cube this holds for")
    sub.add_argument("--figure", type=Path, metavar="FILE", help="measured against fitted (default: beside -o, .png)")
    sub.add_argument("--json", type=Path, metavar="FILE", help="write the figures to FILE as well")

    benches = command("bench", bench, "measure speed against bare floors").add_subparsers(
        dest="what", metavar="WHAT", required=True
    )
    for name, text in (
        ("pipeline", "the core against the same law and matrix product in bare numpy"),
        ("echo", "bare rclpy: publish, echo, receive messages of a skin's sizes"),
        ("skin", "simulated hubs to received tensors, beside the echo"),
        ("scale", "skin for growing numbers of cubes, with a picture"),
    ):
        sub = benches.add_parser(name, help=text)
        sub.add_argument("--json", type=Path, metavar="FILE", help="write the figures to FILE as well")
        if name == "scale":
            sub.add_argument("--counts", type=int, nargs="+", default=[1, 4, 16, 64, 256, 1024, 4096], metavar="N")
            sub.add_argument("--figure", type=Path, default=Path("scale.png"), metavar="FILE", help="(scale.png)")
        else:
            sub.add_argument("--cubes", type=int, default=1260 if name == "pipeline" else 64, metavar="N")
        if name != "pipeline":
            sub.add_argument("--rate", type=positive, default=1000.0, metavar="HZ", help="scans per second (1000)")
            sub.add_argument("--duration", type=positive, default=10.0, metavar="S", help="seconds to measure (10)")
        if name == "skin":
            sub.add_argument("--composed", action="store_true", help="driver and reconstruction in one process")

    sub = command("record", record, "record the topics of a running skin into a bag that ros2 bag reads too")
    sub.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="folder of the bag, a new one")
    sub.add_argument("--topics", nargs="+", default=[], metavar="T", help="frequencies stress info /diagnostics if none")
    sub.add_argument("--duration", type=positive, metavar="S", help="end after S seconds (default: Ctrl-C)")
    sub.add_argument("--storage", choices=["mcap", "sqlite3"], default="mcap", help="(default: mcap)")
    sub.add_argument("--split-size", type=positive, metavar="MB", help="begin a new file after so many megabytes")
    sub.add_argument("--split-time", type=positive, metavar="S", help="begin a new file after so many seconds")

    sub = command("reprocess", reprocess, "make stress of recorded frequencies again, as live but with what is known now")
    sub.add_argument("bags", type=Path, nargs="+", metavar="BAG")
    sub.add_argument("-o", "--output", type=Path, required=True, metavar="OUT", help="folder for the results")
    sub.add_argument("--calibration", metavar="FILE", help="of all cubes (default: as recorded)")
    sub.add_argument("--skin", type=Path, metavar="FILE", help="skin file whose calibrations to use, cubes by name")
    sub.add_argument("--tare-from", type=float, nargs=2, metavar=("T0", "T1"), help="no load then, s after the start")
    sub.add_argument("--format", choices=["bag", "parquet", "csv"], default="bag", help="(default: bag)")
    sub.add_argument("--jobs", type=int, metavar="N", help="processes (default: one per core)")
    sub.add_argument("--scheduler", metavar="ADDRESS", help="of a Dask cluster to run on, tcp://host:8786")

    bags = command("bag", None, "look into a bag, or repair one").add_subparsers(metavar="WHAT", required=True)
    sub = bags.add_parser("repair", help="make a bag readable that was cut off: killed, disk full, power lost")
    sub.set_defaults(run=bag_repair)
    sub.add_argument("bag", type=Path, metavar="BAG")

    sub = command("test", test, "build and run the test suite; arguments go to pytest")
    sub.add_argument("arguments", nargs=argparse.REMAINDER)
    command("lint", lint, "check style and types (ruff, mypy)")
    # Run by tools/environment.py, before Python modules of the environment are needed; here for --help.
    command("exec", None, "run any command inside the built environment: ./cube exec python -c '…'")
    return top


def main(arguments: list[str] | None = None) -> int:
    options = parser().parse_args(arguments)
    # Not before the arguments are read: --help works without the environment.
    from .core.errors import CubeError

    try:
        return int(options.run(options))
    except CubeError as error:
        print(f"cube: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130


if __name__ == "__main__":
    sys.exit(main())
