"""`./cube bench`: what reconstruction and the whole chain cost, beside a bare floor measured in the
same run, in a DDS domain of their own: a skin that runs elsewhere is not disturbed."""

from __future__ import annotations

import gc
import re
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import Progress

from cube_tensor_driver.config.grid import grid
from cube_tensor_driver.config.skin import read_skin
from cube_tensor_driver.config.yaml import write_yaml
from cube_tensor_driver.core.calibration import illustrative
from cube_tensor_driver.core.errors import CubeError
from cube_tensor_driver.core.oscillator import pad_frequency
from cube_tensor_driver.core.pipeline import Pipeline
from cube_tensor_driver.core.rows import FrequencyRows
from cube_tensor_driver.demo.running import end_simulator, observing, report
from cube_tensor_driver.demo.usage import Usage
from cube_tensor_driver.demo.verification import Arrivals, compare, percentile
from cube_tensor_driver.messages.codec import stress_codec
from cube_tensor_driver.msg import SkinStress
from cube_tensor_driver.processes.children import Children
from cube_tensor_driver.processes.domain import own_domain
from cube_tensor_driver.processes.skin_processes import Process, SimulatedHubs, skin_processes
from cube_tensor_driver.ros.qos import batch_profile
from cube_tensor_driver.simulation.sample_log import SampleTable
from cube_tensor_driver.views.figures.style import save
from cube_tensor_hub.firmware import FirmwareError

from .hubs_in_c import HubLoad, read_samples
from .scale import draw_scale

LAYOUT, PITCH = "planar", 0.012
INSTANTS = 16
"""Instants of the load that the simulator repeats: it must cost little here."""
LOADS = "hubs", "simulator"
"""What sends the samples: hubs in C, or the simulator where they cannot be built."""
ROUNDS = 400
FIRST_S, SETTLE_S, DRAIN_S, ECHO_S = 30.0, 3.0, 1.0, 15.0
"""s: until the first tensor at most; until it is measured; for what is still on its way; of the
floor at most."""
SAMPLE_S = 0.5
"""How often memory is looked at."""
LONG_S, BLOCKS = 60.0, 8
"""From what duration growth of memory is given, and of how many mean values."""


@dataclass(frozen=True)
class Measurement:
    """What processes used from start_ns to end_ns of the wall clock.

    cpu_percent: of one core, by process
    memory_mb: twice a second, by process
    first_tensor_s: from the start of the processes to the first message of stress
    """

    start_ns: int
    end_ns: int
    cpu_percent: dict[str, float]
    memory_mb: dict[str, list[float]]
    first_tensor_s: float


def bench_pipeline(*, cubes: int, json_path: Path | None = None) -> int:
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
    report(result, json_path)
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


def bench_echo(*, cubes: int, rate: float, duration: float, json_path: Path | None = None) -> int:
    """Measure the bare floor alone: a source of messages, an echo and a receiver."""
    with own_domain(), _progress() as progress:
        result = _echo(cubes, rate, duration, progress)
    report({"cubes": cubes, "rate_hz": rate, "duration_s": duration, **result}, json_path)
    return 0


def bench_skin(
    *,
    cubes: int,
    rate: float,
    duration: float,
    publish_period: float = 0.0,
    composed: bool = False,
    json_path: Path | None = None,
) -> int:
    """Measure the whole chain, and the floor before and after it.

    The load are hubs in C (firmware/), or the simulator where they cannot be built.

    cubes: or a few more, because all hubs have as many
    rate: samples per second; duration: s of measurement
    publish_period: s that one message covers, 0: one message for each scan
    composed: driver and reconstruction in one process
    """
    with own_domain(), _progress() as progress:
        result = _skin_and_echo(
            cubes, rate, duration, progress, publish_period=publish_period, composed=composed
        )
    report(result, json_path)
    return 0


def bench_scale(
    *,
    counts: list[int],
    rate: float,
    duration: float,
    figure: Path,
    json_path: Path | None = None,
) -> int:
    """CPU and latency for each of these numbers of cubes, as figures and as a picture."""
    with own_domain(), _progress() as progress:
        rows = [_skin_and_echo(cubes, rate, duration, progress) for cubes in counts]
    report({"rate_hz": rate, "duration_s": duration, "skins": rows}, json_path)
    save(draw_scale(rows), figure)
    return 0


