"""./cube bench: what the core and the whole chain cost, against bare floors measured in the same
run."""

from __future__ import annotations

import gc
import json
import math
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import rclpy
from rclpy.signals import SignalHandlerOptions
from rich.console import Console
from rich.progress import Progress

from cube_tensor_driver.msg import SkinStress

from ..config.grid import grid
from ..config.output_files import write_json
from ..config.skin import read_skin
from ..config.yaml import write_yaml
from ..core.calibration import illustrative
from ..core.errors import CubeError
from ..core.oscillator import pad_frequency
from ..core.pipeline import Pipeline
from ..core.rows import FrequencyRows
from ..plot.scale import draw_scale
from ..plot.style import save
from ..processes.children import Children
from ..processes.skin_processes import Process, SimulatedHubs, skin_processes
from ..ros.node import make_executor, queue
from ..simulation.arrival_count import Tally

CALIBRATION, LAYOUT, PITCH, CUBES_PER_HUB, INSTANTS = "planar", "planar", 0.012, 80, 16
ROUNDS = 400
FIRST_S, SETTLE_S, DRAIN_S, ECHO_S = 30.0, 3.0, 1.0, 15.0
SAMPLE_S, LONG_S, BLOCKS = 0.5, 60.0, 8


def bench_pipeline(cubes: int, json_path: Path | None) -> int:
    """Time the pipeline and the same law and matrix product in bare numpy, in turn."""
    calibration = illustrative(LAYOUT)
    rng = np.random.default_rng(0)
    result: dict[str, object] = {"cubes": cubes}
    for dtype in (np.float32, np.float64):
        pipeline = Pipeline([calibration] * cubes, dtype)
        cube = np.arange(cubes)
        state = rng.normal(0, 5e3, (cubes, 7))
        law = calibration.rest_frequency, calibration.beta, calibration.modulus
        frequency = pad_frequency(state @ calibration.response.T, *law).astype(dtype)
        rows = FrequencyRows.of(cube, frequency)
        rest = np.tile(calibration.rest_frequency, (cubes, 1)).astype(dtype)
        matrix = rng.normal(size=(8, 16)).astype(dtype)
        beta = dtype(calibration.beta[0])

        def floor(
            frequency: Any = frequency, rest: Any = rest, beta: Any = beta, matrix: Any = matrix
        ) -> None:
            ratio = frequency / rest
            ((ratio - 1) / (1 + beta * (1 - ratio))) @ matrix

        def ours(pipeline: Any = pipeline, rows: Any = rows) -> None:
            pipeline.process(rows)

        ours_us, floor_us = _interleaved(ours, floor)
        result[np.dtype(dtype).name] = {
            "pipeline_us": ours_us,
            "floor_us": floor_us,
            "ratio": ours_us / floor_us,
        }
    _report(result, json_path)
    return 0


def _interleaved(first: Callable[[], None], second: Callable[[], None]) -> tuple[float, float]:
    """Medians in µs of two functions called in turn."""
    times: tuple[list[float], list[float]] = ([], [])
    for _ in range(ROUNDS):
        for run, kept in zip((first, second), times, strict=True):
            start = time.perf_counter()
            run()
            kept.append(1e6 * (time.perf_counter() - start))
    return statistics.median(times[0]), statistics.median(times[1])


def bench_echo(cubes: int, rate: float, duration: float, json_path: Path | None) -> int:
    """The bare floor alone: source → echo → receive."""
    with _ros(), _progress() as progress:
        result = _echo(cubes, rate, duration, progress)
    _report({"cubes": cubes, "rate_hz": rate, "duration_s": duration, **result}, json_path)
    return 0


def bench_skin(
    cubes: int,
    rate: float,
    duration: float,
    publish_period: float,
    composed: bool,
    json_path: Path | None,
) -> int:
    """The whole chain, the floor before and after it in the same run."""
    with _ros(), _progress() as progress:
        result = _skin_and_echo(cubes, rate, duration, progress, publish_period, composed)
    _report(result, json_path)
    return 0


