"""The reconstruction node: raw frequencies in, stress tensors and gradients out."""

from __future__ import annotations

import threading
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.event_handler import SubscriptionEventCallbacks

from cube_tensor_driver.msg import SkinFrequencies, SkinInfo, SkinStress

from ..bags.message_codec import frequency_codec, stress_codec
from ..config.skin import read_skin
from ..core.errors import CubeError
from ..core.health import Health
from ..core.pipeline import Pipeline
from ..core.rows import FrequencyRows, StressRows
from ..core.status import INVALID
from ..core.tare import DriftTracker
from .cube_health import CubeHealth
from .cube_topics import CubeTopics
from .diagnostics import Diagnostics, make_status
from .messages import info_message
from .node import BUFFERS_KEPT, LATCHED, CubeNode, queue, run, scans_per_message
from .taring import Taring, tare_folder

if TYPE_CHECKING:
    from ..bags.recorded_health import RecordedHealth

BAGS = (".mcap", ".db3")
LISTENERS_S = 0.5
"""How often it is looked up which cubes' own topics anybody listens to."""


class Reconstruction(CubeNode):
    """Publishes `stress`, `info`, diagnostics, and per cube `cubes/<name>/stress` and
    `cubes/<name>/wrench`."""

    def __init__(self, subscribes: bool = True) -> None:
        """subscribes: False when `take` is called by a driver in the same process."""
        super().__init__("reconstruction")
        self._subscribes = subscribes
        self.declare(
            "autostart",
            True,
            "Configure and activate at once; false waits for lifecycle transitions.",
        )
        self.declare(
            "config",
            "",
            "Skin file (YAML), or a bag: then replayed frequencies give the recorded stress.",
        )
        self.declare(
            "wrench_side",
            0.0,
            "Side of the face that wrenches refer to, m; 0: the cube's own.",
            (0.0, 10.0),
        )
        self.declare(
            "publish_period", 0.0, "The driver's, for how long queues must be, s.", (0.0, 1.0)
        )
        self.declare(
            "qos_reliability",
            "reliable",
            "Reliability of the batch topics.",
            choices="reliable, best_effort",
        )
        self.declare(
            "tare_duration",
            1.0,
            "What ~/tare averages over unless it is told, s.",
            (0.5, 10.0),
            live=True,
        )
        self.declare(
            "tare_folder", "", "Where tare is kept, by uid; empty: ~/.ros/cube_tensor_driver/tare."
        )
        self.declare(
            "drift_time",
            0.0,
            "Time constant with which rest frequencies follow slow drift while nothing "
            "touches a cube, s; 0: never.",
            (0.0, 1e6),
            live=True,
        )
        self._active = False
        self._recorded: RecordedHealth | None = None
        # In one process with the driver its thread calls `take`, while services run in the main
        # thread.
        self._lock = threading.Lock()
        self._diagnostics = Diagnostics(self, self._statuses)

    def configure(self) -> None:
        path, folder = self.config(), tare_folder(self.value("tare_folder"))
        recorded = self._recorded = _recorded(path)
        skin = self._skin = recorded.skin if recorded else read_skin(path)
        self._pipeline = (
            recorded.pipeline
            if recorded
            else Pipeline([cube.calibration for cube in skin.cubes], np.float32)
        )
        self._health = recorded or Health(self._pipeline)
        self._rows = self._rows_before = self._invalid = self._bad_messages = 0
        self._lost_messages = self._lost_before = 0
        turns = scans_per_message(self.value("publish_period"), skin.rate)
        rate = None if skin.rate is None else skin.rate / turns
        quality = queue(rate, self.value("qos_reliability"), turns * len(skin.cubes))
        self._blank = lru_cache(maxsize=BUFFERS_KEPT)(stress_codec.buffer)
        self._stress = self.create_lifecycle_publisher(SkinStress, "stress", quality)
        self._info = self.create_publisher(SkinInfo, "info", LATCHED)
        self._cubes = CubeTopics(self, skin, self._pipeline, self.value("wrench_side") or None)
        self._drift = DriftTracker(self._pipeline, self._health)
        self._drift_time = float(self.value("drift_time"))
        self._words = CubeHealth(skin, self._pipeline, self._health)
        self._taring = Taring(
            self,
            skin,
            self._pipeline,
            self._health,
            None if recorded else folder,
            lambda: float(self.value("tare_duration")),
            self._publish_info,
            self._lock,
        )
        self._listening = self.create_subscription(SkinInfo, "info", self._taring.on_info, LATCHED)
        if self._subscribes:
            lost = SubscriptionEventCallbacks(message_lost=self._on_lost)
            self._subscription = self.create_subscription(
                SkinFrequencies, "frequencies", self.take, quality, raw=True, event_callbacks=lost
            )
        self._looking = self.create_timer(LISTENERS_S, self._cubes.find_listeners)
        self._publish_info()

    def changed(self, name: str) -> None:
        self._drift_time = float(self.value("drift_time"))

    def activate(self) -> None:
        self._active = True

    def deactivate(self) -> None:
        self._active = False

    def cleanup(self) -> None:
        if hasattr(self, "_looking"):
            if self._subscribes:
                self.destroy_subscription(self._subscription)
            self.destroy_subscription(self._listening)
            self._taring.close()
            self.destroy_timer(self._looking)
            for publisher in (self._stress, self._info):
                self.destroy_publisher(publisher)
            self._cubes.close()
            if self._recorded is not None:
                self._recorded.close()
            del self._looking

    def take(self, data: bytes) -> None:
        """Publish the tensors of one message of frequencies, as it comes: serialised."""
        try:
            message = frequency_codec.decode(data)
        except CubeError as error:
            self._refuse(error)
            return
        self.take_rows(message.rows, int(message.stamp_ns[0]), message.frame_id)

    def on_rows(self, rows: FrequencyRows) -> None:
        """Publish the tensors of rows that come from a driver in the same process."""
        frame_id = self._skin.parent_frame.encode() + b"\0"
        self.take_rows(rows, int(rows.stamp_ns.min()), frame_id)

    def take_rows(self, given: FrequencyRows, stamp_ns: int, frame_id: bytes) -> None:
        """Publish the tensors of rows; stamp and frame of their message are its own, too."""
        if not self._active:
            return
        cube = given.cube
        try:
            with self._lock:
                windows = self._health.closed
                pad_fault, status = self._health.update(
                    cube, given.frequency, given.pad_fault, given.stamp_ns, given.temperature
                )
                rows = self._pipeline.process(cube, given.frequency, pad_fault, given.temperature)
                self._health.residual(cube, rows.status)
                rows.status[:] |= status
                if (
                    self._drift_time
                    and self._health.closed != windows
                    and self._drift.step(self._drift_time)
                ):
                    self._publish_info()
        except CubeError as error:
            self._refuse(error)
            return
        stress = StressRows(cube, given.sequence, given.stamp_ns, *rows, pad_fault)
        message = self._blank(frame_id, len(cube))
        message.fill(stress)
        self._stress.publish(message.data(stamp_ns))
        self._rows += len(cube)
        self._invalid += int(np.count_nonzero(rows.status & INVALID))
        self._cubes.publish(given, stress, pad_fault)

    def _refuse(self, error: CubeError) -> None:
        self._bad_messages += 1
        self.get_logger().error(f"frequencies: {error}", throttle_duration_sec=5.0)

    def _publish_info(self) -> None:
        # Just behind the last row that was made without it: so a bag says from which row on it
        # holds.
        since_ns = (
            self._health.newest_ns + 1
            if self._health.newest_ns
            else self.get_clock().now().nanoseconds
        )
        self._info.publish(info_message(self._skin, self._pipeline, since_ns, self._taring.uids))

    def _on_lost(self, event: Any) -> None:
        """DDS says that messages are gone for good: the network or this node was away for longer
        than queues hold."""
        self._lost_messages = event.total_count

    def _statuses(self) -> list[DiagnosticStatus]:
        """For diagnostics, of the whole and of cubes that are not fine; what was found since the
        last time."""
        if not self.configured:
            return []
        with self._lock:
            statuses, lines = self._words.statuses(self._taring.uids)
            summary = self._words.summary()
        for line, bad in lines:
            if bad:
                self.get_logger().warning(line)
            else:
                self.get_logger().info(line)
        rate, self._rows_before = self._rows - self._rows_before, self._rows
        values = {
            "rows": self._rows,
            "rows per second": rate,
            "invalid rows": self._invalid,
            "messages lost on the way": self._lost_messages,
            "messages that contradict themselves": self._bad_messages,
            **self._taring.age(),
            **summary,
        }
        news, self._lost_before = self._lost_messages - self._lost_before, self._lost_messages
        text = f"{news} messages lost on the way: see the network" if news > 0 else ""
        level = DiagnosticStatus.WARN if self._bad_messages or text else DiagnosticStatus.OK
        return [make_status("rows", self._skin.name, level, text, values), *statuses]


def _recorded(path: Path) -> RecordedHealth | None:
    """What a bag says, None of a skin file. BagError: no bag."""
    if not path.is_dir() and path.suffix not in BAGS:
        return None
    # Here, because it loads much that a node does not need otherwise.
    from ..bags.recorded_health import RecordedHealth

    return RecordedHealth(path)


def main() -> None:
    run(lambda: [Reconstruction()])


if __name__ == "__main__":
    main()
