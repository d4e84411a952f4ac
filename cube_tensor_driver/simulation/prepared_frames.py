"""Frames that go out again and again with other numbers: encoded once, for simulated hubs that must
cost little."""

from __future__ import annotations

import struct
import zlib

from cobs import cobs  # type: ignore[import-untyped]

from ..device.protocol import Sample, encode

_HEAD = 24
"""Bytes of a SAMPLE before its frequencies; the last one is spare and 0."""
_SEQUENCE, _DEVICE_US = (struct.Struct("<I"), 4), (struct.Struct("<Q"), 12)


class Prepared:
    """A SAMPLE that is encoded but for sequence, time and checksum.

    COBS codes what lies between two zeros alike wherever it stands, so the frame is coded in three
    parts: up to the last byte of the header, up to the last zero before the checksum, and the rest.
    """

    def __init__(self, sample: Sample) -> None:
        whole = encode(sample)
        body = cobs.decode(whole[1:-1])[:-4]
        self._head, self._tail = bytearray(body[:_HEAD]), body[_HEAD:]
        last = body.rfind(b"\0", _HEAD)
        self._middle, self._rest = cobs.encode(body[_HEAD:last]), body[last + 1 :]
        # 254 bytes without a zero before one of those two are coded otherwise, and there may be no
        # zero at all.
        self._whole: Sample | None = None
        if last < 0 or self.encode(sample.sequence, sample.device_us) != whole:
            self._whole = sample

    def encode(self, sequence: int, device_us: int) -> bytes:
        """The same bytes as `protocol.encode` of the sample with these numbers."""
        if self._whole is not None:
            self._whole.sequence, self._whole.device_us = sequence, device_us
            return encode(self._whole)
        for (field, place), value in ((_SEQUENCE, sequence), (_DEVICE_US, device_us)):
            field.pack_into(self._head, place, value)
        crc = zlib.crc32(self._tail, zlib.crc32(self._head)).to_bytes(4, "little")
        start, end = cobs.encode(bytes(self._head[:-1])), cobs.encode(self._rest + crc)
        return b"".join((b"\0", start, self._middle, end, b"\0"))
