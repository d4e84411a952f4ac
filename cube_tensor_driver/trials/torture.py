"""./cube torture: a skin under a random mix of all faults, in real processes, judged against the
injector's book."""

from __future__ import annotations

import dataclasses
import heapq
import json
import signal
import socket
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.signals import SignalHandlerOptions

from cube_tensor_driver.msg import SkinFrequencies, SkinStress

from ..bags.message_codec import AnyRows, frequency_codec, stress_codec
from ..config.grid import grid
from ..config.output_files import write_json
from ..config.skin import read_skin
from ..config.yaml import to_yaml, write_yaml
from ..core.errors import CubeError
from ..core.rows import FrequencyRows, StressRows
from ..processes.children import Children
from ..processes.skin_processes import SimulatedHubs, skin_processes
from ..ros.messages import to_ns
from ..ros.node import make_executor, queue
from ..simulation.faults import FRAME, PAD
from ..simulation.simulator import CONTROL
from ..simulation.torture_verification import TortureVerification

HUBS, NX, NY, RATE, INSTANTS = 4, 8, 4, 500.0, 1000
START_S, SETTLE_S, MARGIN_S, DRAIN_S = 40.0, 8.0, 2.0, 60.0
BATCH = 64
"""Messages judged at a time: what numpy costs per call no longer counts, and the judge needs little
of the machine."""
LAG = 300
"""Messages of tensors that wait for their frequencies to be judged first."""
CUTS = (
    "stall",
    "burst",
    "unplug",
    "rename",
    "reset",
    "wrap",
    "drift",
    "step",
    "uid",
    "pads",
    "version",
)
NODES = ("driver", "reconstruction", "simulator")


@dataclass(frozen=True)
class Options:
    """As on the command line; duration in s of the faults."""

    duration: float
    seed: int
    json: Path | None


