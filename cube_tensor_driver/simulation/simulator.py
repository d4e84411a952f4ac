"""Plays all hubs of a skin in one process, on pseudo-terminals or TCP, under a load, and keeps the
book of it."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import selectors
import signal
import sys
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from ..config.skin import Skin
from ..config.yaml import parse_yaml
from ..core.errors import ConfigError
from .cubes import SimulatedCubes
from .faults import Fault, Injector
from .hub import SimulatedHub
from .line import Line, TcpLine
from .load import Load

ABSENT = -1
FIRST_UID = 0xC0BE_0000_0000_0001
LATE_US = 500_000
"""A simulator that cannot keep up lets a hub miss samples rather than take them ever later."""
KEPT_BYTES = 64 << 20
CONTROL = ".faults"
"""A pipe in the folder of the ports: each line written to it is a fault, as YAML."""


@dataclasses.dataclass
class Bench:
    """A hub on its line. members: (hub cubes,) index in the skin of each cube of the hub, ABSENT
    where it has none."""

    name: str
    hub: SimulatedHub
    line: Line
    members: np.ndarray
    cubes: SimulatedCubes
    prepared: list[np.ndarray] = dataclasses.field(default_factory=list)


class Simulator:
    """All hubs of a skin. noise and drift as in `SimulatedCubes`."""

    def __init__(
        self,
        skin: Skin,
        load: Load,
        ports: Path,
        noise: float = 0.0,
        drift: float = 0.0,
        instants: int | None = None,
        faults: Sequence[Fault] = (),
        seed: int = 0,
        tcp: bool = False,
    ) -> None:
        """instants: compute the load at so many instants of its script beforehand and go round
        them, one a sample.

        faults: to carry out; seed: of what is random in them; tcp: play links whose port is
        socket://host:port there.
        ConfigError: cubes of one hub have different numbers of pads, the folder for the ports or a
        TCP address cannot be used, or a fault is of what there is not.
        """
        self._load = load
        self._ports = ports
        self._fields: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        self._start_ns = time.monotonic_ns()
        self.start_time_ns = time.time_ns()
        self.benches: list[Bench] = []
        try:
            ports.mkdir(parents=True, exist_ok=True)
            for number, link in enumerate(skin.links):
                members = hub_members(skin, link.name)
                cubes = [skin.cubes[member] for member in members if member != ABSENT]
                if not cubes:
                    continue
                widths = {cube.calibration.layout.n_pads for cube in cubes}
                if len(widths) > 1:
                    raise ConfigError(
                        f"link {link.name}: its cubes have {sorted(widths)} pads; a hub carries one kind only"
                    )
                uids = [
                    skin.cubes[m].uid or FIRST_UID + int(m)
                    if m != ABSENT
                    else FIRST_UID + 0xFFFF - i
                    for i, m in enumerate(members)
                ]
                # Clocks that started at different times, as those of real hubs.
                hub = SimulatedHub(
                    link.hub_uid or number + 1, uids, widths.pop(), boot_us=1_000_003 * (number + 1)
                )
                simulated = SimulatedCubes(
                    [cube.calibration for cube in cubes], noise, drift, seed=number
                )
                line = (
                    TcpLine(link.port)
                    if tcp and link.port.startswith("socket://")
                    else Line(ports / link.name)
                )
                self.benches.append(Bench(link.name, hub, line, members, simulated))
            control = ports / CONTROL
            control.unlink(missing_ok=True)
            os.mkfifo(control)
            self._control = os.open(control, os.O_RDWR | os.O_NONBLOCK)
        except OSError as error:
            raise ConfigError(
                f"{ports}: {error.strerror}; name a folder that can be written for the simulated ports"
            ) from None
        self._injector = Injector(self.benches, faults, seed)
        self._prepare(instants or 0)
        for bench in self.benches:
            bench.line.send(bench.hub.hello(), 0)

    def _prepare(self, instants: int) -> None:
        for number in range(instants):
            stress, gradient = self._load.at(number * self._load.period / instants)
            for bench in self.benches:
                bench.prepared.append(self._frequency(bench, stress, gradient, 0.0))
                bench.hub.prepare(bench.prepared[-1])

    def now_us(self) -> int:
        """Simulated time: µs since the start."""
        return (time.monotonic_ns() - self._start_ns) // 1000

    def run(self, stop: Stop) -> None:
        """Play the hubs until `stop` is set: HELLO and STATS at 1 Hz, samples when asked for."""
        with selectors.SelectSelector() as selector:  # epoll counts in ms
            watched: dict[str, int] = {}
            selector.register(stop.fd, selectors.EVENT_READ, None)
            selector.register(self._control, selectors.EVENT_READ, self._take_orders)
            second_us = 1_000_000
            while not stop.requested:
                for bench in self.benches:
                    self._watch(selector, watched, bench)
                due = self._due_us(second_us)
                for key, _ in selector.select(max(0.0, (due - self.now_us()) * 1e-6)):
                    if key.data is not None:
                        key.data()
                now = self.now_us()
                for bench in self.benches:
                    if (
                        bench.hub.started
                        and not bench.prepared
                        and now - bench.hub.next_us > LATE_US
                    ):
                        bench.hub.skip(now)
                behind = True
                while behind and not stop.requested:
                    # One of each hub in turn: where this loop comes late no hub falls silent behind
                    # the others.
                    behind = False
                    for bench in self.benches:
                        if bench.hub.started and bench.hub.next_us <= now:
                            # Faults fall between the samples where they belong, however late this
                            # loop comes.
                            self._injector.step(bench.hub.next_us)
                            if bench.hub.started:
                                self._sample(bench, now)
                            behind |= bench.hub.started and bench.hub.next_us <= now
                for bench in self.benches:
                    bench.line.flush(now)
                    if bench.hub.started and not bench.prepared:
                        self._field_at(
                            bench.hub.next_us
                        )  # before it is due: a hub does not compute its load
                self._injector.step(now)
                if now >= second_us:
                    second_us += 1_000_000
                    for bench in self.benches:
                        if bench.line.plugged:
                            bench.line.send(bench.hub.hello() + bench.hub.stats(now), now)

    def _due_us(self, second_us: int) -> int:
        """When something is to be done next."""
        now = self.now_us()
        times: list[int | None] = [second_us, self._injector.due_us()]
        times += [bench.hub.next_us for bench in self.benches if bench.hub.started]
        times += [bench.line.due_us(now) for bench in self.benches]
        return min(time for time in times if time is not None)

    def _watch(
        self, selector: selectors.BaseSelector, watched: dict[str, int], bench: Bench
    ) -> None:
        """Listen to the line as it is plugged now."""
        fd = bench.line.fd
        if watched.get(bench.name, -1) != fd:
            if watched.get(bench.name, -1) >= 0:
                selector.unregister(watched[bench.name])
            if fd >= 0:
                selector.register(fd, selectors.EVENT_READ, partial(self._answer, bench))
            watched[bench.name] = fd

    def _answer(self, bench: Bench) -> None:
        now = self.now_us()
        bench.line.send(bench.hub.receive(bench.line.read(), now), now)

    def _take_orders(self) -> None:
        """Faults that somebody wrote into the control pipe."""
        for line in os.read(self._control, 65536).decode(errors="replace").splitlines():
            try:
                self._injector.add(Fault.parse(parse_yaml(line, "fault"), "fault"), self.now_us())
            except ConfigError as error:
                print(f"simulator: {error}", file=sys.stderr, flush=True)

    def _sample(self, bench: Bench, now_us: int) -> None:
        hub = bench.hub
        if bench.prepared:
            frequency = bench.prepared[hub.next_us // hub.period_us % len(bench.prepared)]
        else:
            stress, gradient = self._field_at(hub.next_us)
            frequency = self._frequency(bench, stress, gradient, hub.next_us * 1e-6)
        frame = hub.sample(self._injector.values(bench, frequency, hub.next_us))
        data = self._injector.frame(bench, frame)
        if not bench.line.send(data, now_us):
            hub.dropped += 1

    def _field_at(self, time_us: int) -> tuple[np.ndarray, np.ndarray]:
        """The field at a time, kept for the next time that the script comes by there."""
        if self._load.script.period is not None:
            time_us %= round(1e6 * self._load.script.period)
        if time_us not in self._fields:
            stress, gradient = self._load.at(time_us * 1e-6)
            if (len(self._fields) + 1) * (stress.nbytes + gradient.nbytes) > KEPT_BYTES:
                self._fields.clear()
            self._fields[time_us] = stress, gradient
        return self._fields[time_us]

    def _frequency(
        self, bench: Bench, stress: np.ndarray, gradient: np.ndarray, seconds: float
    ) -> np.ndarray:
        there = bench.members != ABSENT
        frequency = np.zeros((len(there), bench.hub.n_pads), "<u4")
        cubes = bench.members[there]
        frequency[there] = bench.cubes.frequency(stress[cubes], gradient[cubes], seconds)
        return frequency

    def book(self) -> dict[str, object]:
        """What was sampled: start_time_ns (wall clock at simulated time 0), per link runs, dropped,
        members; faults."""
        links = {
            bench.name: {
                "runs": [dataclasses.asdict(run) for run in bench.hub.runs],
                "dropped": bench.hub.dropped,
                "cubes": bench.members.tolist(),
            }
            for bench in self.benches
        }
        return {"start_time_ns": self.start_time_ns, "links": links, "faults": self._injector.book}

    def close(self) -> None:
        for bench in self.benches:
            bench.line.unplug()
        os.close(self._control)
        (self._ports / CONTROL).unlink(missing_ok=True)
        # Ours to remove when nobody else put anything there.
        with contextlib.suppress(OSError):
            self._ports.rmdir()


class Stop:
    """Set by SIGINT and SIGTERM; its fd wakes a selector."""

    def __init__(self) -> None:
        self.requested = False
        self.fd, write = os.pipe()
        os.set_blocking(write, False)
        signal.set_wakeup_fd(write)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._set)

    def _set(self, *_: object) -> None:
        self.requested = True


def hub_members(skin: Skin, link: str) -> np.ndarray:
    """(hub cubes,) index in the skin of each cube that a simulated hub on this link carries, ABSENT
    for none.

    Cubes that are known by uid alone take the free places; without a link they sit on the first
    one.
    """
    fixed = {
        cube.index: number
        for number, cube in enumerate(skin.cubes)
        if cube.link == link and cube.index is not None
    }
    first = skin.links[0].name
    loose = [
        number
        for number, cube in enumerate(skin.cubes)
        if cube.index is None and (cube.link or first) == link
    ]
    size = max([len(fixed) + len(loose), *(index + 1 for index in fixed)], default=0)
    members = np.full(size, ABSENT)
    members[list(fixed)] = list(fixed.values())
    free = np.flatnonzero(members == ABSENT)[: len(loose)]
    members[free] = loose
    return members
