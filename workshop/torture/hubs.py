# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Process that simulates hubs like `simulation/main.py`, and stores what they send in each sample.

Links whose port in the skin file is a TCP address listen there, instead of on a pseudo-terminal.
"""

from __future__ import annotations

import contextlib
import socket
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cube_tensor_driver.config.skin import Skin, SkinLink
from cube_tensor_driver.core.errors import ConfigError
from cube_tensor_driver.device.links.tcp import parse_url
from cube_tensor_driver.simulation.cubes import NO_ERRORS, Millihertz, PadErrors
from cube_tensor_driver.simulation.injector import Injector, SimulatedLink
from cube_tensor_driver.simulation.line import SimulatedLine
from cube_tensor_driver.simulation.load import Fields
from cube_tensor_driver.simulation.main import main
from cube_tensor_driver.simulation.simulator import Simulator

from ..checks.sent_readings import make_reading_type

READINGS = "readings"
"""Name of the folder, beside that of the ports, for what the hubs send."""


class TcpLine(SimulatedLine):
    """A line that listens for one TCP connection of the host at a URL socket://host:port.

    `unplug` closes the connection and stops listening; `plug` listens again at the same address.
    """

    def __init__(self, url: str) -> None:
        """Listen at the address.

        Raises:
            LinkError: The URL does not have the form socket://host:port.
            ConfigError: Listening at this address failed.
        """
        self._address = parse_url(url)
        self._listener: socket.socket | None = None
        self._connection: socket.socket | None = None
        super().__init__(Path(url))

    def plug(self, port: Path | None = None) -> None:
        """Listen at the address of the line; `port` is ignored."""
        try:
            self._listener = socket.create_server(self._address, backlog=1)
        except OSError as error:
            host, number = self._address
            raise ConfigError(
                f"{host}:{number}: {error.strerror}; name an address that is free here"
            ) from None
        self._listener.setblocking(False)
        self.fd = self._listener.fileno()

    def unplug(self) -> None:
        """Close the connection and stop listening; bytes that wait to be sent are lost."""
        self._hang_up()
        if self._listener is not None:
            self._listener.close()
            self._listener = None
            self.fd = -1
        self._queue.clear()

    def flush(self, now_us: int) -> None:
        """Write as many waiting bytes as the connection takes now; without one, they wait."""
        if self._connection is None:
            return
        try:
            super().flush(now_us)
        except ConnectionError:
            self._hang_up()

    def read(self) -> bytes:
        """Return the bytes that the host has sent; without a connection, accept one instead."""
        if self._connection is None:
            self._accept()
            return b""
        try:
            data = super().read()
        except ConnectionError:
            data = b""
        if not data:  # the host has closed the connection
            self._hang_up()
        return data

    def _accept(self) -> None:
        """Accept the connection that made the listener readable."""
        if self._listener is None:
            return
        with contextlib.suppress(OSError):  # the host has closed it again
            self._connection, _ = self._listener.accept()
            self._connection.setblocking(False)
            # Without this option, TCP would delay samples to send several of them together.
            self._connection.setsockopt(
                socket.IPPROTO_TCP,
                socket.TCP_NODELAY,
                1,
            )
            self.fd = self._connection.fileno()

    def _hang_up(self) -> None:
        """Close the connection and wait for the next one."""
        if self._connection is not None:
            self._connection.close()
            self._connection = None
            self.fd = -1
            if self._listener is not None:
                self.fd = self._listener.fileno()


class StoringInjector(Injector):
    """An injector that stores what each hub sends, in one file for each link."""

    def __init__(self, links: Sequence[SimulatedLink], folder: Path) -> None:
        super().__init__(links)
        folder.mkdir()
        self._files = {link.name: (folder / link.name).open("wb") for link in links}

    def measure(
        self,
        link: SimulatedLink,
        frequency: Millihertz,
        now_us: int,
    ) -> Millihertz:
        """Return the frequencies that a hub measures, and store them with what the hub states."""
        millihertz = super().measure(link, frequency, now_us)
        size = link.size
        reading = np.zeros((), make_reading_type(size.cubes, size.pads))
        # The fault "pads" adds a pad, and no host takes its samples.
        reading["millihertz"] = millihertz[:, : size.pads]
        reading["centi_celsius"] = link.hub.celsius
        if link.hub.pad_fault is not None:
            reading["pad_fault"] = link.hub.pad_fault
        self._files[link.name].write(reading.tobytes())
        return millihertz

    def close(self) -> None:
        """Complete the files."""
        for file in self._files.values():
            file.close()


class TorturedSimulator(Simulator):
    """A simulator that stores what its hubs send, whose links with a TCP address are on TCP."""

    def __init__(
        self, skin: Skin, load: Fields, ports: Path, errors: PadErrors = NO_ERRORS, **options: Any
    ) -> None:
        super().__init__(skin, load, ports, errors, **options)
        self._injector = self._store = StoringInjector(self._links, ports.with_name(READINGS))

    def close(self) -> None:
        self._store.close()
        super().close()

    def _make_line(self, link: SkinLink) -> SimulatedLine:
        if link.port.startswith("socket://"):
            return TcpLine(link.port)
        return super()._make_line(link)


if __name__ == "__main__":
    sys.exit(main(simulator=TorturedSimulator))
