# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Carries out faults on simulated hubs, at given times or at once, and records them."""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from functools import partial

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
"""Factor by which the frequency of a pad rises if its lead is broken (fault `open`), because only a
part of the parasitic capacitance remains. Stress can raise the frequency at most 4.3 times if the
parasitic capacitance is 0.3 times that of the pad's foam at rest (the usual value)."""

MAX_MILLIHERTZ = 0xFFFFFFFF
"""Highest frequency, in mHz, that the 32 bits for a pad in a message of a hub can hold."""

DAMAGING_FAULTS = ("drop", "flip", "insert", "truncate")
"""Kinds of faults after which the host may not be able to decode a frame (message) of a hub."""

_MAX_INSERTED_BYTES = 20
"""Exclusive upper limit of the random number of bytes that the fault `insert` adds to a frame."""

_FALSE_UID_BITS = 0xBAD
"""Bits of a hub's uid (unique number) that the fault `uid` inverts."""


@dataclass(kw_only=True)
class SimulatedLink:
    """A link of the skin: a simulated hub, its line to the host, and the faults that affect it now.

    Attributes:
        name: Name of the link.
        hub: Simulated hub.
        line: Line between hub and host.
        damaged: Samples whose frame was altered or not sent: for each, the number of the hub's
            restarts before, and the number of the sample.
        frame_faults: Kinds of faults for the next SAMPLE frames (messages with a sample), one kind
            for each frame.
        held_back: Frame that is sent after the next one (fault `reorder`).
        faults: Faults with a duration that act now, in the order in which they began.
        first_readings: Fault of a pad -> frequency in mHz of the pad at the first sample after the
            fault began. The fault `stuck` repeats this frequency.
    """

    name: str
    hub: SimulatedHub
    line: SimulatedLine
    damaged: list[tuple[int, int]] = field(default_factory=list)
    frame_faults: list[str] = field(default_factory=list)
    held_back: bytes = b""
    faults: list[FaultRecord] = field(default_factory=list)
    first_readings: dict[FaultRecord, int] = field(default_factory=dict)

    @property
    def size(self) -> HubSize:
        """Number of cubes and pads of the hub."""
        return HubSize(len(self.hub.cube_uids), self.hub.n_pads)

    def find_faults(self, *kinds: str) -> list[FaultRecord]:
        """Return the faults of some kinds that act now, in the order in which they began."""
        return [record for record in self.faults if record.fault.kind in kinds]

    def mark_damaged(self) -> None:
        """Record that the frame of the hub's newest sample is altered or not sent."""
        newest = self.hub.sequence - 1
        self.damaged.append((self.hub.boots, newest))

    def find_load_time_us(self, now_us: int) -> int:
        """Return the simulated time, in µs, whose load acts on the cubes of the hub.

        It is earlier than the present time `now_us` during the fault `hold`, which keeps the load
        constant.
        """
        holds = self.find_faults("hold")
        return holds[-1].start_us if holds else now_us

    def restart(self, now_us: int, sequence: int = 0) -> None:
        """Restart the hub, which then describes itself by a HELLO frame.

        Args:
            now_us: Simulated time in µs.
            sequence: Number of the next sample of the hub.
        """
        self.held_back = b""
        self.hub.reset(now_us, sequence)
        self.line.send(self.hub.make_hello(), now_us)

    def update_hub(self) -> None:
        """Set the uid, pads, protocol version and failed pads that the hub reports under faults."""
        kinds = {record.fault.kind for record in self.faults}
        hub = self.hub
        hub.false_uid = None
        if "uid" in kinds:
            hub.false_uid = hub.uid ^ _FALSE_UID_BITS
        hub.extra_pads = int("pads" in kinds)
        hub.version = VERSION + ("version" in kinds)
        reported = np.zeros(len(hub.cube_uids), "<u4")
        for record in self.find_faults("report"):
            fault = record.fault
            pad_bit = np.uint32(1 << fault.pad)
            reported[fault.cube] |= pad_bit
        hub.pad_fault = reported


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
        # Heap (priority queue) of starts and ends of faults. An entry has the simulated time in µs,
        # whether it is a start (at the same time, ends come first), a serial number, and the
        # function that begins or ends the fault.
        self._schedule: list[tuple[int, bool, int, Callable[[int], None]]] = []
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
            on_link = replace(fault, link=name)
            begin = partial(self._begin, on_link)
            self._push(at_us, True, begin)

    def _push(
        self,
        at_us: int,
        begins: bool,
        act: Callable[[int], None],
    ) -> None:
        number = next(self._numbers)
        entry = (at_us, begins, number, act)
        heapq.heappush(self._schedule, entry)

    def find_due_us(self) -> int | None:
        """Return the simulated time in µs at which the next fault begins or ends.

        The result is None if no fault is scheduled.
        """
        return self._schedule[0][0] if self._schedule else None

    def step(self, now_us: int) -> None:
        """Begin and end the faults that are due at simulated time `now_us`."""
        while self._schedule and self._schedule[0][0] <= now_us:
            *_, act = heapq.heappop(self._schedule)
            act(now_us)

    def measure(
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
        # The array is copied, because it may be used again for a later sample.
        frequency = frequency.copy()
        # The newest change of the temperature replaces the earlier ones.
        for record in link.find_faults("temperature")[-1:]:
            # The temperature rises linearly during the fault and then stays constant.
            fault = record.fault
            elapsed_s = 1e-6 * (now_us - record.start_us)
            duration_s = max(fault.seconds, 1e-6)
            share = min(1.0, elapsed_s / duration_s)
            rise = share * fault.value
            # A rise of 0 ends the fault. Then the hub reports no temperature, as before the fault.
            link.hub.celsius = TEMPERATURE_UNKNOWN
            if rise:
                link.hub.celsius = round(100 * (ROOM_CELSIUS + rise))
            warmed = frequency * (1 + RELATIVE_CHANGE_PER_CELSIUS * rise)
            frequency = np.rint(warmed).astype("<u4")
        for record in link.find_faults(*PAD_FAULTS):
            fault = record.fault
            pad = fault.cube, fault.pad
            sound = int(frequency[pad])
            first = link.first_readings.setdefault(record, sound)
            frequency[pad] = compute_broken_reading(
                fault,
                sound,
                first,
                now_us,
            )
        no_cubes, pads_behind = (0, 0), (0, link.hub.extra_pads)
        return np.pad(frequency, (no_cubes, pads_behind))

    def transmit(self, link: SimulatedLink, data: bytes) -> bytes:
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
        end_us = now_us
        is_momentary = fault.kind in MOMENTARY_FAULTS
        if not is_momentary:
            end_us += round(1e6 * fault.seconds)
        record = FaultRecord(now_us, end_us, fault)
        self.records.append(record)
        match fault.kind:
            case kind if kind in FRAME_FAULTS:
                link.frame_faults += [kind] * fault.count
            case "stall":
                link.line.held_until_us = end_us
            case "burst":
                link.line.burst_until_us = end_us
            case "unplug" | "rename":
                link.held_back = b""
                link.hub.started = False  # a hub is powered by its port
                link.line.unplug()
            case "reset":
                link.restart(now_us)
            case "wrap":
                # Sample numbers reach 2**32 after `count` samples.
                link.restart(now_us, -fault.count % 2**32)
            case "drift":
                link.hub.set_clock(now_us, drift_ppm=fault.value)
            case "step":
                link.hub.set_clock(now_us, step_us=round(1e6 * fault.value))
        if not is_momentary:
            link.faults.append(record)
            link.update_hub()
            # A changed temperature stays until the next fault of this kind.
            if fault.kind != "temperature":
                end = partial(self._end, record)
                self._push(end_us, False, end)

    def _end(self, record: FaultRecord, now_us: int) -> None:
        """End a fault on its link at simulated time `now_us`."""
        fault = record.fault
        link = self._links[fault.link]
        link.faults.remove(record)
        link.update_hub()
        # The end of another fault may have plugged the line in already.
        if fault.kind in ("unplug", "rename") and not link.line.plugged:
            renamed = None
            if fault.kind == "rename":
                renamed = link.line.port.with_name(f"{link.name}_{len(self.records)}")
            link.line.plug(renamed)
            link.restart(now_us)


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
