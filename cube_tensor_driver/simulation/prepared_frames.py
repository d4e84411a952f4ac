"""SAMPLE frames that are sent again and again with other numbers and times, encoded once: simulated
hubs must cost little where the driver is measured."""

from __future__ import annotations

import struct
import zlib

from ..device.wire import cobs
from ..device.wire.protocol import Sample, encode

_HEAD = 24
"""Bytes of a SAMPLE before its frequencies; the last one is spare and 0."""
_SEQUENCE = struct.Struct("<I"), 4
_DEVICE_US = struct.Struct("<Q"), 12
"""How a field of the header is packed, and where."""


class PreparedFrame:
    """A SAMPLE that is encoded but for sequence, time and checksum.

    COBS codes what lies between two zeros in the same way wherever it stands. So the frame is coded
    in three parts: up to the last byte of the header, up to the last zero before the checksum, and
    the rest.
    """

    def __init__(self, sample: Sample) -> None:
        frame = encode(sample)
        body = (cobs.decode(frame[1:-1]) or b"")[:-4]
        self._head, self._tail = bytearray(body[:_HEAD]), body[_HEAD:]
        last_zero = body.rfind(b"\0", _HEAD)
        self._middle = cobs.encode(body[_HEAD:last_zero])
        self._rest = body[last_zero + 1 :]
        # Where there is no zero, or 254 bytes without one before one of these two zeros, COBS codes
        # otherwise: such a sample is encoded again each time.
        self._sample: Sample | None = None
        if last_zero < 0 or self.encode(sample.sequence, sample.device_us) != frame:
            self._sample = sample

    def encode(self, sequence: int, device_us: int) -> bytes:
        """The same bytes as `protocol.encode` of the sample with these numbers."""
        if self._sample is not None:
            self._sample.sequence, self._sample.device_us = sequence, device_us
            return encode(self._sample)
        for (packing, offset), value in ((_SEQUENCE, sequence), (_DEVICE_US, device_us)):
            packing.pack_into(self._head, offset, value)
        crc = zlib.crc32(self._tail, zlib.crc32(self._head)).to_bytes(4, "little")
        start, end = cobs.encode(bytes(self._head[:-1])), cobs.encode(self._rest + crc)
        return b"".join((b"\0", start, self._middle, end, b"\0"))
