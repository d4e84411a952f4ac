"""./cube export: bags into the formats of learning and analysis; without ROS."""

from __future__ import annotations

import argparse
from pathlib import Path

from . import reprocess
from .parser import Parser, count

TABLES = {
    "parquet": "one Parquet table per bag",
    "csv": "one CSV table per bag",
    "zarr": "one Zarr group per bag",
}


def arguments(parser: Parser) -> None:
    lerobot = parser.add_subcommand("lerobot", "one LeRobot data set (v3.0) of all bags")
    _add_common(lerobot)
    lerobot.add_argument(
        "--fps", type=count, required=True, metavar="N", help="frames per second of the data set"
    )
    lerobot.add_argument(
        "--task", default="touch", metavar="TEXT", help="what was done (default: %(default)s)"
    )
    lerobot.add_argument(
        "--marks",
        metavar="TOPIC",
        help="topic of texts (std_msgs/String): each begins an episode with this task, an empty "
        "one only ends it (default: each bag is one episode)",
    )
    lerobot.add_argument(
        "--topics",
        nargs="*",
        metavar="T",
        help="other topics to add: images and numbers with a stamp (default: all)",
    )
    lerobot.add_argument(
        "--state",
        metavar="TOPIC",
        help="topic of observation.state (default: the only topic of joint states)",
    )
    lerobot.add_argument("--action", metavar="TOPIC", help="topic of action (default: none)")
    lerobot.add_argument(
        "--frequencies", metavar="TOPIC", help="frequencies to export, of several skins in a bag"
    )
    for name, text in TABLES.items():
        table = parser.add_subcommand(name, text)
        _add_common(table)
        table.set_defaults(format=name, contacts=None, scheduler=None)
        table.add_argument(
            "--jobs", type=count, metavar="N", help="number of processes (default: one per core)"
        )


def _add_common(parser: Parser) -> None:
    parser.add_argument(
        "bags", type=Path, nargs="+", metavar="BAG", help="folders or files of bags"
    )
    parser.add_output(
        "-o", "--output", kind="folder", required=True, help="folder, empty or not there yet"
    )
    reprocess.add_overrides(parser)


def run(options: argparse.Namespace) -> int:
    """1 if a table could not be made. CubeError: nothing was begun."""
    from ..bags.reprocess.all_bags import RECIPE
    from ..lerobot.choices import Choices
    from ..lerobot.export import check_empty, export_lerobot
    from ..views.terminal.exporting import say_exported
    from ..views.terminal.output import progress_bar

    if options.what in TABLES:
        if not (options.output / RECIPE).exists():  # an export that was interrupted goes on
            check_empty(options.output)
        return reprocess.run(options)
    choices = Choices(
        options.fps,
        options.task,
        options.marks,
        options.frequencies,
        options.topics,
        options.state,
        options.action,
        reprocess.overrides_of(options),
    )
    with progress_bar() as report:
        exported = export_lerobot(options.bags, options.output, choices, report)
    say_exported(options.output, exported)
    return 0
