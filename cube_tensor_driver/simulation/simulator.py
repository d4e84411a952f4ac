"""Plays all hubs of a skin in one process, under a load and faults, and logs what they sampled.

The hubs are on pseudo-terminals or TCP.
"""

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

from ..config.skin import Skin
from ..config.yaml import parse_yaml, write_yaml
from ..core.errors import ConfigError
from .cubes import HubCubes, Millihertz, hub_cubes
from .faults import Fault
from .hub import SimulatedHub
from .imperfections import Imperfections
from .injector import Injector, SimulatedLink
from .line import SimulatedLine, TcpLine
from .load import Fields, LoadMemory
from .sample_log import ABSENT, LinkLog, SampleLog

FIRST_UID = 0xC0BE_0000_0000_0001
"""Uid of the skin's first cube if the skin file gives none; the following cubes count up."""

ABSENT_UID = FIRST_UID + 0xFFFF
"""Uid of the first cube of a hub that the skin does not have; the following cubes count down."""

FIRST_BOOT_US = 1_000_003
"""Clock of the first hub at simulated time 0, in µs; that of the second one shows twice as much,
and so on. The clocks of real hubs start at different times, too."""

MAX_DELAY_US = 500_000
"""Delay in µs beyond which a hub leaves samples out. Otherwise, a simulator that is too slow would
fall behind without limit."""

SECOND_US = 1_000_000
"""Period in µs of HELLO and STATS."""

FAULT_PIPE = ".faults"
"""Name of a pipe in the folder of the ports. Each line that is written to it is a fault in YAML."""

HUBS_FILE = ".hubs"
"""Name of a file in the folder of the ports with the `HubSize` of each link in YAML. It exists
before the pipe."""

_PIPE_BYTES = 65536


@dataclass
class PlayedLink(SimulatedLink):
    """A link with the cubes of the skin that its hub carries.

    Attributes:
        carried: The cubes.
        prepared: Frequencies (hub cubes, pads) in mHz at each instant, if they are computed in
            advance.
    """

    carried: HubCubes
    prepared: list[Millihertz] = field(default_factory=list)

    @property
    def computes_load(self) -> bool:
        """Whether the hub takes samples whose load is not computed in advance."""
        return self.hub.started and not self.prepared


