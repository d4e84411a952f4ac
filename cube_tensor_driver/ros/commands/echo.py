# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Finds one topic, subscribes to it, and returns its messages as plain values (`./cube echo`)."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from rclpy.node import Node
from rclpy.subscription import Subscription

from ...core.errors import ConfigError, CubeError, MessageError
from ...core.modes import GRADIENT, STRESS
from ...core.rows import StressRows
from ...messages.codec import stress_codec
from ...msg import SkinInfo, SkinStress, StressTensorStamped
from ...processes.stop_signals import stop_event
from ..messages import find_message_class, log_refused_message, to_ns
from ..qos import LATCHED, match_offered_profile
from ..session import describe_domain, run_node_session, spin_until
from .services import discover

QUEUE_DEPTH = 100
"""Maximum number of messages that wait to be printed. If messages arrive faster than they are
printed, the oldest ones are dropped."""

MAX_INFO_S = 3.0
"""Maximum time, in seconds, to wait for the topic `info`, which contains the names of the cubes,
before stress is printed. Without it the cubes are printed by their indices."""

MAX_MESSAGE_S = 5.0
"""Maximum time, in seconds, to wait for a message if a single one was asked for (`once`). Without a
message in this time the command fails."""


@dataclass(frozen=True)
class StressReading:
    """The stress of one cube at one instant.

    Attributes:
        stamp_ns: Time at which the pads were read, in ns since the Unix epoch.
        cube: Name of the cube.
        stress: Name of each stress component -> its value, in Pa; NaN if it is not observed.
        gradient: Name of each gradient -> its value, in Pa/m; NaN if it is not observed.
        residual: Disagreement between the signals of the pads, sqrt(chi-square / degrees of
            freedom): about 1 for noise alone, larger for a faulty pad or an unusual load.
        status: Status bits, see `core/status.py`.
    """

    stamp_ns: int
    cube: str
    stress: dict[str, float]
    gradient: dict[str, float]
    residual: float
    status: int


Item = StressReading | dict[str, Any]
"""Content of a message: the stress of a cube, or the fields of any other message by name."""


def listen(topic: str, once: bool) -> Iterator[list[Item]]:
    """Yield the content of each message of a topic, until a signal asks the process to end.

    Args:
        topic: Name of the topic.
        once: Whether to end after the first message.

    Yields:
        The content of one message, as a list: one `StressReading` per cube and sampling time if the
        message contains stress, else a single dict with the fields of the message.

    Raises:
        CubeError: No node publishes the topic, the type of its messages is not installed, or with
            `once` no message came within `MAX_MESSAGE_S`.
    """
    stop = stop_event()
    with run_node_session("echo") as (node, executor):
        name = resolve_topics(node, [topic])[0]
        listener = _Listener(node, name)

        def is_published() -> bool:
            return stop.is_set() or node.count_publishers(name) > 0

        if not discover(executor, is_published):
            raise CubeError(
                f"nobody publishes {name} in {describe_domain()}; ./cube topics lists what there is"
            )
        listener.subscribe()
        spin_until(
            executor,
            lambda: stop.is_set() or listener.has_names,
            MAX_INFO_S,
        )
        # Without `once` there is no time limit, because the user ends the command with Ctrl-C.
        wait_s = MAX_MESSAGE_S if once else float("inf")
        while spin_until(
            executor,
            lambda: stop.is_set() or listener.waiting,
            wait_s,
        ):
            if stop.is_set():
                return
            yield listener.take()
            if once:
                return
        raise CubeError(
            f"no message came on {name} within {MAX_MESSAGE_S:g} s; /diagnostics says how the "
            "links are"
        )


def resolve_topics(node: Node, topics: Sequence[str]) -> list[str]:
    """Return the full names of topics, with the namespace and remaps of a node.

    Args:
        node: The node.
        topics: Names as users write them, such as `stress`.

    Raises:
        ConfigError: ROS does not allow one of the names.
    """
    names = []
    for topic in topics:
        try:
            names.append(node.resolve_topic_name(topic))
        # rclpy raises RCLError or InvalidTopicNameException, which derive from these two types.
        except (RuntimeError, ValueError):
            raise ConfigError(
                f"topic {topic!r}, allowed: letters, digits, _ and /, and no digit after a /"
            ) from None
    return names


def to_plain(value: Any) -> Any:
    """Convert a message, or the value of one of its fields, to plain Python values.

    Args:
        value: A message, which becomes a dict of its fields; an array, which becomes a list; a
            number or text, which stays as it is; or a byte, which becomes a number.
    """
    if hasattr(value, "get_fields_and_field_types"):
        names = value.get_fields_and_field_types()
        return {name: to_plain(getattr(value, name)) for name in names}
    # rclpy represents a field of type byte as a bytes object of length 1.
    if isinstance(value, bytes):
        return value[0]
    if isinstance(value, (str, bool, int, float)):
        return value
    if isinstance(value, np.generic):
        return value.item()
    return [to_plain(one) for one in value]


