"""`./cube torture`: a skin under a random mix of all faults, in processes of its own. Every row
that arrives is checked against what was measured and what was done to it."""

from __future__ import annotations

import heapq
import socket
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState

from cube_tensor_driver.msg import SkinFrequencies, SkinStress

from ..bags.message_codec import frequency_codec, stress_codec
from ..config.grid import grid
from ..config.skin import Skin, read_skin
from ..config.yaml import write_yaml
from ..core.errors import CubeError
from ..core.rows import FrequencyRows, StressRows, concatenate
from ..processes.children import Children
from ..processes.skin_processes import SimulatedHubs, skin_processes
from ..ros.messages import to_ns
from ..ros.node import queue
from ..simulation.faults import FRAME_FAULTS, PAD_FAULTS
from ..simulation.inject import fault_line
from ..simulation.simulator import FAULT_PIPE
from ..simulation.torture_verification import TortureVerification
from .running import Observer, Usage, end_simulator, interruption, observing, report

HUBS, NX, NY, RATE, INSTANTS = 4, 8, 4, 500.0, 1000
CUBES_PER_HUB = NX * NY // HUBS
START_S, SETTLE_S, DRAIN_S = 40.0, 8.0, 60.0
"""s: until the nodes answer; after the last fault; until everything sent has come, at most."""
MARGIN_S, LAST_S = 2.0, 2.5
"""s: what was taken so shortly before the end does not count; until the rest of it has come."""
ANSWER_TRIES = 4
WARM_S = 60.0
"""From when on memory must not grow; a third of a shorter run."""
BATCH = 64
"""Messages checked at a time: then what numpy costs per call does not count, and checking needs
little of the machine."""
LAG = 300
"""Messages of tensors that wait, so that their frequencies are checked first."""
DEPTH = 20_000
"""Messages that our queues hold, more than anybody's: when this process is held up, nothing may be
lost that the driver would be blamed for."""
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
"""Faults that a link has one after the other."""
NODES = ("driver", "reconstruction")
PROCESSES = (*NODES, "simulator")
COUNTERS = (
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
"""What the driver counts for each link."""
LIMITS = {
    "missed_by_judge": 0.0,
    "unaccounted": 0.0,
    "wrong": 0.0,
    "wrong_tensors": 0.0,
    "false_alarms": 0.0,
    "crashes": 0.0,
    "threads_leaked": 0.0,
    "rss_growth_mb": 5.0,
    "worst_reconnect_s": 3.0,
    "stamp_error_p99_ms": 1.0,
}
"""The most that each figure may be."""


def schedule(duration: float, seed: int) -> Iterator[tuple[float, dict[str, Any]]]:
    """(time in s, fault) in order: harmed frames all the time, cuts of each link one after the
    other, broken pads."""
    random = np.random.default_rng(seed)
    coming: list[tuple[float, int, dict[str, Any]]] = []

    def add(at: float, **fault: Any) -> None:
        heapq.heappush(coming, (at, len(coming), fault))

    at = 0.0
    while (at := at + random.exponential(0.15)) < duration:
        kind, hub = str(random.choice(FRAME_FAULTS)), int(random.integers(HUBS))
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
            "cube": int(random.integers(CUBES_PER_HUB)),
        }
        seconds = round(random.uniform(0.5, 3.0), 3)
        add(
            at,
            kind=str(random.choice(PAD_FAULTS)),
            **place,
            pad=int(random.integers(8)),
            seconds=seconds,
        )
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


def run_torture(*, duration: float, seed: int = 0, json_path: Path | None = None) -> int:
    """Torture a skin for `duration` s with the mix of faults of a seed, and print the figures;
    returns the exit code, 0 when all figures are as they must be. CubeError: something does not
    start."""
    interrupted = interruption()
    with tempfile.TemporaryDirectory(prefix="cube_torture_") as name:
        result = _torture(duration, seed, Path(name), interrupted)
    report(result, json_path)
    broken = failures(result)
    if broken:
        print(f"not as it must be: {', '.join(broken)}")
    return 1 if broken else 0


