"""The reconstruction node: raw frequencies in, stress tensors and gradients out."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus

from ...config.parameters import RECONSTRUCTION
from ...config.skin import read_skin
from ...core.errors import BagError, CubeError, MessageError
from ...core.reconstructor import Reconstructor
from ...core.rows import FrequencyRows
from ...messages.codec import frequency_codec
from ...msg import SkinFrequencies, SkinInfo
from ..compat import with_number
from ..diagnostics.reconstruction import (
    LostMessages,
    ReconstructionDiagnostics,
    log_changes,
)
from ..diagnostics.updater import Diagnostics
from ..messages import info_message, log_refused_message
from ..node import CubeNode, run
from ..qos import LATCHED, scans_per_message
from .stress_publisher import StressPublisher
from .taring import Taring, tare_folder

if TYPE_CHECKING:
    from ...bags.reprocess.recorded_reconstruction import RecordedReconstruction

MAX_SCANS = 1000
"""Maximum number of rows of one cube in a message, unless publish_period needs more.

One row for each of 1280 cubes takes up to 0.3 ms, and the node does nothing else meanwhile.
"""

BAG_SUFFIXES = (".mcap", ".db3")
"""Suffixes of the files of bags. A folder is a bag, too."""


class Reconstruction(CubeNode):
    """Publishes `stress`, `info`, diagnostics, and the stress and wrench of single cubes."""

    def __init__(self, subscribes: bool = True) -> None:
        """Make the node; it does not subscribe where a driver in this process calls `on_rows`."""
        super().__init__("reconstruction", RECONSTRUCTION)
        self._subscribes = subscribes
        # In one process with the driver, its thread calls `on_rows`; services run in the main one.
        self._lock = threading.Lock()
        self._lost = LostMessages()
        self._updater = Diagnostics(self, self._statuses, lambda: self.callback_errors.count)

    def configure(self) -> None:
        self._recorded = self._open_recording()
        skin = self._skin = self._recorded.skin if self._recorded else read_skin(self.config())
        self._reconstructor = Reconstructor(skin)
        self._reconstructor.drift_time = float(self.value("drift_time"))
        # One scan more than asked for, as drivers may gather it; twice, because rates vary.
        scans = scans_per_message(self.value("publish_period"), skin.rate)
        self._max_scans = max(MAX_SCANS, 2 * (scans + 1))

        profile = self.batch_profile(skin.rate, len(skin.cubes))
        self._publisher = StressPublisher(
            self,
            skin,
            self._reconstructor,
            profile,
            side=self.value("wrench_side") or None,
            with_forces=bool(self.value("forces")),
        )
        self._info = self.own(self.create_publisher(SkinInfo, "info", LATCHED))
        self._taring = Taring(
            self,
            skin,
            self._reconstructor,
            None if self._recorded else tare_folder(self.value("tare_folder")),
            self._lock,
            self._publish_info,
        )
        self._diagnostics = ReconstructionDiagnostics(
            skin, self._reconstructor, self._taring, self._lost
        )
        self.own(
            self.create_subscription(
                SkinInfo,
                "driver/info",
                self._taring.on_info,
                LATCHED,
            )
        )
        if self._subscribes:
            frequencies = self.create_subscription(
                SkinFrequencies,
                "frequencies",
                with_number(self._on_frequencies),
                profile,
                raw=True,
                event_callbacks=self._lost.new_subscription(),
            )
            self.own(frequencies)
        self._publish_info()

    def on_parameter_change(self, name: str) -> None:
        self._reconstructor.drift_time = float(self.value("drift_time"))

    def on_rows(self, rows: FrequencyRows) -> None:
        """Process rows of a driver in the same process, as it would put them into one message."""
        if self.is_active:
            frame_id = self._skin.parent_frame.encode() + b"\0"
            self._process(rows, int(rows.stamp_ns.min()), frame_id)

    def _on_frequencies(self, data: bytes, number: int | None) -> None:
        self._lost.note_arrival(number)
        try:
            message = frequency_codec.decode(data)
        except CubeError as error:
            self._refuse(error)
            return
        self._process(message.rows, int(message.stamp_ns[0]), message.frame_id)

    def _process(
        self,
        rows: FrequencyRows,
        stamp_ns: int,
        frame_id: bytes,
    ) -> None:
        """Publish the stress of the rows of one message, with its stamp and frame."""
        if not self.is_active:
            return
        try:
            self._check_scans(rows)
            with self._lock:
                recorded = self._recorded
                health = recorded.health_at(rows, self._reconstructor) if recorded else None
                # A tare between two steps of this would mix old and new.
                stress = self._reconstructor.process(rows, health)
                if self._reconstructor.rest_changes != self._published_rest_changes:
                    self._publish_info()
        except CubeError as error:
            self._refuse(error)
            return
        self._publisher.publish(stress, stamp_ns, frame_id)
        self._diagnostics.count(stress)

    def _refuse(self, error: CubeError) -> None:
        self._diagnostics.refused_messages += 1
        log_refused_message(self, "frequencies", error)

    def _check_scans(self, rows: FrequencyRows) -> None:
        """Raise MessageError if a message has too many rows of one cube."""
        # Almost all messages end here: so few rows cannot be too many of one cube.
        if len(rows) <= self._max_scans:
            return
        counts = np.bincount(rows.cube)
        if counts.max() > self._max_scans:
            raise MessageError(
                f"a message has {counts.max()} rows of cube {counts.argmax()}, the limit is "
                f"{self._max_scans}: set parameter publish_period to the driver's"
            )

    def _publish_info(self) -> None:
        # One ns after the last row without these rest frequencies: a bag says from which row on
        # they hold.
        newest_ns = self._reconstructor.health.newest_ns
        since_ns = newest_ns + 1 if newest_ns else self.get_clock().now().nanoseconds
        self._published_rest_changes = self._reconstructor.rest_changes
        info = info_message(
            self._skin,
            self._reconstructor.pipeline,
            since_ns,
            self._taring.uids,
        )
        self._info.publish(info)

    def _statuses(self) -> list[DiagnosticStatus]:
        if not self.is_configured:
            return []
        with self._lock:
            statuses, changes = self._diagnostics.statuses(self.is_active)
        # Outside of the lock, for which the thread of a driver in this process may wait.
        log_changes(self.get_logger(), changes)
        return statuses

    def _open_recording(self) -> RecordedReconstruction | None:
        """Return what a bag says about its reconstruction, or None if `config` is a skin file.

        Raises:
            BagError: The path is no bag, or the library that reads bags is missing.
        """
        path = self.config()
        if not path.is_dir() and path.suffix not in BAG_SUFFIXES:
            return None
        # Imported here because no other node or parameter needs the library for bags, which has no
        # rosdep key.
        try:
            from ...bags.reprocess.recorded_reconstruction import RecordedReconstruction
        except ModuleNotFoundError as error:
            raise BagError(
                f"config: {path} is a bag, and reading it needs the Python package {error.name}: "
                "pip install 'rosbags>=0.11,<0.12' 'mcap>=1.6,<2' zstandard"
            ) from None

        recorded = RecordedReconstruction(path)
        self.call_at_cleanup(recorded.close)
        return recorded


def main() -> None:
    run(lambda: [Reconstruction()])


if __name__ == "__main__":
    main()
