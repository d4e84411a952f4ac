# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""A hub that a test plays: the near end of a pseudo-terminal whose far end is the driver's port."""

from __future__ import annotations

import contextlib
import os
import tty
from pathlib import Path

import numpy as np

from cube_tensor_driver.config.package_data import find_package_data
from cube_tensor_driver.device.wire.decoder import Decoder
from cube_tensor_driver.device.wire.protocol import Command, Hello, Request, Sample, encode

SINGLE = find_package_data() / "config" / "cube.yaml"
"""The skin of one cube with 8 pads, on the link hub0."""
HUB_UID, CUBE_UID, PERIOD_US = 0xAB, 0xCD, 10_000
REST = np.full((1, 8), 100_000_000, "<u4")
"""mHz of the pads without load."""


class PlayedHub:
    """Sends what it is told to. requests: that the driver sent so far."""

    def __init__(self, folder: Path, name: str) -> None:
        """Appear as the port `name` in a folder."""
        folder.mkdir(exist_ok=True)
        self.fd, self._far = os.openpty()
        tty.setraw(self._far)
        os.set_blocking(self.fd, False)
        self._port = folder / name
        self._port.symlink_to(os.ttyname(self._far))
        self._decoder = Decoder()
        self.requests: list[int] = []

    def send(self, data: bytes) -> None:
        os.write(self.fd, data)

    def listen(self) -> list[int]:
        with contextlib.suppress(BlockingIOError):
            frames = self._decoder.feed(os.read(self.fd, 65536))
            self.requests += [frame.request for frame in frames if isinstance(frame, Request)]
        return self.requests

    def asked(self, command: Command) -> bool:
        """Whether the driver has sent this request."""
        return command in self.listen()

    def close(self) -> None:
        """Vanish."""
        self._port.unlink(missing_ok=True)
        os.close(self.fd)
        os.close(self._far)


def greeting(n_pads: int = 8, cube_uids: tuple[int, ...] = (CUBE_UID,)) -> bytes:
    """A HELLO frame."""
    return encode(Hello(HUB_UID, 1, n_pads, PERIOD_US, np.array(cube_uids, "<u8")))


def sample(sequence: int, millihertz: np.ndarray) -> bytes:
    """A SAMPLE frame; millihertz: (cubes, pads)."""
    n = len(millihertz)
    no_fault, unknown_temperature = np.zeros(n, "<u4"), np.full(n, -32768, "<i2")
    device_us = PERIOD_US * sequence
    return encode(Sample(sequence, 0, device_us, millihertz, no_fault, unknown_temperature))