def bench_scale(
    counts: list[int], rate: float, duration: float, json_path: Path | None, figure: Path
) -> int:
    """CPU and latency per frame for growing skins, as table and picture."""
    with _ros(), _progress() as progress:
        rows = [_skin_and_echo(cubes, rate, duration, progress) for cubes in counts]
    _report({"rate_hz": rate, "duration_s": duration, "skins": rows}, json_path)
    save(draw_scale(rows), figure)
    return 0


def _skin_and_echo(
    cubes: int,
    rate: float,
    duration: float,
    progress: Progress,
    publish_period: float = 0.0,
    composed: bool = False,
) -> dict[str, Any]:
    before = _echo(cubes, rate, min(duration / 2, ECHO_S), progress)
    skin = _skin(cubes, rate, duration, progress, publish_period, composed)
    after = _echo(cubes, rate, min(duration / 2, ECHO_S), progress)
    echo = (before["echo_cpu_percent"] + after["echo_cpu_percent"]) / 2
    total = sum(
        value for name, value in skin.items() if name.startswith("cpu_") and "simulator" not in name
    )
    return {
        "cubes": cubes,
        "rate_hz": rate,
        "duration_s": duration,
        **skin,
        "echo_cpu_percent": round(echo, 1),
        "ratio_to_echo": round(total / echo, 3),
    }


def _skin(
    cubes: int,
    rate: float,
    duration: float,
    progress: Progress,
    publish_period: float,
    composed: bool,
) -> dict[str, Any]:
    with tempfile.TemporaryDirectory(prefix="cube_bench_") as name:
        folder = Path(name)
        path = folder / "skin.yaml"
        hubs = math.ceil(cubes / CUBES_PER_HUB)
        write_yaml(
            path,
            grid(
                nx=cubes,
                ny=1,
                pitch=PITCH,
                links=hubs,
                calibration=CALIBRATION,
                layout=LAYOUT,
                rate=rate,
            ),
        )
        book = folder / "book.json"
        processes = skin_processes(
            path,
            publish_period=publish_period,
            composed=composed,
            simulated=SimulatedHubs(folder / "ports", sample_log=book, instants=INSTANTS),
        )
        tally = Tally(read_skin(path))
        with Children(folder) as children:
            begun = time.monotonic()
            cpu, memory, span = _measure(
                processes, children, tally, rate, duration, progress, f"skin of {cubes} cubes"
            )
            started = span[2] - begun
            children.end(["simulator"])
            result = tally.result(json.loads(book.read_text()), span[0], span[1])
        names = [process.executable for process in processes]
        return {
            **result,
            **{f"cpu_{executable}_percent": round(cpu[executable], 1) for executable in names},
            **_memory(memory),
            "first_tensor_s": round(started, 2),
        }


def _echo(cubes: int, rate: float, duration: float, progress: Progress) -> dict[str, float]:
    parameters: dict[str, Any] = {"cubes": cubes, "rate": float(rate)}
    processes = [
        Process(role, "cube_tensor_driver.ros.echo", parameters=parameters, arguments=(role,))
        for role in ("echo", "source")
    ]

    class Count:
        rows = 0

        def take(self, data: bytes) -> None:
            self.rows += 1

    with (
        tempfile.TemporaryDirectory(prefix="cube_bench_") as name,
        Children(Path(name)) as children,
    ):
        count = Count()
        cpu, _, _ = _measure(
            processes, children, count, rate, duration, progress, f"echo of {cubes} cubes"
        )
    return {"echo_cpu_percent": round(cpu["echo"] + cpu["source"], 1)}


