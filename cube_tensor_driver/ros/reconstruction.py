"""The reconstruction node: raw frequencies in, stress tensors and gradients out."""

from __future__ import annotations

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import WrenchStamped
from std_msgs.msg import Header

from cube_tensor_driver.msg import SkinFrequencies, SkinInfo, SkinStress, StressTensorStamped

from ..core.errors import CubeError
from ..core.pipeline import INVALID, Pipeline, StressRows
from ..core.tensor import contact_wrench
from ..files.skin import read_skin
from .messages import Times, info_message, read_frequencies, stress_message, tensor_message, to_time, wrench_message
from .node import LATCHED, CubeNode, queue, run

LISTENERS_S = 0.5
"""How often it is looked up which cubes' own topics anybody listens to."""


class Reconstruction(CubeNode):
    """Publishes `stress`, `info`, diagnostics, and per cube `cubes/<name>/stress` and `cubes/<name>/wrench`."""

    def __init__(self) -> None:
        super().__init__("reconstruction")
        self.declare("autostart", True, "Configure and activate at once; false waits for lifecycle transitions.")
        self.declare("config", "", "Skin file (YAML).")
        self.declare("wrench_side", 0.0, "Side of the face that wrenches refer to, m; 0: the cube's own.", (0.0, 10.0))
        self.declare("qos_reliability", "reliable", "Reliability of the batch topics.", choices="reliable, best_effort")
        self._active = False

    def configure(self) -> None:
        skin = self._skin = read_skin(self.config())
        self._pipeline = Pipeline([cube.calibration for cube in skin.cubes], np.float32)
        self._covariances: dict[tuple[int, int], np.ndarray] = {}
        self._rows = self._rows_before = self._invalid = self._bad_messages = 0
        quality = queue(skin.rate, self.value("qos_reliability"))
        self._stress = self.create_lifecycle_publisher(SkinStress, "stress", quality)
        self._info = self.create_publisher(SkinInfo, "info", LATCHED)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._tensors = [
            self.create_publisher(StressTensorStamped, f"cubes/{cube.name}/stress", 10) for cube in skin.cubes
        ]
        self._wrenches = [self.create_publisher(WrenchStamped, f"cubes/{cube.name}/wrench", 10) for cube in skin.cubes]
        self._listened: tuple[list[int], list[int]] = ([], [])
        side = float(self.value("wrench_side"))
        self._sides = np.array([side or 2 * cube.calibration.half_side for cube in skin.cubes])
        self._subscription = self.create_subscription(SkinFrequencies, "frequencies", self._on_frequencies, quality)
        self._timers = [
            self.create_timer(1.0, self._publish_diagnostics),
            self.create_timer(LISTENERS_S, self._find_listeners),
        ]
        self._info.publish(info_message(skin, self._pipeline, self.get_clock().now().nanoseconds))

    def activate(self) -> None:
        self._active = True

    def deactivate(self) -> None:
        self._active = False

    def cleanup(self) -> None:
        if hasattr(self, "_subscription"):
            self.destroy_subscription(self._subscription)
            for timer in self._timers:
                self.destroy_timer(timer)
            for publisher in (self._stress, self._info, self._diagnostics, *self._tensors, *self._wrenches):
                self.destroy_publisher(publisher)
            del self._subscription

    def _on_frequencies(self, message: SkinFrequencies) -> None:
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
        if any(self._listened):
            self._publish_cubes(times, rows, pad_fault)

    def _publish_cubes(self, times: Times, rows: StressRows, pad_fault: np.ndarray) -> None:
        """The per-cube topics, for the cubes that somebody listens to."""
        tensors, wrenches = self._listened
        stamps = times.stamp_ns
        if wrenches:
            sent = np.isin(times.cube, wrenches) & (rows.status & INVALID == 0)
            chosen = np.flatnonzero(sent)
            cubes = times.cube[chosen].tolist()
            forces, torques = contact_wrench(rows.stress[chosen], rows.gradient[chosen], self._sides[cubes][:, None])
            for row, cube, force, torque in zip(chosen, cubes, forces, torques, strict=True):
                self._wrenches[cube].publish(wrench_message(self._header(cube, int(stamps[row])), force, torque))
        for row in np.flatnonzero(np.isin(times.cube, tensors)).tolist():
            cube = int(times.cube[row])
            header = self._header(cube, int(stamps[row]))
            covariance = self._covariance(cube, int(pad_fault[row]))
            self._tensors[cube].publish(tensor_message(header, rows, row, covariance))

    def _header(self, cube: int, stamp_ns: int) -> Header:
        return Header(stamp=to_time(stamp_ns), frame_id=self._skin.frame(self._skin.cubes[cube]))

    def _covariance(self, cube: int, pad_fault: int) -> np.ndarray:
        key = cube, pad_fault
        if key not in self._covariances:
            if len(self._covariances) > 4096:
                self._covariances.clear()
            self._covariances[key] = self._pipeline.covariance(cube, pad_fault)
        return self._covariances[key]

    def _find_listeners(self) -> None:
        self._listened = tuple(  # type: ignore[assignment]
            [number for number, publisher in enumerate(publishers) if publisher.get_subscription_count()]
            for publishers in (self._tensors, self._wrenches)
        )

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
    run(Reconstruction)


if __name__ == "__main__":
    main()
