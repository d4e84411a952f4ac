"""The driver node: live links with a publisher at their end."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.qos import QoSProfile

from ...config.parameters import DRIVER
from ...config.skin import read_skin
from ...core.pipeline import Pipeline
from ...core.rows import FrequencyRows
from ...device.chain import LiveLinks
from ...device.live import cube_addresses, link_configs
from ...messages.codec import MessageBuffer, frequency_codec
from ...msg import SkinFrequencies, SkinInfo
from ..compat import on_matched
from ..diagnostics.links import LinkDiagnostics
from ..diagnostics.updater import Diagnostics
from ..messages import info_message
from ..node import (
    MAX_BUFFERS,
    CubeNode,
    NodeClock,
    run,
)
from ..qos import LATCHED, scans_per_message

COUNT_PERIOD_S = 0.2
"""Time, in seconds, between two counts of subscribers where rclpy does not report their number."""


class Driver(CubeNode):
    """Publishes `frequencies`, `driver/info` and diagnostics.

    The reader's thread publishes the frequencies, the main thread spins the node.
    """

    def __init__(self, on_rows: Callable[[FrequencyRows], None] | None = None) -> None:
        """Make the node.

        Args:
            on_rows: Called in the reader's thread with the rows of each message, which are valid
                until it returns. Messages are then sent only while somebody subscribes to them.
        """
        super().__init__("driver", DRIVER)
        self._on_rows = on_rows
        self._node_clock = NodeClock(self)
        # None while the node is not configured.
        self._links: LiveLinks | None = None
        self._diagnostics = Diagnostics(self, self._statuses, self._count_errors)

    @property
    def failure(self) -> Exception | None:
        return None if self._links is None else self._links.failure

    def configure(self) -> None:
        skin = self._skin = read_skin(self.config())
        self._pipeline = Pipeline([cube.calibration for cube in skin.cubes])
        rate_hz = self._rate()
        self._frequencies = FrequenciesPublisher(
            self,
            skin.parent_frame,
            self.batch_profile(rate_hz, len(skin.cubes)),
            always=self._on_rows is None,
        )
        self._info = self.own(self.create_publisher(SkinInfo, "driver/info", LATCHED))
        self._links = LiveLinks(
            link_configs(skin, self.value("port"), self.value("port_directory")),
            cube_addresses(skin),
            self._publish,
            rate=rate_hz,
            # Several scans in a message save time per message where latency does not matter.
            scans_per_call=scans_per_message(self.value("publish_period"), rate_hz),
            make_rows=self._frequencies.make_rows,
            clock_ns=self._node_clock.now_ns,
            is_host_clock=lambda: not self._node_clock.is_simulated,
            log=self.get_logger(),
        )
        self.call_at_cleanup(self._forget_links)
        self._link_diagnostics = LinkDiagnostics(skin.name)
        self._published_uids: dict[int, int] = {}
        self._publish_info()

    def activate(self) -> None:
        if self._links is not None:
            self._node_clock.update()
            self._links.start()

    def deactivate(self) -> None:
        if self._links is not None:
            self._links.close()

    def on_parameter_change(self, name: str) -> None:
        """Ask the hubs for the new rate at once; queues keep the depth that they were made with."""
        if self._links is not None:
            self._links.set_rate(self._rate())

    def _forget_links(self) -> None:
        self._links = None

    def _rate(self) -> float | None:
        """Return the samples per second to ask of the hubs; None leaves it to them."""
        return float(self.value("rate")) or self._skin.rate

    def _publish(self, rows: FrequencyRows) -> None:
        self._frequencies.publish()
        if self._on_rows is not None:
            self._on_rows(rows)

    def _count_errors(self) -> int:
        """Return the number of errors of callbacks, in the main thread and in the reader's."""
        # Errors there do not pass through `callback_errors`, which serves the main thread.
        in_reader = 0 if self._links is None else self._links.callback_errors
        return self.callback_errors.count + in_reader

    def _publish_info(self) -> None:
        now_ns = self.get_clock().now().nanoseconds
        uids = self._published_uids
        self._info.publish(
            info_message(
                self._skin,
                self._pipeline,
                now_ns,
                uids,
                "driver",
            )
        )

    def _statuses(self) -> list[DiagnosticStatus]:
        """Return the status of all rows, and of each link while the node is active."""
        if self._links is None:
            return []
        self._node_clock.update()
        # Hubs report uids some time after the start; the reconstruction restores tares by them.
        if self._links.cube_uids != self._published_uids:
            self._published_uids = self._links.cube_uids
            self._publish_info()
        return self._link_diagnostics.statuses(self._links, with_links=self.is_active)


class FrequenciesPublisher:
    """Publishes `frequencies`: rows are written into the bytes of a message, and those are sent.

    One thread makes and publishes the rows.
    """

    def __init__(
        self,
        node: CubeNode,
        frame_id: str,
        profile: QoSProfile,
        always: bool,
    ) -> None:
        """Announce the topic; `always` publishes it whether or not anybody subscribes."""
        self._always = always
        self._has_subscribers = False
        self._frame_id = frame_id.encode() + b"\0"
        self._buffer = lru_cache(maxsize=MAX_BUFFERS)(self._make_buffer)
        # The message that holds the rows which the reader is filling.
        self._next: MessageBuffer[FrequencyRows] | None = None

        # DDS tells how many subscribe; asking at each message would cost more.
        events = on_matched(self._note_subscribers)
        self._publisher = node.own(
            node.create_lifecycle_publisher(
                SkinFrequencies, "frequencies", profile, event_callbacks=events
            )
        )
        if events is None:
            node.own(node.create_timer(COUNT_PERIOD_S, self._count_subscribers))

    def make_rows(self, n_rows: int, n_pads: int) -> FrequencyRows:
        """Return rows to fill, in the memory of the next message, valid until the next call."""
        self._next = self._buffer(n_rows, n_pads)
        return self._next.rows

    def publish(self) -> None:
        """Publish the rows that `make_rows` returned last."""
        if self._next is not None and (self._always or self._has_subscribers):
            self._publisher.publish(self._next.data())

    def _make_buffer(self, n_rows: int, n_pads: int) -> MessageBuffer[FrequencyRows]:
        return frequency_codec.buffer(self._frame_id, n_rows, n_pads)

    def _note_subscribers(self, count: int) -> None:
        self._has_subscribers = count > 0

    def _count_subscribers(self) -> None:
        self._note_subscribers(self._publisher.get_subscription_count())


def main() -> None:
    run(lambda: [Driver()])


if __name__ == "__main__":
    main()
