# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Carries out faults on simulated hubs, at given times or at once, and records them."""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Iterable
from dataclasses import KW_ONLY, dataclass, field, replace

import numpy as np

from ..device.wire.protocol import TEMPERATURE_UNKNOWN, VERSION
from .cubes import Millihertz
from .faults import FRAME_FAULTS, MOMENTARY_FAULTS, PAD_FAULTS, Fault, HubSize, check_target
from .hub import SimulatedHub
from .line import SimulatedLine
from .sample_log import FaultRecord

RELATIVE_CHANGE_PER_CELSIUS = 50e-6
"""Relative change of the rest frequency (frequency without stress) of every pad per °C, which the
fault `temperature` causes."""

ROOM_CELSIUS = 25.0
"""Temperature in °C at which pads have the rest frequencies of their calibration."""

OPEN_FACTOR = 8
"""Factor by which the frequency of a pad rises if its lead is broken (fault `open`), because only
the parasitic capacitance remains. No stress can cause such a high frequency if the parasitic
capacitance is 0.3 times that of the pad at rest (the usual value)."""

MAX_MILLIHERTZ = 0xFFFFFFFF
"""Highest frequency, in mHz, that the 32 bits for a pad in a message of a hub can hold."""

DAMAGING_FAULTS = ("drop", "flip", "insert", "truncate")
"""Kinds of faults after which the host may not be able to decode a frame (message) of a hub."""

_MAX_INSERTED_BYTES = 20
"""Exclusive upper limit of the random number of bytes that the fault `insert` adds to a frame."""

_FALSE_UID_BITS = 0xBAD
"""Bits of a hub's uid (unique number) that the fault `uid` inverts."""

_FAULTS_WITHOUT_END = ("stall", "burst", "temperature")
"""Kinds of faults whose end is not scheduled. The line itself ends a stall and a burst; a changed
temperature stays until the next fault of the kind `temperature`."""


@dataclass
class _BrokenPad:
    """A pad under a fault, and its frequency in mHz at the first sample after the fault began."""

    fault: Fault
    reading: int | None = None


@dataclass
class SimulatedLink:
    """A link of the skin: a simulated hub, its line to the host, and the faults that affect it now.

    Attributes:
        name: Name of the link.
        hub: Simulated hub.
        line: Line between hub and host.
        damaged: Samples whose frame was altered or not sent: for each, the number of the hub's
            restarts before, and the number of the sample.
        frame_faults: Kinds of faults for the next SAMPLE frames (messages with a sample), one for
            each.
        held_back: Frame that is sent after the next one (fault `reorder`).
        broken_pads: Pads under a fault.
        warming: Simulated time in µs at which the temperature began to change, and the fault.
        hold: Simulated time in µs at which a fault `hold` has frozen the load, and this fault;
            None: the load changes with time.
    """

    name: str
    hub: SimulatedHub
    line: SimulatedLine
    _: KW_ONLY
    damaged: list[tuple[int, int]] = field(default_factory=list)
    frame_faults: list[str] = field(default_factory=list)
    held_back: bytes = b""
    broken_pads: list[_BrokenPad] = field(default_factory=list)
    warming: tuple[int, Fault] | None = None
    hold: tuple[int, Fault] | None = None

    @property
    def size(self) -> HubSize:
        """Number of cubes and pads of the hub."""
        return HubSize(len(self.hub.cube_uids), self.hub.n_pads)

    def mark_damaged(self) -> None:
        """Record that the frame of the hub's newest sample is altered or not sent."""
        newest = self.hub.sequence - 1
        self.damaged.append((self.hub.boots, newest))

    def load_us(self, now_us: int) -> int:
        """Return the simulated time, in µs, whose load acts on the cubes of the hub.

        It is earlier than the present time `now_us` during the fault `hold`, which keeps the load
        constant.
        """
        return now_us if self.hold is None else self.hold[0]


