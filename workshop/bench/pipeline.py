"""`./cube bench pipeline`: the reconstruction beside the same equations in bare numpy."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from cube_tensor_driver.core.calibration import illustrative
from cube_tensor_driver.core.oscillator import pad_frequency
from cube_tensor_driver.core.pipeline import Pipeline
from cube_tensor_driver.core.rows import FrequencyRows

Function = Callable[[], Any]
"""Function that is called and timed."""

LAYOUT = "planar"
"""Name of the layout of the cubes whose pipeline is timed."""

ROUNDS = 400
"""Number of calls of each function, of which the median is given."""

LOAD_PA = 5e3
"""Standard deviation of the amplitudes of the modes (linear stress fields) of the load, in Pa."""


def bench_pipeline(cubes: int) -> dict[str, Any]:
    """Time the pipeline and the same pad law and matrix product in bare numpy, in turn.

    Args:
        cubes: Number of cubes.
    """
    result: dict[str, Any] = {"cubes": cubes}
    for dtype in (np.float32, np.float64):
        pipeline_us, floor_us = _time_in_turn(_make_functions(cubes, dtype))
        result[np.dtype(dtype).name] = {
            "pipeline_us": pipeline_us,
            "floor_us": floor_us,
            "ratio": pipeline_us / floor_us,
        }
    return result


def _make_functions(
    cubes: int,
    dtype: Any,
) -> list[Function]:
    """Return one call of the pipeline, and one of the bare equations, for one scan."""
    calibration = illustrative(LAYOUT)
    rng = np.random.default_rng(0)
    modes = rng.normal(0, LOAD_PA, (cubes, 7))
    law = calibration.rest_frequency, calibration.beta, calibration.modulus
    frequency = pad_frequency(modes @ calibration.response.T, *law).astype(dtype)

    pipeline = Pipeline([calibration] * cubes, dtype)
    rows = FrequencyRows.of(np.arange(cubes), frequency)
    rest = np.tile(calibration.rest_frequency, (cubes, 1)).astype(dtype)
    # Any matrix of the size of an estimator takes the same time.
    matrix = rng.normal(size=(8, 16)).astype(dtype)
    beta = dtype(calibration.beta[0])

    def compute_floor() -> Any:
        ratio = frequency / rest
        return ((ratio - 1) / (1 + beta * (1 - ratio))) @ matrix

    return [lambda: pipeline.process(rows), compute_floor]


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