def _measure(
    processes: list[Process],
    children: Children,
    tally: Any,
    rate: float,
    duration: float,
    progress: Progress,
    what: str,
) -> tuple[dict[str, float], dict[str, list[float]], tuple[int, int, float]]:
    """Start processes, wait for the first tensors, let them settle, measure for `duration`.

    Returns CPU in percent and memory in MB, twice a second, per process, and (start ns, end ns,
    monotonic time of the first tensor).
    """
    # Nothing of ours may hold up what we measure.
    gc.collect()
    gc.freeze()
    for process in processes:
        children.start(process)
    node = rclpy.create_node("bench")
    executor = make_executor()
    node.create_subscription(SkinStress, "stress", tally.take, queue(rate), raw=True)
    executor.add_node(node)
    task = progress.add_task(what, total=duration)

    def spin(seconds: float, done: Callable[[], bool] = lambda: False) -> None:
        until = time.monotonic() + seconds
        while not done() and (left := until - time.monotonic()) > 0:
            executor.spin_once(timeout_sec=min(left, 0.2))

    try:
        spin(FIRST_S, lambda: tally.rows > 0)
        children.check()
        if not tally.rows:
            logs = "\n".join(children.log(process.executable)[-800:] for process in processes)
            raise CubeError(f"{what}: no tensor after {FIRST_S:g} s\n{logs}")
        first = time.monotonic()
        spin(SETTLE_S)
        watched = {p.executable: psutil.Process(children.pid(p.executable)) for p in processes}
        cpu = {name: _cpu(process) for name, process in watched.items()}
        memory: dict[str, list[float]] = {name: [] for name in watched}
        start_ns, start = time.time_ns(), time.monotonic()
        while time.monotonic() - start < duration:
            spin(min(SAMPLE_S, duration - (time.monotonic() - start)))
            progress.update(task, completed=time.monotonic() - start)
            for name, one in watched.items():
                memory[name].append(one.memory_info().rss / 2**20)
        children.check()
        end_ns, seconds = time.time_ns(), time.monotonic() - start
        used = {
            name: 100 * (_cpu(process) - cpu[name]) / seconds for name, process in watched.items()
        }
        spin(DRAIN_S)
    finally:
        executor.remove_node(node)
        node.destroy_node()
        progress.remove_task(task)
    return used, memory, (start_ns, end_ns, first)


def _memory(memory: dict[str, list[float]]) -> dict[str, float]:
    """Most MB of any process; over a minute or more how fast the fastest grows after the first
    fifth, and the error.

    A line through the means of blocks: allocators grow in steps, so neighbours in time are not
    independent.
    """
    nodes = [np.array(values) for name, values in memory.items() if name != "simulator"]
    result = {"rss_mb": round(float(np.max(nodes)), 1)}
    if len(nodes[0]) * SAMPLE_S >= LONG_S:
        slopes = []
        for values in nodes:
            blocks = [part.mean() for part in np.array_split(values[len(values) // 5 :], BLOCKS)]
            minutes = np.arange(BLOCKS) * 0.8 * len(values) * SAMPLE_S / 60 / BLOCKS
            (slope, _), covariance = np.polyfit(minutes, blocks, 1, cov=True)
            slopes.append((float(slope), float(np.sqrt(covariance[0, 0]))))
        slope, error = max(slopes)
        result |= {"rss_mb_per_minute": round(slope, 3), "rss_mb_per_minute_error": round(error, 3)}
    return result


def _cpu(process: psutil.Process) -> float:
    times = process.cpu_times()
    return float(times.user + times.system)


def _progress() -> Progress:
    """Drawn once a second: drawing keeps whoever measures from receiving."""
    return Progress(console=Console(stderr=True), refresh_per_second=1)


class _ros:
    """rclpy for the length of a block."""

    def __enter__(self) -> None:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)

    def __exit__(self, *_: object) -> None:
        rclpy.try_shutdown()


def _report(result: dict[str, Any], path: Path | None) -> None:
    print(json.dumps(result, indent=2))
    if path is not None:
        write_json(path, result)
