# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Simulates all hubs of a skin in one process, under a load and faults, and logs their samples.

The hubs are connected to the host by pseudo-terminals.
"""

from __future__ import annotations

import contextlib
import math
import os
import select
import signal
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

from ..config.skin import Skin, SkinLink
from ..config.yaml import parse_yaml, write_yaml
from ..core.errors import ConfigError
from .cubes import NO_ERRORS, HubCubes, Millihertz, PadErrors, make_hub_cubes
from .faults import Fault
from .hub import SimulatedHub
from .injector import Injector, SimulatedLink
from .line import SimulatedLine
from .load import Fields, remember
from .sample_log import ABSENT, LinkLog, SampleLog

FIRST_UID = 0xC0BE_0000_0000_0001
"""Uid (unique number of a device) of the skin's first cube if the skin file gives none. Every
following cube without a uid gets this number plus its index in the skin."""

ABSENT_UID = FIRST_UID + 0xFFFF
"""Highest uid (unique number of a device) of cubes that are on a simulated hub but not in the skin.
Such a cube gets this number minus its index on the hub."""

FIRST_BOOT_US = 1_000_003
"""Value of the first hub's clock at simulated time 0, in µs. The clock of hub n starts at n times
this value, because the clocks of real hubs start at different times, too."""

MAX_DELAY_US = 500_000
"""Maximum delay, in µs, of a simulated sample behind the time at which it is due. Beyond it, the
hub leaves samples out. Otherwise, the delay of a simulator that is too slow would grow without
limit."""

MAX_WAIT_S = 1.0
"""Maximum time, in seconds, from SIGINT until the simulator ends. It ends earlier if all drivers
have asked the hubs to send no more samples (STOP)."""

MAX_STEP_S = 0.05
"""Maximum time, in seconds, for which the simulator waits for the next event. After this time at
the latest, it notices a request to end."""

REPORT_PERIOD_US = 1_000_000
"""Period, in µs, at which a hub sends the HELLO frame (its description) and the STATS frame (its
counters)."""

FAULT_PIPE = ".faults"
"""Name of a pipe in the folder of the simulated ports. Each line that another process writes to it
is a fault in YAML, which the simulator carries out at once."""

HUBS_FILE = ".hubs"
"""Name of a YAML file in the folder of the simulated ports with the number of cubes and pads of
each link's hub (`HubSize`). It is written before the pipe for faults is created."""

START_FILE = ".start"
"""Name of a file in the folder of the simulated ports with the wall clock at simulated time 0, in
ns since the Unix epoch."""

_PIPE_BYTES = 65536
"""Maximum number of bytes that one read from the pipe for faults returns."""


@dataclass(kw_only=True)
class PlayedLink(SimulatedLink):
    """A simulated link and the cubes on its hub.

    Attributes:
        carried: Cubes on the hub.
        prepared: Frequencies (hub cubes, pads) in mHz that were computed in advance, one array for
            each of successive sampling times; after the last one the first is used again. Empty:
            the load is computed for each sample.
    """

    carried: HubCubes
    prepared: list[Millihertz] = field(default_factory=list)

    @property
    def computes_load(self) -> bool:
        """Whether the hub takes samples now and their load is not computed in advance."""
        return self.hub.started and not self.prepared


