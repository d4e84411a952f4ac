"""The reconstruction node: raw frequencies in, stress tensors and gradients out."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.event_handler import SubscriptionEventCallbacks

from cube_tensor_driver.msg import SkinFrequencies, SkinInfo

from ..bags.message_codec import frequency_codec
from ..config.skin import read_skin
from ..core.errors import CubeError
from ..core.reconstructor import Reconstructor
from ..core.rows import FrequencyRows
from .diagnostics import Diagnostics
from .messages import info_message
from .node import LATCHED, CubeNode, queue, run, scans_per_message
from .parameters import RECONSTRUCTION
from .reconstruction_diagnostics import ReconstructionDiagnostics
from .stress_publisher import StressPublisher
from .taring import Taring, tare_folder

if TYPE_CHECKING:
    from ..bags.recorded_health import RecordedReconstruction

BAGS = (".mcap", ".db3")


class Reconstruction(CubeNode):
    """Publishes `stress`, `info`, diagnostics, and per cube `cubes/<name>/stress` and `.../wrench`."""

    def __init__(self, subscribes: bool = True) -> None:
        """subscribes: False when a driver in the same process calls `on_rows`."""
        super().__init__("reconstruction", RECONSTRUCTION)
        self._subscribes = subscribes
        self._active = False
        # In one process with the driver, its thread calls `on_rows`; services run in the main one.
        self._lock = threading.Lock()
        self._updater = Diagnostics(self, self._statuses)

    def configure(self) -> None:
        path = self.config()
        recorded = self._recorded = _recorded(path)
        skin = self._skin = recorded.skin if recorded else read_skin(path)
        self._reconstructor = Reconstructor(skin)
        self._reconstructor.drift_time = float(self.value("drift_time"))
        self._rest_published = self._reconstructor.rest_changes
        scans = scans_per_message(self.value("publish_period"), skin.rate)
        rate = None if skin.rate is None else skin.rate / scans
        quality = queue(rate, self.value("qos_reliability"), scans * len(skin.cubes))
        side = self.value("wrench_side") or None
        self._publisher = StressPublisher(self, skin, self._reconstructor, quality, side)
        self._info = self.create_publisher(SkinInfo, "info", LATCHED)
        folder = None if recorded else tare_folder(self.value("tare_folder"))
        self._taring = Taring(
            self, skin, self._reconstructor, folder, self._lock, self._publish_info
        )
        self._diagnostics = ReconstructionDiagnostics(skin, self._reconstructor, self._taring)
        self._listening = [
            self.create_subscription(SkinInfo, "info", self._taring.on_info, LATCHED)
        ]
        if self._subscribes:
            lost = SubscriptionEventCallbacks(message_lost=self._on_lost)
            frequencies = self.create_subscription(
                SkinFrequencies,
                "frequencies",
                self._on_frequencies,
                quality,
                raw=True,
                event_callbacks=lost,
            )
            self._listening.append(frequencies)
        self._publish_info()

    def changed(self, name: str) -> None:
        self._reconstructor.drift_time = float(self.value("drift_time"))

    def activate(self) -> None:
        self._active = True

    def deactivate(self) -> None:
        self._active = False

    def cleanup(self) -> None:
        if not self.configured:
            return
        for subscription in self._listening:
            self.destroy_subscription(subscription)
        self._publisher.close()
        self._taring.close()
        self.destroy_publisher(self._info)
        if self._recorded is not None:
            self._recorded.close()

    def _on_frequencies(self, data: bytes) -> None:
        """One message, serialised."""
        try:
            message = frequency_codec.decode(data)
        except CubeError as error:
            self._refuse(error)
            return
        self._publish(message.rows, int(message.stamp_ns[0]), message.frame_id)

    def on_rows(self, rows: FrequencyRows) -> None:
        """Rows of a driver in the same process, as it would put them into one message."""
        frame_id = self._skin.parent_frame.encode() + b"\0"
        self._publish(rows, int(rows.stamp_ns.min()), frame_id)

    def _publish(self, rows: FrequencyRows, stamp_ns: int, frame_id: bytes) -> None:
        """Publish the stress of the rows of one message; stamp and frame of the message are kept."""
        if not self._active:
            return
        try:
            with self._lock:
                recorded = self._recorded
                verdicts = recorded.verdicts(rows, self._reconstructor) if recorded else None
                stress = self._reconstructor.process(rows, verdicts)
                if self._reconstructor.rest_changes != self._rest_published:
                    self._publish_info()
        except CubeError as error:
            self._refuse(error)
            return
        self._publisher.publish(stress, stamp_ns, frame_id)
        self._diagnostics.count(stress)

    def _refuse(self, error: CubeError) -> None:
        self._diagnostics.bad_messages += 1
        self.get_logger().error(f"frequencies: {error}", throttle_duration_sec=5.0)

    def _publish_info(self) -> None:
        # Just behind the last row that was made without it: a bag says from which row on it holds.
        newest_ns = self._reconstructor.health.newest_ns
        since_ns = newest_ns + 1 if newest_ns else self.get_clock().now().nanoseconds
        self._rest_published = self._reconstructor.rest_changes
        self._info.publish(
            info_message(self._skin, self._reconstructor.pipeline, since_ns, self._taring.uids)
        )

    def _on_lost(self, event: Any) -> None:
        """Messages are gone for good: the network or this node was away longer than queues hold."""
        self._diagnostics.lost_messages = event.total_count

    def _statuses(self) -> list[DiagnosticStatus]:
        if not self.configured:
            return []
        with self._lock:
            statuses, lines = self._diagnostics.statuses()
        for line, bad in lines:
            # rclpy ties a level to a line of code.
            if bad:
                self.get_logger().warning(line)
            else:
                self.get_logger().info(line)
        return statuses


def _recorded(path: Path) -> RecordedReconstruction | None:
    """What a bag says about its reconstruction; None for a skin file. BagError: no bag."""
    if not path.is_dir() and path.suffix not in BAGS:
        return None
    # Imported here because it loads much that a node does not need otherwise.
    from ..bags.recorded_health import RecordedReconstruction

    return RecordedReconstruction(path)


def main() -> None:
    run(lambda: [Reconstruction()])


if __name__ == "__main__":
    main()
