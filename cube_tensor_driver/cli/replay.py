"""./cube replay: a bag onto its topics, with a progress bar, keys to pause, step and quit, and the
browser view."""

from __future__ import annotations

import os
import select
import signal
import sys
import tempfile
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

from ..bags.read import PACKAGE, Bag
from ..core.errors import BagError
from ..processes.children import Children
from ..processes.skin_processes import Process
from ..ros.node import make_executor
from ..ros.player import Player
from ..ros.replay_control import ReplayControl

KEYS = "space: pause, s: step, q: quit"
LOOK_S, START_S = 0.05, 30.0


@dataclass(frozen=True)
class Options:
    """As on the command line. start in s after the begin of the bag. view: show the recorded stress
    in the browser."""

    bag: Path
    rate: float
    loop: bool
    start: float
    clock: bool
    stress: bool
    view: bool = False


def run_replay(options: Options) -> int:
    """Replay until the bag ends or asked to end. BagError: what is wrong with the bag."""
    failed: list[BagError] = []
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    try:
        with Bag(options.bag) as bag, _view(options, bag) as children, _keys() as keys:
            node = rclpy.create_node("player")
            player = Player(
                node,
                bag,
                rate=options.rate,
                stress=options.stress or options.view,
                clock=options.clock,
            )
            ReplayControl(node, player)
            executor = make_executor()
            executor.add_node(node)
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
                signal.signal(number, lambda *_: player.end())

            def play() -> None:
                try:
                    player.run(options.start, options.loop, hold=options.view)
                except BagError as error:
                    failed.append(error)

            thread = threading.Thread(target=play, name="player")
            thread.start()
            try:
                with _progress(bool(keys)) as progress:
                    task = progress.add_task("", total=player.length)
                    while thread.is_alive():
                        executor.spin_once(timeout_sec=LOOK_S)
                        children.check()
                        _obey(keys, player)
                        shown = "paused" if player.paused else "replaying"
                        progress.update(task, completed=player.position, description=shown)
                    progress.update(task, completed=player.position)
            finally:
                player.end()
                thread.join()
            executor.remove_node(node)
            node.destroy_node()
    finally:
        rclpy.try_shutdown()
    if failed:
        raise failed[0]
    return 0


@contextmanager
def _view(options: Options, bag: Bag) -> Iterator[Children]:
    """The browser view as a child, if asked for. BagError: it would have nothing to show."""
    with (
        tempfile.TemporaryDirectory(prefix="cube_replay_") as name,
        Children(Path(name)) as children,
    ):
        if options.view:
            if not bag.topics(f"{PACKAGE}/msg/SkinStress"):
                raise BagError(
                    f"{bag.path}: no stress to show; ./cube reprocess makes it of the frequencies"
                )
            children.start(Process("view", "cube_tensor_driver.cli", False, arguments=("view",)))
            print(children.said("view", "http://", START_S), file=sys.stderr)
        yield children


def _progress(keys: bool) -> Progress:
    columns = [
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.completed:.1f} / {task.total:.1f} s"),
    ]
    return Progress(*columns, TextColumn(KEYS if keys else ""), console=Console(stderr=True))


def _obey(keys: bool, player: Player) -> None:
    """Do what the key says that was pressed, if any."""
    if not keys or not select.select([sys.stdin], [], [], 0)[0]:
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