class Simulator:
    """Simulates all hubs of a skin in real time.

    Simulated times count from the creation of the simulator, in µs.

    Attributes:
        start_time_ns: Wall clock at simulated time 0, in ns since the Unix epoch.
    """

    def __init__(
        self,
        skin: Skin,
        load: Fields,
        ports: Path,
        errors: PadErrors = NO_ERRORS,
        *,
        instants: int = 0,
        faults: Sequence[Fault] = (),
    ) -> None:
        """Create the hubs and their ports.

        Args:
            skin: Skin whose hubs are simulated.
            load: Stress and gradient at the cubes over time.
            ports: Folder in which the ports appear, each under the name of its link.
            errors: Deviations of the pads from their calibrations.
            instants: Number of times, equally spaced over the period of the load, at which the load
                is computed in advance; successive samples use successive times, again and again.
                0: the load is computed for each sample.
            faults: Faults to carry out at their times.

        Raises:
            ConfigError: Cubes of one hub have different numbers of pads, the folder cannot be used,
                or a fault names a link, cube or pad that does not exist.
        """
        self._ports = ports
        self._field_at = remember(load)
        # Both clocks are read together, because simulated times (by the monotonic clock) are
        # converted to wall clock times in the log.
        self._start_ns = time.monotonic_ns()
        self.start_time_ns = time.time_ns()
        self._links: list[PlayedLink] = []
        try:
            ports.mkdir(parents=True, exist_ok=True)
            for carried in make_hub_cubes(skin, errors):
                link = PlayedLink(
                    name=carried.link.name,
                    hub=_make_hub(skin, carried),
                    line=self._make_line(carried.link),
                    carried=carried,
                )
                self._links.append(link)
            sizes = {link.name: asdict(link.size) for link in self._links}
            write_yaml(ports / HUBS_FILE, sizes)
            (ports / START_FILE).write_text(str(self.start_time_ns))
            self._fault_pipe = _open_pipe(ports / FAULT_PIPE)
        except OSError as error:
            raise ConfigError(
                f"{ports}: {error.strerror}; name a folder that can be written for the simulated "
                "ports"
            ) from None

        self._injector = Injector(self._links, faults)
        for number in range(instants):
            stress, gradient = load.compute_stress_field(number * load.period / instants)
            for link in self._links:
                frequency = link.carried.compute_frequency(
                    stress,
                    gradient,
                    0.0,
                )
                link.prepared.append(frequency)
        for link in self._links:
            link.line.send(link.hub.make_hello(), 0)

    def _make_line(self, link: SkinLink) -> SimulatedLine:
        """Create the line of a hub to the host, a pseudo-terminal.

        Subclasses may create another kind of line.
        """
        return SimulatedLine(self._ports / link.name)

    def now_us(self) -> int:
        """Return the simulated time in µs since the creation of the simulator."""
        return (time.monotonic_ns() - self._start_ns) // 1000

    def run(self, stop: StopRequest) -> None:
        """Simulate the hubs until a stop is requested.

        The hubs send HELLO and STATS at 1 Hz, and samples after the host has requested them
        (START).
        """
        report_us = REPORT_PERIOD_US
        while not stop.is_due(self._is_needed()):
            # A line that was unplugged and plugged in again has another file descriptor.
            plugged = {link.line.fd: link for link in self._links if link.line.plugged}
            now = self.now_us()
            # A pseudo-terminal takes some 10 kB at a time; large frames wait until the host reads.
            writers = [fd for fd, link in plugged.items() if link.line.is_waiting(now)]
            wait_us = self._find_due_us(report_us) - now
            wait_s = min(max(wait_us * 1e-6, 0.0), MAX_STEP_S)
            # `select` is used, because epoll rounds waiting times to milliseconds.
            readable, _, _ = select.select(
                [*plugged, self._fault_pipe],
                writers,
                [],
                wait_s,
            )
            for fd in readable:
                if fd == self._fault_pipe:
                    self._read_faults()
                else:
                    self._answer(plugged[fd])

            now = self.now_us()
            self._take_samples(now, stop)
            for link in self._links:
                link.line.flush(now)
                if link.computes_load:
                    # The load of the next sample is computed in advance, so that the sample is not
                    # late.
                    self._field_at(link.hub.next_us)
            self._injector.step(now)
            if now >= report_us:
                report_us += REPORT_PERIOD_US
                for link in self._links:
                    if link.line.plugged:
                        frames = link.hub.make_hello() + link.hub.make_stats(now)
                        link.line.send(frames, now)

    def _is_needed(self) -> bool:
        """Return whether a driver has asked one of the hubs for samples and not stopped it."""
        return any(link.hub.started for link in self._links)

    def log(self) -> SampleLog:
        """Return the log of all samples and faults so far."""
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
        return SampleLog(
            self.start_time_ns,
            links,
            tuple(self._injector.records),
        )

    def close(self) -> None:
        """Remove the ports, the pipe for faults, and the folder if it is empty then."""
        for link in self._links:
            link.line.unplug()
        os.close(self._fault_pipe)
        # `./cube inject` recognises a running simulator by these files.
        for name in (FAULT_PIPE, HUBS_FILE, START_FILE):
            (self._ports / name).unlink(missing_ok=True)
        # The folder stays if it contains other files.
        with contextlib.suppress(OSError):
            self._ports.rmdir()

    def _find_due_us(self, report_us: int) -> int:
        """Return the simulated time in µs at which the simulator has to act next.

        This is the earliest of the following times: the next sample of a hub, the next report
        (HELLO and STATS), the next start or end of a fault, and the end of a delay of bytes.

        Args:
            report_us: Simulated time in µs of the next HELLO and STATS.
        """
        now = self.now_us()
        times: list[int | None] = [report_us, self._injector.find_due_us()]
        for link in self._links:
            sample_us = link.hub.next_us if link.hub.started else None
            times += [sample_us, link.line.find_due_us(now)]
        return min(time for time in times if time is not None)

    def _take_samples(self, now_us: int, stop: StopRequest) -> None:
        """Take all samples that are due at simulated time `now_us`, unless a stop is requested.

        Every hub takes one sample before any hub takes its next one. So if the simulator is late,
        all hubs are equally late. Hubs that are late by more than `MAX_DELAY_US` leave samples out.
        Samples whose load was computed in advance are never left out, because they take so little
        time that a late hub catches up.
        """
        for link in self._links:
            if link.computes_load and now_us - link.hub.next_us > MAX_DELAY_US:
                link.hub.skip(now_us)
        while not stop.is_due(self._is_needed()):
            due = [link for link in self._links if link.hub.is_due(now_us)]
            if not due:
                return
            for link in due:
                # Faults that are due before this sample come first, also if this loop is late.
                self._injector.step(link.hub.next_us)
                if link.hub.started:
                    self._take_sample(link, now_us)

    def _take_sample(self, link: PlayedLink, now_us: int) -> None:
        """Take the next sample of a hub, and send its frame unless a fault loses it.

        Args:
            link: Link of the hub.
            now_us: Present simulated time in µs; the sample may have been due earlier.
        """
        time_us = link.hub.next_us
        load_us = link.find_load_time_us(time_us)
        if link.prepared:
            instant = load_us // link.hub.period_us % len(link.prepared)
            frequency = link.prepared[instant]
        else:
            stress, gradient = self._field_at(load_us)
            frequency = link.carried.compute_frequency(
                stress,
                gradient,
                time_us * 1e-6,
            )
        celsius = link.carried.cubes.compute_temperature(time_us * 1e-6)
        if not math.isnan(celsius):
            link.hub.celsius = round(100 * celsius)
        measured = self._injector.measure(link, frequency, time_us)
        frame = link.hub.sample(measured)
        sent = self._injector.transmit(link, frame)
        # If the line has no room for the frame, the hub drops the sample and counts it.
        if not link.line.send(sent, now_us):
            link.hub.dropped += 1
            link.mark_damaged()

    def _answer(self, link: PlayedLink) -> None:
        """Read the requests of the host on a link and send the hub's answers."""
        request = link.line.read()
        # A hub that is asked for its time (TIME) must read its clock after the request has come.
        now = self.now_us()
        link.line.send(link.hub.receive(request, now), now)

    def _read_faults(self) -> None:
        """Read the faults that other processes wrote into `FAULT_PIPE`, and let them begin now."""
        data = os.read(self._fault_pipe, _PIPE_BYTES)
        for line in data.decode(errors="replace").splitlines():
            try:
                values = parse_yaml(line, "fault")
                fault = Fault.parse(values, "fault")
                self._injector.add(fault, self.now_us())
            except ConfigError as error:
                # Any process may write into the pipe, so a wrong fault does not end the simulator.
                print(f"simulator: {error}", file=sys.stderr, flush=True)


