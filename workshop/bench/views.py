# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""What views cost: the nodes markers and contacts and the browser view of a skin at 100 Hz.

`python -m workshop.bench.views CUBES` runs a simulated skin with all views and prints one line of
figures. A client that draws nothing reads the page of the browser view.
"""

from __future__ import annotations

import contextlib
import sys
import tempfile
import threading
from pathlib import Path

import msgspec
import viser
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from cube_tensor_driver.demo.demo import write_grid
from cube_tensor_driver.demo.running import observe_skin
from cube_tensor_driver.demo.usage import Usage
from cube_tensor_driver.processes.children import Children
from cube_tensor_driver.processes.domain import use_own_domain
from cube_tensor_driver.processes.skin_processes import VIEW, SimulatedHubs, list_skin_processes

RATE = 100.0
"""Sampling rate of each cube, in Hz."""

INSTANTS = 200
"""Number of instants of the load that are computed in advance and repeated."""

CUBES_PER_HUB = 64
"""Largest number of cubes on one simulated hub."""

MAX_START_S = 30.0
"""Longest time, in seconds, until the browser view has started."""

SETTLE_S = 6.0
"""Time, in seconds, from the start of the browser view to the start of the measurement."""

MEASURE_S = 15.0
"""Duration of the measurement of the views, in seconds."""

VIEWS = ("markers", "contacts", "view")
"""Names of the processes whose processor time is measured."""

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


def open_page(url: str) -> None:
    """Open the page as a client that reads all messages and draws nothing."""
    address = url.replace("http", "ws", 1)
    protocol = Subprotocol(f"viser-v{viser.__version__}")
    socket = connect(address, subprotocols=[protocol], max_size=None)
    socket.send(msgspec.msgpack.encode(CAMERA))

    def read() -> None:
        with contextlib.suppress(ConnectionClosed):
            while True:
                socket.recv()

    threading.Thread(target=read, daemon=True).start()


def measure(cubes: int) -> dict[str, float]:
    """Return processor time (percent of one core) and memory of the views.

    Args:
        cubes: Number of cubes of the skin.
    """
    with contextlib.ExitStack() as stack:
        stack.enter_context(use_own_domain())
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="cube_views_")))
        children = stack.enter_context(Children(folder))
        observer = stack.enter_context(observe_skin("measure", children))
        hubs = SimulatedHubs(folder / "ports", instants=INSTANTS)
        skin = write_grid(folder / "skin.yaml", cubes, RATE, CUBES_PER_HUB)
        for process in list_skin_processes(skin, markers=True, contacts=True, simulated=hubs):
            children.start(process)
        children.start(VIEW)
        url = children.wait_for_line("view", "http://", MAX_START_S).split()[0]
        open_page(url)
        # The first picture takes seconds, which are not measured.
        observer.spin(SETTLE_S)
        usage = Usage(children, VIEWS)
        observer.spin(MEASURE_S)
        figures = {
            f"cpu_{name}_percent": value for name, value in usage.measure_cpu_percent().items()
        }
        figures["rss_view_mb"] = usage.measure_memory_mb()["view"]
        return {name: round(value, 1) for name, value in figures.items()}


if __name__ == "__main__":
    print(sys.argv[1], measure(int(sys.argv[1])), flush=True)
