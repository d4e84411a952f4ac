# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""README's example with each source: a bag, a simulated skin, live links on pseudo-terminals.

.ci/run runs it where nothing is installed but `pip install ".[bags]"`:

    python test/example_without_ros.py
"""

from __future__ import annotations

import importlib.util
import itertools
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

import cube_tensor_driver as ctd
from cube_tensor_driver.config.package_data import find_package_data

CHECKOUT = Path(__file__).resolve().parents[1]
SKIN = find_package_data() / "config" / "skin_demo.yaml"
SCANS = 50


def example(source: ctd.Source) -> None:
    """Reconstruct the first scans of a source, and see that they are those of its skin."""
    reconstruct = ctd.Reconstructor(source.skin)
    rows_seen = 0
    for rows in itertools.islice(source, SCANS):
        stress = reconstruct(rows)
        rows_seen += len(stress)
        assert np.array_equal(stress.cube, rows.cube)
        assert np.all(np.isfinite(stress.stress[:, 2]))
    assert rows_seen >= SCANS
    print(f"{type(source).__name__}: {rows_seen} rows, live: {source.is_live}")


def main() -> None:
    assert not Path(ctd.__file__).is_relative_to(CHECKOUT), "this is the checkout, install it"
    assert importlib.util.find_spec("rclpy") is None, "this is an environment with ROS"
    skin = ctd.read_skin(SKIN)
    with ctd.open_bag(CHECKOUT / "test" / "data" / "bag") as source:
        example(source)
    with ctd.simulate(skin) as source:
        example(source)
    with tempfile.TemporaryDirectory() as ports:
        simulator = [sys.executable, "-m", "cube_tensor_driver.simulation.main"]
        hubs = subprocess.Popen([*simulator, "--config", str(SKIN), "--ports", ports])
        try:
            with ctd.open_links(skin, port_directory=ports) as source:
                example(source)
        finally:
            hubs.terminate()
            hubs.wait(10)


if __name__ == "__main__":
    main()
