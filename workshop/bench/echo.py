# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Floor of a benchmark: bare rclpy that publishes and echoes messages of a skin's sizes.

`source` publishes SkinFrequencies at a rate, and `echo` answers each with a SkinStress. They have
the executor, the quality of service and the flat arrays of the real nodes, but compute nothing.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from std_msgs.msg import Header

from cube_tensor_driver.config.parameters import AUTOSTART, Parameter
from cube_tensor_driver.msg import SkinFrequencies, SkinStress
from cube_tensor_driver.ros.messages import pack_array
from cube_tensor_driver.ros.node import CubeNode, run
from cube_tensor_driver.ros.qos import make_batch_profile

STRESSES = 6
"""Number of stresses in a row of stress."""

GRADIENTS = 9
"""Number of gradients in a row of stress."""

PARAMETERS = (
    AUTOSTART,
    Parameter("cubes", 64, "Rows of a message."),
    Parameter("pads", 8, "Pads of each cube."),
    Parameter("rate", 1000.0, "Messages per second."),
)
"""Parameters of both nodes."""


class BareSource(CubeNode):
    """Publishes `frequencies` at a rate, with a timer."""

    def __init__(self) -> None:
        super().__init__("source", PARAMETERS)

    def configure(self) -> None:
        """Make the publisher, and the constant arrays of all messages."""
        n = int(self.read_value("cubes"))
        rate = float(self.read_value("rate"))
        self._publisher: Any = self.create_lifecycle_publisher(  # type: ignore[no-untyped-call]
            SkinFrequencies,
            "frequencies",
            make_batch_profile(rate),
        )
        self._cube = np.arange(n, dtype=np.uint16)
        self._zeros = np.zeros(n, np.uint32)
        self._frequency = np.full(
            (n, int(self.read_value("pads"))),
            1e5,
            np.float32,
        )
        self._temperature = np.full(n, np.nan, np.float32)
        self._timer = self.create_timer(1.0 / rate, self._publish)

    def _publish(self) -> None:
        message = SkinFrequencies(
            header=Header(frame_id="skin"),
            cube=pack_array("H", self._cube),
            sequence=pack_array("I", self._zeros),
            time_offset=pack_array("i", self._zeros),
            n_pads=self._frequency.shape[1],
            frequency=pack_array("f", self._frequency),
            temperature=pack_array("f", self._temperature),
            pad_fault=pack_array("I", self._zeros),
            status=pack_array("H", self._zeros),
        )
        self._publisher.publish(message)


class BareEcho(CubeNode):
    """Answers each message of `frequencies` with one of `stress` whose rows are zero."""

    def __init__(self) -> None:
        super().__init__("echo", PARAMETERS)

    def configure(self) -> None:
        """Subscribe to `frequencies`, and make the constant arrays of all answers."""
        n = int(self.read_value("cubes"))
        quality = make_batch_profile(float(self.read_value("rate")))
        self._publisher: Any = self.create_lifecycle_publisher(  # type: ignore[no-untyped-call]
            SkinStress,
            "stress",
            quality,
        )
        self._zeros = np.zeros((n, GRADIENTS), np.float32)
        self._subscription = self.create_subscription(
            SkinFrequencies,
            "frequencies",
            self._answer,
            quality,
        )

    def _answer(self, message: SkinFrequencies) -> None:
        # Columns are given as bytes, because rclpy checks each element of a list.
        zeros = self._zeros
        answer = SkinStress(
            cube=message.cube,
            sequence=message.sequence,
            time_offset=message.time_offset,
            stress=pack_array("f", zeros[:, :STRESSES]),
            gradient=pack_array("f", zeros),
            residual=pack_array("f", zeros[:, 0]),
            status=pack_array("H", zeros[:, 0]),
            observed=pack_array("H", zeros[:, 0]),
            left_out=pack_array("I", zeros[:, 0]),
        )
        self._publisher.publish(answer)


def main() -> None:
    """Run the node that the arguments name."""
    run(lambda: [BareSource() if "source" in sys.argv else BareEcho()])


if __name__ == "__main__":
    main()
