# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The node `reconstruction`: computes stress tensors and gradients from the pads' frequencies."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus

from ...config.parameters import RECONSTRUCTION
from ...core.arrays import Array
from ...core.compensation.motion import UNKNOWN_MOTION, ForcesAtCubes, Motion
from ...core.errors import BagError, CubeError, MessageError
from ...core.reconstructor import Reconstructor
from ...core.rows import FrequencyRows
from ...messages.codec import SECOND, frequency_codec
from ...messages.compensation import encode_compensation
from ...messages.skin_info import read_cube_poses
from ...msg import SkinCompensation, SkinFrequencies, SkinInfo
from ..callbacks import LOG_PERIOD_S
from ..compat import wrap_with_number
from ..diagnostics.reconstruction import (
    LostMessages,
    ReconstructionDiagnostics,
    log_changes,
)
from ..diagnostics.updater import Diagnostics
from ..messages import (
    CheckedSubscription,
    log_refused_message,
    make_info_message,
)
from ..motion import MissingMotion, make_motion_source
from ..node import CubeNode, run
from ..qos import LATCHED, count_scans_per_message
from .state_interfaces import make_state_interfaces
from .stress_publisher import StressPublisher
from .taring import Taring, find_tare_folder
from .touch_publisher import TouchPublisher

if TYPE_CHECKING:
    from ...bags.reprocess.recorded_reconstruction import RecordedReconstruction

MAX_SCANS = 1000
"""Maximum number of scans in a message of `frequencies`; a scan has one sample of every cube. A
message with more is refused, unless the parameter publish_period requires more.

The limit keeps a single message from blocking the node for long: the computation of one scan of
1280 cubes takes up to 0.3 ms.
"""

STATES_PERIOD_NS = 10 * SECOND
"""Time, in ns, between two messages with the states of the compensation of creep and temperature.

A recording can be processed again from any of these messages on, and gives the same stress bit for
bit.
"""

BAG_SUFFIXES = (".mcap", ".db3")
"""Suffixes of file names for which the parameter `config` is taken as the path of a bag (recording)
and not of a skin file. The path of a folder is also taken for a bag."""


