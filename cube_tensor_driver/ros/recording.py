"""Recording from the first message to a complete bag: as a command, and as the node `recorder`."""

from __future__ import annotations

import os
import shutil
import sys
import threading
import time
from collections.abc import Callable, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

from rclpy.exceptions import ParameterException
from rclpy.node import Node

from ..bags.repair import repair
from ..bags.write import BagWriter
from ..core.errors import BagError, ConfigError, CubeError
from ..processes.skin_processes import RECORDED
from .parameters import RECORDER
from .recorder import Recorder
from .session import node_session, on_stop_signal

MISSING_S = 10.0
"""The node warns of topics that nobody offers after so long."""
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


def stop_event() -> threading.Event:
    """Set by the signals that ask the process to end."""
    stop = threading.Event()
    on_stop_signal(stop.set)
    return stop


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


class _Log:
    """What the node `recorder` says while it records: each thing once."""

    def __init__(self, node: Node) -> None:
        self._log = node.get_logger()
        self._said: set[str] = set()

    def show(self, recorder: Recorder, seconds: float) -> None:
        for reason in recorder.refused.values():
            self._warn(f"not recorded: {reason}")
        if recorder.dropped:
            self._warn("the disk is too slow: messages are dropped")
        if recorder.missing and seconds > MISSING_S:
            self._warn(
                f"nobody offers {', '.join(recorder.missing)}: nothing of it is recorded yet"
            )

    def _warn(self, text: str) -> None:
        if text not in self._said:
            self._said.add(text)
            self._log.warning(text)


def new_folder(node: Node, skin: str) -> Path:
    """Below the current folder, named [namespace_]skin_date-time."""
    parts = [part for part in node.get_namespace().split("/") if part]
    return Path("_".join([*parts, skin, f"{datetime.now():%Y_%m_%d-%H_%M_%S}"])).absolute()


def main() -> int:
    """The node `recorder`: records the skin in whose namespace it is, until a signal.

    Returns the exit code: 1 if there is no recording, or messages are missing from it.
    """
    stop = stop_event()
    try:
        with node_session("recorder") as (node, executor):
            for parameter in RECORDER:
                node.declare_parameter(parameter.name, parameter.default)
            bag = BagWriter(new_folder(node, node.get_parameter("skin").value), "mcap", 0, 0.0)
            node.get_logger().info(f"recording into {bag.folder}")
            names = resolve_topics(node, RECORDED)
            show = _Log(node).show
            recorder = fill(bag, node, executor, names, stop=stop, duration=None, show=show)
            node.get_logger().info(f"{bag.folder}: {bag.messages} messages")
    except (ParameterException, CubeError) as error:
        print(f"recorder: {error}", file=sys.stderr)
        return 1
    if recorder.dropped:
        print(
            f"recorder: the disk is too slow: {recorder.dropped} messages dropped", file=sys.stderr
        )
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
