"""./cube bag info, ./cube bag repair: what a bag holds, and bags made readable again."""

from __future__ import annotations

import argparse
from pathlib import Path

from .parser import Parser


def arguments(parser: Parser) -> None:
    info = parser.add_subcommand(
        "info", "print skin, cubes, calibrations, rates, gaps and counters"
    )
    info.add_argument("bag", type=Path, metavar="BAG", help="folder or file of the bag")
    repair = parser.add_subcommand(
        "repair", "make a bag readable that was cut off: killed, disk full, power lost"
    )
    repair.add_argument("bag", type=Path, metavar="BAG", help="folder or file of the bag")


def run(options: argparse.Namespace) -> int:
    if options.what == "info":
        from ..views.terminal.bag import show_bag

        show_bag(options.bag)
        return 0
    return repair_bag(options.bag)


def repair_bag(bag: Path) -> int:
    """Make a bag readable and print what was lost."""
    from ..bags.repair import REST, repair
    from ..views.terminal.output import warn

    done = repair(bag)
    print(f"{bag}: {done.messages} messages can be read")
    if done.cut:
        print(f"moved {done.cut} bytes behind the last complete chunk to files ending in {REST}")
    if done.damaged:
        warn(f"left out {done.damaged} damaged chunks")
    return 0
