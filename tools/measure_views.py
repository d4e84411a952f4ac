"""What those who look cost: markers, contacts and browser view beside a skin of so many cubes that
sends at 100 Hz.

measure_views.py CUBES [chromium]: one line of figures. The page is read by a client that draws
nothing, or by headless Chromium, which draws on the processor; then shown_hz is how often it drew
something new.
"""

from __future__ import annotations

import contextlib
import functools
import math
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import psutil
import rclpy
import viser
import zstandard
from photograph import chromium
from rclpy.signals import SignalHandlerOptions
from visualization_msgs.msg import MarkerArray
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from cube_tensor_driver.bags.message_codec import stress_codec
from cube_tensor_driver.config.grid import grid
from cube_tensor_driver.config.skin import read_skin
from cube_tensor_driver.config.yaml import write_yaml
from cube_tensor_driver.core.pipeline import Pipeline
from cube_tensor_driver.core.rows import StressRows
from cube_tensor_driver.msg import SkinContacts, SkinInfo, SkinStress
from cube_tensor_driver.processes.children import Children
from cube_tensor_driver.processes.skin_processes import Process
from cube_tensor_driver.ros.messages import info_message
from cube_tensor_driver.ros.node import LATCHED, make_executor, queue
from cube_tensor_driver.simulation.load import Load, default_script

RATE, INSTANTS, START_S, SETTLE_S, MEASURE_S = 100.0, 200, 30.0, 6.0, 15.0
SHOWN = """(() => {
  window.shown_ = 0
  let come = false, drawn = false
  const Plain = Worker
  Worker = class extends Plain {
    constructor(...all) {
      super(...all)
      const field = message => message.name == '/field'
      this.addEventListener('message', ({data}) => { if (data.messages && data.messages.some(field)) come = true })
    }
  }
  for (const name of ['drawElements', 'drawElementsInstanced']) {
    const draw = WebGL2RenderingContext.prototype[name]
    WebGL2RenderingContext.prototype[name] = function(...all) { drawn = true; return draw.apply(this, all) }
  }
  (function next() {
    if (come && drawn) { window.shown_++; come = false }
    drawn = false
    requestAnimationFrame(next)
  })()
})()"""
"""Counts the pictures that are drawn after new data came; what is drawn without is no new
picture."""
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
"""A page that has said where it looks from is one that the view draws for."""


class Counter:
    """Pictures that a reader of the page gets; it draws nothing."""

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
                assert isinstance(data, bytes)
                length = int.from_bytes(data[8:16], "little")
                self.pictures += zstandard.decompress(data[16 : 16 + length]).count(b"/field")


