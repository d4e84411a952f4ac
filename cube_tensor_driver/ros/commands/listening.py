"""One topic for a command: found, subscribed to, and its messages as readings of cubes or as plain
values."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.topic_endpoint_info import TopicEndpointInfo

from ...core.errors import CubeError, MessageError
from ...core.rows import StressRows
from ...messages.codec import stress_codec
from ...msg import SkinInfo, SkinStress, StressTensorStamped
from ...processes.stop_signals import on_stop_signal
from ..messages import message_class, to_ns
from ..session import node_session
from .asking import STEP_S, discover, domain_text, spin
from .recording import resolve_topics

DEPTH = 100
INFO_S = 3.0
"""How long the names of cubes may take to come after their topic was found."""
MESSAGE_S = 5.0
"""How long the first message may take, where one is wanted."""


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
    """What each message of a topic says, until a signal asks to end; `once`: the first message.

    Topics of stress give one `StressReading` per row, others one dict of plain values.
    CubeError: nobody publishes it, its messages are not installed here, or with
    `once` no message comes within MESSAGE_S.
    """
    stop = threading.Event()
    on_stop_signal(stop.set)
    with node_session("echo") as (node, executor):
        name = resolve_topics(node, [topic])[0]
        listener = Listener(node, name)
        found = discover(executor, lambda: stop.is_set() or listener.find())
        if stop.is_set():
            return
        if not found:
            raise CubeError(
                f"nobody publishes {name} in {domain_text()}; ./cube topics lists what there is"
            )
        spin(executor, INFO_S, lambda: stop.is_set() or listener.has_names)
        spin(
            executor,
            MESSAGE_S if once else float("inf"),
            lambda: stop.is_set() or listener.waiting,
        )
        if once and not listener.waiting and not stop.is_set():
            raise CubeError(
                f"no message came on {name} within {MESSAGE_S:g} s; /diagnostics says how the "
                "links are"
            )
        while not stop.is_set():
            while listener.waiting:
                yield listener.take()
                if once:
                    return
            executor.spin_once(timeout_sec=STEP_S)


class Listener:
    """Subscribes to one topic, and for names of cubes to the `info` beside it.

    waiting: messages that nobody has taken yet; the oldest are dropped where the reader is slower
    than the topic.
    """

    def __init__(self, node: Node, topic: str) -> None:
        self.waiting: deque[Any] = deque(maxlen=DEPTH)
        self._node, self._topic = node, topic
        self._names: list[str] | None = None
        self._needs_names = False
        self._asked: Any = None
        cubes, _, what = topic.rpartition("/")
        self._cube = cubes.rpartition("/")[2]
        if what == "stress" and cubes.rpartition("/")[0].endswith("/cubes"):
            # A large skin announces the topic of a cube only once somebody asks for it.
            self._asked = self._subscribe(StressTensorStamped, self._on_message, profile_of([]))

    @property
    def has_names(self) -> bool:
        """Whether the names of cubes are known, or not needed."""
        return self._names is not None or not self._needs_names

    def find(self) -> bool:
        """Subscribe once the topic has a publisher; returns whether it has. CubeError: it has
        several types, or its messages are not installed here."""
        offers = self._node.get_publishers_info_by_topic(self._topic)
        if not offers:
            return False
        kinds = sorted({offer.topic_type for offer in offers})
        if len(kinds) > 1:
            raise CubeError(
                f"{self._topic} has publishers of {' and '.join(kinds)}; end those of the wrong one"
            )
        kind = message_class(self._topic, kinds[0])
        profile = profile_of(offers)
        if self._asked is not None:
            if kind is StressTensorStamped:
                return True
            self._node.destroy_subscription(self._asked)
        if kind is SkinStress:
            self._needs_names = True
            latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
            info = f"{self._topic.rpartition('/')[0]}/info"
            self._node.create_subscription(SkinInfo, info, self._on_info, latched)
            self._subscribe(SkinStress, self._on_stress, profile, raw=True)
        elif kind is StressTensorStamped:
            self._subscribe(StressTensorStamped, self._on_message, profile)
        else:
            self._subscribe(kind, self._on_message, profile)
        return True

    def take(self) -> list[Item]:
        """What the oldest waiting message says."""
        message = self.waiting.popleft()
        if isinstance(message, StressRows):
            return list(self._rows(message))
        if isinstance(message, StressTensorStamped):
            return [self._tensor(message)]
        return [plain(message)]

    def _subscribe(
        self, kind: type, receive: Callable[[Any], None], profile: QoSProfile, raw: bool = False
    ) -> Any:
        return self._node.create_subscription(kind, self._topic, receive, profile, raw=raw)

    def _on_info(self, info: SkinInfo) -> None:
        self._names = [cube.name for cube in info.cubes]

    def _on_message(self, message: Any) -> None:
        self.waiting.append(message)

    def _on_stress(self, data: bytes) -> None:
        try:
            rows = stress_codec.decode(data).rows
        except MessageError as error:
            self._node.get_logger().error(str(error), throttle_duration_sec=5.0)
            return
        self.waiting.append(rows)

    def _rows(self, rows: StressRows) -> Iterator[StressReading]:
        names = dict(enumerate(self._names or []))
        values = np.hstack([rows.stress, rows.gradient]).tolist()
        columns = (rows.stamp_ns, rows.cube, rows.residual, rows.status)
        numbers = zip(*(column.tolist() for column in columns), values, strict=True)
        for stamp_ns, cube, residual, status, row in numbers:
            yield StressReading(stamp_ns, names.get(cube, f"cube {cube}"), row, residual, status)

    def _tensor(self, message: StressTensorStamped) -> StressReading:
        tensor = message.tensor
        normal, shear = tensor.normal, tensor.shear
        stress = [normal.x, normal.y, normal.z, shear.x, shear.y, shear.z]
        values = [*stress, *tensor.normal_gradient.tolist()]
        stamp_ns = to_ns(message.header.stamp)
        return StressReading(stamp_ns, self._cube, values, tensor.residual, tensor.status)


def plain(value: Any) -> Any:
    """A message as dicts, lists, numbers and texts."""
    if hasattr(value, "get_fields_and_field_types"):
        return {name: plain(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if isinstance(value, bytes):  # a field of type byte
        return value[0]
    if isinstance(value, (str, bool, int, float)):
        return value
    if isinstance(value, np.generic):
        return value.item()
    return [plain(one) for one in value]


def profile_of(offers: list[TopicEndpointInfo]) -> QoSProfile:
    """What fits all publishers."""
    profiles = [offer.qos_profile for offer in offers]
    latched = profiles and all(
        profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for profile in profiles
    )
    reliable = all(profile.reliability == ReliabilityPolicy.RELIABLE for profile in profiles)
    return QoSProfile(
        depth=DEPTH,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )
