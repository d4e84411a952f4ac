# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Simulated captures of the pads' oscillators, for firmware in an emulator without them.

An emulated hub asks for each measuring window over a separate line, and receives the edges that
its counter would have captured. firmware/an386/captures.c describes the bytes.
"""

from __future__ import annotations

import contextlib
import socket
import struct
import zlib
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from cube_tensor_driver.simulation.cubes import HubCubes
from cube_tensor_driver.simulation.load import AnyLoad, remember

COUNTER_HZ = 25_000_000
"""Frequency of the counter with which the emulated board (MPS2-AN386) measures pads, in Hz."""

WINDOW_US = 2_500
"""Length of the window in which the emulated board counts the periods of all pads, in µs."""

EDGES = np.dtype([("first", "<u2"), ("last", "<u2"), ("periods", "<u2")])
"""Captures of one pad: ticks of the counter from the beginning of the window to the first and to
the last edge, and the number of periods between these two."""

_QUESTION = struct.Struct("<IQI")
"""Layout of the bytes with which the emulated hub asks for captures: number of the question, device
time of the middle of the window in µs, and CRC-32 of both."""


def find_edges(
    millihertz: NDArray[np.uint32],
    phase: NDArray[np.float64],
) -> NDArray[np.void]:
    """Return what is captured of pads within a window.

    The n-th edge is at the time (phase + n) / f. The counter shows the ticks completed by then.

    Args:
        millihertz: (pads,) frequencies in mHz; 0 for a pad that does not oscillate.
        phase: (pads,) time from the beginning of the window to the first edge, in periods.

    Returns:
        (pads,) of the type `EDGES`.
    """
    found = np.zeros(len(millihertz), EDGES)
    hertz = 1e-3 * millihertz.astype(float)
    in_window = hertz * WINDOW_US * 1e-6
    periods = np.ceil(in_window - phase) - 1
    # A pad without two edges in the window has no period to capture.
    runs = periods >= 1
    hertz, phase, periods = hertz[runs], phase[runs], periods[runs]
    first_s = phase / hertz
    last_s = (phase + periods) / hertz
    found["first"][runs] = np.floor(first_s * COUNTER_HZ)
    found["last"][runs] = np.floor(last_s * COUNTER_HZ)
    found["periods"][runs] = periods
    return found


@dataclass
class Oscillators:
    """The pads of one hub under a load, as its counter captures them.

    Attributes:
        hub: The hub and its cubes.
        load: The load; its script runs in the device time of the hub.
        windows: Device time of the middle of each window that was asked for, in µs, in order.
        seed: Seed of the random phases.
    """

    hub: HubCubes
    load: AnyLoad
    windows: list[int] = field(default_factory=list)
    seed: int = 0

    def __post_init__(self) -> None:
        self._field_at = remember(self.load)
        self._random = np.random.default_rng(self.seed)
        self._unread = b""

    def answer(self, data: bytes) -> bytes:
        """Return the answers to the questions that are completed by bytes from the hub.

        A damaged question has no answer, because the hub asks again.
        """
        self._unread += data
        answers = b""
        while len(self._unread) >= _QUESTION.size:
            question = self._unread[: _QUESTION.size]
            number, middle_us, crc = _QUESTION.unpack(question)
            if crc != zlib.crc32(question[:-4]):
                # The next question may begin at any byte.
                self._unread = self._unread[1:]
                continue
            self._unread = self._unread[_QUESTION.size :]
            self.windows.append(middle_us)
            body = struct.pack("<I", number) + self._find_edges(middle_us).tobytes()
            answers += body + struct.pack("<I", zlib.crc32(body))
        return answers

    def serve(self, line: socket.socket) -> None:
        """Answer questions until the line is closed."""
        with contextlib.suppress(OSError):
            while data := line.recv(4096):
                line.sendall(self.answer(data))

    def _find_edges(self, middle_us: int) -> NDArray[np.void]:
        """Return what the counter captures of all pads in one measuring window.

        Args:
            middle_us: Device time of the middle of the window, in µs.
        """
        stress, gradient = self._field_at(middle_us)
        # Boards have no common clock with the pads, so that the first edge comes at any phase.
        millihertz = self.hub.compute_frequency(stress, gradient, middle_us * 1e-6).ravel()
        return find_edges(millihertz, self._random.random(len(millihertz)))
