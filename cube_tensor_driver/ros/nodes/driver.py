# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The node `driver`: reads the hubs of a skin and publishes the frequencies of the pads."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.qos import QoSProfile

from ...config.parameters import DRIVER
from ...core.pipeline import Pipeline
from ...core.rows import FrequencyRows
from ...device.chain import LiveLinks
from ...device.live import make_cube_addresses, make_link_configs
from ...messages.codec import MessageBuffer, frequency_codec
from ...msg import SkinFrequencies, SkinInfo
from ..diagnostics.links import LinkDiagnostics
from ..diagnostics.updater import Diagnostics
from ..messages import make_info_message
from ..node import (
    MAX_BUFFERS,
    CubeNode,
    NodeClock,
    run,
)
from ..qos import LATCHED, count_scans_per_message


class Driver(CubeNode):
    """Publishes `frequencies`, `driver/info` and diagnostics.

    The thread that reads the links (the reader's thread) publishes the frequencies. The main thread
    spins the node.
    """

    def __init__(self, on_rows: Callable[[FrequencyRows], None] | None = None) -> None:
        """Make the node.

        Args:
            on_rows: Called in the thread that reads the links, with the rows (samples of one cube
                each) of a message. Their arrays are overwritten after it has returned. If it is
                given, the topic `frequencies` is published only while it has subscribers; with None
                it is published always.
        """
        super().__init__("driver", DRIVER)
        self._on_rows = on_rows
        self._node_clock = NodeClock(self)
        self._diagnostics = Diagnostics(self, self._make_statuses)

    @property
    def failure(self) -> Exception | None:
        return self._links.failure if self.is_configured else None

    def configure(self) -> None:
        skin = self._skin = self.read_skin()
        self._pipeline = Pipeline([cube.calibration for cube in skin.cubes])
        rate_hz = self._choose_rate()
        self._frequencies = FrequenciesPublisher(
            self,
            skin.parent_frame,
            self.make_batch_profile(rate_hz, len(skin.cubes)),
            always=self._on_rows is None,
        )
        self._info = self.own(self.create_publisher(SkinInfo, "driver/info", LATCHED))
        self._links = LiveLinks(
            make_link_configs(
                skin,
                self.read_value("port"),
                self.read_value("port_directory"),
            ),
            make_cube_addresses(skin),
            self._publish,
            rate=rate_hz,
            # Gathering several scans (samples of all cubes) in a message saves CPU time, but adds
            # latency, so the user decides on it by the parameter publish_period.
            scans_per_call=count_scans_per_message(self.read_value("publish_period"), rate_hz),
            make_rows=self._frequencies.make_rows,
            clock_ns=self._node_clock.now_ns,
            is_host_clock=lambda: not self._node_clock.is_simulated,
            log=self.get_logger(),
        )
        self._link_diagnostics = LinkDiagnostics(skin.name)
        self._published_uids: dict[int, int] = {}
        self._publish_info()

    def activate(self) -> None:
        self._node_clock.update()
        self._links.start()

    def deactivate(self) -> None:
        self._links.close()

    def on_parameter_change(self, name: str) -> None:
        """Ask the hubs for the new sampling rate.

        The depth of the topics' queues, which follows from the sampling rate, is not changed: that
        would need new publishers.
        """
        self._links.set_rate(self._choose_rate())

    def _choose_rate(self) -> float | None:
        """Return the sampling rate, in Hz, that hubs are asked for; None: each hub chooses one."""
        return float(self.read_value("rate")) or self._skin.rate

    def _publish(self, rows: FrequencyRows) -> None:
        self._frequencies.publish()
        if self._on_rows is not None:
            self._on_rows(rows)

    def count_errors(self) -> int:
        """Return the number of exceptions in callbacks in both threads: main thread and reader."""
        in_reader = self._links.callback_errors if self.is_configured else 0
        return super().count_errors() + in_reader

    def _publish_info(self) -> None:
        now_ns = self.get_clock().now().nanoseconds
        uids = self._published_uids
        self._info.publish(
            make_info_message(
                self._skin,
                self._pipeline,
                now_ns,
                uids,
                "driver",
            )
        )

    def _make_statuses(self) -> list[DiagnosticStatus]:
        """Return the diagnostics: a status about all rows (samples), and while the node is active
        one for each link (connection to a hub)."""
        if not self.is_configured:
            return []
        self._node_clock.update()
        # Hubs report the uids (unique numbers) of cubes some time after the start. The
        # reconstruction finds the tare files by them, so `driver/info` is published again.
        if self._links.cube_uids != self._published_uids:
            self._published_uids = self._links.cube_uids
            self._publish_info()
        return self._link_diagnostics.make_statuses(self._links, with_links=self.is_active)


class FrequenciesPublisher:
    """Publishes `frequencies` without copying: the caller writes rows into the serialised message.

    A row is one sample of one cube. `make_rows` and `publish` must be called from the same thread.
    """

    def __init__(
        self,
        node: CubeNode,
        frame_id: str,
        profile: QoSProfile,
        always: bool,
    ) -> None:
        """Make the publisher.

        Args:
            node: The node, which is being configured.
            frame_id: Frame id in the header of the messages.
            profile: Quality of service of the topic.
            always: Whether messages are published even while the topic has no subscribers.
        """
        self._always = always
        self._frame_id = frame_id.encode() + b"\0"
        self._buffer = lru_cache(maxsize=MAX_BUFFERS)(self._make_buffer)
        # The message into which the caller of `make_rows` writes rows now; None before its first
        # call.
        self._next: MessageBuffer[FrequencyRows] | None = None
        self._publisher = node.own(
            node.create_lifecycle_publisher(SkinFrequencies, "frequencies", profile)
        )

    def make_rows(self, n_rows: int, n_pads: int) -> FrequencyRows:
        """Return rows for the caller to fill; their arrays are views of the next message's bytes.

        Args:
            n_rows: Number of rows (samples of one cube each).
            n_pads: Number of frequencies per row.

        Returns:
            The rows, which are valid until the next call of this method.
        """
        self._next = self._buffer(n_rows, n_pads)
        return self._next.rows

    def publish(self) -> None:
        """Publish the message whose rows `make_rows` returned last and the caller has filled."""
        if self._next is None:
            return
        if self._always or self._publisher.get_subscription_count():
            self._publisher.publish(self._next.encode())

    def _make_buffer(
        self,
        n_rows: int,
        n_pads: int,
    ) -> MessageBuffer[FrequencyRows]:
        return frequency_codec.make_buffer(self._frame_id, n_rows, n_pads)


def main() -> None:
    """Run the node `driver`."""
    run(lambda: [Driver()])


if __name__ == "__main__":
    main()
