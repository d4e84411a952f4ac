"""./cube replay: a bag onto its topics, with keys to pause, step and quit, and the browser view."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from .parser import Parser, not_negative, positive

if TYPE_CHECKING:
    from ..bags.read import Bag
    from ..processes.children import Children
    from ..ros.commands.player import Player

START_S = 30.0
"""How long the browser view may take to start."""


def arguments(parser: Parser) -> None:
    parser.add_argument("bag", type=Path, metavar="BAG", help="folder or file of the bag")
    parser.add_argument(
        "--rate",
        type=positive,
        default=1.0,
        metavar="R",
        help="times the recorded speed (default: %(default)g)",
    )
    parser.add_argument("--loop", action="store_true", help="begin again at the end")
    parser.add_argument(
        "--start",
        type=not_negative,
        default=0.0,
        metavar="S",
        help="begin S seconds after the start of the bag (default: %(default)g)",
    )
    parser.add_argument(
        "--clock", action="store_true", help="publish /clock for nodes with use_sim_time"
    )
    parser.add_argument("--stress", action="store_true", help="publish the recorded stress too")
    parser.add_argument(
        "--view",
        action="store_true",
        help="show the recorded stress in the browser, with a time slider",
    )


def run(options: argparse.Namespace) -> int:
    from ..bags.read import Bag
    from ..ros.commands.replaying import replay
    from ..views.terminal.replaying import ReplayBar, pressed_key, single_keys

    with Bag(options.bag) as bag, browser(bag, options.view) as children, single_keys() as keys:
        length = (bag.end_ns - bag.start_ns) * 1e-9
        with ReplayBar(length, keys) as bar:

            def each(player: Player) -> None:
                children.check()
                if keys:
                    obey(pressed_key(), player)
                bar.show(player.position, player.paused)

            replay(
                bag,
                rate=options.rate,
                loop=options.loop,
                start=options.start,
                clock=options.clock,
                stress=options.stress or options.view,
                hold=options.view,
                each=each,
            )
    return 0


def obey(key: str, player: Player) -> None:
    if key == " ":
        player.pause(not player.paused)
    elif key == "s":
        player.step()
    elif key == "q":
        player.end()


@contextmanager
def browser(bag: Bag, wanted: bool) -> Iterator[Children]:
    """The browser view as a child, if wanted. BagError: it would have nothing to show."""
    import tempfile

    from ..core.errors import BagError
    from ..messages.types import PACKAGE
    from ..processes.children import Children
    from ..processes.skin_processes import Process

    with (
        tempfile.TemporaryDirectory(prefix="cube_replay_") as name,
        Children(Path(name)) as children,
    ):
        if wanted:
            if not bag.topics(f"{PACKAGE}/msg/SkinStress"):
                raise BagError(
                    f"{bag.path}: no stress to show; "
                    "./cube reprocess computes it from the frequencies"
                )
            children.start(Process("view", "cube_tensor_driver.cli", False, arguments=("view",)))
            print(children.wait_for_line("view", "http://", START_S), file=sys.stderr)
        yield children
