"""./cube replay: publish a bag, with keys to pause, step and quit, and with the browser view."""

from __future__ import annotations

import argparse
import os
import select
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from .parser import Parser, not_negative, positive

if TYPE_CHECKING:
    from rich.progress import Progress

    from ..bags.read import Bag
    from ..processes.children import Children
    from ..ros.commands.replay import Player

MAX_START_S = 30.0
"""Time, in seconds, that the browser view may take to start."""

KEYS = "space: pause, s: step, q: quit"
"""The line of help beside the bar."""


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
    from ..ros.commands.replay import replay

    with Bag(options.bag) as bag, browser(bag, options.view) as children, single_keys() as has_keys:
        length_s = (bag.end_ns - bag.start_ns) * 1e-9
        with replay_bar(has_keys) as bar:
            task = bar.add_task("replaying", total=length_s)

            # It runs in the main thread, between two spins of the node.
            def each(player: Player) -> None:
                children.check()
                if has_keys:
                    obey(pressed_key(), player)
                text = "paused" if player.paused else "replaying"
                bar.update(task, completed=player.position, description=text)

            replay(
                bag,
                rate=options.rate,
                loop=options.loop,
                start=options.start,
                clock=options.clock,
                # The view shows the recorded stress, not one that is computed again.
                stress=options.stress or options.view,
                hold=options.view,
                each=each,
            )
    return 0


def obey(key: str, player: Player) -> None:
    """Do what a key stands for; other keys do nothing."""
    if key == " ":
        player.pause(not player.paused)
    elif key == "s":
        player.step()
    elif key == "q":
        player.end()


@contextmanager
def single_keys() -> Iterator[bool]:
    """Let keys arrive one by one, without Enter and without echo.

    Yields:
        Whether there are keys; there are none where stdin is no terminal.
    """
    import termios
    import tty

    if not sys.stdin.isatty():
        yield False
        return
    # `cbreak` leaves Ctrl-C as it is.
    number = sys.stdin.fileno()
    before = termios.tcgetattr(number)
    try:
        tty.setcbreak(number)
        yield True
    finally:
        termios.tcsetattr(number, termios.TCSADRAIN, before)


def pressed_key() -> str:
    """Return the next key that was pressed, empty if none was."""
    if not select.select([sys.stdin], [], [], 0)[0]:
        return ""
    # Not sys.stdin.read, whose buffer would hide further keys from select.
    return os.read(sys.stdin.fileno(), 1).decode(errors="replace")


def replay_bar(has_keys: bool) -> Progress:
    """Return a bar on stderr for the time within the bag; has_keys: with the help for keys."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.completed:.1f} / {task.total:.1f} s"),
        TextColumn(KEYS if has_keys else ""),
        console=Console(stderr=True),
    )


@contextmanager
def browser(bag: Bag, wanted: bool) -> Iterator[Children]:
    """Start the browser view as a child process, if wanted.

    Raises:
        BagError: The bag has no stress, which is all that the view shows.
    """
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
            # The view does not compute stress.
            if not bag.topics(f"{PACKAGE}/msg/SkinStress"):
                raise BagError(
                    f"{bag.path}: no stress to show; "
                    "./cube reprocess computes it from the frequencies"
                )
            # The page needs seconds to start; the replay begins when it can be opened.
            children.start(Process("view", "cube_tensor_driver.cli", False, arguments=("view",)))
            print(children.wait_for_line("view", "http://", MAX_START_S), file=sys.stderr)
        yield children
