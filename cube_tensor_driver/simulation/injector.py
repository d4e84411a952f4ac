"""Carries faults out on simulated hubs, by schedule or at once, and keeps a record of it."""

from __future__ import annotations

import heapq
from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ..device.protocol import TEMPERATURE_UNKNOWN, VERSION
from .faults import FRAME_FAULTS, MOMENTARY_FAULTS, PAD_FAULTS, Fault, HubSize, check_target
from .hub import SimulatedHub
from .line import Line
from .sample_log import FaultRecord

PER_CELSIUS = 50e-6
"""Relative change of every rest frequency per °C."""
ROOM_CELSIUS = 25.0
OPEN_FACTOR = 8
"""An open pad has only its parasitic capacitance: its frequency rises above all that the pad law
with β = 0.3 can give."""
MAX_MILLIHERTZ = 0xFFFFFFFF


@dataclass
class SimulatedLink:
    """A link: the simulated hub at its far end, and the line between."""

    name: str
    hub: SimulatedHub
    line: Line


@dataclass
class _BrokenPad:
    """A pad under a fault; reading: what a stuck pad repeats."""

    fault: Fault
    reading: np.uint32 | None = None


@dataclass
class _State:
    """What is wrong with one hub now.

    frames: what happens to the next SAMPLE frames, in order
    held_back: a frame that goes out after the next one
    warming: simulated time at which the temperature began to change, and the fault that says how
    """

    frames: list[str] = field(default_factory=list)
    held_back: bytes = b""
    pads: list[_BrokenPad] = field(default_factory=list)
    warming: tuple[int, Fault] | None = None

    def warmer(self, now_us: int) -> float:
        """°C above room temperature."""
        if self.warming is None:
            return 0.0
        begin_us, fault = self.warming
        part = (now_us - begin_us) * 1e-6 / max(fault.seconds, 1e-6)
        return fault.value * min(1.0, part)