class Simulator:
    """All hubs of a skin.

    Attributes:
        start_time_ns: Wall clock at simulated time 0, in ns.
    """

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
        """Create the hubs and their ports.

        Args:
            skin: Skin whose hubs are played.
            load: Load on the skin.
            ports: Folder in which the ports appear, each under the name of its link.
            noise: Noise of the pads as in `SimulatedCubes`.
            drift: Drift of the pads as in `SimulatedCubes`.
            imperfections: Imperfections of the pads as in `SimulatedCubes`.
            instants: Number of times at which the load is computed in advance. They are repeated,
                one for each sample. 0: the load is computed for each sample.
            faults: Faults to carry out.
            seed: Seed of what is random in the faults.
            tcp: Whether links whose port is socket://host:port are played there.

        Raises:
            ConfigError: Cubes of one hub have different numbers of pads, the folder or a TCP
                address cannot be used, or a fault names a link, cube or pad that does not exist.
        """
        self._ports = ports
        self._load = LoadMemory(load)
        # Both clocks are read together: the log converts simulated time to wall clock.
        self._start_ns = time.monotonic_ns()
        self.start_time_ns = time.time_ns()
        self._links: list[PlayedLink] = []
        try:
            ports.mkdir(parents=True, exist_ok=True)
            for carried in hub_cubes(
                skin,
                noise=noise,
                drift=drift,
                imperfections=imperfections,
            ):
                self._links.append(_connect(skin, carried, ports, tcp))
            write_yaml(
                ports / HUBS_FILE,
                {link.name: asdict(link.size) for link in self._links},
            )
            self._fault_pipe = _open_pipe(ports / FAULT_PIPE)
        except OSError as error:
            raise ConfigError(
                f"{ports}: {error.strerror}; name a folder that can be written for the simulated "
                "ports"
            ) from None

        self._injector = Injector(self._links, faults, seed)
        self._prepare(load, instants)
        for link in self._links:
            link.line.send(link.hub.hello(), 0)

    def _prepare(self, load: Fields, instants: int) -> None:
        """Compute frequencies and frames at equally spaced times of the load in advance."""
        for number in range(instants):
            stress, gradient = load.at(number * load.period / instants)
            for link in self._links:
                frequency = link.carried.frequency(stress, gradient, 0.0)
                link.prepared.append(frequency)
                link.hub.prepare(frequency)

    def now_us(self) -> int:
        """Return the simulated time: µs since the start."""
        return (time.monotonic_ns() - self._start_ns) // 1000

    def run(self, stop: Stop) -> None:
        """Play the hubs until a stop is requested: HELLO and STATS at 1 Hz, samples on request."""
        # SelectSelector, because epoll rounds waiting times to ms.
        with selectors.SelectSelector() as selector:
            watched: dict[str, int] = {}
            selector.register(stop.fd, selectors.EVENT_READ, None)
            selector.register(self._fault_pipe, selectors.EVENT_READ, self._read_faults)
            report_us = SECOND_US
            while not stop.requested:
                for link in self._links:
                    self._watch(selector, watched, link)
                wait_s = max(0.0, (self._due_us(report_us) - self.now_us()) * 1e-6)
                for key, _ in selector.select(wait_s):
                    if key.data is not None:
                        key.data()

                now = self.now_us()
                self._skip_late(now)
                self._take_samples(now, stop)
                for link in self._links:
                    link.line.flush(now)
                    if link.computes_load:
                        # Computed before it is due: real hubs do not have to compute their load.
                        self._load.at(link.hub.next_us)
                self._injector.step(now)
                if now >= report_us:
                    report_us += SECOND_US
                    self._report(now)

    def _report(self, now_us: int) -> None:
        """Send HELLO and STATS of all hubs."""
        for link in self._links:
            if link.line.plugged:
                link.line.send(link.hub.hello() + link.hub.stats(now_us), now_us)

    def log(self) -> SampleLog:
        """Return the log of all samples so far."""
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
        """Remove the ports."""
        for link in self._links:
            link.line.unplug()
        os.close(self._fault_pipe)
        # These files tell `inject` that a simulator runs.
        for name in (FAULT_PIPE, HUBS_FILE):
            (self._ports / name).unlink(missing_ok=True)
        # The folder stays if it contains other files.
        with contextlib.suppress(OSError):
            self._ports.rmdir()

    def _due_us(self, report_us: int) -> int:
        """Return the simulated time at which something has to be done next."""
        now = self.now_us()
        times: list[int | None] = [report_us, self._injector.due_us()]
        times += [link.hub.next_us for link in self._links if link.hub.started]
        times += [link.line.due_us(now) for link in self._links]
        return min(time for time in times if time is not None)

    def _skip_late(self, now_us: int) -> None:
        """Leave samples out where a hub is late by more than `MAX_DELAY_US`.

        Prepared samples are never left out: they take little time, and the hub catches up.
        """
        for link in self._links:
            if link.computes_load and now_us - link.hub.next_us > MAX_DELAY_US:
                link.hub.skip(now_us)

    def _take_samples(self, now_us: int, stop: Stop) -> None:
        """Take all samples that are due.

        The hubs take turns, one sample each. If this loop is late, no hub falls behind the others.
        """
        is_behind = True
        while is_behind and not stop.requested:
            is_behind = False
            for link in self._links:
                if link.hub.started and link.hub.next_us <= now_us:
                    # Faults take place between the right samples, however late this loop is.
                    self._injector.step(link.hub.next_us)
                    if link.hub.started:
                        self._take_sample(link, now_us)
                    is_behind |= link.hub.started and link.hub.next_us <= now_us

    def _take_sample(self, link: PlayedLink, now_us: int) -> None:
        """Take and send the next sample of a hub."""
        time_us = link.hub.next_us
        load_us = self._injector.load_us(link, time_us)
        if link.prepared:
            instant = load_us // link.hub.period_us % len(link.prepared)
            frequency = link.prepared[instant]
        else:
            stress, gradient = self._load.at(load_us)
            frequency = link.carried.frequency(stress, gradient, time_us * 1e-6)
        frame = link.hub.sample(self._injector.measured(link, frequency, time_us))
        # Without room on the line, a hub drops the sample and counts it.
        if not link.line.send(self._injector.transmitted(link, frame), now_us):
            link.hub.dropped += 1
            link.mark_damaged()

    def _watch(
        self,
        selector: selectors.BaseSelector,
        watched: dict[str, int],
        link: PlayedLink,
    ) -> None:
        """Let the selector wait for bytes on a line, which may have been plugged or unplugged.

        Args:
            selector: Selector of the main loop.
            watched: File descriptor that is registered for each link.
            link: Link to watch.
        """
        fd = link.line.fd
        before = watched.get(link.name, -1)
        # A line that was unplugged and plugged again has another descriptor.
        if fd == before:
            return
        if before >= 0:
            selector.unregister(before)
        if fd >= 0:
            selector.register(fd, selectors.EVENT_READ, partial(self._answer, link))
        watched[link.name] = fd

    def _answer(self, link: PlayedLink) -> None:
        """Answer what the host sent on a link."""
        now = self.now_us()
        link.line.send(link.hub.receive(link.line.read(), now), now)

    def _read_faults(self) -> None:
        """Carry out the faults that were written into the pipe."""
        text = os.read(self._fault_pipe, _PIPE_BYTES).decode(errors="replace")
        for line in text.splitlines():
            try:
                self._injector.add(
                    Fault.parse(parse_yaml(line, "fault"), "fault"),
                    self.now_us(),
                )
            except ConfigError as error:
                # Anybody may write into the pipe: a mistake must not end the simulator.
                print(f"simulator: {error}", file=sys.stderr, flush=True)


