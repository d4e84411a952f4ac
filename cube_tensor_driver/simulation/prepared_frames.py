"""SAMPLE frames that are encoded once and sent again with other sequence numbers and times.

This saves computing time of the simulated hubs, which must be small where the speed of the driver
is measured on the same machine.
"""

from __future__ import annotations

import struct
import zlib

from ..device.wire import cobs
from ..device.wire.protocol import Sample, encode

_HEAD_BYTES = 24
"""Number of bytes of a SAMPLE frame, before COBS encoding, in front of its frequencies. The last of
them is not used and always 0."""

_CRC_BYTES = 4
"""Number of bytes of the checksum (CRC-32) at the end of a frame."""

_SEQUENCE = struct.Struct("<I")
_SEQUENCE_OFFSET = 4
_DEVICE_US = struct.Struct("<Q")
_DEVICE_US_OFFSET = 12


class PreparedFrame:
    """A SAMPLE frame that is encoded in advance, except for sequence number, time and checksum.

    COBS (the encoding that removes zero bytes from frames) encodes the bytes between two zeros
    independently of all others. So the frame is encoded in three parts: up to the zero at the end
    of its head, from there to the last zero before the checksum, and the rest. Only the middle part
    is the same in all frames.
    """

    def __init__(self, sample: Sample) -> None:
        frame = encode(sample)
        body = (cobs.decode(frame[1:-1]) or b"")[:-_CRC_BYTES]
        last_zero = body.rfind(b"\0", _HEAD_BYTES)
        self._head = bytearray(body[:_HEAD_BYTES])
        self._tail = body[_HEAD_BYTES:]
        self._encoded_middle = cobs.encode(body[_HEAD_BYTES:last_zero])
        self._rest = body[last_zero + 1 :]

        # Without a zero before the checksum, or with a run of 254 bytes without a zero, the parts
        # cannot be encoded separately. Such a sample is encoded as a whole each time.
        self._sample: Sample | None = None
        if last_zero < 0 or self.encode(sample.sequence, sample.device_us) != frame:
            self._sample = sample

    def encode(self, sequence: int, device_us: int) -> bytes:
        """Return the frame with this number and time, the same bytes as from `protocol.encode`.

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
        # The bytes of the checksum may be zeros, which the encoding removes. So the checksum is
        # encoded each time, together with the last part of the frame.
        crc = zlib.crc32(self._tail, zlib.crc32(self._head)).to_bytes(_CRC_BYTES, "little")
        start = cobs.encode(bytes(self._head[:-1]))
        end = cobs.encode(self._rest + crc)
        return b"".join((b"\0", start, self._encoded_middle, end, b"\0"))
