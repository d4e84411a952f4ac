"""Plays a torture: starts the processes of a skin, does to them what the mix says, and records what
comes. Nothing is judged here."""

from __future__ import annotations

import socket
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Event
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node

from cube_tensor_driver.config.grid import grid
from cube_tensor_driver.config.skin import Skin, read_skin
from cube_tensor_driver.config.yaml import write_yaml
from cube_tensor_driver.core.errors import CubeError
from cube_tensor_driver.demo.running import Observer, end_simulator, observing
from cube_tensor_driver.messages.codec import frequency_codec, stress_codec
from cube_tensor_driver.msg import SkinFrequencies, SkinStress
from cube_tensor_driver.processes.children import Children
from cube_tensor_driver.processes.skin_processes import Process, SimulatedHubs, skin_processes
from cube_tensor_driver.ros.messages import to_ns
from cube_tensor_driver.ros.qos import batch_profile
from cube_tensor_driver.simulation.inject import fault_line
from cube_tensor_driver.simulation.sample_log import SampleLog
from cube_tensor_driver.simulation.simulator import FAULT_PIPE

from ..checks.expected import load_tables
from ..checks.record import Deed, Record
from .actions import START_S, Deeds
from .memory import Memory
from .message_log import CubeTape, Tape
from .mix import CUBES_PER_HUB, HUBS, OPENING_CUBES, OPENING_HUB, RATE, schedule
from .mutations import mutated

NX, NY, INSTANTS = 8, HUBS * CUBES_PER_HUB // 8, 1000
LISTENED_CUBE = OPENING_HUB * CUBES_PER_HUB + OPENING_CUBES[0]
"""Its own topics are recorded, too. One of its pads breaks at the beginning."""
SETTLE_S, MARGIN_S, LAST_S, DRAIN_S = 3.0, 2.0, 2.5, 60.0
"""s: after the last fault; what was taken so shortly before the end does not count; until the rest
of it has come; until everything that was sent has come, at most."""
QUIET_S = 1.0
"""s without a new row: then everything has come."""
DEPTH = 20_000
"""Messages that our queues hold, more than anybody's: when this process is held up, nothing may be
lost that the driver would be blamed for."""
NODES = ("driver", "reconstruction")
COUNTERS = ("lost_on_the_way", "dropped_in_hub", "taken", "delivered", "duplicate", "resets")
"""What the driver counts for each link, of what is shown or judged."""


@dataclass(frozen=True)
class Played:
    """A torture that is over.

    began_s: monotonic time at which the driver became active
    figures: of the processes
    """

    record: Record
    log: SampleLog
    began_s: float
    figures: dict[str, Any]


def play(
    duration: float, seed: int, folder: Path, interrupted: Event, mutation: str = ""
) -> Played:
    """Torture a skin for `duration` s. mutation: of the driver or the reconstruction. CubeError:
    something does not start."""
    ports, log = folder / "ports", folder / "log.json"
    path = _skin_file(folder, ports)
    skin = read_skin(path)
    load_tables(skin, INSTANTS)  # now, because later the judge would take longer
    with Children(folder) as children:
        processes = _processes(path, ports, log, folder, mutation)
        for process in processes.values():
            children.start(process)
        memory = Memory(children, NODES)
        with _recording(skin, children, interrupted, memory) as recorder:
            deeds = Deeds(
                recorder.observer,
                children,
                processes,
                skin,
                recorder.stress,
                recorder.new_driver,
            )
            deeds.start_driver(ports / FAULT_PIPE)
            began_s, begin_ns = time.monotonic(), time.time_ns()
            observer = recorder.observer
            observer.spin(START_S, lambda: recorder.stress.cubes_so_far() == len(skin.cubes))
            if not recorder.stress.count:
                said = "\n".join(children.log(name)[-500:] for name in NODES)
                raise CubeError(f"no tensor came within {START_S:g} s:\n{said}")
            threads = memory.threads()
            _torture(observer, deeds, ports, duration, seed)
            observer.spin(SETTLE_S - LAST_S)
            end_ns = time.time_ns() - round(1e9 * MARGIN_S)
            observer.spin(LAST_S)
            leaked = {name: memory.threads()[name] - threads[name] for name in NODES}
            slope = memory.slope_mb_per_min()
            stopped_ns = time.time_ns()
            deeds.stop_driver()
            observer.spin(DRAIN_S, lambda: recorder.is_complete(stopped_ns))
            record = recorder.record(begin_ns, end_ns, deeds.done)
        logs = {name: children.log(name) for name in processes}
        sample_log = end_simulator(children, log)
    kinds = Counter(fault.fault.kind for fault in sample_log.faults)
    failed = [f"{deed.kind}: {deed.answer}" for deed in deeds.done if not deed.done]
    refused = [f"tare: {answer}" for answer in deeds.refused]
    return Played(
        record,
        sample_log,
        began_s,
        {
            "faults": dict(sorted(kinds.items())),
            "deeds": dict(sorted(Counter(deed.kind for deed in deeds.done).items())),
            "timeline": [
                f"{deed.kind}: {_seconds(deed.begin_ns, sample_log)} to "
                f"{_seconds(deed.end_ns, sample_log)} s"
                for deed in deeds.done
            ],
            "deeds_failed": len(failed) - len(refused),
            "failed": failed,
            "refused": refused,
            "counters": dict(record.counters),
            "threads_leaked": sum(max(0, more) for more in leaked.values()),
            "rss_slope_mb_per_min": slope,
            "crashes": sum(text.count("Traceback") for text in logs.values()),
        },
    )


