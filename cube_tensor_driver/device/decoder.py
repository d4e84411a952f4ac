"""From the bytes of a link to frames, whatever the bytes are.

`Decoder.feed` never raises: every non-empty run of bytes closed by a zero becomes exactly one frame
or is counted in exactly one counter of `Counters`.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np
from cobs import cobs  # type: ignore[import-untyped]

from .protocol import HEADER, MAX_FRAME, OVERHEAD, REQUEST, UNPACK, VERSION, Frame

MAX_RUN = MAX_FRAME + (MAX_FRAME + 253) // 254
"""Longest run of bytes between two zeros that can be a frame: COBS adds at most one byte in 254."""
MIN_RUN = OVERHEAD + REQUEST.size + 1
"""Shortest run that can be a frame, of any version: to try shorter ones would let noise slow the
decoder down."""
SHORT_RUN, CROWD = 32, 32
"""More runs in a feed than CROWD that are shorter than any SAMPLE are noise: see
`Decoder._thinned`."""
# CRC-32 over data followed by its own CRC is this constant: no slice, no second look at the frame's
# end.
_CRC_RESIDUE = 0x2144DF1C


@dataclass(slots=True)
class Counters:
    """What became of the bytes fed to a `Decoder`. All but `bytes` count frames or runs between
    zeros."""

    bytes: int = 0
    frames: int = 0
    crc: int = 0  # checksum wrong
    framing: int = 0  # not COBS, or cut off by the end of the stream
    length: int = 0  # too short for a frame, or the length does not fit the contents
    version: int = 0  # sound, but of another protocol version: see Decoder.other_version
    unknown_type: int = 0  # sound, but of a type that version 1 does not have
    overrun: int = 0  # longer than any frame can be, thrown away up to the next zero

    def as_dict(self) -> dict[str, int]:
        return {name: getattr(self, name) for name in self.__slots__}


class Decoder:
    """Bytes in, frames out. Holds at most MAX_RUN bytes between calls.

    counters: `Counters`, growing for the life of the decoder.
    other_version: the last version other than ours that a sound frame named, None if there was
    none.
    """

    def __init__(self) -> None:
        self.counters = Counters()
        self.other_version: int | None = None
        self._tail = bytearray()
        self._discarding = False

    def feed(self, data: bytes | bytearray) -> list[Frame]:
        """Frames that `data` completes, in order. Never raises, whatever the bytes are."""
        self.counters.bytes += len(data)
        last = len(data) - 1
        if (
            last > MIN_RUN
            and not data[0]
            and data.find(0, 1) == last
            and not (self._tail or self._discarding)
        ):
            # One frame and nothing else, as it mostly comes.
            only = self._decode(data[1:last])
            return [] if only is None else [only]
        data = bytes(data)
        runs = (self._thinned(data) if data.count(0) > CROWD else data).split(b"\0")
        rest = runs.pop()
        frames: list[Frame] = []
        if runs:
            if self._tail or self._discarding:
                runs[0] = b"" if self._discarding else bytes(self._tail + runs[0])
                self._tail.clear()
                self._discarding = False
            for run in runs:
                if len(run) >= MIN_RUN:
                    frame = self._decode(run)
                    if frame is not None:
                        frames.append(frame)
                elif run:
                    self.counters.length += 1
        if not self._discarding:
            self._tail += rest
            if len(self._tail) > MAX_RUN:
                self.counters.overrun += 1
                self._tail.clear()
                self._discarding = True
        return frames

    def reset(self) -> None:
        """The stream ended: what is left of it is no frame (counted as framing). Counters go on."""
        self.counters.framing += bool(self._tail)
        self._tail.clear()
        self._discarding = False

    def _thinned(self, data: bytes) -> bytes:
        """Data without the short runs that can be no frame, where they are a crowd: counted without
        a step each.

        To decode each would take longer than good frames of the same size. A short frame with a
        sound checksum but type or version 0, which no version has, counts as crc here.
        """
        code = np.frombuffer(
            data + b"\0", np.uint8
        )  # one more, where what leads beyond the data ends
        zeros = np.flatnonzero(code[:-1] == 0)
        length = np.diff(zeros) - 1
        tiny = np.count_nonzero(length < MIN_RUN) - np.count_nonzero(length == 0)
        kept = length >= MIN_RUN
        short = np.flatnonzero(kept & (length < SHORT_RUN))
        if len(short) > CROWD:
            # Each code word says where the next one is; a run is COBS where that leads to its end,
            # a zero, which stays.
            at = np.minimum(np.arange(len(code)) + code, len(code) - 1)
            for _ in range((SHORT_RUN - 1).bit_length()):
                at = at[at]
            first, end, size = zeros[short] + 1, zeros[short + 1], length[short]
            sound = at[first] == end
            # The header's fourth byte, the high one of its length, is the only one of four that is
            # 0.
            hopeful = sound & (code[first] == 4) & (code[first + 3] == size - 1 - OVERHEAD)
            kept[short] = hopeful
            self.counters.framing += len(short) - int(np.count_nonzero(sound))
            self.counters.crc += int(np.count_nonzero(sound)) - int(np.count_nonzero(hopeful))
        elif tiny <= CROWD:
            return data
        self.counters.length += tiny
        chosen = np.flatnonzero(kept)
        runs = [
            data[i:j]
            for i, j in zip((zeros[chosen] + 1).tolist(), zeros[chosen + 1].tolist(), strict=True)
        ]
        return b"\0".join([data[: zeros[0]], *runs, data[zeros[-1] + 1 :]])

    def _decode(self, run: bytes | bytearray) -> Frame | None:
        counters = self.counters
        if len(run) > MAX_RUN:
            counters.overrun += 1
            return None
        try:
            raw = cobs.decode(run)
        except cobs.DecodeError:
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
