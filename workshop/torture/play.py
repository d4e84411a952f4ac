# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""One torture: its processes, what is done to them, and the record of what arrives.

Nothing is checked here.
"""

from __future__ import annotations

import socket
import time
from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from threading import Event
from typing import Any, NamedTuple

from cube_tensor_driver.config.grid import describe_grid
from cube_tensor_driver.config.skin import read_skin
from cube_tensor_driver.config.yaml import write_yaml
from cube_tensor_driver.core.arrays import Records
from cube_tensor_driver.core.errors import CubeError
from cube_tensor_driver.demo.running import Observer, end_simulator
from cube_tensor_driver.processes.children import Children
from cube_tensor_driver.processes.skin_processes import Process, SimulatedHubs, list_skin_processes
from cube_tensor_driver.simulation.inject import format_fault
from cube_tensor_driver.simulation.sample_log import SampleLog
from cube_tensor_driver.simulation.simulator import FAULT_PIPE

from ..checks.record import NS_PER_S, NodeAction, Record, Span
from ..checks.sent_readings import read_readings
from .actions import MAX_START_S, Actions
from .hubs import READINGS
from .memory import MemoryMonitor
from .mix import CUBES_PER_HUB, HUBS, PADS, RATE, schedule
from .mutations import apply_mutation
from .recorder import record_torture

CUBES_PER_ROW = 8
"""Number of cubes side by side on the tortured skin."""

SETTLE_S = 3.0
"""Time, in seconds, from the end of the mix of faults to the end of the torture."""

UNCHECKED_S = 2.0
"""Length, in seconds, of the last part of a torture, whose samples are not checked."""

ARRIVAL_S = 2.5
"""Time, in seconds, within which the last checked samples arrive."""

MAX_DRAIN_S = 60.0
"""Longest time, in seconds, from the end of the driver until everything that was sent has
arrived."""

NODES = ("driver", "reconstruction")
"""Names of the processes whose memory and threads are measured."""

INSTANTS = 1000
"""Number of instants of the load that the simulated hubs repeat."""


class Played(NamedTuple):
    """Results of a torture (run of a simulated skin under faults).

    Attributes:
        record: What arrived and what was done.
        log: Which samples the hubs took.
        readings: What the hubs sent in each sample, see `read_readings`.
        figures: Figures of the processes, by the name that torture prints.
    """

    record: Record
    log: SampleLog
    readings: Records
    figures: dict[str, Any]


def play(
    duration: float,
    seed: int,
    folder: Path,
    interrupted: Event,
    mutation: str = "",
) -> Played:
    """Run a simulated skin under faults, and record what arrives.

    Args:
        duration: Time in which faults begin, in seconds.
        seed: Seed of the random mix of faults.
        folder: Folder for all files.
        interrupted: Event that ends the torture.
        mutation: Name of a mutation (deliberate error) of a node; empty: none.

    Raises:
        CubeError: A process does not start, or ends.
    """
    ports, log_path = folder / "ports", folder / "log.json"
    skin_path = _write_skin(folder, ports)
    skin = read_skin(skin_path)
    processes = _make_processes(skin_path, ports, log_path, mutation)

    with Children(folder) as children:
        for process in processes.values():
            children.start(process)
        memory = MemoryMonitor(children, NODES)
        with record_torture(skin, children, interrupted, memory) as recorder:
            observer, stress = recorder.observer, recorder.stress
            actions = Actions(
                observer,
                children,
                processes,
                skin,
                stress,
                recorder.on_driver_killed,
            )
            actions.start_driver(ports / FAULT_PIPE)
            begin_ns = time.time_ns()
            # Faults begin only when every cube delivers, because the driver counts the lost samples
            # of a hub from the first one that arrives.
            observer.spin(MAX_START_S, stress.has_every_cube)
            if not stress.count:
                logs = "\n".join(children.log(name)[-500:] for name in NODES)
                raise CubeError(f"no tensor arrived within {MAX_START_S:g} s:\n{logs}")

            # All threads exist when tensors arrive; further ones later are leaks.
            threads = memory.count_threads()
            _carry_out(
                observer,
                actions,
                ports / FAULT_PIPE,
                schedule(duration, seed),
                duration,
            )
            observer.spin(SETTLE_S - ARRIVAL_S)
            # The last samples may still be on their way, so they are not checked.
            end_ns = time.time_ns() - round(NS_PER_S * UNCHECKED_S)
            observer.spin(ARRIVAL_S)
            leaked = Counter(memory.count_threads())
            leaked.subtract(threads)
            growth = memory.compute_growth_mb_per_min()

            # Once it is deactivated, the driver still reports the final counters.
            stopped_ns = time.time_ns()
            actions.stop_driver()
            observer.spin(MAX_DRAIN_S, lambda: recorder.is_complete(stopped_ns))
            record = recorder.finish(Span(begin_ns, end_ns), actions.done)
        logs_text = "".join(children.log(name) for name in processes)
        log = end_simulator(children, log_path)
        readings = read_readings(folder / READINGS, log, PADS)
    figures = {
        **_describe(actions, log),
        "counters": dict(record.counters),
        "threads_leaked": (+leaked).total(),
        "rss_slope_mb_per_min": growth,
        "crashes": logs_text.count("Traceback"),
    }
    return Played(record, log, readings, figures)


def _describe(actions: Actions, log: SampleLog) -> dict[str, Any]:
    """Return the figures of faults and actions."""

    def compute_seconds(time_ns: int) -> float:
        return round((time_ns - log.start_time_ns) / NS_PER_S, 3)

    def format_span(action: NodeAction) -> str:
        begin_s, end_s = compute_seconds(action.begin_ns), compute_seconds(action.end_ns)
        return f"{action.kind}: {begin_s} to {end_s} s"

    failed = [f"{action.kind}: {action.answer}" for action in actions.done if not action.succeeded]
    return {
        "faults": _count_sorted(record.fault.kind for record in log.faults),
        "actions": _count_sorted(action.kind for action in actions.done),
        "timeline": [format_span(action) for action in actions.done],
        # A tare that was refused because the host was too busy is no failure.
        "actions_failed": len(failed) - len(actions.refused),
        "failed": failed,
        "refused": [f"tare: {answer}" for answer in actions.refused],
    }


def _count_sorted(kinds: Iterable[str]) -> dict[str, int]:
    return dict(sorted(Counter(kinds).items()))


def _make_processes(
    skin_path: Path,
    ports: Path,
    log_path: Path,
    mutation: str,
) -> dict[str, Process]:
    """Return the processes by name; the node `markers` is the other subscriber of stress."""
    hubs = SimulatedHubs(ports, sample_log=log_path, instants=INSTANTS)
    processes = {}
    for process in list_skin_processes(
        skin_path,
        rate=RATE,
        markers=True,
        simulated=hubs,
    ):
        # The driver is activated later, when everybody has discovered it.
        if process.executable == "driver":
            process.parameters.update({"autostart": False, "port_directory": ""})
        if process.executable == "reconstruction":
            process.parameters["tare_folder"] = str(skin_path.parent / "tare")
        if process.executable == "simulator":
            process = replace(process, module="workshop.torture.hubs")
        processes[process.executable] = apply_mutation(process, mutation)
    return processes


def _write_skin(folder: Path, ports: Path) -> Path:
    """Write the file of a skin whose hubs are found by their uid, whatever port they are at.

    The last hub is connected by TCP instead of a port, and has the same faults.
    """
    rows = HUBS * CUBES_PER_HUB // CUBES_PER_ROW
    data = describe_grid(
        nx=CUBES_PER_ROW,
        ny=rows,
        links=HUBS,
        rate=RATE,
        port="{}",
    )
    for number, link in enumerate(data["links"]):
        link["port"], link["hub_uid"] = str(ports / "*"), number + 1
    # The system chooses a free port, which the simulator opens again a moment later.
    with socket.create_server(("127.0.0.1", 0)) as free:
        data["links"][-1]["port"] = f"socket://127.0.0.1:{free.getsockname()[1]}"
    path = folder / "skin.yaml"
    write_yaml(path, data)
    return path


def _carry_out(
    observer: Observer,
    actions: Actions,
    fault_pipe: Path,
    events: list[tuple[float, dict[str, Any]]],
    duration: float,
) -> None:
    """Carry out events at their times, and wait for the end of the duration."""
    began_s = time.monotonic()
    # Each line is flushed, because the simulator must carry the fault out at once.
    with fault_pipe.open("w") as pipe:
        for at_s, event in events:
            observer.spin(began_s + at_s - time.monotonic())
            if "action" in event:
                actions.do(event, time.monotonic() - began_s - at_s)
            else:
                pipe.write(format_fault(event))
                pipe.flush()
    observer.spin(began_s + duration - time.monotonic())
