"""SAMPLE frames that are encoded once and sent again with other sequence numbers and times.

Simulated hubs must use little time where the speed of the driver is measured.
"""

from __future__ import annotations

import struct
import zlib

from ..device.wire import cobs
from ..device.wire.protocol import Sample, encode

_HEAD_BYTES = 24
"""Number of bytes of a SAMPLE before its frequencies; the last one is spare and 0."""

_CRC_BYTES = 4
"""Number of bytes of the checksum at the end of a frame."""

_SEQUENCE = struct.Struct("<I")
_SEQUENCE_OFFSET = 4
_DEVICE_US = struct.Struct("<Q")
_DEVICE_US_OFFSET = 12


class PreparedFrame:
    """A SAMPLE frame that is encoded except for sequence number, time and checksum.

    COBS encodes the bytes between two zeros in the same way wherever they stand. So the frame is
    encoded in three parts: up to the last byte of the head, up to the last zero before the
    checksum, and the rest.
    """

    def __init__(self, sample: Sample) -> None:
        frame = encode(sample)
        body = (cobs.decode(frame[1:-1]) or b"")[:-_CRC_BYTES]
        last_zero = body.rfind(b"\0", _HEAD_BYTES)
        self._head = bytearray(body[:_HEAD_BYTES])
        self._tail = body[_HEAD_BYTES:]
        self._encoded_middle = cobs.encode(body[_HEAD_BYTES:last_zero])
        self._rest = body[last_zero + 1 :]

        # Without such a zero, or with 254 bytes without a zero before one of these two zeros, COBS
        # encodes differently. Such a sample is encoded as a whole each time.
        self._sample: Sample | None = None
        if last_zero < 0 or self.encode(sample.sequence, sample.device_us) != frame:
            self._sample = sample

    def encode(self, sequence: int, device_us: int) -> bytes:
        """Encode the sample with these numbers, with the result of `protocol.encode`.

        Args:
            sequence: Sequence number of the sample.
            device_us: Time of the hub's clock in µs.
        """
        if self._sample is not None:
            self._sample.sequence = sequence
            self._sample.device_us = device_us
            return encode(self._sample)

        _SEQUENCE.pack_into(self._head, _SEQUENCE_OFFSET, sequence)
        _DEVICE_US.pack_into(self._head, _DEVICE_US_OFFSET, device_us)
        # The checksum covers head and tail, and its four bytes may contain zeros.
        crc = zlib.crc32(self._tail, zlib.crc32(self._head)).to_bytes(_CRC_BYTES, "little")
        start = cobs.encode(bytes(self._head[:-1]))
        end = cobs.encode(self._rest + crc)
        return b"".join((b"\0", start, self._encoded_middle, end, b"\0"))
