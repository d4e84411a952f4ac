"""What the timers of a board would capture of oscillators, for firmware that runs without them.

An emulated hub asks for each window over a line of its own, and gets the edges that its counter
would have seen. firmware/an386/captures.c describes the bytes.
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
from cube_tensor_driver.simulation.load import AnyLoad, LoadMemory

COUNTER_HZ = 25_000_000
WINDOW_US = 2_500
EDGES = np.dtype([("first", "<u2"), ("last", "<u2"), ("periods", "<u2")])
"""Of one pad: ticks of the counter from the begin of the window to its first and to its last edge,
and the periods between these two."""
_QUESTION = struct.Struct("<IQI")


def edges(
    millihertz: NDArray[np.uint32],
    phase: NDArray[np.float64],
    counter_hz: int = COUNTER_HZ,
    window_us: int = WINDOW_US,
) -> NDArray[np.void]:
    """What is captured of pads within a window: EDGES (pads,).

    millihertz: (pads,), 0 for a pad that does not oscillate
    phase: (pads,) periods from the begin of the window to the first edge, 0 to 1

    The n-th edge is at (phase + n) / f. The counter shows the ticks that are complete by then.
    """
    found = np.zeros(len(millihertz), EDGES)
    hertz = 1e-3 * millihertz.astype(float)
    periods = np.ceil(hertz * window_us * 1e-6 - phase) - 1
    runs = periods >= 1
    hertz, phase, periods = hertz[runs], phase[runs], periods[runs]
    found["first"][runs] = np.floor(phase / hertz * counter_hz)
    found["last"][runs] = np.floor((phase + periods) / hertz * counter_hz)
    found["periods"][runs] = periods
    return found


@dataclass
class Oscillators:
    """The pads of one hub under a load, as its counter sees them.

    windows: device time of the middle of each window that was asked for, µs, in order; the load
        script runs in device time
    """

    hub: HubCubes
    load: AnyLoad
    windows: list[int] = field(default_factory=list)
    seed: int = 0

    def __post_init__(self) -> None:
        self._memory = LoadMemory(self.load)
        self._random = np.random.default_rng(self.seed)
        self._unread = b""

    def answer(self, data: bytes) -> bytes:
        """What goes back to the hub for bytes that came from it. A damaged question has no answer:
        the hub asks again."""
        self._unread += data
        answers = b""
        while len(self._unread) >= _QUESTION.size:
            question = self._unread[: _QUESTION.size]
            number, middle_us, crc = _QUESTION.unpack(question)
            if crc != zlib.crc32(question[:-4]):
                self._unread = self._unread[1:]
                continue
            self._unread = self._unread[_QUESTION.size :]
            self.windows.append(middle_us)
            body = struct.pack("<I", number) + self._edges(middle_us).tobytes()
            answers += body + struct.pack("<I", zlib.crc32(body))
        return answers

    def serve(self, line: socket.socket) -> None:
        """Answer until the line ends."""
        with contextlib.suppress(OSError):
            while data := line.recv(4096):
                line.sendall(self.answer(data))

    def _edges(self, middle_us: int) -> NDArray[np.void]:
        stress, gradient = self._memory.at(middle_us)
        millihertz = self.hub.frequency(stress, gradient, middle_us * 1e-6).ravel()
        return edges(millihertz, self._random.random(len(millihertz)))
