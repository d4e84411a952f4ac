# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""What views cost: the nodes markers and contacts and the browser view of a skin at 100 Hz.

`python -m workshop.bench.views CUBES [chromium]` prints one line of figures. A client that draws
nothing reads the page. With `chromium`, headless Chromium shows it too and draws on the processor;
then shown_hz is how often it drew something new.
"""

from __future__ import annotations

import contextlib
import math
import sys
import tempfile
import threading
import time
from pathlib import Path

import msgspec
import numpy as np
import viser
import zstandard
from rclpy.node import Node
from selenium import webdriver
from visualization_msgs.msg import MarkerArray
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from cube_tensor_driver.config.grid import grid
from cube_tensor_driver.config.skin import Skin, read_skin
from cube_tensor_driver.config.yaml import write_yaml
from cube_tensor_driver.core.pipeline import Pipeline
from cube_tensor_driver.core.rows import StressRows
from cube_tensor_driver.demo.running import observing
from cube_tensor_driver.demo.usage import Usage
from cube_tensor_driver.messages.codec import stress_codec
from cube_tensor_driver.msg import SkinContacts, SkinInfo, SkinStress
from cube_tensor_driver.processes.children import Children
from cube_tensor_driver.processes.skin_processes import Process
from cube_tensor_driver.ros.messages import info_message
from cube_tensor_driver.ros.qos import LATCHED, batch_profile
from cube_tensor_driver.simulation.load import Load, default_script

from ..pictures.photograph import chromium

RATE = 100.0
"""Sampling rate of each cube, in Hz."""

INSTANTS = 200
"""Number of instants of the load that are computed in advance and repeated."""

MAX_START_S = 30.0
"""Longest time, in seconds, until the browser view has started."""

SETTLE_S = 6.0
"""Time, in seconds, from the start of the browser view to the begin of the measurement."""

MEASURE_S = 15.0
"""Duration of the measurement of the views, in seconds."""

SHOWN = """(() => {
  window.shown_ = 0
  let come = false, drawn = false
  const Plain = Worker
  Worker = class extends Plain {
    constructor(...all) {
      super(...all)
      const field = message => (message.name || '').startsWith('/field')
      this.addEventListener('message', ({data}) => {
        if (data.messages && data.messages.some(field)) come = true
      })
    }
  }
  for (const name of ['drawElements', 'drawElementsInstanced']) {
    const draw = WebGL2RenderingContext.prototype[name]
    WebGL2RenderingContext.prototype[name] = function(...all) {
      drawn = true
      return draw.apply(this, all)
    }
  }
  (function next() {
    if (come && drawn) { window.shown_++; come = false }
    drawn = false
    requestAnimationFrame(next)
  })()
})()"""
"""JavaScript that counts the pictures that the browser draws after new data has come."""
CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": (1, 0, 0, 0),
    "position": (0, 0, 1),
    "fov": 1.0,
    "near": 0.01,
    "far": 9.0,
    "image_height": 9,
    "image_width": 9,
    "look_at": (0, 0, 0),
    "up_direction": (0, 0, 1),
}
"""Message of a client about its camera. The view draws only for clients that have sent one."""


class PictureCounter:
    """A client of the page that draws nothing and counts the pictures that it receives."""

    def __init__(self, url: str) -> None:
        self.pictures = 0
        address = url.replace("http", "ws", 1)
        self._socket = connect(
            address, subprotocols=[Subprotocol(f"viser-v{viser.__version__}")], max_size=None
        )
        self._socket.send(msgspec.msgpack.encode(CAMERA))
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        with contextlib.suppress(ConnectionClosed):
            for data in self._socket:
                if not isinstance(data, bytes):
                    raise TypeError("a text from viser, which sends bytes only")
                # viser puts the length in front of the compressed message.
                length = int.from_bytes(data[8:16], "little")
                self.pictures += b"/field" in zstandard.decompress(data[16 : 16 + length])


class SkinSender:
    """Publishes the info of a skin, and its stress under a load that moves; a context manager.

    A thread of its own publishes the stress inside the block.
    """

    def __init__(self, node: Node, skin: Skin) -> None:
        info = node.create_publisher(SkinInfo, "info", LATCHED)
        info.publish(info_message(skin, Pipeline(skin.calibrations), time.time_ns()))
        self._publisher = node.create_publisher(SkinStress, "stress", batch_profile(RATE))
        load = Load(skin, default_script())
        self._frame_id = skin.parent_frame.encode() + b"\0"
        self._instants = [
            stress_rows(*load.at(number * load.period / INSTANTS)) for number in range(INSTANTS)
        ]
        self._instants_per_scan = INSTANTS / (load.period * RATE)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._send)

    def __enter__(self) -> SkinSender:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    def _send(self) -> None:
        number = 0
        while not self._ended.wait(1 / RATE):
            number += 1
            rows = self._instants[int(number * self._instants_per_scan) % INSTANTS]
            rows.sequence[:] = number
            rows.stamp_ns[:] = time.time_ns()
            self._publisher.publish(stress_codec.encode(rows, self._frame_id))


class MessageCounter:
    """Counts the messages of a topic without decoding them."""

    def __init__(self, node: Node, message_type: type, topic: str) -> None:
        self.count = 0
        node.create_subscription(message_type, topic, self._receive, 10, raw=True)

    def _receive(self, _: bytes) -> None:
        self.count += 1


class BrowserMeter:
    """Counts what a browser does with the page."""

    def __init__(self, page: webdriver.Chrome) -> None:
        self._page = page
        page.execute_cdp_cmd("Performance.enable", {})

    def pictures(self) -> int:
        """Return the number of pictures drawn so far after new data had come."""
        return int(self._page.execute_script("return window.shown_"))

    def script_seconds(self) -> float:
        """Return the time, in seconds, that the main thread of the page has spent in scripts."""
        metrics = self._page.execute_cdp_cmd("Performance.getMetrics", {})["metrics"]
        durations = {metric["name"]: metric["value"] for metric in metrics}
        return float(durations["ScriptDuration"])


def measure(cubes: int, browser: bool) -> dict[str, float]:
    """Return rates (Hz), processor time (percent of one core) and memory (MiB) of the views.

    Args:
        cubes: Number of cubes of the skin.
        browser: Whether Chromium shows the page.
    """
    with tempfile.TemporaryDirectory(prefix="cube_views_") as name, contextlib.ExitStack() as stack:
        folder = Path(name)
        skin = make_skin(folder, cubes)
        children = stack.enter_context(Children(folder))
        observer = stack.enter_context(observing("measure", children))
        counters = {
            "markers": MessageCounter(observer.node, MarkerArray, "markers"),
            "contacts": MessageCounter(observer.node, SkinContacts, "contacts"),
        }
        stack.enter_context(SkinSender(observer.node, skin))
        for topic in counters:
            children.start(Process(topic, f"cube_tensor_driver.ros.nodes.{topic}"))
        children.start(Process("view", "cube_tensor_driver.cli", False, arguments=("view",)))
        url = children.wait_for_line("view", "http://", MAX_START_S).split()[0]
        pictures = PictureCounter(url)
        meter = BrowserMeter(stack.enter_context(chromium(url, SHOWN))) if browser else None

        def read() -> dict[str, float]:
            """Return everything that is counted, so far."""
            counted: dict[str, float] = {f"{name}_hz": one.count for name, one in counters.items()}
            counted["view_hz"] = pictures.pictures
            if meter:
                counted["shown_hz"] = meter.pictures()
                counted["script"] = meter.script_seconds()
            return counted

        # The first picture takes seconds, which are not measured.
        observer.spin(SETTLE_S)
        usage = Usage(children, (*counters, "view"))
        before, start = read(), time.monotonic()
        observer.spin(MEASURE_S)
        after, seconds = read(), time.monotonic() - start
        result = {name: (after[name] - before[name]) / seconds for name in after}
        if meter:
            result["script_ms_per_picture"] = 1e3 * result.pop("script") / result["shown_hz"]
        cpu = usage.cpu_percent()
        result |= {f"cpu_{process}_percent": value for process, value in cpu.items()}
        result["rss_view_mb"] = usage.memory_mb()["view"]
        return {name: round(value, 1) for name, value in result.items()}


def make_skin(folder: Path, cubes: int) -> Skin:
    """Make a grid that is as nearly square as the number of cubes allows."""
    nx = math.ceil(math.sqrt(cubes))
    # The next larger divisor, so that all rows are full.
    while cubes % nx:
        nx += 1
    path = folder / "skin.yaml"
    write_yaml(path, grid(nx=nx, ny=cubes // nx, pitch=0.012, rate=RATE, port="/dev/null"))
    return read_skin(path)


def stress_rows(stress: np.ndarray, gradient: np.ndarray) -> StressRows:
    """Return rows of stress in which the components that planar cubes do not observe are NaN."""
    stress = stress.astype(np.float32)
    gradient = gradient[:, :3].reshape(-1, 9).astype(np.float32)
    stress[:, [1, 3, 5]] = np.nan
    gradient[:, [1, 3, 4, 5, 7]] = np.nan
    return StressRows.of(np.arange(len(stress)), stress, gradient, residual=1.0)


if __name__ == "__main__":
    print(sys.argv[1:], measure(int(sys.argv[1]), "chromium" in sys.argv), flush=True)
