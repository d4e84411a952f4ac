"""./cube demo: simulated hubs, driver and reconstruction in real processes, watched over DDS,
judged against truth."""

from __future__ import annotations

import json
import math
import os
import signal
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.signals import SignalHandlerOptions

from cube_tensor_driver.msg import SkinFrequencies, SkinStress

from ..bags.message_codec import frequency_codec, stress_codec
from ..config.grid import grid
from ..config.load_script import read_script
from ..config.output_files import write_json
from ..config.package_data import package_data
from ..config.skin import Skin, read_skin
from ..config.yaml import write_yaml
from ..core.errors import ConfigError, CubeError, MessageError
from ..plot.skin_force import draw_forces
from ..plot.style import save
from ..processes.children import Children
from ..processes.skin_processes import Process, SimulatedHubs, skin_processes
from ..ros.node import make_executor, queue
from ..simulation.load import Load, default_script
from ..simulation.verification import Judge
from ..terminal.live_table import LiveTable

FIRST_TENSORS_S = 20.0
LAST_TENSORS_S = 2.0
CALIBRATION, LAYOUT, PITCH, RATE, CUBES_PER_HUB = "planar", "planar", 0.012, 100.0, 8


@dataclass(frozen=True)
class Options:
    """As on the command line; None: not given. duration in s, None: until Ctrl-C."""

    config: Path | None
    cubes: int | None
    rate: float | None
    duration: float | None
    headless: bool
    json: Path | None
    view: bool = False
    load: Path | None = None
    figure: Path | None = None


class Interrupted(CubeError):
    """Ctrl-C, or asked to end."""


def demo_skin(options: Options, folder: Path) -> Path:
    """The skin file to run: the given one, the shipped one, or a grid of as many cubes as asked
    for."""
    if options.config is not None:
        return options.config.resolve()
    if options.cubes is None:
        return package_data() / "config" / "skin_demo.yaml"
    if not 1 <= options.cubes <= 4096:
        raise ConfigError(f"--cubes is {options.cubes}, allowed: 1 to 4096")
    nx = math.ceil(math.sqrt(options.cubes))
    skin = grid(
        "skin",
        nx=nx,
        ny=math.ceil(options.cubes / nx),
        pitch=PITCH,
        links=math.ceil(options.cubes / CUBES_PER_HUB),
        calibration=CALIBRATION,
        layout=LAYOUT,
        rate=options.rate or RATE,
        port="/dev/ttyACM{}",
    )
    skin["cubes"] = skin["cubes"][: options.cubes]
    used = {cube["link"] for cube in skin["cubes"]}
    skin["links"] = [link for link in skin["links"] if link["name"] in used]
    path = folder / "skin.yaml"
    write_yaml(path, skin)
    return path


def run_demo(options: Options) -> int:
    """Run until the duration is over or Ctrl-C; returns the exit code."""
    interrupted = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda *_: interrupted.set())
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    try:
        with tempfile.TemporaryDirectory(prefix="cube_demo_") as name:
            folder = Path(name)
            path = demo_skin(options, folder)
            return _run(options, path, read_skin(path), folder, interrupted)
    except Interrupted:
        # Without a duration Ctrl-C is how it ends.
        return 0 if options.duration is None else 130
    finally:
        rclpy.try_shutdown()


