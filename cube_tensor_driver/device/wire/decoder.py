# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Decoding of the bytes of a link to frames. Any bytes are accepted, also damaged ones.

Each non-empty run (bytes between two zero bytes) becomes one frame, or increases exactly one error
counter of `Counters`. `PythonDecoder` is easy to read and is used where no C compiler was present;
`NativeDecoder` is implemented in C. Both give the same result, and `Decoder` is the one to use.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass

from . import cobs
from .native import NOT_COMPILED, wire
from .protocol import HEADER, MAX_FRAME, OVERHEAD, UNPACK, VERSION, Frame

MAX_RUN = MAX_FRAME + (MAX_FRAME + 253) // 254
"""Length, in bytes, of the longest run (bytes between two zero bytes) that can be a frame. The COBS
encoding adds one byte to each 254."""
MIN_PAYLOAD = 5
"""Smallest payload of a frame, in bytes. Later protocol versions keep this limit."""
MIN_RUN = OVERHEAD + MIN_PAYLOAD + 1
"""Length, in bytes, of the shortest run (bytes between two zero bytes) that can be a frame of any
protocol version: header, CRC, smallest payload, and the byte that COBS adds."""
_CRC_RESIDUE = 0x2144DF1C
"""CRC-32 of any data that are followed by their own CRC-32. So a frame, including the CRC at its
end, is valid if its CRC-32 has this value."""


@dataclass(slots=True)
class Counters:
    """Numbers of bytes, frames and invalid runs (bytes between two zeros) of one decoder.

    Attributes:
        bytes: Received bytes.
        frames: Valid frames.
        crc: Runs with a wrong checksum.
        framing: Runs that are no valid COBS encoding, or were cut off by the end of the stream.
        length: Runs that are too short for a frame, or whose length does not fit their contents.
        version: Runs with a correct checksum but another protocol version.
        unknown_type: Runs with a correct checksum but a frame type that version 1 does not have.
        overrun: Runs longer than any frame, which were discarded up to the next zero.
    """

    bytes: int = 0
    frames: int = 0
    crc: int = 0
    framing: int = 0
    length: int = 0
    version: int = 0
    unknown_type: int = 0
    overrun: int = 0


class PythonDecoder:
    """Decodes the bytes of one link; keeps at most `MAX_RUN` bytes between two calls.

    Attributes:
        counters: Numbers of bytes, frames and invalid runs (bytes between two zeros) since the
            decoder was made.
        other_version: Protocol version of the last frame with a correct checksum and another
            version than `VERSION`; None if there was no such frame.
    """

    def __init__(self) -> None:
        self.counters = Counters()
        self.other_version: int | None = None
        self._tail = bytearray()
        self._discarding = False

    def feed(self, data: bytes | bytearray) -> list[Frame]:
        """Return the frames that are complete with these bytes, in order. Never raises.

        Args:
            data: The next received bytes. An unfinished frame at their end is kept.
        """
        self.counters.bytes += len(data)
        *runs, rest = bytes(data).split(b"\0")
        frames: list[Frame] = []
        if runs:
            # The first zero ends a run whose beginning may have come in an earlier call.
            runs[0] = b"" if self._discarding else bytes(self._tail + runs[0])
            self._tail.clear()
            self._discarding = False
        for run in runs:
            frame = self._decode(run)
            if frame is not None:
                frames.append(frame)

        if not self._discarding:
            self._tail += rest
            # A run longer than MAX_RUN cannot become a frame, so the rest of it is not kept.
            if len(self._tail) > MAX_RUN:
                self.counters.overrun += 1
                self._tail.clear()
                self._discarding = True
        return frames

    def reset(self) -> None:
        """Discard an unfinished frame, because the stream has ended, and count it as `framing`."""
        self.counters.framing += bool(self._tail)
        self._tail.clear()
        self._discarding = False

    def _decode(self, run: bytes) -> Frame | None:
        """Return the frame of one run (bytes between two zeros); None if it is invalid.

        The counter `frames` is increased, or the counter of the defect.
        """
        counters = self.counters
        if len(run) < MIN_RUN:
            counters.length += len(run) > 0
            return None
        if len(run) > MAX_RUN:
            counters.overrun += 1
            return None
        raw = cobs.decode_in_python(run)
        if raw is None:
            counters.framing += 1
            return None
        if zlib.crc32(raw) != _CRC_RESIDUE:
            counters.crc += 1
            return None

        # The checksum is correct, so a mistake that is found below was not made on the line but by
        # the sender, for example a hub with another protocol version.
        code, version, size = HEADER.unpack_from(raw)
        if version != VERSION:
            counters.version += 1
            self.other_version = version
            return None
        unpack = UNPACK.get(code)
        if unpack is None:
            counters.unknown_type += 1
            return None
        frame = unpack(raw, size) if size == len(raw) - OVERHEAD else None
        if frame is None:
            counters.length += 1
        else:
            counters.frames += 1
        return frame


class NativeDecoder:
    """Decodes the bytes of one link in C, with the same result as `PythonDecoder`.

    Attributes:
        wire: Decoder object of the C module, with which one call can read several links.

    Raises:
        RuntimeError: The C module was not compiled.
    """

    def __init__(self) -> None:
        if wire is None:
            raise RuntimeError(NOT_COMPILED)
        self.wire = wire.Decoder()

    @property
    def counters(self) -> Counters:
        """Numbers of bytes, frames and invalid runs since the decoder was made."""
        return Counters(*self.wire.counters())

    @property
    def other_version(self) -> int | None:
        """Protocol version of the last valid frame with another version than the driver's.

        It is None if there was no such frame.
        """
        return self.wire.other_version()

    def feed(self, data: bytes | bytearray) -> list[Frame]:
        """Return the frames that are complete with these bytes, in order. Never raises.

        Args:
            data: The next received bytes. An unfinished frame at their end is kept.
        """
        return unpack_all(self.wire.feed(data))

    def reset(self) -> None:
        """Discard an unfinished frame, because the stream has ended, and count it as `framing`."""
        self.wire.reset()


def unpack_all(raws: list[bytes]) -> list[Frame]:
    """Return the frames of bytes that are no longer COBS-encoded.

    Args:
        raws: The bytes of each frame, from the type to the CRC (checksum), as the decoder in C
            returns them after its checks.
    """
    frames: list[Frame] = []
    for raw in raws:
        unpack = UNPACK[raw[0]]
        frame = unpack(raw, len(raw) - OVERHEAD)
        if frame is not None:
            frames.append(frame)
    return frames


Decoder = PythonDecoder if wire is None else NativeDecoder
