"""The simulator: one process that plays all hubs of a skin on pseudo-terminals, under a load that moves over the skin.

Each link's port appears as PORTS/<link name>. On SIGINT or SIGTERM it ends and writes its book: what was sampled when,
so that others can tell what should have arrived.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import json
import os
import selectors
import signal
import sys
import time
import tty
from pathlib import Path

import numpy as np

from ..core.errors import ConfigError, CubeError
from ..files.skin import Skin, read_skin
from .cubes import SimulatedCubes
from .hub import SimulatedHub
from .load import CIRCUIT_S, MovingLoad

OUT_LIMIT = 1 << 16
"""Bytes that wait for the line at most: what is sampled beyond is dropped in the hub, and counted there."""
ABSENT = -1
FIRST_UID = 0xC0BE_0000_0000_0001


class Line:
    """A hub on its pseudo-terminal."""

    def __init__(self, port: Path, hub: SimulatedHub, members: np.ndarray, cubes: SimulatedCubes) -> None:
        """members: (hub cubes,) index in the skin of each cube of the hub, ABSENT where the skin has none."""
        self.hub, self.members, self.cubes, self.port = hub, members, cubes, port
        # The far end stays open, else the near one reports an error whenever the driver closes it.
        self.fd, self._far = os.openpty()
        tty.setraw(self._far)
        os.set_blocking(self.fd, False)
        self._out = bytearray()
        self.prepared: list[np.ndarray] = []
        port.unlink(missing_ok=True)
        port.symlink_to(os.ttyname(self._far))
        self.send(hub.hello())

    def send(self, data: bytes) -> bool:
        """Queue bytes for the line and write what it takes; False when there was no room for them."""
        room = len(self._out) + len(data) <= OUT_LIMIT
        if room:
            self._out += data
        with contextlib.suppress(BlockingIOError):
            while self._out:
                del self._out[: os.write(self.fd, self._out)]
        return room

    def read(self) -> bytes:
        try:
            return os.read(self.fd, 65536)
        except BlockingIOError:
            return b""

    def close(self) -> None:
        self.port.unlink(missing_ok=True)
        os.close(self.fd)
        os.close(self._far)


class Simulator:
    """All hubs of a skin. noise and drift as in `SimulatedCubes`."""

    def __init__(
        self, skin: Skin, ports: Path, noise: float = 0.0, drift: float = 0.0, instants: int | None = None
    ) -> None:
        """instants: compute the load at so many instants of its circuit beforehand and go round them, one a sample.

        ConfigError: cubes of one hub have different numbers of pads, or the folder for the ports cannot be used.
        """
        self._load = MovingLoad(skin)
        self._ports = ports
        self._field: tuple[int, tuple[np.ndarray, np.ndarray]] | None = None
        self._start_ns = time.monotonic_ns()
        self.start_time_ns = time.time_ns()
        self.lines: dict[str, Line] = {}
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
                uids = [skin.cubes[m].uid or FIRST_UID + int(m) if m != ABSENT else FIRST_UID + 0xFFFF - i
                        for i, m in enumerate(members)]  # fmt: skip
                # Clocks that started at different times, as those of real hubs.
                hub = SimulatedHub(link.hub_uid or number + 1, uids, widths.pop(), boot_us=1_000_003 * (number + 1))
                simulated = SimulatedCubes([cube.calibration for cube in cubes], noise, drift, seed=number)
                self.lines[link.name] = Line(ports / link.name, hub, members, simulated)
            self._prepare(instants or 0)
        except OSError as error:
            raise ConfigError(
                f"{ports}: {error.strerror}; name a folder that can be written for the simulated ports"
            ) from None

    def _prepare(self, instants: int) -> None:
        for number in range(instants):
            stress, gradient = self._load.at(number * CIRCUIT_S / instants)
            for line in self.lines.values():
                line.prepared.append(self._frequency(line, stress, gradient, 0.0))

    def now_us(self) -> int:
        """Simulated time: µs since the start."""
        return (time.monotonic_ns() - self._start_ns) // 1000

    def run(self, stop: Stop) -> None:
        """Play the hubs until `stop` is set: HELLO and STATS at 1 Hz, samples when asked for."""
        with selectors.DefaultSelector() as selector:
            for line in self.lines.values():
                selector.register(line.fd, selectors.EVENT_READ, line)
            selector.register(stop.fd, selectors.EVENT_READ, None)
            second_us = 1_000_000
            while not stop.requested:
                due = min([second_us, *(line.hub.next_us for line in self.lines.values() if line.hub.started)])
                for key, _ in selector.select(max(0.0, (due - self.now_us()) * 1e-6)):
                    line = key.data
                    if line is not None:
                        answer = line.hub.receive(line.read(), self.now_us())
                        line.send(answer)
                now = self.now_us()
                for line in self.lines.values():
                    while line.hub.started and line.hub.next_us <= now:
                        self._sample(line)
                if now >= second_us:
                    second_us += 1_000_000
                    for line in self.lines.values():
                        line.send(line.hub.hello() + line.hub.stats(now // 1000))

    def _sample(self, line: Line) -> None:
        hub = line.hub
        if line.prepared:
            frequency = line.prepared[hub.next_us // hub.period_us % len(line.prepared)]
        else:
            if self._field is None or self._field[0] != hub.next_us:
                self._field = hub.next_us, self._load.at(hub.next_us * 1e-6)
            frequency = self._frequency(line, *self._field[1], hub.next_us * 1e-6)
        if not line.send(hub.sample(frequency)):
            hub.dropped += 1

    def _frequency(self, line: Line, stress: np.ndarray, gradient: np.ndarray, seconds: float) -> np.ndarray:
        there = line.members != ABSENT
        frequency = np.zeros((len(there), line.hub.n_pads), "<u4")
        cubes = line.members[there]
        frequency[there] = line.cubes.frequency(stress[cubes], gradient[cubes], seconds)
        return frequency

    def book(self) -> dict[str, object]:
        """What was sampled: start_time_ns (wall clock at simulated time 0) and per link runs, dropped, members."""
        links = {
            name: {
                "runs": [dataclasses.asdict(run) for run in line.hub.runs],
                "dropped": line.hub.dropped,
                "cubes": line.members.tolist(),
            }
            for name, line in self.lines.items()
        }
        return {"start_time_ns": self.start_time_ns, "links": links}

    def close(self) -> None:
        for line in self.lines.values():
            line.close()
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
    """(hub cubes,) index in the skin of each cube that a simulated hub on this link carries, ABSENT for none.

    Cubes that are known by uid alone take the free places; without a link they sit on the first one.
    """
    fixed = {
        cube.index: number for number, cube in enumerate(skin.cubes) if cube.link == link and cube.index is not None
    }
    first = skin.links[0].name
    loose = [number for number, cube in enumerate(skin.cubes) if cube.index is None and (cube.link or first) == link]
    size = max([len(fixed) + len(loose), *(index + 1 for index in fixed)], default=0)
    members = np.full(size, ABSENT)
    members[list(fixed)] = list(fixed.values())
    free = np.flatnonzero(members == ABSENT)[: len(loose)]
    members[free] = loose
    return members


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="simulator", description="Simulated hubs of a skin on pseudo-terminals.")
    parser.add_argument("--config", type=Path, required=True, help="skin file")
    parser.add_argument("--ports", type=Path, required=True, help="folder in which the links' ports appear by name")
    parser.add_argument(
        "--noise", type=float, default=0.0, help="relative standard deviation of a frequency (8e-6 is usual)"
    )
    parser.add_argument("--drift", type=float, default=0.0, help="relative drift of the rest frequencies per second")
    parser.add_argument("--book", type=Path, help="file for the book of what was sampled (JSON), written at the end")
    parser.add_argument("--instants", type=int, help="compute the load at so many instants only, and go round them")
    options = parser.parse_args(arguments)
    stop = Stop()
    try:
        simulator = Simulator(read_skin(options.config), options.ports, options.noise, options.drift, options.instants)
    except CubeError as error:
        print(f"simulator: {error}", file=sys.stderr)
        return 1
    try:
        simulator.run(stop)
    finally:
        simulator.close()
    if options.book:
        partial = options.book.with_suffix(".part")
        partial.write_text(json.dumps(simulator.book()))
        partial.replace(options.book)
    return 0


if __name__ == "__main__":
    sys.exit(main())