def _seconds(time_ns: int, log: SampleLog) -> float:
    """Of the simulator's time, as in the judge's examples."""
    return round(1e-9 * (time_ns - log.start_time_ns), 3)


def _processes(
    path: Path, ports: Path, log: Path, folder: Path, mutation: str
) -> dict[str, Process]:
    """By name; the node `markers` is the other subscriber of stress."""
    hubs = SimulatedHubs(ports, sample_log=log, instants=INSTANTS)
    processes = {}
    for process in skin_processes(path, rate=RATE, markers=True, simulated=hubs):
        if process.executable == "driver":
            process.parameters.update({"autostart": False, "port_directory": ""})
        if process.executable == "reconstruction":
            process.parameters["tare_folder"] = str(folder / "tare")
        if process.executable == "simulator":
            process = replace(process, arguments=(*process.arguments, "--tcp"))
        processes[process.executable] = mutated(process, mutation)
    return processes


def _skin_file(folder: Path, ports: Path) -> Path:
    """A skin whose links may each be behind every port: only its uid tells which hub it is. The
    last hub is behind a TCP bridge, for the same faults there."""
    data = grid(nx=NX, ny=NY, pitch=0.012, links=HUBS, rate=RATE, port="{}")
    for number, link in enumerate(data["links"]):
        link["port"], link["hub_uid"] = str(ports / "*"), number + 1
    with socket.create_server(("127.0.0.1", 0)) as free:
        data["links"][-1]["port"] = f"socket://127.0.0.1:{free.getsockname()[1]}"
    path = folder / "skin.yaml"
    write_yaml(path, data)
    return path


def _torture(observer: Observer, deeds: Deeds, ports: Path, duration: float, seed: int) -> None:
    """Do what the schedule of a seed says, for so many s."""
    began = time.monotonic()
    with (ports / FAULT_PIPE).open("w") as pipe:
        for at, event in schedule(duration, seed):
            observer.spin(began + at - time.monotonic())
            if "deed" in event:
                deeds.do(event, time.monotonic() - began - at)
            else:
                pipe.write(fault_line(event))
                pipe.flush()
    observer.spin(began + duration - time.monotonic())


class _Recorder:
    """Records both topics, one cube's own topics, and the diagnostics."""

    def __init__(self, observer: Observer, node: Node, skin: Skin) -> None:
        self.observer, self._skin = observer, skin
        quality = batch_profile(RATE)
        quality.depth = DEPTH
        self.frequencies = Tape(
            node, SkinFrequencies, "frequencies", frequency_codec, quality, skin
        )
        self.stress = Tape(node, SkinStress, "stress", stress_codec, quality, skin)
        self._cube = CubeTape(node, skin, LISTENED_CUBE, quality)
        self._links: dict[str, dict[str, str]] = {}
        self._totals: dict[str, str] = {}
        self._before: Counter[str] = Counter()  # of the driver's earlier lives
        self._messages_lost = [0]  # by the reconstruction, in each of its lives
        self._counters_ns = 0
        self._grew_s, self._size = time.monotonic(), 0
        observer.node.create_subscription(
            DiagnosticArray, "/diagnostics", self._on_diagnostics, 1000
        )

    def take(self) -> None:
        """Take what has come."""
        self.frequencies.take()
        self.stress.take()
        self._cube.take()
        size = self.frequencies.count + self.stress.count
        if size != self._size:
            self._size, self._grew_s = size, time.monotonic()

    def is_complete(self, stopped_ns: int) -> bool:
        """Whether all has come that was sent before a time: the driver's last count, and no row
        for a while."""
        return self._counters_ns > stopped_ns and time.monotonic() - self._grew_s > QUIET_S

    def new_driver(self) -> None:
        """The driver was killed; another one counts from 0."""
        self.frequencies.new_writer()
        self._before.update(self._counters())
        self._links.clear()
        self._totals.clear()

    def _counters(self) -> dict[str, int]:
        """Of the driver's present life."""
        links = self._links.values()
        of_links = {name: sum(int(link.get(name, 0)) for link in links) for name in COUNTERS}
        return {**of_links, **{name: int(value) for name, value in self._totals.items()}}

    def record(self, begin_ns: int, end_ns: int, deeds: list[Deed]) -> Record:
        """All of it. MessageError: nothing came."""
        self.take()
        counters = Counter(self._counters())
        counters.update(self._before)
        return Record(
            skin=self._skin,
            instants=INSTANTS,
            frequencies=self.frequencies.received(),
            stress=self.stress.received(),
            cube_messages=self._cube.received(),
            deeds=tuple(deeds),
            counters=counters,
            messages_lost=sum(self._messages_lost),
            begin_ns=begin_ns,
            end_ns=end_ns,
        )

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            values = {pair.key: pair.value for pair in status.values}
            if status.name.startswith("/driver: link "):
                self._links[status.name] = values
            elif status.name == "/driver: rows":
                self._totals, self._counters_ns = values, to_ns(message.header.stamp)
            elif status.name == "/reconstruction: rows":
                lost = int(values["messages lost on the way"])
                if lost < self._messages_lost[-1]:
                    self._messages_lost.append(0)
                self._messages_lost[-1] = lost


@contextmanager
def _recording(
    skin: Skin, children: Children, interrupted: Event, memory: Memory
) -> Iterator[_Recorder]:
    """A recorder, for the length of a block."""
    steps: list[Callable[[], None]] = [memory.look]

    def on_step() -> None:
        for step in steps:
            step()

    with observing("torture", children, interrupted=interrupted, on_step=on_step) as observer:
        node = rclpy.create_node("checker")
        try:
            recorder = _Recorder(observer, node, skin)
            steps.append(recorder.take)
            yield recorder
        finally:
            node.destroy_node()
