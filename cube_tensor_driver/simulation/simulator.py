"""Plays all hubs of a skin in one process, on pseudo-terminals or TCP, under a load and faults, and
logs what they sampled."""

from __future__ import annotations

import contextlib
import os
import selectors
import signal
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..config.skin import Skin
from ..config.yaml import parse_yaml, write_yaml
from ..core.errors import ConfigError
from .cubes import HubCubes, hub_cubes
from .faults import Fault, HubSize
from .hub import SimulatedHub
from .imperfections import Imperfections
from .injector import Injector, SimulatedLink
from .line import Line, TcpLine
from .load import Fields, LoadMemory
from .sample_log import ABSENT, LinkLog, SampleLog

FIRST_UID = 0xC0BE_0000_0000_0001
"""Uid of the skin's first cube, of those that have none in the skin file."""
ABSENT_UID = FIRST_UID + 0xFFFF
"""Uid of the first cube of a hub that the skin does not have; the others have lower ones."""
FIRST_BOOT_US = 1_000_003
"""Clock of the first hub at simulated time 0; the second one's shows twice that, and so on: clocks
of real hubs start at different times, too."""
LATE_US = 500_000
"""A hub that is so late leaves samples out: a simulator that cannot keep up would fall behind
without limit."""
SECOND_US = 1_000_000
FAULT_PIPE = ".faults"
"""A pipe in the folder of the ports: each line written to it is a fault, as YAML."""
HUBS_FILE = ".hubs"
"""A file in the folder of the ports: link -> `HubSize`, as YAML. It is there before the pipe."""


@dataclass
class PlayedLink(SimulatedLink):
    """A link with the cubes of the skin that its hub carries.

    prepared: what the cubes measure at each instant, (hub cubes, pads) in mHz, where that is
    computed beforehand.
    """

    carried: HubCubes
    prepared: list[NDArray[np.uint32]] = field(default_factory=list)