class Reconstruction(CubeNode):
    """Publishes `stress`, `touch`, `info`, diagnostics, and stress and wrench of single cubes.

    It gets frequencies from the topic `frequencies`, or from a driver in the same process.
    """

    def __init__(self, subscribes: bool = True) -> None:
        """Make the node.

        Args:
            subscribes: Whether the node subscribes to `frequencies`. It is false if a driver node
                in the same process calls `on_rows` instead.
        """
        super().__init__("reconstruction", RECONSTRUCTION)
        self._subscribes = subscribes
        # The lock guards the reconstructor. It may be used in two threads: services run in the main
        # thread, and a driver node in this process calls `on_rows` in another thread.
        self._lock = threading.Lock()
        self._lost = LostMessages()
        self._updater = Diagnostics(self, self._make_statuses)

    def configure(self) -> None:
        recorded = self._recorded = self._open_recording()
        skin = self._skin = recorded.skin if recorded else self.read_skin()
        self._reconstructor = Reconstructor(skin)
        self._reconstructor.drift_time = float(self.read_value("drift_time"))
        # A message of the driver may contain one scan more than follows from publish_period and the
        # rate. The factor 2 allows hubs to send faster than the rate in the skin file.
        scans = count_scans_per_message(self.read_value("publish_period"), skin.rate)
        self._max_scans = max(MAX_SCANS, 2 * (scans + 1))

        profile = self.make_batch_profile(skin.rate, len(skin.cubes))
        self._publisher = StressPublisher(
            self,
            skin,
            self._reconstructor,
            profile,
            side=self.read_value("wrench_side") or None,
            with_forces=bool(self.read_value("forces")),
        )
        false_alarms = float(self.read_value("touch_false_alarms"))
        self._touch = None
        if false_alarms:
            self._touch = TouchPublisher(
                self,
                skin,
                profile,
                false_alarms,
                self._reconstructor,
            )
        self._state_interfaces = make_state_interfaces(self, skin)
        self._info = self.own(self.create_publisher(SkinInfo, "info", LATCHED))
        self._taring = Taring(
            self,
            skin,
            self._reconstructor,
            None if recorded else find_tare_folder(self.read_value("tare_folder")),
            self._lock,
            self._publish_info,
        )
        self._diagnostics = ReconstructionDiagnostics(
            skin,
            self._reconstructor,
            self._taring,
            self._lost,
        )
        info = CheckedSubscription(
            self,
            SkinInfo,
            "driver/info",
            self._taring.on_info,
            LATCHED,
        )
        self.call_at_cleanup(info.close)
        if self._subscribes:
            frequencies = self.create_subscription(
                SkinFrequencies,
                "frequencies",
                wrap_with_number(self._on_frequencies),
                profile,
                raw=True,
                event_callbacks=self._lost.begin_subscription(),
            )
            self.own(frequencies)
        info_now = self._publish_info()
        self._forces = ForcesAtCubes(read_cube_poses(info_now))
        self._motion = make_motion_source(self, skin.parent_frame)
        self._compensation = self.own(
            self.create_publisher(SkinCompensation, "compensation", profile)
        )
        self._states_ns = 0
        for cube in skin.cubes if self._motion else ():
            calibration = cube.calibration
            if calibration.weight is None:
                self.get_logger().warning(
                    f"cube {cube.name}: weight is not compensated, as its calibration "
                    f"{calibration.id} has no response to it: ./cube fem --load weight or "
                    "./cube fit --weight computes it"
                )
                break

    def on_parameter_change(self, name: str) -> None:
        self._reconstructor.drift_time = float(self.read_value("drift_time"))

    def on_rows(self, rows: FrequencyRows) -> None:
        """Compute and publish the stress for rows from a driver node in the same process.

        Args:
            rows: Rows of frequencies, one sample of one cube each. They are the rows of one message
                of `frequencies`.
        """
        if self.is_active:
            stamp_ns = int(rows.stamp_ns.min())
            frame_id = self._skin.parent_frame.encode() + b"\0"
            self._process(rows, stamp_ns, frame_id)

    def _on_frequencies(self, data: bytes, number: int | None) -> None:
        self._lost.note_arrival(number)
        try:
            message = frequency_codec.decode(data)
        except CubeError as error:
            self._refuse(error)
            return
        stamp_ns = int(message.stamp_ns[0])
        self._process(message.rows, stamp_ns, message.frame_id)

    def _process(
        self,
        rows: FrequencyRows,
        stamp_ns: int,
        frame_id: bytes,
    ) -> None:
        """Compute and publish the stress for the frequencies of one message.

        Args:
            rows: Rows of frequencies, one sample of one cube each.
            stamp_ns: Stamp of the message, in ns since the Unix epoch.
            frame_id: Frame id of the message, encoded and with a closing zero byte.
        """
        if not self.is_active:
            return
        try:
            self._check_scans(rows)
            with self._lock:
                recorded = self._recorded
                health = recorded.find_health(rows, self._reconstructor) if recorded else None
                out = self._publisher.make_rows(rows, frame_id)
                rows = self._note_compensation(rows, stamp_ns)
                rest_changes = self._reconstructor.rest_changes
                # Without the lock, the service for tares could change the rest frequencies during
                # the computation.
                stress = self._reconstructor.process(rows, health, out)
                if self._reconstructor.rest_changes != self._published_rest_changes:
                    self._publish_info()
        except CubeError as error:
            self._refuse(error)
            return
        # Touches are published first, because a robot that reacts to them needs the lowest latency.
        if self._touch is not None:
            self._touch.publish(stress, rest_changes)
        self._publisher.publish(stamp_ns)
        if self._state_interfaces is not None:
            self._state_interfaces.publish(stress, stamp_ns)
        self._diagnostics.count(stress)

    def _note_compensation(
        self,
        rows: FrequencyRows,
        stamp_ns: int,
    ) -> FrequencyRows:
        """Publish the data of the compensation, and add to each row the specific force at its cube.

        The message `compensation` contains what a recording needs to repeat the compensation of
        these rows: the motion of the skin, and at intervals the states of creep and temperature.
        If the weight is not compensated, the rows are returned as they are.

        Args:
            rows: Rows of frequencies, one sample of one cube each.
            stamp_ns: Stamp of their message, in ns since the Unix epoch.
        """
        compensation = self._reconstructor.compensation
        problem = ""
        motion: Motion | None = None
        if self._recorded:
            motion = self._recorded.find_compensation(stamp_ns, self._reconstructor)
        elif self._motion:
            try:
                last_ns = int(rows.stamp_ns.max(initial=stamp_ns))
                motion = self._motion.compute_motion(stamp_ns, last_ns)
            except MissingMotion as error:
                motion = UNKNOWN_MOTION
                problem = f"weight is not compensated: {error}"
                self.get_logger().warning(problem, throttle_duration_sec=LOG_PERIOD_S)
        self._diagnostics.compensation_problem = problem
        # Only a recorder needs the message.
        if self._compensation.get_subscription_count():
            states: Mapping[str, Array] = {}
            if abs(stamp_ns - self._states_ns) >= STATES_PERIOD_NS:
                self._states_ns = stamp_ns
                states = compensation.collect_states()
            if motion is not None or states:
                frame_id = self._skin.parent_frame
                data = encode_compensation(frame_id, stamp_ns, motion, states)
                self._compensation.publish(data)
        return rows if motion is None else self._forces.add_to(rows, motion)

    def _refuse(self, error: CubeError) -> None:
        self._diagnostics.refused_messages += 1
        log_refused_message(self, "frequencies", error)

    def _check_scans(self, rows: FrequencyRows) -> None:
        """Check that a message does not have too many scans, see `MAX_SCANS`.

        Args:
            rows: Rows of frequencies, one sample of one cube each.

        Raises:
            MessageError: The message has more than the allowed number of rows of one cube.
        """
        # Counting the rows of each cube takes time. Almost all messages have so few rows in total
        # that no cube can have too many.
        if len(rows) <= self._max_scans:
            return
        counts = np.bincount(rows.cube)
        n_scans = counts.max()
        if n_scans > self._max_scans:
            raise MessageError(
                f"a message has {n_scans} rows of cube {counts.argmax()}, the limit is "
                f"{self._max_scans}: set parameter publish_period to the driver's"
            )

    def _publish_info(self) -> SkinInfo:
        # The stamp of `info` is the time from which on its rest frequencies are valid: 1 ns after
        # the last row that was computed with others. Reprocessing of a bag relies on it.
        newest_ns = self._reconstructor.health.newest_ns
        since_ns = newest_ns + 1 if newest_ns else self.get_clock().now().nanoseconds
        self._published_rest_changes = self._reconstructor.rest_changes
        info = make_info_message(
            self._skin,
            self._reconstructor.pipeline,
            since_ns,
            self._taring.uids,
        )
        self._info.publish(info)
        return info

    def _make_statuses(self) -> list[DiagnosticStatus]:
        if not self.is_configured:
            return []
        with self._lock:
            statuses, changes = self._diagnostics.make_statuses(self.is_active)
        # Logging is slow, so it is done after the lock is released: a driver node in this process
        # may wait for the lock in another thread.
        log_changes(self.get_logger(), changes)
        return statuses

    def _open_recording(self) -> RecordedReconstruction | None:
        """Return the skin, tares and drift recorded in the bag that the parameter `config` names.

        None means that `config` names a skin file.

        Raises:
            BagError: The bag cannot be read, or the library that reads bags is not installed.
        """
        path = self.find_config()
        if not path.is_dir() and path.suffix not in BAG_SUFFIXES:
            return None
        # The import is here and not at the top, because the library that reads bags may be missing:
        # it has no rosdep key, and is needed only if `config` names a bag.
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
    """Run the node `reconstruction`."""
    run(lambda: [Reconstruction()])


if __name__ == "__main__":
    main()
