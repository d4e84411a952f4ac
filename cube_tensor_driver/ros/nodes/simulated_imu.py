# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The node `simulated_imu`: what an IMU measures on the simulated skin that the simulator moves."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
from sensor_msgs.msg import Imu

from ...config.parameters import SIMULATED_IMU
from ...simulation.imperfections import read_imperfections
from ...simulation.motion import MovingFrame
from ...simulation.simulator import START_FILE
from ..messages import to_time
from ..node import CubeNode, run

PERIOD_S = 5e-3
"""Sample period of the IMU, in s."""


class SimulatedImu(CubeNode):
    """Publishes `imu`. The IMU is at the origin of the skin's parent frame and has its axes."""

    def __init__(self) -> None:
        super().__init__("simulated_imu", SIMULATED_IMU)

    def configure(self) -> None:
        imperfections = read_imperfections(Path(self.read_value("imperfections")).expanduser())
        self._frame = MovingFrame(imperfections.poses)
        self._start = Path(self.read_value("port_directory")) / START_FILE
        self._message = Imu()
        self._message.header.frame_id = self.read_skin().parent_frame
        # According to sensor_msgs/Imu, -1 means that the orientation is not measured.
        self._message.orientation_covariance[0] = -1.0
        self._publisher = self.own(self.create_lifecycle_publisher(Imu, "imu", 10))
        self.own(self.create_timer(PERIOD_S, self._publish))

    def _publish(self) -> None:
        try:
            start_ns = int(self._start.read_text())
        except (OSError, ValueError):
            return  # The simulator has not started yet.
        if not self.is_active:
            return
        now_ns = time.time_ns()
        seconds = 1e-9 * (now_ns - start_ns)
        origin = np.zeros((1, 3))
        axes = np.eye(3)[None]
        (force,) = self._frame.compute_specific_force(seconds, origin, axes).tolist()
        velocity = self._frame.compute_angular_velocity(seconds).tolist()
        message = self._message
        message.header.stamp = to_time(now_ns)
        a = message.linear_acceleration
        a.x, a.y, a.z = force
        w = message.angular_velocity
        w.x, w.y, w.z = velocity
        self._publisher.publish(message)


def main() -> None:
    """Run the node `simulated_imu`."""
    run(lambda: [SimulatedImu()])


if __name__ == "__main__":
    main()
