"""Recording from the first message to a complete bag."""

from __future__ import annotations

import os
import shutil
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rclpy.node import Node

from ...bags.repair import repair
from ...bags.write import BagWriter
from ...core.errors import BagError, ConfigError
from ...processes.stop_signals import stop_event
from ..session import node_session
from .recorder import Recorder

FIND_S, SPIN_S, SHOW_S = 0.2, 0.05, 1.0
"""How often topics are looked for, how long a spin lasts, how often `show` is called."""


def record(
    folder: Path,
    topics: Sequence[str],
    *,
    storage: str,
    max_bytes: int,
    max_seconds: float,
    duration: float | None,
    show: Callable[[Recorder, float], None],
) -> Recorder:
    """Record for `duration` s from the first message on (None: until a signal) into a new bag;
    `BagWriter` says of what kind. Without any message it ends after the same time.

    show: called once a second with the recorder and the seconds since the start.
    BagError: cannot be written; what was written before is made readable. Or nothing came: then
    there is no bag. ConfigError: no such topics, or ROS does not start.
    """
    stop = stop_event()
    with node_session("recorder") as (node, executor):
        names = resolve_topics(node, topics)
        bag = BagWriter(folder, storage, max_bytes, max_seconds)
        return fill(bag, node, executor, names, stop=stop, duration=duration, show=show)


def fill(
    bag: BagWriter,
    node: Node,
    executor: Any,
    names: Sequence[str],
    *,
    stop: threading.Event,
    duration: float | None,
    show: Callable[[Recorder, float], None],
) -> Recorder:
    """Record the topics `names` until `stop`, and close the bag; the rest as in `record`."""
    recorder = Recorder(node, names, bag)
    begin = find_at = show_at = time.monotonic()
    until = float("inf") if duration is None else begin + duration
    came = False
    try:
        while not stop.is_set() and recorder.error is None:
            now = time.monotonic()
            if not came and any(recorder.counts.values()):
                # Finding the topics takes up to seconds on a busy machine.
                came, until = True, until + now - begin
            if now >= until:
                break
            executor.spin_once(timeout_sec=min(SPIN_S, until - now))
            if now >= find_at:
                find_at = now + FIND_S
                recorder.find_topics()
            if now >= show_at:
                show_at = now + SHOW_S
                show(recorder, now - begin)
    finally:
        _close(recorder, bag.folder)
    if not bag.messages:
        shutil.rmtree(bag.folder, ignore_errors=True)
        raise BagError(f"nothing recorded, no bag made: {_why_nothing(recorder)}")
    return recorder


def resolve_topics(node: Node, topics: Sequence[str]) -> list[str]:
    """The whole names of topics. ConfigError: ROS does not allow such a name."""
    names = []
    for topic in topics:
        try:
            names.append(node.resolve_topic_name(topic))
        except (RuntimeError, ValueError):  # RCLError, InvalidTopicNameException
            raise ConfigError(
                f"topic {topic!r}, allowed: letters, digits, _ and /, and no digit after a /"
            ) from None
    return names


def _why_nothing(recorder: Recorder) -> str:
    if recorder.refused:
        return "; ".join(recorder.refused.values())
    if recorder.counts:
        return f"no message came on {', '.join(sorted(recorder.counts))}"
    return (
        f"nobody offers {', '.join(recorder.missing)} in DDS domain "
        f"{os.environ.get('ROS_DOMAIN_ID') or 0}; start the skin, or correct --topics"
    )


def _close(recorder: Recorder, folder: Path) -> None:
    try:
        recorder.close()
    except BagError as error:
        # Most likely the disk is full: without the last, incomplete chunk there is room for the
        # summary.
        try:
            done = repair(folder, keep_rest=False)
        except BagError as worse:
            raise BagError(f"{error}\n{worse}") from None
        raise BagError(f"{error}. The {done.messages} messages written before are valid") from None
