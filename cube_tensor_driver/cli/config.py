# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""./cube config grid, ./cube config check: write the skin file of a grid, check a skin file."""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from pathlib import Path

from ..config.grid import DEFAULT_PITCH
from .parser import Parser, count, positive


def add_arguments(parser: Parser) -> None:
    """Add the options of the command."""
    grid = parser.add_subcommand("grid", "write the skin file of a flat grid of cubes")
    grid.add_value("--nx", "N", "cubes along x", count, required=True)
    grid.add_value("--ny", "N", "cubes along y", count, required=True)
    grid.add_value(
        "--pitch",
        "M",
        "distance from cube to cube, m (default: %(default)s)",
        positive,
        default=DEFAULT_PITCH,
    )
    grid.add_value(
        "--links",
        "N",
        "hubs that share the cubes (default: %(default)s)",
        count,
        default=1,
    )
    grid.add_rate()
    grid.add_value(
        "--name",
        "NAME",
        "name of the skin (default: %(default)s)",
        default="skin",
    )
    grid.add_value(
        "--port",
        "PORT",
        "ports; {} is the number of the link (default: %(default)s)",
        default="/dev/ttyACM{}",
    )
    grid.add_value(
        "--layout",
        "NAME",
        "layout of the cubes (default: %(default)s)",
        default="planar",
    )
    grid.add_value(
        "--calibration",
        "FILE",
        "calibration file or name (default: that of the package for the layout)",
    )
    grid.add_output(
        "-o",
        "--output",
        kind="skin",
        required=True,
        help="skin file to write",
    )
    check = parser.add_subcommand("check", "list what is wrong with a skin file, or what it holds")
    check.add_value("file", "FILE", "skin file", Path)


def run(options: argparse.Namespace) -> int:
    """Write the skin file of a grid, or check a skin file."""
    return write_grid(options) if options.what == "grid" else check_file(options.file)


def write_grid(options: argparse.Namespace) -> int:
    """Write the skin file of a grid, and return the exit code 0.

    Raises:
        ConfigError: `./cube config check` would find a mistake in the file.
    """
    from ..config.grid import describe_grid
    from ..config.pose_check import find_pose_doubts
    from ..config.skin import check_skin_data
    from ..config.yaml import write_yaml
    from ..core.errors import ConfigError
    from ..views.terminal.output import format_count, show_working

    # Each option has the name of the argument of `describe_grid` that it sets.
    names = "name", "nx", "ny", "pitch", "links", "calibration", "layout", "rate", "port"
    skin = describe_grid(**{name: getattr(options, name) for name in names})
    checked, mistakes = check_skin_data(skin, options.output.parent)
    if checked is not None:
        mistakes = list(find_pose_doubts(checked))
    if mistakes:
        raise ConfigError(f"grid: {mistakes[0]}")
    size = f"{options.nx} x {options.ny} cubes, {1e3 * options.pitch:g} mm apart"
    # This text is printed and also becomes the header of the file.
    text = f"{size}, on {format_count(options.links, 'link')}"
    with show_working(f"writing {len(skin['cubes'])} cubes"):
        write_yaml(
            options.output,
            skin,
            f"{text}. docs/config.md describes the keys.",
        )
    print(f"wrote {options.output}: {text}")
    return 0


def check_file(path: Path) -> int:
    """Print the mistakes in a skin file, or what it contains if there are none.

    Returns:
        The exit code: 1 if there are mistakes, otherwise 0.
    """
    from ..config.pose_check import find_pose_doubts
    from ..config.skin import check_skin
    from ..device.links.line_load import find_slow_lines
    from ..views.terminal.output import format_count, show_working

    # `show_working` shows that the command is busy, as a skin of thousands of cubes takes seconds.
    with show_working(f"checking {path}"):
        skin, mistakes = check_skin(path)
        # Implausible poses, and serial lines that are too slow for the sampling rate, can only be
        # found if the file describes a valid skin.
        if skin is not None:
            mistakes = [*find_pose_doubts(skin), *find_slow_lines(skin)]
    for mistake in mistakes:
        print(f"cube: {path}: {mistake}", file=sys.stderr)
    if skin is None or mistakes:
        return 1
    # The cubes are counted by layout, because a skin may have cubes of several layouts.
    layouts = Counter(cube.calibration.layout.name for cube in skin.cubes)
    by_layout = ", ".join(f"{number} {name}" for name, number in layouts.items())
    cubes = f"{format_count(len(skin.cubes), 'cube')} ({by_layout})"
    rate = "the rate of the hubs" if skin.rate is None else f"{skin.rate:g} Hz"
    links = format_count(len(skin.links), "link")
    print(f"{path}: skin {skin.name!r}: {cubes}, {links}, {rate}: nothing wrong")
    return 0