class _Listener:
    """Subscribes to one topic, and for `stress` also to `info`, which has the names of the cubes.

    Attributes:
        waiting: Received messages that `take` has not returned yet, the oldest first.
    """

    def __init__(self, node: Node, topic: str) -> None:
        self.waiting: deque[object] = deque(maxlen=QUEUE_DEPTH)
        self._node = node
        self._topic = topic
        self._names: list[str] | None = None
        self._needs_names = False
        self._early_subscription: Subscription | None = None
        parent, _, what = topic.rpartition("/")
        cubes, _, self._cube = parent.rpartition("/")
        if what == "stress" and cubes.endswith("/cubes"):
            # On a large skin the publisher of a single cube's topic is made only when somebody
            # subscribes, so the subscription comes before the search for the publisher.
            profile = match_offered_profile([], QUEUE_DEPTH)
            self._early_subscription = node.create_subscription(
                StressTensorStamped,
                topic,
                self._on_message,
                profile,
            )

    @property
    def has_names(self) -> bool:
        """Whether the names of the cubes are known, or are not needed for this topic."""
        return self._names is not None or not self._needs_names

    def subscribe(self) -> None:
        """Subscribe to the topic with the type and quality of service of its publishers.

        Nothing is done if the topic has no publisher.

        Raises:
            CubeError: Publishers of the topic have different types, or the type of its messages is
                not installed.
        """
        offers = self._node.get_publishers_info_by_topic(self._topic)
        if not offers:
            return
        kinds = sorted({offer.topic_type for offer in offers})
        # A subscription has one type, and messages of publishers with another type would be
        # missing without an error.
        if len(kinds) > 1:
            raise CubeError(
                f"{self._topic} has publishers of {' and '.join(kinds)}; end those of the wrong one"
            )
        kind = find_message_class(self._topic, kinds[0])
        if self._early_subscription is not None:
            if kind is StressTensorStamped:
                return
            self._node.destroy_subscription(self._early_subscription)

        profile = match_offered_profile(offers, QUEUE_DEPTH)
        if kind is SkinStress:
            # SkinStress contains only the indices of cubes; their names are in the topic `info`.
            self._needs_names = True
            namespace = self._topic.rpartition("/")[0]
            info = f"{namespace}/info"
            self._node.create_subscription(
                SkinInfo,
                info,
                self._on_info,
                LATCHED,
            )
            self._node.create_subscription(
                kind,
                self._topic,
                self._on_stress,
                profile,
                raw=True,
            )
        else:
            self._node.create_subscription(
                kind,
                self._topic,
                self._on_message,
                profile,
            )

    def take(self) -> list[Item]:
        """Remove the oldest message from `waiting`, and return its content.

        If the message contains stress, the list has one `StressReading` per cube and sampling time,
        else a single dict with the fields of the message.
        """
        message = self.waiting.popleft()
        if isinstance(message, StressRows):
            return list(self._read_rows(message))
        if isinstance(message, StressTensorStamped):
            return [self._read_tensor(message)]
        return [to_plain(message)]

    def _on_message(self, message: object) -> None:
        self.waiting.append(message)

    def _on_info(self, info: SkinInfo) -> None:
        self._names = [cube.name for cube in info.cubes]

    def _on_stress(self, data: bytes) -> None:
        try:
            self.waiting.append(stress_codec.decode(data).rows)
        except MessageError as error:
            log_refused_message(self._node, self._topic, error)

    def _read_rows(self, rows: StressRows) -> Iterator[StressReading]:
        names = dict(enumerate(self._names or []))
        columns = (
            rows.stamp_ns,
            rows.cube,
            rows.stress,
            rows.gradient,
            rows.residual,
            rows.status,
        )
        lists = [column.tolist() for column in columns]
        for stamp_ns, cube, stress, gradient, residual, status in zip(*lists, strict=True):
            yield StressReading(
                stamp_ns,
                names.get(cube, f"cube {cube}"),
                dict(zip(STRESS, stress, strict=True)),
                dict(zip(GRADIENT, gradient, strict=True)),
                residual,
                status,
            )

    def _read_tensor(self, message: StressTensorStamped) -> StressReading:
        tensor = message.tensor
        normal = tensor.normal
        shear = tensor.shear
        stress = [normal.x, normal.y, normal.z, shear.x, shear.y, shear.z]
        gradient = tensor.normal_gradient.tolist()
        return StressReading(
            to_ns(message.header.stamp),
            self._cube,
            dict(zip(STRESS, stress, strict=True)),
            dict(zip(GRADIENT, gradient, strict=True)),
            tensor.residual,
            tensor.status,
        )