def failures(result: dict[str, Any]) -> list[str]:
    """Names of the figures that are not as they must be."""
    return [name for name, limit in LIMITS.items() if (result[name] or 0) > limit]


def _torture(
    duration: float, seed: int, folder: Path, interrupted: threading.Event
) -> dict[str, Any]:
    """All figures."""
    ports, log = folder / "ports", folder / "log.json"
    path = _skin_file(folder, ports)
    skin = read_skin(path)
    verification = TortureVerification(skin, INSTANTS)
    with Children(folder) as children:
        hubs = SimulatedHubs(ports, sample_log=log, instants=INSTANTS)
        for process in skin_processes(path, rate=RATE, simulated=hubs):
            if process.executable == "driver":
                process.parameters.update({"autostart": False, "port_directory": ""})
            if process.executable == "simulator":
                process = replace(process, arguments=(*process.arguments, "--tcp"))
            children.start(process)
        with observing("torture", children, interrupted=interrupted) as observer:
            receiver = _Receiver(observer, verification)
            driver = _Lifecycle(observer)
            _start(observer, driver, children, ports)
            observer.spin(START_S, lambda: verification.tensors > 2 * RATE * len(skin.cubes))
            usage = Usage(children, PROCESSES)
            threads, memory = usage.threads(), _inject(observer, usage, ports, duration, seed)
            observer.spin(SETTLE_S)
            end_ns = time.time_ns() - round(1e9 * MARGIN_S)
            observer.spin(LAST_S)
            growth = {name: usage.memory_mb()[name] - memory[name] for name in NODES}
            leaked = {name: max(0, now - threads[name]) for name, now in usage.threads().items()}
            stopped_ns = time.time_ns()
            driver.change(Transition.TRANSITION_DEACTIVATE)
            # What is still on its way here is not lost: with too little of the machine this process
            # may be behind by minutes.
            observer.spin(
                DRAIN_S,
                lambda: receiver.counters_ns > stopped_ns and receiver.rows >= receiver.published,
            )
            receiver.check_all()
        logs = {name: children.log(name) for name in PROCESSES}
        sample_log = end_simulator(children, log)
    figures = verification.result(
        sample_log, end_ns, counted=receiver.counted, published=receiver.published
    )
    faults = Counter(record.fault.kind for record in sample_log.faults)
    return {
        "duration_s": duration,
        "seed": seed,
        **figures,
        "faults": dict(sorted(faults.items())),
        "counters": receiver.counters,
        "threads_leaked": sum(leaked.values()),
        "rss_growth_mb": round(max(growth.values()), 2),
        "said_of_unexplained": _said_of(skin, figures["unexplained"], logs["reconstruction"]),
        "crashes": sum(text.count("Traceback") for text in logs.values()),
    }


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


def _start(observer: Observer, driver: _Lifecycle, children: Children, ports: Path) -> None:
    """Activate the driver when both ends of every topic know each other, so that the first sample
    is received too. CubeError: it did not become active."""
    # Whether this one succeeded shows at the next: a request that is sent again is refused.
    driver.change(Transition.TRANSITION_CONFIGURE)
    node = observer.node
    observer.spin(
        START_S,
        lambda: (
            node.count_publishers("stress") > 0
            and node.count_subscribers("frequencies") > 1
            and node.count_publishers("frequencies") > 0
            and (ports / FAULT_PIPE).exists()
        ),
    )
    observer.spin(1.0)
    if not driver.change(Transition.TRANSITION_ACTIVATE):
        raise CubeError(f"the driver did not become active:\n{children.log('driver')[-1500:]}")


def _inject(
    observer: Observer, usage: Usage, ports: Path, duration: float, seed: int
) -> dict[str, float]:
    """Inject the faults of a seed for so many s; returns the memory of each process when warm."""
    began, memory = time.monotonic(), dict[str, float]()
    with (ports / FAULT_PIPE).open("w") as pipe:
        for at, fault in schedule(duration, seed):
            if not memory and at > min(WARM_S, duration / 3):
                memory = usage.memory_mb()
            observer.spin(began + at - time.monotonic())
            pipe.write(fault_line(fault))
            pipe.flush()
    observer.spin(began + duration - time.monotonic())
    return memory or usage.memory_mb()


