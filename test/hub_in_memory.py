# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""A hub in this process, on a line without delay, in simulated time: the `Wire` of a check."""

from __future__ import annotations

import numpy as np

from cube_tensor_driver.simulation.hub import SimulatedHub

ROOM = 20_000
"""Bytes that wait for a host that does not read, at most."""
SECOND_US = 1_000_000


class HubInMemory(SimulatedHub):
    """What a hub does by itself, in one place, so that a test can break it."""

    def once_a_second(self, now_us: int) -> bytes:
        return self.make_hello() + self.make_stats(now_us)

    def on_the_line(self, data: bytes) -> bytes:
        """The last chance to change what goes out."""
        return data

    def take(self, room: bool) -> bytes:
        """The frames of the sample that is due, b"" if there is no room for them."""
        if room:
            return self.sample(np.full((len(self.cube_uids), self.n_pads), 10**8, "<u4"))
        self.sequence += 1
        self.next_us += self.period_us
        self.dropped += 1
        return b""

    def host_left(self) -> None:
        """The port was closed."""

    def host_came(self, now_us: int) -> None:
        """The port was opened again."""


class MemoryWire:
    """Time passes only while the host waits."""

    port = "memory"

    def __init__(self, hub: HubInMemory, is_tcp: bool = False, greeting: bytes = b"") -> None:
        self.is_tcp = is_tcp
        self._hub = hub
        self._now_us = 0
        self._second_us = SECOND_US
        self._out = bytearray(greeting + hub.on_the_line(hub.make_hello()))

    def now(self) -> float:
        return 1e-6 * self._now_us

    def send(self, data: bytes) -> None:
        self._out += self._hub.on_the_line(self._hub.receive(data, self._now_us))

    def listen(self, seconds: float) -> bytes:
        until = self._now_us + max(1, round(1e6 * seconds))
        while not self._out and self._now_us < until:
            self._next_event(until)
        data = bytes(self._out)
        self._out.clear()
        return data

    def ignore(self, seconds: float) -> None:
        until = self._now_us + round(1e6 * seconds)
        while self._now_us < until:
            self._next_event(until)

    def reopen(self, seconds: float) -> None:
        self._hub.host_left()
        self.ignore(seconds)
        self._out.clear()
        self._hub.host_came(self._now_us)

    def _next_event(self, until_us: int) -> None:
        hub = self._hub
        sample_us = hub.next_us if hub.started else until_us
        self._now_us = max(self._now_us, min(self._second_us, sample_us, until_us))
        if hub.started and self._now_us >= hub.next_us:
            data = hub.take(len(self._out) < ROOM)
            self._out += hub.on_the_line(data)
        if self._now_us >= self._second_us:
            self._second_us += SECOND_US
            self._out += hub.on_the_line(hub.once_a_second(self._now_us))
