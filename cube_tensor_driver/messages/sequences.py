# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Serialised messages that consist of a header and sequences, made without message objects.

rclpy checks every field of an object and then converts it twice, which takes several times as long.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable

from ..core.arrays import AnyArray
from .codec import LITTLE_ENDIAN, SECOND


def encode_header(stamp_ns: int, frame_id: str) -> bytes:
    """Return a header (std_msgs/Header) in little-endian CDR, which begins a message.

    Args:
        stamp_ns: Time stamp, in ns since the Unix epoch.
        frame_id: Coordinate frame.
    """
    text = frame_id.encode() + b"\0"
    return struct.pack("<iII", *divmod(stamp_ns, SECOND), len(text)) + text


def encode_sequences(begin: bytes, columns: Iterable[AnyArray]) -> bytes:
    """Return a serialised message.

    Args:
        begin: The fields before the sequences, as from `encode_header`.
        columns: Values of each sequence with the type of the field. A sequence of vectors is an
            array (n, 3) of float64.
    """
    data = bytearray(begin)
    for values in columns:
        # CDR aligns a number to its size, from the end of the encapsulation header on.
        data += bytes(-len(data) % 4) + struct.pack("<I", len(values))
        if values.size:
            data += bytes(-len(data) % values.itemsize) + values.tobytes()
    return LITTLE_ENDIAN + data