class Injector:
    """Carries out faults. records: those that have begun."""

    def __init__(
        self, links: Iterable[SimulatedLink], faults: Iterable[Fault] = (), seed: int = 0
    ) -> None:
        """seed: of what is random in the faults. ConfigError: a fault of a link, cube or pad that
        there is not."""
        self.records: list[FaultRecord] = []
        self._links = {link.name: link for link in links}
        self._states = {name: _State() for name in self._links}
        self._random = np.random.default_rng(seed)
        # Heaps of (simulated time, number, fault): of equal times the earlier number comes first.
        self._coming: list[tuple[int, int, Fault]] = []
        self._ending: list[tuple[int, int, Fault]] = []
        self._number = 0
        for fault in faults:
            self.add(fault, round(1e6 * fault.at))

    def add(self, fault: Fault, at_us: int) -> None:
        """Carry out a fault at a simulated time. ConfigError: of a link, cube or pad that there is
        not."""
        sizes = {
            name: HubSize(len(link.hub.cube_uids), link.hub.n_pads)
            for name, link in self._links.items()
        }
        for name in check_target(fault, sizes):
            self._push(self._coming, at_us, replace(fault, link=name))

    def due_us(self) -> int | None:
        """When `step` has to be called next."""
        times = [heap[0][0] for heap in (self._coming, self._ending) if heap]
        return min(times, default=None)

    def step(self, now_us: int) -> None:
        """Begin and end what is due."""
        while self._ending and self._ending[0][0] <= now_us:
            _, _, fault = heapq.heappop(self._ending)
            self._end(fault, now_us)
        while self._coming and self._coming[0][0] <= now_us:
            _, _, fault = heapq.heappop(self._coming)
            self._begin(fault, now_us)

    def measured(
        self, link: SimulatedLink, frequency: NDArray[np.uint32], now_us: int
    ) -> NDArray[np.uint32]:
        """What the hub measures (cubes, pads) in mHz, given what sound pads would do."""
        state, hub = self._states[link.name], link.hub
        if not state.pads and state.warming is None and not hub.extra_pads:
            return frequency
        frequency = frequency.copy()
        if state.warming is not None:
            warmer = state.warmer(now_us)
            hub.celsius = round(100 * (ROOM_CELSIUS + warmer)) if warmer else TEMPERATURE_UNKNOWN
            frequency = np.rint(frequency * (1 + PER_CELSIUS * warmer)).astype("<u4")
        for broken in state.pads:
            at = broken.fault.cube, broken.fault.pad
            frequency[at] = self._reading(broken, frequency[at])
        if hub.extra_pads:
            frequency = np.pad(frequency, ((0, 0), (0, hub.extra_pads)))
        return frequency

    def _reading(self, broken: _BrokenPad, sound: np.uint32) -> int | np.uint32:
        """What a broken pad reads, mHz; sound: what it would read otherwise."""
        fault = broken.fault
        if fault.kind == "short":
            return 0
        if fault.kind == "open":
            return min(OPEN_FACTOR * int(sound), MAX_MILLIHERTZ)
        if fault.kind == "noisy":
            return round(float(sound) * (1 + fault.value * self._random.standard_normal()))
        if broken.reading is None:
            broken.reading = sound
        return broken.reading

    def transmitted(self, link: SimulatedLink, data: bytes) -> bytes:
        """What goes onto the line of one SAMPLE frame; b"" when it is lost or held back."""
        state, random = self._states[link.name], self._random
        kind = state.frames.pop(0) if state.frames else ""
        held_back, state.held_back = state.held_back, b""
        if kind == "drop":
            data = b""
        elif kind == "flip":
            harmed = bytearray(data)
            harmed[int(random.integers(1, len(data) - 1))] ^= 1 << int(random.integers(8))
            data = bytes(harmed)
        elif kind == "insert":
            at = int(random.integers(0, len(data) + 1))
            data = data[:at] + random.bytes(int(random.integers(1, 20))) + data[at:]
        elif kind == "duplicate":
            data += data
        elif kind == "truncate":
            data = data[: int(random.integers(1, len(data) - 1))]
        elif kind == "reorder" and not held_back:
            state.held_back = data
            return b""
        return data + held_back

    def _begin(self, fault: Fault, now_us: int) -> None:
        link, state = self._links[fault.link], self._states[fault.link]
        hub, line, kind = link.hub, link.line, fault.kind
        end_us = now_us
        if kind not in MOMENTARY_FAULTS:
            end_us += round(1e6 * fault.seconds)
        if kind in FRAME_FAULTS:
            state.frames += [kind] * fault.count
        elif kind in PAD_FAULTS:
            state.pads.append(_BrokenPad(fault))
        elif kind == "stall":
            line.held_until_us = end_us
        elif kind == "burst":
            line.burst_until_us = end_us
        elif kind in ("unplug", "rename"):
            state.held_back = b""
            hub.off()
            line.unplug()
        elif kind in ("reset", "wrap"):
            state.held_back = b""
            hub.reset(now_us, -fault.count % 2**32 if kind == "wrap" else 0)
            line.send(hub.hello(), now_us)
        elif kind == "drift":
            hub.set_clock(now_us, drift_ppm=fault.value)
        elif kind == "step":
            hub.set_clock(now_us, step_us=round(1e6 * fault.value))
        elif kind == "temperature":
            state.warming = now_us, fault
        elif kind == "uid":
            hub.false_uid = hub.uid ^ 0xBAD
        elif kind == "pads":
            hub.extra_pads = 1
        elif kind == "version":
            hub.version = VERSION + 1
        self.records.append(FaultRecord(now_us, end_us, fault))
        # The line itself ends a stall and a burst; a temperature stays until the next one.
        if end_us > now_us and kind not in ("stall", "burst", "temperature"):
            self._push(self._ending, end_us, fault)

    def _end(self, fault: Fault, now_us: int) -> None:
        link, state = self._links[fault.link], self._states[fault.link]
        hub, line, kind = link.hub, link.line, fault.kind
        if kind in PAD_FAULTS:
            state.pads = [broken for broken in state.pads if broken.fault is not fault]
        elif kind in ("unplug", "rename") and not line.plugged:
            renamed = None
            if kind == "rename":
                renamed = line.port.with_name(f"{link.name}_{len(self.records)}")
            line.plug(renamed)
            hub.reset(now_us, 0)
            line.send(hub.hello(), now_us)
        elif kind == "uid":
            hub.false_uid = None
        elif kind == "pads":
            hub.extra_pads = 0
        elif kind == "version":
            hub.version = VERSION

    def _push(self, heap: list[tuple[int, int, Fault]], at_us: int, fault: Fault) -> None:
        self._number += 1
        heapq.heappush(heap, (at_us, self._number, fault))
