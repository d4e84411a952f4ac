# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Consistent overhead byte stuffing (COBS): removes zero bytes, so that a zero can end a frame.

Each zero byte of the data ends a block. A block is encoded as one byte with its length plus one
(the zero not counted), then its bytes without the zero. Blocks longer than 254 bytes are split, and
the last block has no zero. Source: Cheshire, Baker, "Consistent overhead byte stuffing", IEEE/ACM
Transactions on Networking 7 (1999).
"""

from __future__ import annotations

from .native import wire

MAX_BLOCK = 254
"""Length of the longest block of the COBS encoding (bytes between two zeros), in bytes. Its length
byte, 255, means that no zero follows the block."""


def encode_in_python(data: bytes) -> bytes:
    """Return the COBS encoding (consistent overhead byte stuffing) of any bytes; it has no zero."""
    code = bytearray()
    block = b""
    for block in data.split(b"\0"):
        while len(block) >= MAX_BLOCK:
            code += b"\xff" + block[:MAX_BLOCK]
            block = block[MAX_BLOCK:]
        code.append(len(block) + 1)
        code += block

    if data and data[-1] and not block:
        # The data end with a block of 254 bytes, after which the loop has added an empty block. The
        # encoding does not need it, so its length byte is removed.
        del code[-1]
    return bytes(code)


def decode_in_python(code: bytes) -> bytes | None:
    """Return the data of a COBS encoding; None if the bytes are no valid COBS encoding."""
    if b"\0" in code:
        return None
    blocks: list[bytes] = []
    start = 0
    while start < len(code):
        length = code[start]
        end = start + length
        if end > len(code):
            return None
        blocks.append(code[start + 1 : end])
        # COBS: each block stands for its bytes and a zero. The last block and blocks of the full
        # length stand for their bytes only.
        if length <= MAX_BLOCK and end < len(code):
            blocks.append(b"\0")
        start = end
    return b"".join(blocks)


encode = encode_in_python if wire is None else wire.cobs_encode
