"""From the bytes of a link to frames, whatever the bytes are.

`Decoder.feed` never raises. Each non-empty run of bytes that a zero closes becomes one frame, or is
counted in exactly one counter of `Counters`. `PythonDecoder` is for reading and for where nothing
was compiled; `Decoder` is the one in C where there is one. Both give the same.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass

from . import cobs
from .native import SLOWER, wire
from .protocol import HEADER, MAX_FRAME, OVERHEAD, REQUEST, UNPACK, VERSION, Frame

MAX_RUN = MAX_FRAME + (MAX_FRAME + 253) // 254
"""Longest run of bytes between two zeros that can be a frame. COBS adds one byte to each 254."""
MIN_RUN = OVERHEAD + REQUEST.size + 1
"""Shortest run that can be a frame of any version."""
# The CRC-32 of data followed by its own CRC is this constant, so the CRC need not be cut off.
_CRC_RESIDUE = 0x2144DF1C


@dataclass(slots=True)
class Counters:
    """What became of the bytes fed to a `Decoder`: how many bytes, frames, and runs that are no
    frame."""

    bytes: int = 0
    frames: int = 0
    crc: int = 0  # checksum wrong
    framing: int = 0  # not COBS, or cut off by the end of the stream
    length: int = 0  # too short for a frame, or the length does not fit the contents
    version: int = 0  # checksum right, but another protocol version: see Decoder.other_version
    unknown_type: int = 0  # checksum right, but a type that version 1 does not have
    overrun: int = 0  # longer than any frame can be; thrown away up to the next zero

    def as_dict(self) -> dict[str, int]:
        return {name: getattr(self, name) for name in self.__slots__}


class PythonDecoder:
    """Bytes in, frames out. Keeps at most MAX_RUN bytes between calls.

    counters: `Counters` of all bytes since the decoder was made.
    other_version: the last version other than ours in a frame with a right checksum; None if there
    was none.
    """

    def __init__(self) -> None:
        self.counters = Counters()
        self.other_version: int | None = None
        self._tail = bytearray()
        self._discarding = False

    def feed(self, data: bytes | bytearray) -> list[Frame]:
        """The frames that `data` completes, in order. Never raises, whatever the bytes are."""
        self.counters.bytes += len(data)
        *runs, rest = bytes(data).split(b"\0")
        frames: list[Frame] = []
        if runs:
            runs[0] = b"" if self._discarding else bytes(self._tail + runs[0])
            self._tail.clear()
            self._discarding = False
        for run in runs:
            frame = self._decode(run)
            if frame is not None:
                frames.append(frame)
        if not self._discarding:
            self._tail += rest
            if len(self._tail) > MAX_RUN:
                self.counters.overrun += 1
                self._tail.clear()
                self._discarding = True
        return frames

    def reset(self) -> None:
        """The stream ended: the bytes of an unfinished frame are thrown away, and count as
        framing."""
        self.counters.framing += bool(self._tail)
        self._tail.clear()
        self._discarding = False

    def _decode(self, run: bytes) -> Frame | None:
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
    """The same in C, where it was compiled; see `PythonDecoder`."""

    def __init__(self) -> None:
        """RuntimeError: it was not compiled."""
        if wire is None:
            raise RuntimeError(SLOWER)
        self.wire = wire.Decoder()

    @property
    def counters(self) -> Counters:
        return Counters(*self.wire.counters())

    @property
    def other_version(self) -> int | None:
        return self.wire.other_version()

    def feed(self, data: bytes | bytearray) -> list[Frame]:
        return unpacked(self.wire.feed(data))

    def reset(self) -> None:
        self.wire.reset()


def unpacked(raws: list[bytes]) -> list[Frame]:
    """The frames of what the decoder in C gives, which has looked at their lengths."""
    return [
        frame for raw in raws if (frame := UNPACK[raw[0]](raw, len(raw) - OVERHEAD)) is not None
    ]


Decoder = PythonDecoder if wire is None else NativeDecoder
