"""Publishes `frequencies`: rows are written into the bytes of a message, and those are sent."""

from __future__ import annotations

from functools import lru_cache

from rclpy.lifecycle import LifecycleNode
from rclpy.qos import QoSProfile

from ...core.rows import FrequencyRows
from ...messages.codec import MessageBuffer, frequency_codec
from ...msg import SkinFrequencies
from ..compat import on_matched
from ..node import BUFFERS_KEPT

COUNT_S = 0.2
"""How often subscribers are counted where rclpy does not tell."""


class FrequenciesPublisher:
    """A publisher of SkinFrequencies with the memory of its messages, for use by one thread."""

    def __init__(
        self, node: LifecycleNode, frame_id: str, quality: QoSProfile, always: bool
    ) -> None:
        """always: publish whether or not anybody subscribes."""
        self._node = node
        self._always = always
        self._has_subscribers = False
        self._frame_id = frame_id.encode() + b"\0"
        self._buffer = lru_cache(maxsize=BUFFERS_KEPT)(self._make_buffer)
        self._next: MessageBuffer[FrequencyRows] | None = None
        # DDS tells how many subscribe; asking at each message would cost more.
        events = on_matched(self._on_count)
        self._publisher = node.create_lifecycle_publisher(
            SkinFrequencies, "frequencies", quality, event_callbacks=events
        )
        self._timer = None if events else node.create_timer(COUNT_S, self._count)

    def make_rows(self, n_rows: int, n_pads: int) -> FrequencyRows:
        """Rows to fill, in the memory of the next message; they are valid until the next call."""
        self._next = self._buffer(n_rows, n_pads)
        return self._next.rows

    def publish(self) -> None:
        """Publish the rows that `make_rows` gave last."""
        if self._next is not None and (self._always or self._has_subscribers):
            self._publisher.publish(self._next.data())

    def destroy(self) -> None:
        """End it."""
        if self._timer is not None:
            self._node.destroy_timer(self._timer)
        self._node.destroy_publisher(self._publisher)

    def _make_buffer(self, n_rows: int, n_pads: int) -> MessageBuffer[FrequencyRows]:
        return frequency_codec.buffer(self._frame_id, n_rows, n_pads)

    def _on_count(self, subscribers: int) -> None:
        self._has_subscribers = subscribers > 0

    def _count(self) -> None:
        self._on_count(self._publisher.get_subscription_count())