def _said_of(skin: Skin, unexplained: list[tuple[int, float]], log: str) -> list[str]:
    """Lines of a node's log about cubes with rows that no fault explains."""
    names = {f"cube {skin.cubes[cube].name}: " for cube, _ in unexplained}
    return [line for line in log.splitlines() if any(name in line for name in names)]


class _Lifecycle:
    """Transitions of the driver."""

    def __init__(self, observer: Observer) -> None:
        self._observer = observer
        self._client = observer.node.create_client(ChangeState, "driver/change_state")
        observer.spin(START_S, self._client.service_is_ready)

    def change(self, transition: int) -> bool:
        """Whether it succeeded. An answer is lost if the driver has not met our client yet: then it
        is asked again."""
        request = ChangeState.Request(transition=Transition(id=transition))
        for _ in range(ANSWER_TRIES):
            future = self._client.call_async(request)
            self._observer.spin(START_S / ANSWER_TRIES, future.done)
            if future.done():
                return bool(future.result().success)
        return False


class _Receiver:
    """Receives everything and has it checked, some messages at a time.

    rows: of frequencies that came; counters_ns: when the newest diagnostics of the driver were made
    """

    def __init__(self, observer: Observer, verification: TortureVerification) -> None:
        self.rows = self.counters_ns = 0
        self._verification = verification
        self._frequencies: list[FrequencyRows] = []
        self._stress: list[StressRows] = []
        self._links: dict[str, dict[str, str]] = {}
        self._totals: dict[str, str] = {}
        quality = queue(RATE)
        quality.depth = DEPTH
        observer.listen(SkinFrequencies, "frequencies", self._on_frequencies, quality)
        observer.listen(SkinStress, "stress", self._on_stress, quality)
        observer.node.create_subscription(
            DiagnosticArray, "/diagnostics", self._on_diagnostics, 1000
        )

    def check_all(self) -> None:
        """Check what still waits."""
        self._check(lag=0)

    @property
    def counters(self) -> dict[str, int]:
        """What the driver counted: sums over all links, and rows."""
        totals = {
            name: sum(int(link.get(name, 0)) for link in self._links.values()) for name in COUNTERS
        }
        return {**totals, **{name: int(value) for name, value in self._totals.items()}}

    @property
    def published(self) -> int:
        """Rows that the driver says it published."""
        return self.counters["rows published"]

    @property
    def counted(self) -> int:
        """Rows that the driver says it did not deliver."""
        counters = self.counters
        samples = counters["lost_on_the_way"] + counters["dropped_in_hub"]
        rows = counters["rows of unknown cubes"] + counters["rows with another number of pads"]
        return CUBES_PER_HUB * samples + rows

    def _on_frequencies(self, data: bytes) -> None:
        rows = frequency_codec.decode(data).rows
        self.rows += len(rows)
        self._frequencies.append(rows)
        if len(self._frequencies) >= BATCH:
            self._check(LAG)

    def _on_stress(self, data: bytes) -> None:
        self._stress.append(stress_codec.decode(data).rows)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            values = {pair.key: pair.value for pair in status.values}
            if status.name.startswith("/driver: link "):
                self._links[status.name] = values
            elif status.name == "/driver: rows":
                self._totals, self.counters_ns = values, to_ns(message.header.stamp)

    def _check(self, lag: int) -> None:
        """Check all frequencies that wait, then all tensors but the newest."""
        if self._frequencies:
            self._verification.frequencies(concatenate(self._frequencies))
            self._frequencies.clear()
        end = max(0, len(self._stress) - lag)
        ready, self._stress = self._stress[:end], self._stress[end:]
        if ready:
            self._verification.stress(concatenate(ready))