def measure(cubes: int, browser: bool) -> dict[str, float]:
    with tempfile.TemporaryDirectory(prefix="cube_views_") as name, contextlib.ExitStack() as stack:
        folder = Path(name)
        nx = math.ceil(math.sqrt(cubes))
        while cubes % nx:
            nx += 1
        write_yaml(
            folder / "skin.yaml",
            grid(nx=nx, ny=cubes // nx, pitch=0.012, links=1, rate=RATE, port="/dev/null"),
        )
        skin = read_skin(folder / "skin.yaml")
        load = Load(skin, default_script())
        node = rclpy.create_node("measure")
        info = node.create_publisher(SkinInfo, "info", LATCHED)
        info.publish(
            info_message(skin, Pipeline([cube.calibration for cube in skin.cubes]), time.time_ns())
        )
        publisher = node.create_publisher(SkinStress, "stress", queue(RATE))
        counts = {"markers": 0, "contacts": 0}
        for topic, kind in (("markers", MarkerArray), ("contacts", SkinContacts)):
            count = functools.partial(
                lambda topic, _: counts.__setitem__(topic, counts[topic] + 1), topic
            )
            node.create_subscription(kind, topic, count, 10, raw=True)
        frame_id = skin.parent_frame.encode() + b"\0"
        rows = [stress_rows(*load.at(k * load.period / INSTANTS)) for k in range(INSTANTS)]
        ended = threading.Event()

        def send() -> None:
            number = 0
            while not ended.wait(1 / RATE):
                number += 1
                instant = number * INSTANTS // round(load.period * RATE) % INSTANTS
                rows[instant].sequence[:] = number
                rows[instant].stamp_ns[:] = time.time_ns()
                publisher.publish(stress_codec.encode(rows[instant], frame_id))

        sender = threading.Thread(target=send)
        sender.start()
        stack.callback(sender.join)
        stack.callback(ended.set)
        children = stack.enter_context(Children(folder))
        for topic in counts:
            children.start(Process(topic, f"cube_tensor_driver.ros.{topic}"))
        children.start(Process("view", "cube_tensor_driver.cli", False, arguments=("view",)))
        url = children.wait_for_line("view", "http://", START_S).split()[0]
        counter = Counter(url)
        page = stack.enter_context(chromium(url, SHOWN)) if browser else None
        executor = make_executor()
        executor.add_node(node)

        def spin(seconds: float) -> None:
            until = time.monotonic() + seconds
            while time.monotonic() < until:
                executor.spin_once(timeout_sec=0.1)

        spin(SETTLE_S)
        if page:
            page.execute_cdp_cmd("Performance.enable", {})
            script, shown = scripting(page), page.execute_script("return window.shown_")
        names = (*counts, "view")
        before = {name: cpu(children.pid(name)) for name in names}
        counts_before, pictures, start = counts.copy(), counter.pictures, time.monotonic()
        spin(MEASURE_S)
        seconds = time.monotonic() - start
        result = {
            f"cpu_{name}_percent": 100 * (cpu(children.pid(name)) - before[name]) / seconds
            for name in names
        }
        result |= {
            f"{topic}_hz": (counts[topic] - counts_before[topic]) / seconds for topic in counts
        }
        result["view_hz"] = (counter.pictures - pictures) / seconds
        if page:
            shown = page.execute_script("return window.shown_") - shown
            result |= {
                "shown_hz": shown / seconds,
                "script_ms_per_picture": 1e3 * (scripting(page) - script) / shown,
            }
        result["rss_view_mb"] = psutil.Process(children.pid("view")).memory_info().rss / 2**20
        children.check()
        executor.remove_node(node)
        ended.set()
        sender.join()
        node.destroy_node()
        return {name: round(value, 1) for name, value in result.items()}


def scripting(page: Any) -> float:
    """Seconds that the page's main thread has spent in its own code, without drawing."""
    metrics = page.execute_cdp_cmd("Performance.getMetrics", {})["metrics"]
    return float(next(metric["value"] for metric in metrics if metric["name"] == "ScriptDuration"))


def stress_rows(stress: np.ndarray, gradient: np.ndarray) -> StressRows:
    """As planar cubes would give them."""
    n = len(stress)
    stress, gradient = stress.astype(np.float32), gradient[:, :3].reshape(n, 9).astype(np.float32)
    stress[:, [1, 3, 5]], gradient[:, [1, 3, 4, 5, 7]] = np.nan, np.nan
    return StressRows(
        cube=np.arange(n, dtype=np.uint16),
        sequence=np.zeros(n, np.uint32),
        stamp_ns=np.zeros(n, np.int64),
        stress=stress,
        gradient=gradient,
        residual=np.ones(n, np.float32),
        status=np.zeros(n, np.uint16),
        observed=np.zeros(n, np.uint16),
        left_out=np.zeros(n, np.uint32),
    )


def cpu(pid: int) -> float:
    times = psutil.Process(pid).cpu_times()
    return float(times.user + times.system)


if __name__ == "__main__":
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    print(sys.argv[1:], measure(int(sys.argv[1]), "chromium" in sys.argv), flush=True)
    rclpy.try_shutdown()
