"""Faults of simulated hubs, by schedule or live: what happens to which hub, when, and the book of
it.

A fault is a table with `kind` and, where it needs them: `at` (s of simulated time, now if left
out), `link` (all if left out), `seconds` (how long), `count` (samples harmed), `cube` and `pad` (on
the hub), `value`.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..core.errors import ConfigError
from ..device.protocol import TEMPERATURE_UNKNOWN, VERSION
from .hub import SimulatedHub
from .line import Line

FRAME = ("drop", "flip", "insert", "duplicate", "reorder", "truncate")
KINDS = {
    "drop": "lose `count` samples on the way",
    "flip": "flip a bit in each of `count` samples",
    "insert": "insert noise into or between `count` samples",
    "duplicate": "send `count` samples twice",
    "reorder": "send each of `count` samples after the one that follows",
    "truncate": "cut the end off `count` samples",
    "stall": "send nothing for `seconds`; what does not fit the hub's buffer is dropped there",
    "burst": "send every 16 ms what has gathered, for `seconds`",
    "unplug": "cut the port and the power for `seconds`",
    "rename": "the same, and come back under another name",
    "reset": "restart the hub behind the open port",
    "wrap": "restart the hub with its sample count `count` before 2^32",
    "drift": "let the hub's clock run fast by `value` ppm",
    "step": "set the hub's clock forward by `value` s",
    "open": "break the lead of a pad for `seconds`",
    "short": "stop the oscillator of a pad for `seconds`",
    "stuck": "repeat the reading of a pad for `seconds`",
    "noisy": "add noise of `value` (relative, 1e-3) to a pad for `seconds`",
    "temperature": "raise the temperature by `value` °C within `seconds`, and the rest frequencies by 50 ppm per °C",
    "uid": "name another hub uid for `seconds`",
    "pads": "send one pad too many for `seconds`",
    "version": "speak protocol version 2 for `seconds`",
}
PAD = ("open", "short", "stuck", "noisy")
PER_CELSIUS, CELSIUS = 50e-6, 25.0


@dataclass(frozen=True)
class Fault:
    """One fault; see the head of this file."""

    kind: str
    at: float = 0.0
    link: str = ""
    seconds: float = 1.0
    count: int = 1
    cube: int = 0
    pad: int = 0
    value: float = 1e-3

    @classmethod
    def parse(cls, data: Any, place: str) -> Fault:
        """From plain values. ConfigError names key, what was found and what is allowed."""
        if not isinstance(data, dict) or "kind" not in data:
            raise ConfigError(
                f"{place}: found {str(data)[:60]!r}, allowed: a table with the key kind, {{kind: drop}}"
            )
        known: dict[str, Any] = {field.name: type(field.default) for field in fields(cls)}
        known["kind"] = str
        for key, value in data.items():
            if key not in known:
                raise ConfigError(f"{place}: unknown key {key!r}, allowed: {', '.join(known)}")
            kind = known[key]
            number = (
                isinstance(value, (int, float))
                and not isinstance(value, bool)
                and math.isfinite(value)
            )
            fine = (
                (number and (kind is float or value == int(value)))
                if kind is not str
                else isinstance(value, str)
            )
            if not fine or (key not in ("value", "kind", "link") and value < 0):
                raise ConfigError(
                    f"{place}: {key}: found {value!r}, allowed: a {kind.__name__} from 0 up"
                )
        if data["kind"] not in KINDS:
            raise ConfigError(f"{place}: kind: found {data['kind']!r}, allowed: {', '.join(KINDS)}")
        return cls(**{key: known[key](value) for key, value in data.items()})


def parse_faults(data: Any, place: str) -> list[Fault]:
    """A list of faults from plain values. ConfigError: as `Fault.parse`."""
    if not isinstance(data, list):
        raise ConfigError(f"{place}: found {str(data)[:60]!r}, allowed: a list of faults")
    return [Fault.parse(item, f"{place}: [{number}]") for number, item in enumerate(data)]


class Bench(Protocol):
    """What faults act on: one hub and its line."""

    name: str
    hub: SimulatedHub
    line: Line


class Injector:
    """Carries out faults. book: what was done, as [start in µs, end in µs, link, fault]."""

    def __init__(self, benches: Iterable[Bench], faults: Iterable[Fault], seed: int = 0) -> None:
        """ConfigError: a fault of a link, cube or pad that there is not."""
        self._benches = {bench.name: bench for bench in benches}
        self._random = np.random.default_rng(seed)
        self._coming: list[tuple[int, int, Fault]] = []
        self._ending: list[tuple[int, int, str, Fault]] = []
        self._number = 0
        self.book: list[tuple[int, int, str, dict[str, Any]]] = []
        self._frames: dict[str, list[str]] = {name: [] for name in self._benches}
        self._held: dict[str, bytes] = {}
        self._pads: dict[str, list[tuple[Fault, NDArray[np.uint32] | None]]] = {
            name: [] for name in self._benches
        }
        self._warm: dict[str, tuple[int, float, float]] = {}
        for fault in faults:
            self.add(fault, round(1e6 * fault.at))

    def add(self, fault: Fault, at_us: int) -> None:
        """Carry out a fault at a simulated time. ConfigError: of a link, cube or pad that there is
        not."""
        names = [fault.link] if fault.link else list(self._benches)
        for name in names:
            bench = self._benches.get(name)
            if bench is None:
                raise ConfigError(
                    f"fault {fault.kind}: link {name!r}, allowed: {', '.join(self._benches)}"
                )
            cubes, pads = len(bench.hub.cube_uids), bench.hub.n_pads
            if fault.kind in PAD and not (fault.cube < cubes and fault.pad < pads):
                raise ConfigError(
                    f"fault {fault.kind}: found cube {fault.cube}, pad {fault.pad}; allowed: below {cubes}, {pads}"
                )
            self._number += 1
            heapq.heappush(
                self._coming, (at_us, self._number, Fault(**{**asdict(fault), "link": name}))
            )

    def due_us(self) -> int | None:
        """When `step` has to be called next."""
        times = [queue[0][0] for queue in (self._coming, self._ending) if queue]
        return min(times, default=None)

    def step(self, now_us: int) -> None:
        """Begin and end what is due."""
        while self._ending and self._ending[0][0] <= now_us:
            _, _, name, fault = heapq.heappop(self._ending)
            self._end(self._benches[name], fault, now_us)
        while self._coming and self._coming[0][0] <= now_us:
            _, _, fault = heapq.heappop(self._coming)
            self._begin(self._benches[fault.link], fault, now_us)

    def values(
        self, bench: Bench, frequency: NDArray[np.uint32], now_us: int
    ) -> NDArray[np.uint32]:
        """What the hub measures, (cubes, pads) in mHz, of what the pads would do."""
        pads, warm = self._pads[bench.name], self._warm.get(bench.name)
        extra = bench.hub.extra_pads
        if not pads and warm is None and not extra:
            return frequency
        frequency = frequency.copy()
        if warm is not None:
            warmer = self._celsius(bench.name, now_us)
            bench.hub.celsius = round(100 * (CELSIUS + warmer)) if warmer else TEMPERATURE_UNKNOWN
            frequency = np.rint(frequency * (1 + PER_CELSIUS * warmer)).astype("<u4")
        for place, (fault, kept) in enumerate(pads):
            at = fault.cube, fault.pad
            if fault.kind == "short":
                frequency[at] = 0
            elif fault.kind == "open":
                # Only the parasitic capacitance is left: above all that the law of β = 0.3 knows.
                frequency[at] = min(8 * int(frequency[at]), 0xFFFFFFFF)
            elif fault.kind == "noisy":
                frequency[at] = round(
                    float(frequency[at]) * (1 + fault.value * self._random.standard_normal())
                )
            else:
                if kept is None:
                    kept = frequency[at].copy()
                    pads[place] = fault, kept
                frequency[at] = kept
        return np.pad(frequency, ((0, 0), (0, extra))) if extra else frequency

    def frame(self, bench: Bench, data: bytes) -> bytes:
        """What goes onto the line of one SAMPLE frame; b"" when it is lost or held back."""
        waiting = self._frames[bench.name]
        kind = waiting.pop(0) if waiting else ""
        held = self._held.pop(bench.name, b"")
        random = self._random
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
        elif kind == "reorder" and not held:
            self._held[bench.name] = data
            return b""
        return data + held

    def _begin(self, bench: Bench, fault: Fault, now_us: int) -> None:
        name, hub, line = bench.name, bench.hub, bench.line
        end_us = now_us + round(1e6 * fault.seconds)
        if fault.kind in FRAME:
            self._frames[name] += [fault.kind] * fault.count
            end_us = now_us
        elif fault.kind in PAD:
            self._pads[name].append((fault, None))
        elif fault.kind == "stall":
            line.held_until_us = end_us
        elif fault.kind == "burst":
            line.burst_until_us = end_us
        elif fault.kind in ("unplug", "rename"):
            self._held.pop(name, None)
            hub.off()
            line.unplug()
        elif fault.kind in ("reset", "wrap"):
            end_us = now_us
            self._held.pop(name, None)
            hub.reset(now_us, -fault.count % 2**32 if fault.kind == "wrap" else 0)
            line.send(hub.hello(), now_us)
        elif fault.kind == "drift":
            end_us = now_us
            hub.set_clock(now_us, drift_ppm=fault.value)
        elif fault.kind == "step":
            end_us = now_us
            hub.set_clock(now_us, step_us=round(1e6 * fault.value))
        elif fault.kind == "temperature":
            self._warm[name] = now_us, fault.seconds, fault.value
        elif fault.kind == "uid":
            hub.false_uid = hub.uid ^ 0xBAD
        elif fault.kind == "pads":
            hub.extra_pads = 1
        elif fault.kind == "version":
            hub.version = VERSION + 1
        self.book.append((now_us, end_us, name, asdict(fault)))
        if end_us > now_us and fault.kind not in ("stall", "burst", "temperature"):
            self._number += 1
            heapq.heappush(self._ending, (end_us, self._number, name, fault))

    def _end(self, bench: Bench, fault: Fault, now_us: int) -> None:
        hub, line = bench.hub, bench.line
        if fault.kind in PAD:
            self._pads[bench.name] = [
                pair for pair in self._pads[bench.name] if pair[0] is not fault
            ]
        elif fault.kind in ("unplug", "rename") and not line.plugged:
            renamed = (
                line.port.with_name(f"{bench.name}_{len(self.book)}")
                if fault.kind == "rename"
                else None
            )
            line.plug(renamed)
            hub.reset(now_us, 0)
            line.send(hub.hello(), now_us)
        elif fault.kind == "uid":
            hub.false_uid = None
        elif fault.kind == "pads":
            hub.extra_pads = 0
        elif fault.kind == "version":
            hub.version = VERSION

    def _celsius(self, name: str, now_us: int) -> float:
        if name not in self._warm:
            return 0.0
        begin, seconds, value = self._warm[name]
        return value * min(1.0, (now_us - begin) * 1e-6 / max(seconds, 1e-6))