def _skin_and_echo(
    cubes: int, rate: float, duration: float, progress: Progress, **chain: Any
) -> dict[str, Any]:
    """chain: publish_period and composed, as `bench_skin`."""
    cubes = HubLoad.of(cubes).cubes
    before = _echo(cubes, rate, min(duration / 2, ECHO_S), progress)
    skin = _skin(cubes, rate, duration, progress, **chain)
    after = _echo(cubes, rate, min(duration / 2, ECHO_S), progress)
    echo = (before["echo_cpu_percent"] + after["echo_cpu_percent"]) / 2
    total = sum(
        value
        for name, value in skin.items()
        if name.startswith("cpu_") and name not in (f"cpu_{load}_percent" for load in LOADS)
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
    *,
    publish_period: float = 0.0,
    composed: bool = False,
) -> dict[str, Any]:
    with tempfile.TemporaryDirectory(prefix="cube_bench_") as name:
        folder = Path(name)
        path, log, ports = folder / "skin.yaml", folder / "log", folder / "ports"
        load = HubLoad.of(cubes)
        write_yaml(path, grid(nx=load.cubes, ny=1, pitch=PITCH, links=load.hubs, rate=rate))
        hubs = SimulatedHubs(ports, sample_log=log, instants=INSTANTS)
        processes = skin_processes(
            path, publish_period=publish_period, composed=composed, simulated=hubs
        )
        try:
            program = load.build(folder / "firmware")
        except FirmwareError as error:
            progress.console.print(f"The Python simulator is the load, which takes more: {error}")
        else:
            ports.mkdir()
            arguments = (*load.arguments(ports, rate), "--log", str(log))
            in_c = Process("hubs", "", node=False, program=program, arguments=arguments)
            processes[0] = in_c
        arrivals = Arrivals(read_skin(path), one_per_hub=True)

        def receive(data: bytes) -> None:
            arrivals.add(stress_codec.decode(data).rows, time.time_ns())

        with Children(folder) as children:
            measured = _measure(
                processes,
                children,
                receive,
                rate,
                duration,
                progress,
                f"skin of {load.cubes} cubes",
            )
            taken, skipped = _end_load(processes[0].executable, children, log, load)
    comparison = compare(taken, arrivals, measured.start_ns, measured.end_ns)
    cpu = measured.cpu_percent
    seconds = 1e-9 * (measured.end_ns - measured.start_ns)
    return {
        "samples_expected": round(rate * seconds) * load.cubes,
        "samples_sent": comparison.sent,
        "tensors_received": comparison.received,
        "lost": comparison.missing,
        "skipped": skipped,
        "latency_p50_ms": percentile(comparison.latency_ms, 50),
        "latency_p99_ms": percentile(comparison.latency_ms, 99),
        **{f"cpu_{name}_percent": round(value, 1) for name, value in cpu.items()},
        **_memory(measured.memory_mb),
        "first_tensor_s": round(measured.first_tensor_s, 2),
    }


def _end_load(
    executable: str, children: Children, log: Path, load: HubLoad
) -> tuple[SampleTable, int]:
    """End what sends the samples. Returns what it took, and how many samples it had no room for."""
    if executable == "simulator":
        sample_log = end_simulator(children, log)
        return sample_log.table, sample_log.dropped
    children.end([executable])
    dropped = re.findall(r" taken, (\d+) dropped", children.log(executable))
    return read_samples(log, load), sum(map(int, dropped))


def _echo(cubes: int, rate: float, duration: float, progress: Progress) -> dict[str, float]:
    parameters: dict[str, Any] = {"cubes": cubes, "rate": float(rate)}
    processes = [
        Process(role, "workshop.bench.echo", parameters=parameters, arguments=(role,))
        for role in ("echo", "source")
    ]
    with (
        tempfile.TemporaryDirectory(prefix="cube_bench_") as name,
        Children(Path(name)) as children,
    ):
        what = f"echo of {cubes} cubes"
        measured = _measure(processes, children, lambda data: None, rate, duration, progress, what)
    return {"echo_cpu_percent": round(sum(measured.cpu_percent.values()), 1)}


def _measure(
    processes: list[Process],
    children: Children,
    receive: Callable[[bytes], None],
    rate: float,
    duration: float,
    progress: Progress,
    what: str,
) -> Measurement:
    """Start processes, wait for the first tensors, let them settle, measure for `duration` s.

    receive: is given each message of stress, serialised: a receiver must not cost what is measured.
    what: for the progress bar. CubeError: no tensor came.
    """
    # Garbage collection must not hold up the receiver.
    gc.collect()
    gc.freeze()
    begun = time.monotonic()
    for process in processes:
        children.start(process)
    messages = 0

    def on_stress(data: bytes) -> None:
        nonlocal messages
        messages += 1
        receive(data)

    names = [process.executable for process in processes]
    task = progress.add_task(what, total=duration)
    with observing("bench", children) as observer:
        observer.listen(SkinStress, "stress", on_stress, batch_profile(rate))
        observer.spin(FIRST_S, lambda: messages > 0)
        if not messages:
            logs = "\n".join(children.log(name)[-800:] for name in names)
            raise CubeError(f"{what}: no tensor after {FIRST_S:g} s\n{logs}")
        first_tensor_s = time.monotonic() - begun
        observer.spin(SETTLE_S)
        usage = Usage(children, names)
        memory: dict[str, list[float]] = {name: [] for name in names}
        start_ns, start = time.time_ns(), time.monotonic()
        while (left := duration - (time.monotonic() - start)) > 0:
            observer.spin(min(SAMPLE_S, left))
            progress.update(task, completed=time.monotonic() - start)
            for name, value in usage.memory_mb().items():
                memory[name].append(value)
        end_ns, cpu = time.time_ns(), usage.cpu_percent()
        observer.spin(DRAIN_S)
    progress.remove_task(task)
    return Measurement(start_ns, end_ns, cpu, memory, first_tensor_s)


def _memory(memory: dict[str, list[float]]) -> dict[str, float]:
    """Most MB of any process but the load; over a minute or more also how fast the fastest
    grows after the first fifth, with the standard error.

    It is a line through the means of blocks: allocators grow in steps, so neighbours in time are
    not independent.
    """
    nodes = [np.array(values) for name, values in memory.items() if name not in LOADS]
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


def _progress() -> Progress:
    """Drawn once a second: drawing keeps the receiver from receiving."""
    return Progress(console=Console(stderr=True), refresh_per_second=1)
