"""From the bytes of a link to frames, whatever the bytes are.

`Decoder.feed` never raises. Each non-empty run of bytes that a zero closes becomes one frame, or is
counted in exactly one counter of `Counters`.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np
from cobs import cobs  # type: ignore[import-untyped]
from numpy.typing import NDArray

from .protocol import HEADER, MAX_FRAME, OVERHEAD, REQUEST, UNPACK, VERSION, Frame

MAX_RUN = MAX_FRAME + (MAX_FRAME + 253) // 254
"""Longest run of bytes between two zeros that can be a frame. COBS adds one byte to each 254."""
MIN_RUN = OVERHEAD + REQUEST.size + 1
"""Shortest run that can be a frame of any version. Trying shorter ones would let noise slow the
decoder down."""
SHORT_RUN = 32
"""Any SAMPLE is longer."""
MANY_RUNS = 32
"""More short runs than this in one feed are taken for noise, and sorted out together."""
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


class Decoder:
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
        last = len(data) - 1
        is_single_run = last > MIN_RUN and data[0] == 0 and data.find(0, 1) == last
        if is_single_run and not (self._tail or self._discarding):
            # The common case, and quick: one frame and nothing else.
            only = self._decode(data[1:last])
            return [] if only is None else [only]
        data = bytes(data)
        if data.count(0) > MANY_RUNS:
            data = self._without_noise(data)
        runs = data.split(b"\0")
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
        """The stream ended: the bytes of an unfinished frame are thrown away, and count as
        framing."""
        self.counters.framing += bool(self._tail)
        self._tail.clear()
        self._discarding = False

    def _without_noise(self, data: bytes) -> bytes:
        """The data without short runs that are no frame, if there are many; they are counted.

        Trying them one by one would take longer than decoding good frames of the same size. A short
        run with a right checksum whose type or version is 0, which no version has, counts as crc
        here.
        """
        # One byte more, so that a code word that leads beyond the data leads to the last index.
        code = np.frombuffer(data + b"\0", np.uint8)
        zeros = np.flatnonzero(code[:-1] == 0)
        length = np.diff(zeros) - 1
        n_tiny = np.count_nonzero(length < MIN_RUN) - np.count_nonzero(length == 0)
        kept = length >= MIN_RUN
        short = np.flatnonzero(kept & (length < SHORT_RUN))
        if len(short) > MANY_RUNS:
            is_cobs, is_hopeful = _check_short_runs(code, zeros[short], zeros[short + 1])
            kept[short] = is_hopeful
            n_cobs, n_hopeful = int(is_cobs.sum()), int(is_hopeful.sum())
            self.counters.framing += len(short) - n_cobs
            self.counters.crc += n_cobs - n_hopeful
        elif n_tiny <= MANY_RUNS:
            return data
        self.counters.length += n_tiny
        starts = (zeros[:-1][kept] + 1).tolist()
        ends = zeros[1:][kept].tolist()
        runs = [data[start:end] for start, end in zip(starts, ends, strict=True)]
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


def _check_short_runs(
    code: NDArray[np.uint8], before: NDArray[np.intp], end: NDArray[np.intp]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which runs between the zeros `before` and `end` are COBS, and which of these can be frames.

    code: the bytes, and one more.
    """
    # Each code word tells where the next one is, and a run is COBS if following them leads to its
    # end. A zero leads to itself. Each step below follows twice as many as the one before.
    at = np.minimum(np.arange(len(code)) + code, len(code) - 1)
    for _ in range((SHORT_RUN - 1).bit_length()):
        at = at[at]
    first = before + 1
    is_cobs = at[first] == end
    # Of a short frame's header only the fourth byte, the high one of the length, is 0.
    has_length = code[first + 3] == end - first - 1 - OVERHEAD
    return is_cobs, is_cobs & (code[first] == 4) & has_length