class Injector:
    """Carries out faults, such as lost frames or broken pads, on the links of one simulator.

    Attributes:
        records: Records of all faults that have begun.
    """

    def __init__(
        self,
        links: Iterable[SimulatedLink],
        faults: Iterable[Fault] = (),
        seed: int = 0,
    ) -> None:
        """Schedule faults.

        Args:
            links: All links of the simulator.
            faults: Faults to carry out at their times.
            seed: Seed of the random numbers in the faults.

        Raises:
            ConfigError: A fault names a link, cube or pad that does not exist.
        """
        self.records: list[FaultRecord] = []
        self._links = {link.name: link for link in links}
        self._random = np.random.default_rng(seed)
        # Heap (priority queue) of begins and ends of faults: simulated time in µs, whether the
        # fault begins (at the same time, ends come first), serial number, fault.
        self._schedule: list[tuple[int, bool, int, Fault]] = []
        self._numbers = itertools.count()
        for fault in faults:
            self.add(fault, round(1e6 * fault.at))

    def add(self, fault: Fault, at_us: int) -> None:
        """Schedule a fault.

        Args:
            fault: Fault; one without a link affects all links.
            at_us: Simulated time in µs at which the fault begins.

        Raises:
            ConfigError: The fault names a link, cube or pad that does not exist.
        """
        sizes = {name: link.size for name, link in self._links.items()}
        # A fault without a link becomes one fault per link.
        for name in check_target(fault, sizes):
            self._push(at_us, True, replace(fault, link=name))

    def due_us(self) -> int | None:
        """Return the simulated time in µs at which the next fault begins or ends.

        The result is None if no fault is scheduled.
        """
        return self._schedule[0][0] if self._schedule else None

    def step(self, now_us: int) -> None:
        """Begin and end the faults that are due at simulated time `now_us`."""
        while self._schedule and self._schedule[0][0] <= now_us:
            _, begins, _, fault = heapq.heappop(self._schedule)
            act = self._begin if begins else self._end
            act(fault, now_us)

    def measured(
        self,
        link: SimulatedLink,
        frequency: Millihertz,
        now_us: int,
    ) -> Millihertz:
        """Return the frequencies (cubes, pads) in mHz that a hub measures under its faults.

        Args:
            link: Link of the hub.
            frequency: Frequencies (cubes, pads) in mHz of pads without faults.
            now_us: Simulated time of the sample in µs.
        """
        hub = link.hub
        # The array is copied, because it may be used again for a later sample.
        frequency = frequency.copy()
        if link.warming is not None:
            begin_us, fault = link.warming
            # The temperature rises linearly during the fault and then stays constant.
            elapsed_s = 1e-6 * (now_us - begin_us)
            share = min(1.0, elapsed_s / max(fault.seconds, 1e-6))
            rise = share * fault.value
            # A rise of 0 ends the fault. The hub then reports no temperature, as before it.
            hub.celsius = round(100 * (ROOM_CELSIUS + rise)) if rise else TEMPERATURE_UNKNOWN
            warmed = frequency * (1 + RELATIVE_CHANGE_PER_CELSIUS * rise)
            frequency = np.rint(warmed).astype("<u4")
        for broken in link.broken_pads:
            pad = broken.fault.cube, broken.fault.pad
            sound = int(frequency[pad])
            if broken.reading is None:
                broken.reading = sound
            frequency[pad] = compute_broken_reading(broken.fault, sound, broken.reading, now_us)
        no_cubes, pads_behind = (0, 0), (0, hub.extra_pads)
        return np.pad(frequency, (no_cubes, pads_behind))

    def transmitted(self, link: SimulatedLink, data: bytes) -> bytes:
        """Return the bytes that are sent on a link in place of one frame (message) with a sample.

        Args:
            link: The link.
            data: The frame.

        Returns:
            The frame, altered if a fault acts on it; empty if the frame is lost or held back. A
            frame that was held back before (fault `reorder`) follows at the end.
        """
        kind = link.frame_faults.pop(0) if link.frame_faults else ""
        held_back, link.held_back = link.held_back, b""
        if kind in DAMAGING_FAULTS:
            link.mark_damaged()
        if kind == "reorder" and not held_back:
            link.held_back = data
            return b""
        return self._alter_frame(kind, data) + held_back

    def _alter_frame(self, kind: str, data: bytes) -> bytes:
        """Return the bytes that are sent for a frame under a fault.

        Args:
            kind: One of `FRAME_FAULTS`. Any other text leaves the frame unchanged.
            data: Bytes of the frame.
        """
        random = self._random
        match kind:
            case "drop":
                return b""
            case "duplicate":
                return data + data
            case "flip":
                altered = bytearray(data)
                # The zero bytes that delimit the frame at both ends are not altered.
                byte = int(random.integers(1, len(data) - 1))
                altered[byte] ^= 1 << int(random.integers(8))
                return bytes(altered)
            case "insert":
                at = int(random.integers(0, len(data) + 1))
                noise = random.bytes(int(random.integers(1, _MAX_INSERTED_BYTES)))
                return data[:at] + noise + data[at:]
            case "truncate":
                return data[: int(random.integers(1, len(data) - 1))]
        return data

    def _begin(self, fault: Fault, now_us: int) -> None:
        """Begin a fault on its link, record it and schedule its end.

        Args:
            fault: Fault with the name of a single link.
            now_us: Simulated time in µs.
        """
        link = self._links[fault.link]
        hub = link.hub
        line = link.line
        is_momentary = fault.kind in MOMENTARY_FAULTS
        end_us = now_us if is_momentary else now_us + round(1e6 * fault.seconds)
        match fault.kind:
            case kind if kind in FRAME_FAULTS:
                link.frame_faults += [kind] * fault.count
            case kind if kind in PAD_FAULTS:
                link.broken_pads.append(_BrokenPad(fault))
                _report_pads(link)
            case "stall":
                line.held_until_us = end_us
            case "burst":
                line.burst_until_us = end_us
            case "unplug" | "rename":
                link.held_back = b""
                hub.started = False  # a hub is powered by its port
                line.unplug()
            case "reset":
                self._restart(link, now_us, 0)
            case "wrap":
                # Sample numbers reach 2**32 after `count` samples.
                self._restart(link, now_us, -fault.count % 2**32)
            case "drift":
                hub.set_clock(now_us, drift_ppm=fault.value)
            case "step":
                hub.set_clock(now_us, step_us=round(1e6 * fault.value))
            case "temperature":
                link.warming = now_us, fault
            case "hold":
                link.hold = now_us, fault
            case "uid":
                hub.false_uid = hub.uid ^ _FALSE_UID_BITS
            case "pads":
                hub.extra_pads = 1
            case "version":
                hub.version = VERSION + 1

        self.records.append(FaultRecord(now_us, end_us, fault))
        if end_us > now_us and fault.kind not in _FAULTS_WITHOUT_END:
            self._push(end_us, False, fault)

    def _restart(
        self,
        link: SimulatedLink,
        now_us: int,
        sequence: int,
    ) -> None:
        """Restart a hub, which then describes itself by a HELLO frame.

        Args:
            link: Link of the hub.
            now_us: Simulated time in µs.
            sequence: Number of the next sample of the hub.
        """
        link.held_back = b""
        link.hub.reset(now_us, sequence)
        link.line.send(link.hub.hello(), now_us)

    def _end(self, fault: Fault, now_us: int) -> None:
        """End a fault on its link, and undo its effect on the hub, its pads or its line.

        Args:
            fault: Fault that has lasted for its duration.
            now_us: Simulated time in µs.
        """
        link = self._links[fault.link]
        hub = link.hub
        line = link.line
        match fault.kind:
            case kind if kind in PAD_FAULTS:
                link.broken_pads = [
                    broken for broken in link.broken_pads if broken.fault is not fault
                ]
                _report_pads(link)
            case "hold":
                # A fault `hold` that began later has replaced this one, and does not end now.
                if link.hold is not None and link.hold[1] is fault:
                    link.hold = None
            case "unplug" | "rename":
                if line.plugged:
                    return  # the end of another fault has plugged the line in already
                renamed = None
                if fault.kind == "rename":
                    renamed = line.port.with_name(f"{link.name}_{len(self.records)}")
                line.plug(renamed)
                self._restart(link, now_us, 0)
            case "uid":
                hub.false_uid = None
            case "pads":
                hub.extra_pads = 0
            case "version":
                hub.version = VERSION

    def _push(
        self,
        at_us: int,
        begins: bool,
        fault: Fault,
    ) -> None:
        """Schedule the begin or the end of a fault.

        Args:
            at_us: Simulated time in µs.
            begins: Whether the fault begins at this time; otherwise it ends.
            fault: Fault with the name of a single link.
        """
        heapq.heappush(self._schedule, (at_us, begins, next(self._numbers), fault))


def compute_broken_reading(
    fault: Fault,
    sound: int,
    first: int,
    time_us: int,
) -> int:
    """Return the frequency in mHz that a hub measures for a pad under a fault.

    Args:
        fault: Fault of the pad.
        sound: Frequency in mHz without the fault.
        first: Frequency in mHz at the first sample after the fault began.
        time_us: Simulated time in µs.
    """
    match fault.kind:
        case "short":
            return 0
        case "open":
            return min(OPEN_FACTOR * sound, MAX_MILLIHERTZ)
        case "noisy":
            # The simulated time is the seed of the random noise, so that it is reproducible.
            noise = np.random.default_rng(time_us).standard_normal()
            return round(sound * (1 + fault.value * noise))
        case "stuck":
            return first
    return sound


def _report_pads(link: SimulatedLink) -> None:
    """Set the pads that a hub reports as failed in its frames: those under the fault `report`."""
    bits = np.zeros(len(link.hub.cube_uids), "<u4")
    for broken in link.broken_pads:
        if broken.fault.kind == "report":
            bits[broken.fault.cube] |= np.uint32(1 << broken.fault.pad)
    link.hub.pad_fault = bits
