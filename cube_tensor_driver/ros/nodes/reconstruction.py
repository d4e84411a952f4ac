"""The reconstruction node: raw frequencies in, stress tensors and gradients out."""

from __future__ import annotations

import threading
from contextlib import ExitStack

from diagnostic_msgs.msg import DiagnosticStatus

from ...config.parameters import RECONSTRUCTION
from ...config.skin import read_skin
from ...core.errors import CubeError
from ...core.reconstructor import Reconstructor
from ...core.rows import FrequencyRows
from ...messages.codec import frequency_codec
from ...msg import SkinFrequencies, SkinInfo
from ..compat import with_number
from ..diagnostics.lost_messages import LostMessages
from ..diagnostics.reconstruction import ReconstructionDiagnostics, log_changes
from ..diagnostics.updater import Diagnostics
from ..messages import info_message
from ..node import LATCHED, CubeNode, batch_queue, run
from .message_limit import check_scans, scan_limit
from .recorded import open_recording
from .stress_publisher import StressPublisher
from .taring import Taring, tare_folder


class Reconstruction(CubeNode):
    """Publishes `stress`, `info`, diagnostics, and the stress and wrench of single cubes."""

    def __init__(self, subscribes: bool = True) -> None:
        """subscribes: False when a driver in the same process calls `on_rows`."""
        super().__init__("reconstruction", RECONSTRUCTION)
        self._subscribes = subscribes
        self._active = False
        # In one process with the driver, its thread calls `on_rows`; services run in the main one.
        self._lock = threading.Lock()
        self._configured = ExitStack()
        self._lost = LostMessages()
        self._updater = Diagnostics(self, self._statuses, lambda: self.guard.errors)

    def configure(self) -> None:
        made = self._configured
        self._recorded = open_recording(self.config(), made)
        skin = self._skin = self._recorded.skin if self._recorded else read_skin(self.config())
        reconstructor = self._reconstructor = Reconstructor(skin)
        reconstructor.drift_time = float(self.value("drift_time"))
        quality = batch_queue(self, skin.rate, len(skin.cubes))
        self._scan_limit = scan_limit(self, skin.rate)
        side = self.value("wrench_side") or None
        self._publisher = StressPublisher(
            self, skin, reconstructor, quality, side, bool(self.value("forces"))
        )
        made.callback(self._publisher.close)
        self._info = self.create_publisher(SkinInfo, "info", LATCHED)
        made.callback(self.destroy_publisher, self._info)
        folder = None if self._recorded else tare_folder(self.value("tare_folder"))
        self._taring = Taring(self, skin, reconstructor, folder, self._lock, self._publish_info)
        made.callback(self._taring.close)
        self._diagnostics = ReconstructionDiagnostics(skin, reconstructor, self._taring, self._lost)
        uids = self.create_subscription(SkinInfo, "driver/info", self._taring.on_info, LATCHED)
        made.callback(self.destroy_subscription, uids)
        if self._subscribes:
            frequencies = self.create_subscription(
                SkinFrequencies,
                "frequencies",
                with_number(self._on_frequencies),
                quality,
                raw=True,
                event_callbacks=self._lost.new_subscription(),
            )
            made.callback(self.destroy_subscription, frequencies)
        self._publish_info()

    def changed(self, name: str) -> None:
        self._reconstructor.drift_time = float(self.value("drift_time"))

    def activate(self) -> None:
        self._active = True

    def deactivate(self) -> None:
        self._active = False

    def cleanup(self) -> None:
        self._configured.close()

    def _on_frequencies(self, data: bytes, number: int | None) -> None:
        self._lost.came(number)
        try:
            message = frequency_codec.decode(data)
        except CubeError as error:
            self._refuse(error)
            return
        self._publish(message.rows, int(message.stamp_ns[0]), message.frame_id)

    def on_rows(self, rows: FrequencyRows) -> None:
        """Rows of a driver in the same process, as it would put them into one message."""
        if self._active:
            frame_id = self._skin.parent_frame.encode() + b"\0"
            self._publish(rows, int(rows.stamp_ns.min()), frame_id)

    def _publish(self, rows: FrequencyRows, stamp_ns: int, frame_id: bytes) -> None:
        """Publish the stress of the rows of one message, with its stamp and frame."""
        if not self._active:
            return
        try:
            check_scans(rows, self._scan_limit)
            with self._lock:
                recorded = self._recorded
                health = recorded.health_at(rows, self._reconstructor) if recorded else None
                stress = self._reconstructor.process(rows, health)
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
        info = info_message(self._skin, self._reconstructor.pipeline, since_ns, self._taring.uids)
        self._info.publish(info)

    def _statuses(self) -> list[DiagnosticStatus]:
        if not self.configured:
            return []
        with self._lock:
            statuses, changes = self._diagnostics.statuses()
        log_changes(self.get_logger(), changes)
        return statuses


def main() -> None:
    run(lambda: [Reconstruction()])


if __name__ == "__main__":
    main()