class StopRequest:
    """Request to end the simulator, which another thread or a signal makes."""

    def __init__(self) -> None:
        # Monotonic time, in s, at which the simulator ends at the latest; infinite if nobody has
        # requested that it ends.
        self._until_s = math.inf

    def request(
        self,
        number: int = signal.SIGTERM,
        _: object = None,
    ) -> None:
        """Request the stop; this method is also the handler of SIGINT and SIGTERM.

        Ctrl-C sends SIGINT to the simulator and to the driver at the same time. If a link ended
        before the driver has closed it, the driver would report the link as lost. So after SIGINT,
        the simulator waits up to `MAX_WAIT_S` for the driver.

        Args:
            number: Number of the signal.
        """
        wait_s = MAX_WAIT_S if number == signal.SIGINT else 0.0
        self._until_s = min(self._until_s, time.monotonic() + wait_s)

    def is_due(self, is_needed: bool) -> bool:
        """Return whether to end now.

        Args:
            is_needed: Whether a driver still reads samples of the hubs.
        """
        if self._until_s == math.inf:
            return False
        return not is_needed or time.monotonic() >= self._until_s


def _make_hub(skin: Skin, carried: HubCubes) -> SimulatedHub:
    """Create the hub of a link.

    Args:
        skin: Skin that contains the link.
        carried: Link and cubes of the hub.
    """
    number = skin.links.index(carried.link) + 1
    given = [cube.uid or FIRST_UID + index for index, cube in enumerate(skin.cubes)]
    uids = [
        ABSENT_UID - place if cube == ABSENT else given[cube]
        for place, cube in enumerate(carried.members.tolist())
    ]
    return SimulatedHub(
        uid=carried.link.hub_uid or number,
        cube_uids=uids,
        n_pads=carried.cubes.n_pads,
        boot_us=FIRST_BOOT_US * number,
    )


def _open_pipe(path: Path) -> int:
    """Create a named pipe, open it without blocking and return the file descriptor."""
    path.unlink(missing_ok=True)
    os.mkfifo(path)
    # The pipe is also opened for writing. Otherwise it would always be readable (at its end) after
    # another process has written to it and closed it.
    return os.open(path, os.O_RDWR | os.O_NONBLOCK)
