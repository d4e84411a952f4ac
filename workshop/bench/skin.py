# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""`./cube bench skin`, `echo`, `touch`, `contacts` and `scale`: the whole chain in real processes.

`skin` and `scale` also measure a bare floor in the same run. Everything runs in a DDS domain of
its own, so that a skin that runs elsewhere is not disturbed.
"""

from __future__ import annotations

import gc
import re
import struct
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import Progress

from cube_tensor_driver.config.skin import read_skin
from cube_tensor_driver.core.arrays import Array, Index
from cube_tensor_driver.core.errors import CubeError
from cube_tensor_driver.demo.running import observe_skin
from cube_tensor_driver.demo.usage import Usage
from cube_tensor_driver.demo.verification import compare, compute_percentile
from cube_tensor_driver.messages.codec import stress_codec
from cube_tensor_driver.msg import SkinContacts, SkinStress, SkinTouch
from cube_tensor_driver.processes.children import Children
from cube_tensor_driver.processes.domain import use_own_domain
from cube_tensor_driver.processes.skin_processes import Process, SimulatedHubs, list_skin_processes
from cube_tensor_driver.ros.qos import make_batch_profile
from cube_tensor_driver.simulation.sample_log import SampleLog, SampleTable
from cube_tensor_driver.views.figures.style import save

from ..torture.memory import compute_median_slope
from .balls import write_balls
from .hub_arrivals import HubArrivals
from .hubs_in_c import HubLoad, read_samples
from .scale import draw_scale

FOUND = {"touch": SkinTouch, "contacts": SkinContacts}
"""Topics with what presses on the skin -> type of their messages."""

MAX_CONTACT_RATE_HZ = 100.0
"""Largest value of the parameter `rate` of the node `contacts`."""

LOAD = "hubs"
"""Name of the process that sends the samples. It is not part of what a robot runs."""

MAX_START_S = 30.0
"""Longest time, in seconds, from the start of the processes until the first tensor arrives."""

SETTLE_S = 3.0
"""Time, in seconds, from the first tensor to the start of the measurement."""

DRAIN_S = 1.0
"""Time, in seconds, after the measurement in which its last tensors arrive."""

MAX_ECHO_S = 15.0
"""Longest duration, in seconds, of one measurement of the echo: two nodes that only exchange the
messages of the chain, so that their processor time is a lower bound."""

MEMORY_PERIOD_S = 0.5
"""Time, in seconds, between two measurements of the memory of the processes."""

MIN_GROWTH_DURATION_S = 60.0
"""Shortest duration, in seconds, of a measurement for which the growth of memory is reported."""


@dataclass(frozen=True)
class Bench:
    """Settings of a measurement.

    Attributes:
        rate: Samples per second of each cube.
        duration: Duration of the measurement, in seconds.
        publish_period: Time that one message covers, in seconds; 0: one message for each scan.
        composed: Whether driver and reconstruction run in one process.
        pads: Number of pads of each cube, 8 or 24.
        topic: The topic of `FOUND` whose latency is measured; empty: none.
        has_load: Whether balls move over the skin. Then the simulator in Python sends the samples
            instead of hubs in C, whose frequencies stay the same.
    """

    rate: float
    duration: float
    publish_period: float = 0.0
    composed: bool = False
    pads: int = 8
    topic: str = ""
    has_load: bool = False


@dataclass(frozen=True)
class Measurement:
    """Processor time and memory that the processes used in a span of time.

    Attributes:
        start_ns, end_ns: Start and end of the span, in ns since the Unix epoch.
        cpu_percent: Processor time in percent of one core, by process.
        memory_mb: Resident memory in MB every `MEMORY_PERIOD_S`, by process.
        first_tensor_s: Time from the start of the processes to the first message of stress.
    """

    start_ns: int
    end_ns: int
    cpu_percent: dict[str, float]
    memory_mb: dict[str, list[float]]
    first_tensor_s: float


def bench_echo(cubes: int, bench: Bench) -> dict[str, Any]:
    """Measure only the echo: nodes that exchange messages of the same size without work on them."""
    settings = {"cubes": cubes, "rate_hz": bench.rate, "duration_s": bench.duration}
    with _prepare_domain() as progress:
        return settings | _measure_echo(cubes, bench, progress)


def bench_skin(cubes: int, bench: Bench) -> dict[str, Any]:
    """Measure the driver and the reconstruction, and the echo (only messages) before and after.

    Hubs in C (`firmware/`) send the samples.

    Args:
        cubes: Number of cubes, rounded up so that all hubs have the same number.
        bench: Settings.
    """
    with _prepare_domain() as progress:
        return _measure_both(cubes, bench, progress)


def bench_found(cubes: int, bench: Bench) -> dict[str, Any]:
    """Measure the latency of `bench.topic`, and the processor time that it costs.

    The skin runs once without and once with a subscriber of it, both with one of `stress`.
    """
    topic = bench.topic
    with _prepare_domain() as progress:
        without = _measure_skin(cubes, replace(bench, topic=""), progress)
        found = _measure_skin(cubes, bench, progress)
    chosen = {name: value for name, value in found.items() if name.startswith(("cpu_", topic))}
    cpu = {name: value for name, value in without.items() if name.startswith("cpu_")}
    return {
        "cubes": HubLoad.choose(cubes, bench.pads).cubes,
        "rate_hz": bench.rate,
        "duration_s": bench.duration,
        **chosen,
        f"latency_p99_ms_without_{topic}": without["latency_p99_ms"],
        **{f"{name}_without_{topic}": value for name, value in cpu.items()},
    }


def bench_scale(
    counts: list[int],
    bench: Bench,
    figure: Path,
) -> dict[str, Any]:
    """Run `bench_skin` for several numbers of cubes, and draw a picture of the results."""
    with _prepare_domain() as progress:
        rows = [_measure_both(cubes, bench, progress) for cubes in counts]
    save(draw_scale(rows), figure)
    return {"rate_hz": bench.rate, "duration_s": bench.duration, "skins": rows}


@contextmanager
def _prepare_domain() -> Iterator[Progress]:
    """Set a DDS domain and show a progress bar.

    The bar is drawn only once a second, because this process receives no messages meanwhile.
    """
    progress = Progress(console=Console(stderr=True), refresh_per_second=1)
    with use_own_domain(), progress:
        yield progress


def _measure_both(
    cubes: int,
    bench: Bench,
    progress: Progress,
) -> dict[str, Any]:
    """Measure the echo before and after the chain, and compare the chain with their mean."""
    cubes = HubLoad.choose(cubes, bench.pads).cubes
    before = _measure_echo(cubes, bench, progress)
    skin = _measure_skin(cubes, bench, progress)
    after = _measure_echo(cubes, bench, progress)
    # The speed of the machine may have changed meanwhile.
    echo = (before["echo_cpu_percent"] + after["echo_cpu_percent"]) / 2
    used = [value for name, value in skin.items() if name.startswith("cpu_")]
    robot_percent = sum(used) - skin[f"cpu_{LOAD}_percent"]
    return {
        "cubes": cubes,
        "rate_hz": bench.rate,
        "duration_s": bench.duration,
        **skin,
        "echo_cpu_percent": round(echo, 1),
        # In a measurement of a fraction of a second, the echo can take less processor time than the
        # system resolves. Its time is then 0.
        "ratio_to_echo": round(robot_percent / echo, 3) if echo else None,
    }


def _measure_skin(
    cubes: int,
    bench: Bench,
    progress: Progress,
) -> dict[str, Any]:
    with tempfile.TemporaryDirectory(prefix="cube_bench_") as name:
        folder = Path(name)
        log = folder / "log"
        load = HubLoad.choose(cubes, bench.pads)
        path = load.write_skin(folder, bench.rate)
        processes = _make_processes(path, log, load, bench)
        arrivals = HubArrivals(read_skin(path))
        found: list[tuple[int, int]] = []

        def receive(data: bytes) -> None:
            arrivals.add(stress_codec.decode(data).rows, time.time_ns())

        def receive_found(data: bytes) -> None:
            # The stamp stands behind the four bytes that state the encoding.
            seconds, nanoseconds = struct.unpack_from("<iI", data, 4)
            found.append((10**9 * seconds + nanoseconds, time.time_ns()))

        with Children(folder) as children:
            name = f"skin of {load.cubes} cubes"
            measured = _measure(
                processes,
                children,
                bench,
                receive,
                progress,
                name,
                receive_found,
            )
            taken, skipped = _end_load(children, log, load, bench)
    # Only rows of the first cube of each hub were stored, because storing all would delay this
    # process. They are counted for all cubes of the hub.
    comparison = compare(taken, arrivals, measured.start_ns, measured.end_ns)
    cpu = measured.cpu_percent
    seconds = 1e-9 * (measured.end_ns - measured.start_ns)
    return {
        "samples_expected": round(bench.rate * seconds) * load.cubes,
        "samples_sent": comparison.sent,
        "tensors_received": comparison.received,
        "lost": comparison.missing,
        "skipped": skipped,
        "latency_p50_ms": compute_percentile(comparison.latency_ms, 50),
        "latency_p99_ms": compute_percentile(comparison.latency_ms, 99),
        **{f"cpu_{name}_percent": round(value, 1) for name, value in cpu.items()},
        **summarise_memory(measured.memory_mb),
        "first_tensor_s": round(measured.first_tensor_s, 2),
        **(_summarise_found(bench, np.array(found), taken, measured) if bench.topic else {}),
    }


def _summarise_found(
    bench: Bench,
    found: Index,
    taken: SampleTable,
    measured: Measurement,
) -> dict[str, float]:
    """Return number and latencies of the messages of a topic that has no sequence number.

    Args:
        bench: Settings with the name of the topic.
        found: Stamps and times of arrival (N, 2), in ns since the Unix epoch.
        taken: The samples that the hubs took.
        measured: Span of the measurement.
    """
    sampled_ns = np.sort(taken.time_ns)
    stamp_ns, arrival_ns = found.T
    # A stamp is closer to its own sample than to any other scan.
    after = np.searchsorted(sampled_ns, stamp_ns).clip(1, len(sampled_ns) - 1)
    is_earlier = stamp_ns - sampled_ns[after - 1] < sampled_ns[after] - stamp_ns
    latency_ms = 1e-6 * (arrival_ns - sampled_ns[after - is_earlier])
    latency_ms = latency_ms[(stamp_ns > measured.start_ns) & (stamp_ns < measured.end_ns)]
    return {
        f"{bench.topic}_messages": len(latency_ms),
        f"{bench.topic}_latency_p50_ms": compute_percentile(latency_ms, 50),
        f"{bench.topic}_latency_p99_ms": compute_percentile(latency_ms, 99),
    }


def _make_processes(
    path: Path,
    log: Path,
    load: HubLoad,
    bench: Bench,
) -> list[Process]:
    """Return the process of the load (hubs that send samples), followed by those of the nodes."""
    ports = path.parent / "ports"
    balls = write_balls(path.parent) if bench.has_load else None
    processes = list_skin_processes(
        path,
        publish_period=bench.publish_period,
        composed=bench.composed,
        contacts=bench.topic == "contacts",
        simulated=SimulatedHubs(ports, balls, sample_log=log, noise=None),
    )
    if bench.has_load:
        processes[0] = replace(processes[0], executable=LOAD)
    else:
        processes[0] = load.make_process(
            path.parent / "firmware",
            ports,
            bench.rate,
            log,
        )
    if bench.topic == "contacts":
        processes[-1].parameters["rate"] = min(bench.rate, MAX_CONTACT_RATE_HZ)
    return processes


def _end_load(
    children: Children,
    log: Path,
    load: HubLoad,
    bench: Bench,
) -> tuple[SampleTable, int]:
    """End the hubs; return their samples, and the number that they dropped from full queues."""
    children.end([LOAD])
    if bench.has_load:
        samples = SampleLog.read(log)
        return samples.table, samples.dropped
    # The program prints how many samples it took and dropped when it ends.
    dropped = re.findall(r" taken, (\d+) dropped", children.log(LOAD))
    return read_samples(log, load), sum(map(int, dropped))


def _measure_echo(
    cubes: int,
    bench: Bench,
    progress: Progress,
) -> dict[str, float]:
    parameters: dict[str, Any] = {
        "cubes": cubes,
        "pads": bench.pads,
        "rate": float(bench.rate),
    }
    processes = [
        Process(role, "workshop.bench.echo", parameters=parameters, arguments=(role,))
        for role in ("echo", "source")
    ]
    with (
        tempfile.TemporaryDirectory(prefix="cube_bench_") as folder,
        Children(Path(folder)) as children,
    ):
        part = replace(bench, duration=min(bench.duration / 2, MAX_ECHO_S))
        name = f"echo of {cubes} cubes"
        measured = _measure(
            processes,
            children,
            part,
            lambda data: None,
            progress,
            name,
        )
    return {"echo_cpu_percent": round(sum(measured.cpu_percent.values()), 1)}


def _measure(
    processes: list[Process],
    children: Children,
    bench: Bench,
    receive: Callable[[bytes], None],
    progress: Progress,
    description: str,
    receive_found: Callable[[bytes], None] | None = None,
) -> Measurement:
    """Start the processes, wait for the first tensors and measure.

    Args:
        processes: The processes.
        children: Starts them.
        bench: Rate of the messages and duration of the measurement.
        receive: Called with each message of stress, serialised, because decoding would cost more
            than what is measured.
        progress: Shows how far the measurement is.
        description: Name of the measurement.
        receive_found: Called with each message of `bench.topic`.

    Raises:
        CubeError: No tensor arrived.
    """
    # Garbage collection would delay the receiver.
    gc.collect()
    gc.freeze()
    began_s = time.monotonic()
    for process in processes:
        children.start(process)
    names = [process.executable for process in processes]
    task = progress.add_task(description, total=bench.duration)
    n_messages = 0

    def on_stress(data: bytes) -> None:
        nonlocal n_messages
        n_messages += 1
        receive(data)

    with observe_skin("bench", children) as observer:
        observer.listen(
            SkinStress,
            "stress",
            on_stress,
            make_batch_profile(bench.rate),
        )
        if receive_found is not None and bench.topic:
            kind, profile = FOUND[bench.topic], make_batch_profile(bench.rate)
            observer.listen(kind, bench.topic, receive_found, profile)
        observer.spin(MAX_START_S, lambda: n_messages > 0)
        if not n_messages:
            logs = "\n".join(children.log(name)[-800:] for name in names)
            raise CubeError(f"{description}: no tensor after {MAX_START_S:g} s\n{logs}")
        # The measurement begins later, so that discovery and imports do not count.
        first_tensor_s = time.monotonic() - began_s
        observer.spin(SETTLE_S)
        usage = Usage(children, names)
        memory_mb: dict[str, list[float]] = {name: [] for name in names}
        start_ns, start_s = time.time_ns(), time.monotonic()
        while (left_s := bench.duration - (time.monotonic() - start_s)) > 0:
            observer.spin(min(MEMORY_PERIOD_S, left_s))
            progress.update(task, completed=time.monotonic() - start_s)
            for name, value in usage.measure_memory_mb().items():
                memory_mb[name].append(value)
        end_ns, cpu_percent = time.time_ns(), usage.measure_cpu_percent()
        observer.spin(DRAIN_S)
    progress.remove_task(task)
    return Measurement(
        start_ns,
        end_ns,
        cpu_percent,
        memory_mb,
        first_tensor_s,
    )


def summarise_memory(memory_mb: dict[str, list[float]]) -> dict[str, float]:
    """Return the largest memory of any process except the hubs, in MB.

    If the measurement took a minute or more, the growth of the process that grows fastest after the
    first fifth of the time is returned as well.
    """
    nodes: list[Array] = [np.array(values) for name, values in memory_mb.items() if name != LOAD]
    result = {"rss_mb": round(float(np.max(nodes)), 1)}
    times_s: Array = MEMORY_PERIOD_S * np.arange(len(nodes[0]), dtype=np.float64)
    if times_s[-1] + MEMORY_PERIOD_S < MIN_GROWTH_DURATION_S:
        return result
    begin = len(times_s) // 5
    slopes = [compute_median_slope(times_s[begin:], values[begin:]) for values in nodes]
    return result | {"rss_mb_per_minute": round(60 * max(slopes), 3)}