def schedule(duration: float, seed: int) -> Iterator[tuple[float, dict[str, Any]]]:
    """(time in s, fault) in order: harmed frames all the time, cuts of each link one after the
    other, broken pads."""
    random = np.random.default_rng(seed)
    coming: list[tuple[float, int, dict[str, Any]]] = []

    def add(at: float, **fault: Any) -> None:
        heapq.heappush(coming, (at, len(coming), fault))

    at = 0.0
    while (at := at + random.exponential(0.15)) < duration:
        kind, hub = str(random.choice(FRAME)), int(random.integers(HUBS))
        add(at, kind=kind, link=f"hub{hub}", count=int(random.integers(1, 6)))
    # Each kind in turn, so that a short torture has them all.
    kinds = [kind for _ in range(1 + int(duration)) for kind in random.permutation(CUTS).tolist()]
    for hub in range(HUBS):
        at = random.uniform(0.0, 3.0)
        while at < duration - 4:
            kind, seconds = kinds.pop(), random.uniform(0.3, 2.0)
            fault = {"kind": kind, "link": f"hub{hub}", "seconds": round(seconds, 3)}
            if kind == "drift":
                # Another crystal comes with another hub: the rate changes at a restart.
                add(at, kind="drift", link=f"hub{hub}", value=round(random.uniform(-100, 100), 3))
                fault["kind"] = "reset"
            elif kind == "step":
                fault["value"] = round(random.uniform(-0.5, 5.0), 3)
            elif kind == "wrap":
                fault["count"] = int(random.integers(100, 3000))
            add(at, **fault)
            at += seconds + random.uniform(4.0, 20.0)
    at = 0.0
    while (at := at + random.uniform(1.0, 4.0)) < duration - 4:
        place = {
            "link": f"hub{random.integers(HUBS)}",
            "cube": int(random.integers(NX * NY // HUBS)),
        }
        seconds = round(random.uniform(0.5, 3.0), 3)
        add(at, kind=str(random.choice(PAD)), **place, pad=int(random.integers(8)), seconds=seconds)
    at = 0.0
    while (at := at + random.uniform(8.0, 25.0)) < duration - 5:
        link = f"hub{random.integers(HUBS)}"
        add(
            at,
            kind="temperature",
            link=link,
            value=round(random.uniform(1.0, 10.0), 2),
            seconds=2.0,
        )
        add(at + 3.0, kind="temperature", link=link, value=0.0)
    while coming:
        moment, _, fault = heapq.heappop(coming)
        yield moment, fault


def run_torture(options: Options) -> int:
    """Torture, print or write the figures; exit code 0 when all is as it must be, else 1."""
    interrupted = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: interrupted.set())
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    try:
        with tempfile.TemporaryDirectory(prefix="cube_torture_") as name:
            result = _run(options, Path(name), interrupted)
    finally:
        rclpy.try_shutdown()
    print(json.dumps(result, indent=2))
    if options.json is not None:
        write_json(options.json, result)
    broken = failures(result)
    if broken:
        print(f"not as it must be: {', '.join(broken)}")
    return 1 if broken else 0


def failures(result: dict[str, Any]) -> list[str]:
    """Names of the figures that are not as they must be."""
    none = (
        "missed_by_judge",
        "unaccounted",
        "wrong",
        "wrong_tensors",
        "false_alarms",
        "crashes",
        "threads_leaked",
    )
    limits = dict.fromkeys(none, 0.0)
    limits |= {"rss_growth_mb": 5.0, "worst_reconnect_s": 3.0, "stamp_error_p99_ms": 1.0}
    return [name for name, limit in limits.items() if (result[name] or 0) > limit]


def _run(options: Options, folder: Path, interrupted: threading.Event) -> dict[str, Any]:
    ports, path, book = folder / "ports", folder / "skin.yaml", folder / "book.json"
    # Every link may be behind every port: which hub it is only its uid says.
    data = grid(nx=NX, ny=NY, pitch=0.012, links=HUBS, rate=RATE, port=str(ports / "*"))
    for number, link in enumerate(data["links"]):
        link["hub_uid"] = number + 1
    # The last hub is behind a bridge: the same faults over TCP.
    with socket.create_server(("127.0.0.1", 0)) as free:
        data["links"][-1]["port"] = f"socket://127.0.0.1:{free.getsockname()[1]}"
    write_yaml(path, data)
    skin = read_skin(path)
    reckoning = TortureVerification(skin, INSTANTS)
    with Children(folder) as children:
        for process in skin_processes(
            path,
            rate=RATE,
            simulated=SimulatedHubs(ports, sample_log=book, instants=INSTANTS),
        ):
            if process.executable == "driver":
                process.parameters.update({"autostart": False, "port_directory": ""})
            if process.executable == "simulator":
                process = replace(process, arguments=(*process.arguments, "--tcp"))
            children.start(process)
        node = rclpy.create_node("torture")
        watch = _Watch(node, reckoning)
        executor = make_executor()
        executor.add_node(node)

        def spin(seconds: float, done: Callable[[], bool] = lambda: False) -> None:
            until = time.monotonic() + seconds
            while not done() and (left := until - time.monotonic()) > 0:
                if interrupted.is_set():
                    raise CubeError("interrupted")
                executor.spin_once(timeout_sec=min(left, 0.05))
                children.check()

        change = node.create_client(ChangeState, "driver/change_state")
        spin(START_S, change.service_is_ready)

        def transit(number: int) -> bool:
            # An answer is lost if the driver has not met our client yet: asked again.
            for _ in range(4):
                future = change.call_async(ChangeState.Request(transition=Transition(id=number)))
                spin(START_S / 4, future.done)
                if future.done():
                    return bool(future.result().success)
            return False

        # Whether it did shows at the next: asked twice it says no to the second.
        transit(Transition.TRANSITION_CONFIGURE)
        # Both ends of every topic must know each other before the first sample: the judge sees them
        # all.
        spin(
            START_S,
            lambda: (
                node.count_publishers("stress") > 0
                and node.count_subscribers("frequencies") > 1
                and node.count_publishers("frequencies") > 0
                and (ports / CONTROL).exists()
            ),
        )
        spin(1.0)
        if not transit(Transition.TRANSITION_ACTIVATE):
            raise CubeError(f"the driver did not become active:\n{children.log('driver')[-1500:]}")
        spin(START_S, lambda: reckoning.tensors > 2 * RATE * len(skin.cubes))
        processes = {name: psutil.Process(children.pid(name)) for name in NODES}
        threads = {name: process.num_threads() for name, process in processes.items()}
        memory: dict[str, float] = {}
        warm, began = min(60.0, options.duration / 3), time.monotonic()
        with (ports / CONTROL).open("w") as control:
            for at, fault in schedule(options.duration, options.seed):
                if not memory and at > warm:
                    memory = _memory(processes)
                spin(began + at - time.monotonic())
                control.write(to_yaml(fault).replace("\n", " ").strip() + "\n")
                control.flush()
        spin(began + options.duration - time.monotonic())
        spin(SETTLE_S)
        end_ns = time.time_ns() - round(1e9 * MARGIN_S)
        spin(2.5)
        growth = max(after - memory.get(name, after) for name, after in _memory(processes).items())
        leaked = sum(
            max(0, process.num_threads() - threads[name]) for name, process in processes.items()
        )
        ended_ns = time.time_ns()
        transit(Transition.TRANSITION_DEACTIVATE)
        # What is still on its way here is not lost: a judge that got too little of the machine is
        # behind by minutes.
        spin(
            DRAIN_S,
            lambda: watch.said_ns > ended_ns and watch.rows >= watch.counters["rows published"],
        )
        watch.flush()
        counted = watch.counted(len(skin.cubes) // HUBS)
        executor.remove_node(node)
        node.destroy_node()
        logs = {name: children.log(name) for name in NODES}
        children.end(["simulator"])
        result = reckoning.close(
            json.loads(book.read_text()), end_ns, counted, watch.counters["rows published"]
        )
        strange = {f"cube {skin.cubes[cube].name}: " for cube, _ in result["unexplained"]}
        said = [
            line
            for line in logs["reconstruction"].splitlines()
            if any(name in line for name in strange)
        ]
    return {
        "duration_s": options.duration,
        "seed": options.seed,
        **result,
        "faults": _kinds(json.loads(book.read_text())),
        "counters": watch.counters,
        "threads_leaked": leaked,
        "rss_growth_mb": round(growth, 2),
        "said_of_unexplained": said,
        "crashes": sum(log.count("Traceback") for log in logs.values()),
    }


class _Watch:
    """Subscriptions of the judge. rows: of frequencies that came; said_ns: when the driver's
    diagnostics were made."""

    def __init__(self, node: Any, reckoning: TortureVerification) -> None:
        self.rows = self.said_ns = 0
        self._reckoning = reckoning
        self._frequencies: list[FrequencyRows] = []
        self._stress: list[StressRows] = []
        self._links: dict[str, dict[str, str]] = {}
        self._totals: dict[str, str] = {}
        # Deeper than anybody else's: a judge that is held up must not blame the driver for it.
        quality = queue(RATE)
        quality.depth = 20_000
        node.create_subscription(
            SkinFrequencies, "frequencies", self._on_frequencies, quality, raw=True
        )
        node.create_subscription(SkinStress, "stress", self._on_stress, quality, raw=True)
        node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 1000)

    def _on_frequencies(self, data: bytes) -> None:
        rows = frequency_codec.decode(data).rows
        self.rows += len(rows)
        self._frequencies.append(rows)
        if len(self._frequencies) >= BATCH:
            self._judge(LAG)

    def _on_stress(self, data: bytes) -> None:
        self._stress.append(stress_codec.decode(data).rows)

    def _judge(self, lag: int) -> None:
        """All frequencies that wait, then all tensors but the newest."""
        if self._frequencies:
            rows = _joined(self._frequencies)
            self._reckoning.frequencies(rows.cube, rows.sequence, rows.stamp_ns, rows.frequency)
            self._frequencies.clear()
        end = max(0, len(self._stress) - lag)
        ready, self._stress = self._stress[:end], self._stress[end:]
        if ready:
            made = _joined(ready)
            self._reckoning.stress(made.cube, made.sequence, made.stamp_ns, made)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            values = {pair.key: pair.value for pair in status.values}
            if status.name.startswith("/driver: link "):
                self._links[status.name] = values
            elif status.name == "/driver: rows":
                self._totals, self.said_ns = values, to_ns(message.header.stamp)

    def flush(self) -> None:
        """Judge what still waits."""
        self._judge(0)

    @property
    def counters(self) -> dict[str, int]:
        """What the driver counted: over all links, and rows."""
        names = (
            "taken",
            "delivered",
            "lost_on_the_way",
            "dropped_in_hub",
            "duplicate",
            "out_of_order",
            "resets",
            "crc",
            "framing",
            "length",
            "version",
            "overrun",
            "before_hello",
            "opened",
            "silences",
        )
        totals = {
            name: sum(int(link.get(name, 0)) for link in self._links.values()) for name in names
        }
        return {**totals, **{name: int(value) for name, value in self._totals.items()}}

    def counted(self, cubes: int) -> int:
        """Rows that the driver says it did not deliver; `cubes` rows to a sample."""
        counters = self.counters
        rows = counters["rows of unknown cubes"] + counters["rows with another number of pads"]
        return cubes * (counters["lost_on_the_way"] + counters["dropped_in_hub"]) + rows


def _joined(messages: list[AnyRows]) -> AnyRows:
    """The rows of messages, one after the other."""
    names = [field.name for field in dataclasses.fields(messages[0])]
    columns = [np.concatenate([getattr(rows, name) for rows in messages]) for name in names]
    return type(messages[0])(*columns)


def _memory(processes: dict[str, psutil.Process]) -> dict[str, float]:
    return {
        name: process.memory_info().rss / 2**20
        for name, process in processes.items()
        if name != "simulator"
    }


def _kinds(book: dict[str, Any]) -> dict[str, int]:
    """How often each fault was carried out."""
    kinds = [fault["kind"] for _, _, _, fault in book["faults"]]
    return {kind: kinds.count(kind) for kind in sorted(set(kinds))}