class Simulator:
    """All hubs of a skin. start_time_ns: wall clock at simulated time 0."""

    def __init__(
        self,
        skin: Skin,
        load: Fields,
        ports: Path,
        *,
        noise: float | None = 0.0,
        drift: float = 0.0,
        imperfections: Imperfections | None = None,
        instants: int = 0,
        faults: Sequence[Fault] = (),
        seed: int = 0,
        tcp: bool = False,
    ) -> None:
        """ports: folder in which the ports appear, each under the name of its link.

        noise, drift, imperfections: of the pads, as in `SimulatedCubes`
        instants: compute the load at so many times of its script beforehand and repeat them, one
            for each sample; 0: compute it as time goes on, with noise and drift
        faults: to carry out; seed: of what is random in them
        tcp: play links whose port is socket://host:port there

        ConfigError: cubes of one hub have different numbers of pads, the folder for the ports or a
        TCP address cannot be used, or there is no such link, cube or pad as a fault names.
        """
        self._ports = ports
        self._load = LoadMemory(load)
        self._start_ns = time.monotonic_ns()
        self.start_time_ns = time.time_ns()
        self._links: list[PlayedLink] = []
        try:
            ports.mkdir(parents=True, exist_ok=True)
            for carried in hub_cubes(skin, noise=noise, drift=drift, imperfections=imperfections):
                self._links.append(_connect(skin, carried, ports, tcp))
            sizes = {
                link.name: asdict(HubSize(len(link.hub.cube_uids), link.hub.n_pads))
                for link in self._links
            }
            write_yaml(ports / HUBS_FILE, sizes)
            self._fault_pipe = _open_pipe(ports / FAULT_PIPE)
        except OSError as error:
            raise ConfigError(
                f"{ports}: {error.strerror}; name a folder that can be written for the simulated "
                "ports"
            ) from None
        self._injector = Injector(self._links, faults, seed)
        for number in range(instants):
            stress, gradient = load.at(number * load.period / instants)
            for link in self._links:
                link.prepared.append(link.carried.frequency(stress, gradient, 0.0))
                link.hub.prepare(link.prepared[-1])
        for link in self._links:
            link.line.send(link.hub.hello(), 0)

    def now_us(self) -> int:
        """Simulated time: µs since the start."""
        return (time.monotonic_ns() - self._start_ns) // 1000

    def run(self, stop: Stop) -> None:
        """Play the hubs until `stop` is set: HELLO and STATS at 1 Hz, samples when asked for."""
        # SelectSelector, because epoll counts time in ms.
        with selectors.SelectSelector() as selector:
            watched: dict[str, int] = {}
            selector.register(stop.fd, selectors.EVENT_READ, None)
            selector.register(self._fault_pipe, selectors.EVENT_READ, self._read_faults)
            second_us = SECOND_US
            while not stop.requested:
                for link in self._links:
                    self._watch(selector, watched, link)
                due = self._due_us(second_us)
                for key, _ in selector.select(max(0.0, (due - self.now_us()) * 1e-6)):
                    if key.data is not None:
                        key.data()
                now = self.now_us()
                self._skip_late(now)
                self._take_samples(now, stop)
                for link in self._links:
                    link.line.flush(now)
                    if link.hub.started and not link.prepared:
                        # Computed before it is due: real hubs do not compute their load.
                        self._load.at(link.hub.next_us)
                self._injector.step(now)
                if now >= second_us:
                    second_us += SECOND_US
                    for link in self._links:
                        if link.line.plugged:
                            link.line.send(link.hub.hello() + link.hub.stats(now), now)

    def log(self) -> SampleLog:
        """What the hubs did so far."""
        links = tuple(
            LinkLog(
                name=link.name,
                cubes=tuple(link.carried.members.tolist()),
                dropped=link.hub.dropped,
                runs=tuple(link.hub.runs),
                damaged=tuple(link.damaged),
            )
            for link in self._links
        )
        return SampleLog(self.start_time_ns, links, tuple(self._injector.records))

    def close(self) -> None:
        """The ports vanish."""
        for link in self._links:
            link.line.unplug()
        os.close(self._fault_pipe)
        for name in (FAULT_PIPE, HUBS_FILE):
            (self._ports / name).unlink(missing_ok=True)
        # The folder stays when somebody else put something there.
        with contextlib.suppress(OSError):
            self._ports.rmdir()

    def _due_us(self, second_us: int) -> int:
        """When something is to be done next."""
        now = self.now_us()
        times: list[int | None] = [second_us, self._injector.due_us()]
        times += [link.hub.next_us for link in self._links if link.hub.started]
        times += [link.line.due_us(now) for link in self._links]
        return min(time for time in times if time is not None)

    def _skip_late(self, now_us: int) -> None:
        """Leave samples out where a hub is far behind; prepared ones cost too little for that."""
        for link in self._links:
            if link.hub.started and not link.prepared and now_us - link.hub.next_us > LATE_US:
                link.hub.skip(now_us)

    def _take_samples(self, now_us: int, stop: Stop) -> None:
        """All samples that are due, one of each hub in turn: when this loop is late, no hub falls
        silent behind the others."""
        behind = True
        while behind and not stop.requested:
            behind = False
            for link in self._links:
                if link.hub.started and link.hub.next_us <= now_us:
                    # Faults fall between the samples where they belong, however late this loop is.
                    self._injector.step(link.hub.next_us)
                    if link.hub.started:
                        self._take_sample(link, now_us)
                    behind |= link.hub.started and link.hub.next_us <= now_us

    def _take_sample(self, link: PlayedLink, now_us: int) -> None:
        time_us = link.hub.next_us
        load_us = self._injector.load_us(link, time_us)
        if link.prepared:
            frequency = link.prepared[load_us // link.hub.period_us % len(link.prepared)]
        else:
            stress, gradient = self._load.at(load_us)
            frequency = link.carried.frequency(stress, gradient, time_us * 1e-6)
        frame = link.hub.sample(self._injector.measured(link, frequency, time_us))
        if not link.line.send(self._injector.transmitted(link, frame), now_us):
            link.hub.dropped += 1
            link.mark_damaged()

    def _watch(
        self, selector: selectors.BaseSelector, watched: dict[str, int], link: PlayedLink
    ) -> None:
        """Wait for bytes on the line as it is plugged now. watched: by link, what is registered."""
        fd, before = link.line.fd, watched.get(link.name, -1)
        if fd == before:
            return
        if before >= 0:
            selector.unregister(before)
        if fd >= 0:
            selector.register(fd, selectors.EVENT_READ, partial(self._answer, link))
        watched[link.name] = fd

    def _answer(self, link: PlayedLink) -> None:
        now = self.now_us()
        link.line.send(link.hub.receive(link.line.read(), now), now)

    def _read_faults(self) -> None:
        """Carry out the faults that somebody wrote into the pipe."""
        for line in os.read(self._fault_pipe, 65536).decode(errors="replace").splitlines():
            try:
                self._injector.add(Fault.parse(parse_yaml(line, "fault"), "fault"), self.now_us())
            except ConfigError as error:
                print(f"simulator: {error}", file=sys.stderr, flush=True)


class Stop(Protocol):
    """requested: end now; fd: gets readable with it."""

    @property
    def requested(self) -> bool: ...

    @property
    def fd(self) -> int: ...


class StopSignal:
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


def _connect(skin: Skin, carried: HubCubes, ports: Path, tcp: bool) -> PlayedLink:
    """A link, its hub and its line."""
    link = carried.link
    number = skin.links.index(link) + 1
    uids = []
    for place, cube in enumerate(carried.members.tolist()):
        if cube == ABSENT:
            uids.append(ABSENT_UID - place)
        else:
            uids.append(skin.cubes[cube].uid or FIRST_UID + cube)
    hub = SimulatedHub(
        link.hub_uid or number, uids, carried.cubes.n_pads, boot_us=FIRST_BOOT_US * number
    )
    bridged = tcp and link.port.startswith("socket://")
    line = TcpLine(link.port) if bridged else Line(ports / link.name)
    return PlayedLink(link.name, hub, line, carried)


def _open_pipe(path: Path) -> int:
    """A new named pipe, open for reading; open for writing too, so that it never ends."""
    path.unlink(missing_ok=True)
    os.mkfifo(path)
    return os.open(path, os.O_RDWR | os.O_NONBLOCK)
