# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""./cube export: write bags in the formats of machine learning and data analysis, without ROS."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from . import reprocess
from .parser import Parser, count

if TYPE_CHECKING:
    from ..lerobot.export import Exported

TABLES = {
    "parquet": "one Parquet table per bag",
    "csv": "one CSV table per bag",
    "zarr": "one Zarr group per bag",
}
"""Name of a table format, which is also a subcommand -> help text of the subcommand."""


def add_arguments(parser: Parser) -> None:
    """Add the options of the command."""
    lerobot = parser.add_subcommand("lerobot", "one LeRobot data set (v3.0) of all bags")
    _add_common(lerobot)
    lerobot.add_value(
        "--fps",
        "N",
        "frames per second of the data set",
        count,
        required=True,
    )
    lerobot.add_value(
        "--task",
        "TEXT",
        "what was done (default: %(default)s)",
        default="touch",
    )
    lerobot.add_value(
        "--marks",
        "TOPIC",
        "topic of texts (std_msgs/String): each begins an episode with this task, an empty "
        "one only ends it (default: each bag is one episode)",
    )
    lerobot.add_value(
        "--topics",
        "T",
        "other topics to add: images and numbers with a stamp (default: all)",
        nargs="*",
    )
    lerobot.add_value(
        "--state",
        "TOPIC",
        "topic of observation.state (default: the only topic of joint states)",
    )
    lerobot.add_value("--action", "TOPIC", "topic of action (default: none)")
    lerobot.add_value(
        "--frequencies",
        "TOPIC",
        "frequencies to export, of several skins in a bag",
    )
    for name, text in TABLES.items():
        table = parser.add_subcommand(name, text)
        _add_common(table)
        # The command `reprocess` makes the tables. Those of its options that these subcommands lack
        # are set here.
        table.set_defaults(format=name, contacts=None)
        table.add_jobs()


def _add_common(parser: Parser) -> None:
    parser.add_bags()
    parser.add_output(
        "-o",
        "--output",
        kind="folder",
        required=True,
        help="folder, empty or not there yet",
    )
    reprocess.add_overrides(parser)


def run(options: argparse.Namespace) -> int:
    """Export the bags.

    Returns:
        1 if the table of a bag could not be made, otherwise 0.

    Raises:
        CubeError: A bag, an option or the output folder cannot be used.
    """
    from ..bags.reprocess.all_bags import RECIPE_NAME
    from ..lerobot.export import check_empty, export_lerobot
    from ..lerobot.plan import Choices
    from ..views.terminal.output import show_progress_bar

    if options.what in TABLES:
        # A folder that contains the file RECIPE_NAME belongs to an export that was interrupted and
        # is continued; any other folder must be empty.
        if not (options.output / RECIPE_NAME).exists():
            check_empty(options.output)
        return reprocess.run(options)

    # All bags become one data set with the same choices. Each field of `Choices` has the value of
    # the option with the same name.
    options.overrides = reprocess.read_overrides(options)
    choices = Choices(*(getattr(options, name) for name in Choices._fields))
    with show_progress_bar() as report:
        exported = export_lerobot(
            options.bags,
            options.output,
            choices,
            report,
        )
    show_exported(options.output, exported)
    return 0


def show_exported(folder: Path, exported: Exported) -> None:
    """Print what a LeRobot data set contains, and how much data was left out of it and why.

    Args:
        folder: Folder of the data set.
        exported: Counts of what was exported and left out.
    """
    from ..views.terminal.output import say

    others = ", ".join(exported.features) or "no other topics"
    say(
        f"{folder}: {exported.episodes} episodes, {exported.frames} frames, {exported.rows} "
        f"samples, {exported.depth} in a window; {others}"
    )
    if exported.left_out:
        say(f"left out: {exported.left_out} samples outside of the marks", "yellow")
