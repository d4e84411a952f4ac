# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""`./cube bench pipeline`: the reconstruction beside the same equations in bare numpy."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from cube_tensor_driver.core.calibration import make_illustrative_calibration
from cube_tensor_driver.core.oscillator import compute_pad_frequency
from cube_tensor_driver.core.reconstructor import Reconstructor
from cube_tensor_driver.core.rows import FrequencyRows

Function = Callable[[], Any]
"""Function that is called and timed."""

LAYOUT = "planar"
"""Name of the layout of the cubes whose pipeline is timed."""

ROUNDS = 400
"""Number of calls of each function, of which the median is given."""

LOAD_PA = 5e3
"""Standard deviation of the amplitudes of the modes (linear stress fields) of the load, in Pa."""


PERIOD_NS = 1_000_000
"""Time from one scan to the next, in ns, by the time stamps of the rows."""


def bench_pipeline(cubes: int) -> dict[str, Any]:
    """Time the reconstruction of one scan, and the equations alone (pad law, matrix) in numpy.

    Args:
        cubes: Number of cubes.
    """
    functions = _make_functions(cubes)
    times_us = dict(zip(functions, _time_in_turn(list(functions.values())), strict=True))
    floor_us = times_us["floor"]
    ratios = {name: time_us / floor_us for name, time_us in times_us.items()}
    return {"cubes": cubes, "us": times_us, "ratio": ratios}


def _make_functions(cubes: int) -> dict[str, Function]:
    """Return functions that reconstruct a scan with health, without, and by bare equations."""
    calibration = make_illustrative_calibration(LAYOUT)
    rng = np.random.default_rng(0)
    modes = rng.normal(0, LOAD_PA, (cubes, 7))
    law = calibration.rest_frequency, calibration.beta, calibration.modulus
    frequency = compute_pad_frequency(modes @ calibration.response.T, *law).astype(np.float32)

    reconstructor = Reconstructor([calibration] * cubes)
    rows = FrequencyRows.from_values(np.arange(cubes, dtype=np.uint16), frequency)
    rest = np.tile(calibration.rest_frequency, (cubes, 1)).astype(np.float32)
    # Any matrix of the size of an estimator takes the same time.
    matrix = rng.normal(size=(8, 16)).astype(np.float32)
    beta = np.float32(calibration.beta[0])

    def compute_with_health() -> Any:
        rows.stamp_ns[:] += PERIOD_NS
        return reconstructor.process(rows)

    def compute_floor() -> Any:
        ratio = frequency / rest
        return ((ratio - 1) / (1 + beta * (1 - ratio))) @ matrix

    return {
        "health and pipeline": compute_with_health,
        "pipeline": lambda: reconstructor.pipeline.process(rows),
        "floor": compute_floor,
    }


def _time_in_turn(functions: list[Function]) -> list[float]:
    """Return the median time of each function, in µs.

    They are called in turn, so that whatever else the machine does slows down all of them.
    """
    times_us: list[list[float]] = [[] for _ in functions]
    for _ in range(ROUNDS):
        for function, times in zip(functions, times_us, strict=True):
            start_s = time.perf_counter()
            function()
            times.append(1e6 * (time.perf_counter() - start_s))
    return [statistics.median(times) for times in times_us]
