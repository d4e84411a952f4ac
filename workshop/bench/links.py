# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""`./cube bench links`: from the bytes of hubs to arrays, without DDS and reconstruction."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from cube_tensor_driver.config.skin import read_skin
from cube_tensor_driver.core.arrays import Array
from cube_tensor_driver.core.errors import CubeError
from cube_tensor_driver.core.rows import FrequencyRows
from cube_tensor_driver.device.chain import LiveLinks
from cube_tensor_driver.device.live import make_cube_addresses, make_link_configs
from cube_tensor_driver.device.scans.scan import make_empty_rows
from cube_tensor_driver.processes.children import Children

from .hubs_in_c import HubLoad

MAX_START_S = 10.0
"""Longest time, in seconds, from the start of the hubs until the first rows arrive."""

SETTLE_S = 2.0
"""Time, in seconds, from the first rows to the start of the measurement."""

POLL_S = 0.05
"""Time, in seconds, between two checks of a condition that is waited for."""


def bench_links(
    cubes: int,
    rate: float,
    duration: float,
) -> dict[str, Any]:
    """Measure the processor time of reading the links, with samples from hubs in C (`firmware/`).

    The figure `lost` is the number of rows that the hubs sampled and that were not delivered.

    Args:
        cubes: Number of cubes, rounded up so that all hubs have the same number.
        rate: Samples per second of each cube.
        duration: Duration of the measurement, in seconds.

    Raises:
        CubeError: The hubs cannot be built, or no rows arrive.
    """
    load = HubLoad.choose(cubes)
    cubes = load.cubes
    with tempfile.TemporaryDirectory(prefix="cube_bench_") as name:
        folder = Path(name)
        skin = read_skin(load.write_skin(folder, rate))
        hubs = load.make_process(folder / "firmware", folder, rate)
        delivered = 0

        def on_rows(rows: FrequencyRows) -> None:
            nonlocal delivered
            # Nothing else is done with the rows: only reading is measured.
            delivered += len(rows)

        with Children(folder) as children:
            children.start(hubs)
            _wait(lambda: len(list(folder.glob("hub[0-9]*"))) == load.hubs)
            links = LiveLinks(
                make_link_configs(skin, port_directory=folder),
                make_cube_addresses(skin),
                on_rows,
                rate=rate,
                # The arrays for rows are used again, as a node does with the memory of messages.
                make_rows=lru_cache(maxsize=8)(make_empty_rows),
            )

            def read_counters() -> Array:
                """Return wall clock (s), processor time (s), rows and lost samples so far."""
                return np.array(
                    [time.monotonic(), time.process_time(), delivered, _count_lost(links)]
                )

            links.start()
            try:
                _wait(lambda: delivered > 0)
                # Connecting and the first use of memory are not measured.
                time.sleep(SETTLE_S)
                start = read_counters()
                time.sleep(duration)
                seconds, cpu_s, rows, lost = (read_counters() - start).tolist()
            finally:
                links.close()
    return {
        "cubes": cubes,
        "rate_hz": rate,
        "duration_s": duration,
        "rows": int(rows),
        "rows_expected": round(rate * seconds) * cubes,
        "lost": int(lost) * load.cubes_per_hub,
        "cpu_percent": round(100 * cpu_s / seconds, 1),
        "cpu_us_per_scan": round(1e6 * cpu_s * cubes / max(rows, 1), 1),
    }


def _wait(done: Callable[[], bool]) -> None:
    """Wait until a condition is true; raise CubeError if it is not within `MAX_START_S`."""
    until_s = time.monotonic() + MAX_START_S
    while not done():
        if time.monotonic() > until_s:
            raise CubeError(f"the hubs gave nothing within {MAX_START_S:g} s")
        time.sleep(POLL_S)


def _count_lost(links: LiveLinks) -> int:
    """Return the number of samples that the hubs took and that did not arrive so far."""
    names = ("lost_on_the_way", "dropped_in_hub")
    counts = [report.values[name] for report in links.report() for name in names]
    return sum(int(str(count)) for count in counts)
