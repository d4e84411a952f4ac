"""Consistent overhead byte stuffing: bytes without zeros, so that a zero can end a frame.

Cheshire, Baker, "Consistent overhead byte stuffing", IEEE/ACM Transactions on Networking 7 (1999).
Each zero of the data ends a block. A block is coded as its length plus one and its bytes; its zero
is left out. Blocks longer than 254 bytes are cut, and the last one has no zero.
"""

from __future__ import annotations

from .native import wire

FULL = 254
"""Bytes of the longest block. Its code, 255, says that no zero follows."""


def encode_in_python(data: bytes) -> bytes:
    """The code of any bytes."""
    code = bytearray()
    block = b""
    for block in data.split(b"\0"):
        while len(block) >= FULL:
            code += b"\xff" + block[:FULL]
            block = block[FULL:]
        code.append(len(block) + 1)
        code += block
    if data and data[-1] and not block:
        # The data end with a full block: it needs no empty one behind it.
        del code[-1]
    return bytes(code)


def decode_in_python(code: bytes) -> bytes | None:
    """The bytes of a code; None if it is none."""
    if b"\0" in code:
        return None
    blocks: list[bytes] = []
    at = 0
    while at < len(code):
        length = code[at]
        end = at + length
        if end > len(code):
            return None
        blocks.append(code[at + 1 : end])
        if length <= FULL and end < len(code):
            blocks.append(b"\0")
        at = end
    return b"".join(blocks)


encode = encode_in_python if wire is None else wire.cobs_encode
decode = decode_in_python if wire is None else wire.cobs_decode
