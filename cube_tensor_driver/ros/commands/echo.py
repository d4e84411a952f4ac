"""One topic for a command: found, subscribed to, and its messages as plain values."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from rclpy.node import Node
from rclpy.qos import QoSProfile

from ...core.errors import ConfigError, CubeError, MessageError
from ...core.rows import StressRows
from ...messages.codec import stress_codec
from ...msg import SkinInfo, SkinStress, StressTensorStamped
from ...processes.stop_signals import stop_event
from ..messages import log_refused_message, message_class, to_ns
from ..qos import LATCHED, offered_profile
from ..session import domain_text, node_session, spin_until
from .services import discover

QUEUE_DEPTH = 100
"""Number of messages that wait to be printed. The oldest are dropped if printing is too slow."""

MAX_INFO_S = 3.0
"""Maximum time, in seconds, to wait for the names of cubes after their topic was found."""

MAX_MESSAGE_S = 5.0
"""Maximum time, in seconds, to wait for the first message, where one is wanted."""


@dataclass(frozen=True)
class StressReading:
    """The stress of one cube at one instant.

    Attributes:
        stamp_ns: Time at which the pads were read.
        cube: Name of the cube.
        values: One per name of `COMPONENTS`, in Pa and Pa/m; NaN where it is not observed.
        residual: Residual relative to the expected noise.
        status: Bits of `core/status.py`.
    """

    stamp_ns: int
    cube: str
    values: list[float]
    residual: float
    status: int


Item = StressReading | dict[str, Any]


def listen(topic: str, once: bool) -> Iterator[list[Item]]:
    """Yield the content of each message of a topic, until a signal asks to end.

    Args:
        topic: The topic.
        once: Whether to end after the first message.

    Yields:
        For topics of stress one `StressReading` per row, for others one dict of plain values.

    Raises:
        CubeError: Nobody publishes the topic, its messages are not installed here, or with `once`
            no message comes within `MAX_MESSAGE_S`.
    """
    stop = stop_event()
    with node_session("echo") as (node, executor):
        name = resolve_topics(node, [topic])[0]
        listener = _Listener(node, name)
        found = discover(executor, lambda: stop.is_set() or listener.subscribe())
        if not found:
            raise CubeError(
                f"nobody publishes {name} in {domain_text()}; ./cube topics lists what there is"
            )
        spin_until(executor, lambda: stop.is_set() or listener.has_names, MAX_INFO_S)
        # Somebody who watches a topic may wait for its first message as long as he likes.
        wait_s = MAX_MESSAGE_S if once else float("inf")
        while spin_until(executor, lambda: stop.is_set() or listener.waiting, wait_s):
            if stop.is_set():
                return
            yield listener.take()
            if once:
                return
        raise CubeError(
            f"no message came on {name} within {MAX_MESSAGE_S:g} s; /diagnostics says how the "
            "links are"
        )


def resolve_topics(node: Node, topics: tuple[str, ...] | list[str]) -> list[str]:
    """Return the full names of topics. ConfigError: ROS does not allow such a name."""
    names = []
    for topic in topics:
        try:
            names.append(node.resolve_topic_name(topic))
        except (RuntimeError, ValueError):  # RCLError, InvalidTopicNameException
            raise ConfigError(
                f"topic {topic!r}, allowed: letters, digits, _ and /, and no digit after a /"
            ) from None
    return names


def to_plain(value: Any) -> Any:
    """Return a message as dicts, lists, numbers and texts."""
    if hasattr(value, "get_fields_and_field_types"):
        names = value.get_fields_and_field_types()
        return {name: to_plain(getattr(value, name)) for name in names}
    if isinstance(value, bytes):  # a field of type byte
        return value[0]
    if isinstance(value, (str, bool, int, float)):
        return value
    if isinstance(value, np.generic):
        return value.item()
    return [to_plain(one) for one in value]


class _Listener:
    """Subscribes to one topic, and to the `info` beside it for the names of cubes.

    Attributes:
        waiting: Messages that nobody has taken yet.
    """

    def __init__(self, node: Node, topic: str) -> None:
        self.waiting: deque[Any] = deque(maxlen=QUEUE_DEPTH)
        self._node, self._topic = node, topic
        self._names: list[str] | None = None
        self._needs_names = False
        self._early_subscription: Any = None
        cubes, _, what = topic.rpartition("/")
        self._cube = cubes.rpartition("/")[2]
        if what == "stress" and cubes.rpartition("/")[0].endswith("/cubes"):
            # A large skin announces the topic of a cube only once somebody asks for it.
            profile = offered_profile([], QUEUE_DEPTH)
            self._early_subscription = self._add(StressTensorStamped, self._on_message, profile)

    @property
    def has_names(self) -> bool:
        """Whether the names of cubes are known, or not needed."""
        return self._names is not None or not self._needs_names

    def subscribe(self) -> bool:
        """Subscribe once the topic has a publisher, and return whether it has.

        Raises:
            CubeError: The topic has several types, or its messages are not installed here.
        """
        offers = self._node.get_publishers_info_by_topic(self._topic)
        if not offers:
            return False
        kinds = sorted({offer.topic_type for offer in offers})
        # A subscription has one type, and the others would be dropped silently.
        if len(kinds) > 1:
            raise CubeError(
                f"{self._topic} has publishers of {' and '.join(kinds)}; end those of the wrong one"
            )
        kind = message_class(self._topic, kinds[0])
        if self._early_subscription is not None:
            if kind is StressTensorStamped:
                return True
            self._node.destroy_subscription(self._early_subscription)

        profile = offered_profile(offers, QUEUE_DEPTH)
        if kind is SkinStress:
            # Rows number the cubes; their names are in the info.
            self._needs_names = True
            info = f"{self._topic.rpartition('/')[0]}/info"
            self._node.create_subscription(
                SkinInfo,
                info,
                self._on_info,
                LATCHED,
            )
            self._add(SkinStress, self._on_stress, profile, raw=True)
        else:
            self._add(kind, self._on_message, profile)
        return True

    def take(self) -> list[Item]:
        """Return the content of the oldest waiting message."""
        message = self.waiting.popleft()
        if isinstance(message, StressRows):
            return list(self._read_rows(message))
        if isinstance(message, StressTensorStamped):
            return [self._read_tensor(message)]
        return [to_plain(message)]

    def _add(
        self, kind: type, receive: Callable[[Any], None], profile: QoSProfile, raw: bool = False
    ) -> Any:
        return self._node.create_subscription(
            kind,
            self._topic,
            receive,
            profile,
            raw=raw,
        )

    def _on_message(self, message: Any) -> None:
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
        values = np.hstack([rows.stress, rows.gradient]).tolist()
        columns = (rows.stamp_ns, rows.cube, rows.residual, rows.status)
        each_row = zip(
            *(column.tolist() for column in columns),
            values,
            strict=True,
        )
        for stamp_ns, cube, residual, status, row in each_row:
            yield StressReading(
                stamp_ns,
                names.get(cube, f"cube {cube}"),
                row,
                residual,
                status,
            )

    def _read_tensor(self, message: StressTensorStamped) -> StressReading:
        tensor = message.tensor
        normal, shear = tensor.normal, tensor.shear
        stress = [normal.x, normal.y, normal.z, shear.x, shear.y, shear.z]
        values = [*stress, *tensor.normal_gradient.tolist()]
        stamp_ns = to_ns(message.header.stamp)
        return StressReading(
            stamp_ns,
            self._cube,
            values,
            tensor.residual,
            tensor.status,
        )
