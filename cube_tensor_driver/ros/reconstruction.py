"""The reconstruction node: raw frequencies in, stress tensors and gradients out."""

from __future__ import annotations

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from cube_tensor_driver.msg import SkinFrequencies, SkinInfo, SkinStress

from ..core.errors import CubeError
from ..core.pipeline import INVALID, Pipeline
from ..files.skin import read_skin
from .cube_topics import CubeTopics
from .messages import info_message, read_frequencies, stress_message, to_time
from .node import LATCHED, CubeNode, queue, run

LISTENERS_S = 0.5
"""How often it is looked up which cubes' own topics anybody listens to."""


class Reconstruction(CubeNode):
    """Publishes `stress`, `info`, diagnostics, and per cube `cubes/<name>/stress` and `cubes/<name>/wrench`."""

    def __init__(self, subscribes: bool = True) -> None:
        """subscribes: False when `take` is called by a driver in the same process."""
        super().__init__("reconstruction")
        self._subscribes = subscribes
        self.declare("autostart", True, "Configure and activate at once; false waits for lifecycle transitions.")
        self.declare("config", "", "Skin file (YAML).")
        self.declare("wrench_side", 0.0, "Side of the face that wrenches refer to, m; 0: the cube's own.", (0.0, 10.0))
        self.declare("qos_reliability", "reliable", "Reliability of the batch topics.", choices="reliable, best_effort")
        self._active = False

    def configure(self) -> None:
        skin = self._skin = read_skin(self.config())
        self._pipeline = Pipeline([cube.calibration for cube in skin.cubes], np.float32)
        self._rows = self._rows_before = self._invalid = self._bad_messages = 0
        quality = queue(skin.rate, self.value("qos_reliability"))
        self._stress = self.create_lifecycle_publisher(SkinStress, "stress", quality)
        self._info = self.create_publisher(SkinInfo, "info", LATCHED)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._cubes = CubeTopics(self, skin, self._pipeline, self.value("wrench_side") or None)
        if self._subscribes:
            self._subscription = self.create_subscription(SkinFrequencies, "frequencies", self.take, quality)
        self._own_timers = [
            self.create_timer(1.0, self._publish_diagnostics),
            self.create_timer(LISTENERS_S, self._cubes.find_listeners),
        ]
        self._info.publish(info_message(skin, self._pipeline, self.get_clock().now().nanoseconds))

    def activate(self) -> None:
        self._active = True

    def deactivate(self) -> None:
        self._active = False

    def cleanup(self) -> None:
        if hasattr(self, "_own_timers"):
            if self._subscribes:
                self.destroy_subscription(self._subscription)
            for timer in self._own_timers:
                self.destroy_timer(timer)
            for publisher in (self._stress, self._info, self._diagnostics):
                self.destroy_publisher(publisher)
            self._cubes.close()
            del self._own_timers

    def take(self, message: SkinFrequencies) -> None:
        """Publish the tensors of one message of frequencies."""
        if not self._active:
            return
        try:
            times, frequency, pad_fault, temperature = read_frequencies(message)
            rows = self._pipeline.process(times.cube, frequency, pad_fault, temperature)
        except CubeError as error:
            self._bad_messages += 1
            self.get_logger().error(f"frequencies: {error}", throttle_duration_sec=5.0)
            return
        self._stress.publish(stress_message(times, rows))
        self._rows += len(times.cube)
        self._invalid += int(np.count_nonzero(rows.status & INVALID))
        self._cubes.publish(times, rows, pad_fault)

    def _publish_diagnostics(self) -> None:
        rate, self._rows_before = self._rows - self._rows_before, self._rows
        values = {
            "rows": self._rows,
            "rows per second": rate,
            "invalid rows": self._invalid,
            "messages that contradict themselves": self._bad_messages,
        }
        status = DiagnosticStatus(name=self.get_fully_qualified_name(), hardware_id=self._skin.name)
        status.level = DiagnosticStatus.WARN if self._bad_messages else DiagnosticStatus.OK
        status.values = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
        message = DiagnosticArray(status=[status])
        message.header.stamp = to_time(self.get_clock().now().nanoseconds)
        self._diagnostics.publish(message)


def main() -> None:
    run(lambda: [Reconstruction()])


if __name__ == "__main__":
    main()
