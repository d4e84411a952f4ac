"""The floor of the benchmark: bare rclpy publishing, and echoing, messages of a skin's sizes. No
work inside.

`source` publishes SkinFrequencies at a rate, `echo` answers each with a SkinStress; the same
executor, the same quality of service, the same flat arrays as the real nodes.
"""

from __future__ import annotations

import time

import numpy as np
from std_msgs.msg import Header

from cube_tensor_driver.msg import SkinFrequencies, SkinStress

from ..core.pipeline import StressRows
from ..device.scan import Rows
from .messages import Times, frequencies_message, read_frequencies, stress_message
from .node import CubeNode, queue, run

PADS = 8


class Source(CubeNode):
    """Publishes `frequencies` of n cubes at a rate: a timer thread as lean as can be."""

    def __init__(self) -> None:
        super().__init__("source")
        self.declare("autostart", True, "Begin at once.")
        self.declare("cubes", 64, "Rows of a message.")
        self.declare("rate", 1000.0, "Messages per second.")

    def configure(self) -> None:
        n, rate = int(self.value("cubes")), float(self.value("rate"))
        self._publisher = self.create_lifecycle_publisher(
            SkinFrequencies, "frequencies", queue(rate)
        )
        self._rows = Rows(
            np.arange(n, dtype=np.uint16),
            np.zeros(n, np.uint32),
            np.full(n, time.time_ns()),
            np.full((n, PADS), 1e5, np.float32),
            np.full(n, np.nan, np.float32),
            np.zeros(n, np.uint32),
        )
        self._timer = self.create_timer(1.0 / rate, self._publish)

    def _publish(self) -> None:
        self._publisher.publish(frequencies_message(self._rows, "skin"))


class Echo(CubeNode):
    """Answers each `frequencies` with a `stress` of as many rows, always the same values."""

    def __init__(self) -> None:
        super().__init__("echo")
        self.declare("autostart", True, "Begin at once.")
        self.declare("cubes", 64, "Rows of a message.")
        self.declare("rate", 1000.0, "Messages per second.")

    def configure(self) -> None:
        n, quality = int(self.value("cubes")), queue(float(self.value("rate")))
        self._publisher = self.create_lifecycle_publisher(SkinStress, "stress", quality)
        self._rows = StressRows(
            np.zeros((n, 6), np.float32),
            np.zeros((n, 9), np.float32),
            np.zeros(n, np.float32),
            np.zeros(n, np.uint16),
            np.zeros(n, np.uint16),
        )
        self._subscription = self.create_subscription(
            SkinFrequencies, "frequencies", self._answer, quality
        )

    def _answer(self, message: SkinFrequencies) -> None:
        times = read_frequencies(message)[0]
        self._publisher.publish(stress_message(Times(Header(), *times[1:]), self._rows))


def main() -> None:
    import sys

    run(lambda: [Source() if "source" in sys.argv else Echo()])


if __name__ == "__main__":
    main()
