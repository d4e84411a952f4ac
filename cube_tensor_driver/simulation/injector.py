"""Carries faults out on simulated hubs, by schedule or at once, and keeps a record of it."""

from __future__ import annotations

import heapq
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..device.wire.protocol import TEMPERATURE_UNKNOWN, VERSION
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
DAMAGING_FAULTS = ("drop", "flip", "insert", "truncate")
"""What happens to a frame that may not be read any more."""


@dataclass
class SimulatedLink:
    """A link: the simulated hub at its far end, and the line between.

    damaged: restarts of the hub before, and number, of each sample that was not sent as it was
    """

    name: str
    hub: SimulatedHub
    line: Line
    damaged: list[tuple[int, int]] = field(default_factory=list, kw_only=True)

    def mark_damaged(self) -> None:
        """Note that the sample that the hub took last is not sent as it was."""
        self.damaged.append((self.hub.boots, self.hub.sequence - 1))


@dataclass
class _BrokenPad:
    """A pad under a fault; reading: what it read at first, mHz."""

    fault: Fault
    reading: int | None = None


@dataclass
class _State:
    """What is wrong with one hub now.

    frames: what happens to the next SAMPLE frames, in order
    held_back: a frame that goes out after the next one
    warming: simulated time at which the temperature began to change, and the fault that says how
    hold: simulated time whose load stays, and the fault that says so; None: the load goes on
    """

    frames: list[str] = field(default_factory=list)
    held_back: bytes = b""
    pads: list[_BrokenPad] = field(default_factory=list)
    warming: tuple[int, Fault] | None = None
    hold: tuple[int, Fault] | None = None

    def warmer(self, now_us: int) -> float:
        """°C above room temperature."""
        if self.warming is None:
            return 0.0
        begin_us, fault = self.warming
        return float(warming(fault, begin_us, now_us))


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
            hub.celsius = int(centi_celsius(warmer))
            frequency = warmed(frequency, warmer)
        for broken in state.pads:
            at = broken.fault.cube, broken.fault.pad
            if broken.reading is None:
                broken.reading = int(frequency[at])
            frequency[at] = broken_reading(broken.fault, int(frequency[at]), broken.reading, now_us)
        if hub.extra_pads:
            frequency = np.pad(frequency, ((0, 0), (0, hub.extra_pads)))
        return frequency

    def load_us(self, link: SimulatedLink, now_us: int) -> int:
        """Simulated time of the load that the cubes of a hub are under."""
        hold = self._states[link.name].hold
        return now_us if hold is None else hold[0]

    def transmitted(self, link: SimulatedLink, data: bytes) -> bytes:
        """What goes onto the line of one SAMPLE frame; b"" when it is lost or held back."""
        state, random = self._states[link.name], self._random
        kind = state.frames.pop(0) if state.frames else ""
        held_back, state.held_back = state.held_back, b""
        if kind in DAMAGING_FAULTS:
            link.mark_damaged()
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
            _report_pads(hub, state)
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
        elif kind == "hold":
            state.hold = now_us, fault
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
            _report_pads(hub, state)
        elif kind == "hold" and state.hold is not None and state.hold[1] is fault:
            state.hold = None
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


def broken_reading(fault: Fault, sound: int, first: int, time_us: int) -> int:
    """What a broken pad reads at a simulated time, mHz.

    sound: what it would read otherwise; first: what it would have read when the fault began
    """
    if fault.kind == "short":
        return 0
    if fault.kind == "open":
        return min(OPEN_FACTOR * sound, MAX_MILLIHERTZ)
    if fault.kind == "noisy":
        # Noise that depends on the time alone can be computed again from the log.
        return round(sound * (1 + fault.value * np.random.default_rng(time_us).standard_normal()))
    return first if fault.kind == "stuck" else sound


def warming(fault: Fault, begin_us: int, time_us: NDArray[np.int64] | int) -> Any:
    """°C above room temperature at simulated times, while the temperature follows a fault."""
    part = (np.asarray(time_us) - begin_us) * 1e-6 / max(fault.seconds, 1e-6)
    return fault.value * np.minimum(1.0, part)


def warmed(millihertz: NDArray[np.uint32], warmer: Any) -> NDArray[np.uint32]:
    """What pads read that are so many °C warmer, mHz."""
    changed: NDArray[np.uint32] = np.rint(millihertz * (1 + PER_CELSIUS * warmer)).astype("<u4")
    return changed


def centi_celsius(warmer: Any) -> Any:
    """What a hub reports, 0.01 °C: it knows its temperature where it is not room temperature."""
    known = np.rint(100 * (ROOM_CELSIUS + np.asarray(warmer))).astype(int)
    return np.where(np.asarray(warmer) != 0, known, TEMPERATURE_UNKNOWN)


def _report_pads(hub: SimulatedHub, state: _State) -> None:
    """Have the hub report the pads that it is to report."""
    bits = np.zeros(len(hub.cube_uids), "<u4")
    for broken in state.pads:
        if broken.fault.kind == "report":
            bits[broken.fault.cube] |= np.uint32(1 << broken.fault.pad)
    hub.pad_fault = bits if bits.any() else None
