# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
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
"""Maximum time, in seconds, from the start of the browser view until it prints its URL."""

KEYS = "space: pause, s: step, q: quit"
"""Text beside the progress bar that tells which keys control the replay."""


def add_arguments(parser: Parser) -> None:
    """Add the options of the command."""
    parser.add_bag()
    parser.add_value(
        "--rate",
        "R",
        "times the recorded speed (default: %(default)g)",
        positive,
        default=1.0,
    )
    parser.add_switch("--loop", "begin again at the end")
    parser.add_value(
        "--start",
        "S",
        "begin S seconds after the start of the bag (default: %(default)g)",
        not_negative,
        default=0.0,
    )
    parser.add_switch("--clock", "publish /clock for nodes with use_sim_time")
    parser.add_switch("--stress", "publish the recorded stress too")
    parser.add_switch("--view", "show the recorded stress in the browser, with a time slider")


def run(options: argparse.Namespace) -> int:
    """Publish the recorded messages of a bag.

    Stress is published only if an option asks for it, because a reconstruction node computes it
    anew from the published frequencies.
    """
    from ..bags.read import Bag
    from ..ros.commands.replay import replay

    with (
        Bag(options.bag) as bag,
        run_browser(bag, options.view) as children,
        read_single_keys() as has_keys,
    ):
        length_s = (bag.end_ns - bag.start_ns) * 1e-9
        with replay_bar(has_keys) as bar:
            task = bar.add_task("replaying", total=length_s)

            # `replay` calls this function repeatedly in the main thread, between two messages.
            def update_display(player: Player) -> None:
                children.check()
                if has_keys:
                    obey(read_pressed_key(), player)
                text = "paused" if player.paused else "replaying"
                bar.update(task, completed=player.position, description=text)

            replay(
                bag,
                rate=options.rate,
                loop=options.loop,
                start=options.start,
                clock=options.clock,
                # The browser view needs stress; no node computes it again here, so the recorded
                # stress is published.
                stress=options.stress or options.view,
                hold=options.view,
                on_step=update_display,
            )
    return 0


def obey(key: str, player: Player) -> None:
    """Control a replay by a key of `KEYS`; other keys do nothing.

    Args:
        key: The character of the key; empty: no key was pressed.
        player: The replay.
    """
    if key == " ":
        player.pause(not player.paused)
    elif key == "s":
        player.step()
    elif key == "q":
        player.end()


@contextmanager
def read_single_keys() -> Iterator[bool]:
    """Set the terminal so that each key can be read at once, without Enter and without echo.

    The terminal is restored at the end of the `with` block.

    Yields:
        Whether keys can be read; they cannot if stdin is not a terminal.
    """
    import termios
    import tty

    if not sys.stdin.isatty():
        yield False
        return
    # The mode `cbreak`, unlike `raw`, still turns Ctrl-C into a signal.
    number = sys.stdin.fileno()
    before = termios.tcgetattr(number)
    try:
        tty.setcbreak(number)
        yield True
    finally:
        termios.tcsetattr(number, termios.TCSADRAIN, before)


def read_pressed_key() -> str:
    """Return the character of the next key that was pressed, or an empty text if there is none."""
    readable, _, _ = select.select([sys.stdin], [], [], 0)
    if not readable:
        return ""
    # sys.stdin.read would move further keys into its own buffer, where `select` does not find them.
    return os.read(sys.stdin.fileno(), 1).decode(errors="replace")


def replay_bar(has_keys: bool) -> Progress:
    """Return a progress bar on stderr that shows the time within the bag.

    Args:
        has_keys: Whether to show the keys that control the replay beside the bar.
    """
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
def run_browser(bag: Bag, wanted: bool) -> Iterator[Children]:
    """Run the browser view as a child process inside a `with` block, if it is wanted.

    Args:
        bag: The bag that is replayed.
        wanted: Whether to start the view.

    Yields:
        The child processes: the view, or none.

    Raises:
        BagError: The bag contains no stress, which the view would show.
        ChildError: The view did not start within `MAX_START_S`.
    """
    import tempfile

    from ..core.errors import BagError
    from ..messages.types import PACKAGE
    from ..processes.children import Children
    from ..processes.skin_processes import VIEW

    with (
        tempfile.TemporaryDirectory(prefix="cube_replay_") as name,
        Children(Path(name)) as children,
    ):
        if wanted:
            # The view can only show stress that is published; it does not compute any.
            if not bag.list_topics(f"{PACKAGE}/msg/SkinStress"):
                raise BagError(
                    f"{bag.path}: no stress to show; "
                    "./cube reprocess computes it from the frequencies"
                )
            # The view needs seconds to start. Waiting for its URL makes the replay begin when the
            # page can be opened.
            children.start(VIEW)
            print(children.wait_for_line("view", "http://", MAX_START_S), file=sys.stderr)
        yield children
