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