class Stop(Protocol):
    """Request to end the simulator."""

    @property
    def requested(self) -> bool:
        """Whether to end now."""

    @property
    def fd(self) -> int:
        """File descriptor that becomes readable with the request."""


class StopSignal:
    """Request to end by SIGINT or SIGTERM, a `Stop`."""

    def __init__(self) -> None:
        self.requested = False
        self.fd, write = os.pipe()
        os.set_blocking(write, False)  # Python requires it
        # Python writes a byte for each signal, which wakes a selector.
        signal.set_wakeup_fd(write)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._request)

    def _request(self, *_: object) -> None:
        self.requested = True


def _connect(
    skin: Skin,
    carried: HubCubes,
    ports: Path,
    tcp: bool,
) -> PlayedLink:
    """Create a link with its hub and its line."""
    link = carried.link
    number = skin.links.index(link) + 1
    uids = []
    for place, cube in enumerate(carried.members.tolist()):
        if cube == ABSENT:
            uids.append(ABSENT_UID - place)
        else:
            uids.append(skin.cubes[cube].uid or FIRST_UID + cube)

    hub = SimulatedHub(
        uid=link.hub_uid or number,
        cube_uids=uids,
        n_pads=carried.cubes.n_pads,
        boot_us=FIRST_BOOT_US * number,
    )
    is_on_tcp = tcp and link.port.startswith("socket://")
    line = TcpLine(link.port) if is_on_tcp else SimulatedLine(ports / link.name)
    return PlayedLink(link.name, hub, line, carried)


def _open_pipe(path: Path) -> int:
    """Create a named pipe and open it for reading."""
    path.unlink(missing_ok=True)
    os.mkfifo(path)
    # Also open for writing: otherwise it would end whenever a writer closes it.
    return os.open(path, os.O_RDWR | os.O_NONBLOCK)