def _run(
    options: Options, path: Path, skin: Skin, folder: Path, interrupted: threading.Event
) -> int:
    rate = options.rate or skin.rate or RATE
    book = folder / "book.json"
    script = read_script(options.load) if options.load else default_script()
    load = Load(skin, script)
    judge = Judge(skin, load)
    with LiveTable(skin, show=not options.headless) as table, Children(folder) as children:
        for process in skin_processes(
            path,
            rate=rate,
            simulated=SimulatedHubs(folder / "ports", load=options.load, sample_log=book),
        ):
            children.start(process)
        if options.view:
            children.start(Process("view", "cube_tensor_driver.cli", False, arguments=("view",)))
        node = rclpy.create_node("demo", automatically_declare_parameters_from_overrides=False)

        strangers = threading.Event()

        def alone() -> None:
            """CubeError: another skin publishes here."""
            if strangers.is_set() or node.count_publishers("stress") > 1:
                raise CubeError(
                    f"another skin publishes stress in DDS domain {os.environ.get('ROS_DOMAIN_ID', 0)}: end it, or set "
                    "another ROS_DOMAIN_ID for this one"
                )

        def on_stress(data: bytes) -> None:
            received_ns = time.time_ns()
            try:
                rows = stress_codec.decode(data).rows
            except MessageError as error:
                judge.contradictions += 1
                node.get_logger().error(str(error))
                return
            if int(rows.cube.max(initial=0)) >= len(skin.cubes):
                strangers.set()
                return
            if options.duration is not None:
                judge.stress(rows.cube, rows.sequence, rows.stamp_ns, rows, received_ns)
            table.update(rows)

        def on_frequencies(data: bytes) -> None:
            try:
                rows = frequency_codec.decode(data).rows
            except MessageError as error:
                judge.contradictions += 1
                node.get_logger().error(str(error))
                return
            judge.frequencies(rows.cube, rows.sequence)

        crc: dict[str, int] = {}

        def on_diagnostics(message: DiagnosticArray) -> None:
            for status in message.status:
                counted = [int(pair.value) for pair in status.values if pair.key == "crc"]
                if counted:
                    crc[status.name] = counted[0]

        node.create_subscription(SkinStress, "stress", on_stress, queue(rate), raw=True)
        if options.duration is not None:
            node.create_subscription(
                SkinFrequencies, "frequencies", on_frequencies, queue(rate), raw=True
            )
            node.create_subscription(DiagnosticArray, "/diagnostics", on_diagnostics, 10)
        executor = make_executor()
        executor.add_node(node)
        spin = _spinner(executor, children, table, interrupted)
        try:
            # What is measured starts when every topic has reached us: discovery takes up to
            # seconds.
            live = options.duration is None
            spin(
                FIRST_TENSORS_S,
                lambda: (
                    strangers.is_set()
                    or (table.seen_all and (live or (judge.sampled and bool(crc))))
                ),
            )
            alone()
            if not table.seen_all:
                raise CubeError(
                    f"after {FIRST_TENSORS_S:g} s only {table.seen} of {len(skin.cubes)} cubes have a tensor.\n"
                    + "\n".join(children.log(name)[-1500:] for name in ("driver", "reconstruction"))
                )
            if options.view:
                spin(FIRST_TENSORS_S, lambda: "http://" in children.log("view"))
                table.note = (
                    f"\n{children.log('view').strip().splitlines()[-1].split()[0]} shows it"
                )
            if live:
                spin(math.inf, lambda: False)
            spin(0.1, lambda: False)
            start_ns, processes = time.time_ns(), _processes(children)
            cpu = {name: _cpu(process) for name, process in processes.items()}
            spin(options.duration or 0.0, lambda: False)
            alone()
            seconds = (time.time_ns() - start_ns) * 1e-9
            used = {
                name: 100 * (_cpu(process) - cpu[name]) / seconds
                for name, process in processes.items()
            }
            memory = {
                name: process.memory_info().rss / 2**20 for name, process in processes.items()
            }
            end_ns = start_ns + round((options.duration or 0) * 1e9)
            # Where the machine is busy the simulator takes its samples late.
            spin(LAST_TENSORS_S, lambda: judge.beyond(end_ns))
            children.end(["simulator"])
            if not book.exists():
                raise CubeError(
                    f"the simulator did not end as asked:\n{children.log('simulator')[-1500:]}"
                )
            judge.read_book(json.loads(book.read_text()), start_ns, end_ns)
            spin(LAST_TENSORS_S, judge.complete)
        finally:
            executor.remove_node(node)
            node.destroy_node()
    result = {
        "cubes": len(skin.cubes),
        "rate_hz": rate,
        "duration_s": options.duration,
        **judge.result(),
        "crc_errors": sum(crc.values()),
        **{f"cpu_{name}_percent": round(value, 1) for name, value in used.items()},
        **{f"rss_{name}_mb": round(value, 1) for name, value in memory.items()},
    }
    if options.figure is not None:
        forces = judge.forces()
        result |= forces.figures()
        picture = draw_forces(
            seconds=forces.seconds,
            force=forces.force,
            measured_force=forces.found_force,
            centre=forces.centre,
            measured_centre=forces.found_centre,
            cubes=load.places.position,
        )
        save(picture, options.figure)
    _report(result, options)
    return 0


def _spinner(
    executor: Any, children: Children, table: LiveTable, interrupted: threading.Event
) -> Callable[[float, Callable[[], bool]], None]:
    def spin(seconds: float, done: Callable[[], bool]) -> None:
        """Spin for so long or until done. Interrupted: Ctrl-C. ChildError: a process ended."""
        until = time.monotonic() + seconds
        while not done() and (left := until - time.monotonic()) > 0:
            if interrupted.is_set():
                raise Interrupted("interrupted")
            executor.spin_once(timeout_sec=min(left, 0.05))
            children.check()
            table.refresh()

    return spin


def _processes(children: Children) -> dict[str, psutil.Process]:
    return {name: psutil.Process(children.pid(name)) for name in ("driver", "reconstruction")}


def _cpu(process: psutil.Process) -> float:
    times = process.cpu_times()
    return float(times.user + times.system)


def _report(result: dict[str, object], options: Options) -> None:
    if options.json is None:
        print(json.dumps(result, indent=2))
    else:
        write_json(options.json, result)
