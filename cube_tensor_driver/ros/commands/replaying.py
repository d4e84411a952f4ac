"""A bag played from begin to end, with its topics for control."""

from __future__ import annotations

import threading
from collections.abc import Callable

from ...bags.read import Bag
from ...core.errors import BagError
from ...processes.stop_signals import on_stop_signal
from ..session import node_session
from .player import Player
from .replay_control import ReplayControl

SPIN_S = 0.05


def replay(
    bag: Bag,
    *,
    rate: float,
    loop: bool,
    start: float,
    clock: bool,
    stress: bool,
    hold: bool,
    each: Callable[[Player], None],
) -> None:
    """Publish a bag until its end or a signal; with `hold` it waits at its end to be steered.

    each: called in the main thread after every spin, at least each 0.05 s.
    BagError: the bag cannot be read, or has nothing to publish.
    """
    failed: list[BagError] = []
    with node_session("player") as (node, executor):
        player = Player(node, bag, rate=rate, stress=stress, clock=clock)
        ReplayControl(node, player)
        on_stop_signal(player.end)

        def play() -> None:
            try:
                player.run(start, loop, hold=hold)
            except BagError as error:
                failed.append(error)

        thread = threading.Thread(target=play, name="player")
        thread.start()
        try:
            while thread.is_alive():
                executor.spin_once(timeout_sec=SPIN_S)
                each(player)
        finally:
            player.end()
            thread.join()
        each(player)
    if failed:
        raise failed[0]
