"""./cube replay: a bag onto its topics, with a progress bar and keys to pause, step and quit."""

from __future__ import annotations

import os
import select
import signal
import sys
import termios
import threading
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import rclpy
from rclpy.signals import SignalHandlerOptions
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from ..core.errors import BagError
from ..files.bags import Bag
from ..ros.messages import SECOND
from ..ros.player import Player

KEYS = "space: pause, s: step, q: quit"
LOOK_S = 0.1


@dataclass(frozen=True)
class Options:
    """As on the command line. start in s after the begin of the bag."""

    bag: Path
    rate: float
    loop: bool
    start: float
    clock: bool
    stress: bool


def run_replay(options: Options) -> int:
    """Replay until the bag ends or asked to end. BagError: what is wrong with the bag."""
    ended = threading.Event()
    failed: list[BagError] = []
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    try:
        node = rclpy.create_node("player")
        with Bag(options.bag) as bag, _keys() as keys:
            player = Player(node, bag, rate=options.rate, stress=options.stress, clock=options.clock)
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
                signal.signal(number, lambda *_: player.end())
            seconds = (bag.end_ns - bag.start_ns) / SECOND
            passed = [0.0]

            def play() -> None:
                try:
                    player.run(options.start, options.loop, lambda now: passed.__setitem__(0, now))
                except BagError as error:
                    failed.append(error)
                ended.set()

            thread = threading.Thread(target=play, name="player")
            thread.start()
            with _progress(bool(keys)) as progress:
                task = progress.add_task("", total=seconds)
                while not ended.wait(0 if keys else LOOK_S):
                    _obey(keys, player)
                    progress.update(task, completed=passed[0], description="paused" if player.paused else "replaying")
                progress.update(task, completed=passed[0])
            thread.join()
        node.destroy_node()
    finally:
        rclpy.try_shutdown()
    if failed:
        raise failed[0]
    return 0


def _progress(keys: bool) -> Progress:
    columns = [TextColumn("{task.description}"), BarColumn(), TextColumn("{task.completed:.1f} / {task.total:.1f} s")]
    return Progress(*columns, TextColumn(KEYS if keys else ""), console=Console(stderr=True))


def _obey(keys: bool, player: Player) -> None:
    """Wait a moment for a key, and do what it says."""
    if not keys or not select.select([sys.stdin], [], [], LOOK_S)[0]:
        return
    key = os.read(sys.stdin.fileno(), 1)
    if key == b" ":
        player.pause(not player.paused)
    elif key == b"s":
        player.step()
    elif key == b"q":
        player.end()


@contextmanager
def _keys() -> Iterator[bool]:
    """Keys one by one, without echo; False where there is no terminal."""
    if not sys.stdin.isatty():
        yield False
        return
    number = sys.stdin.fileno()
    before = termios.tcgetattr(number)
    try:
        tty.setcbreak(number)
        yield True
    finally:
        termios.tcsetattr(number, termios.TCSADRAIN, before)
