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
