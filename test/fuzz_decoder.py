# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Coverage-guided fuzzing of decoder and account, by hand: `pip install atheris`, then in the
environment

    python test/fuzz_decoder.py CORPUS_FOLDER -max_total_time=60

It feeds any bytes, and frames with a right checksum around any payload. Nothing may be raised,
whatever is decoded encodes to one frame again, and the account adds up.
"""

from __future__ import annotations

import sys
import zlib

import atheris

with atheris.instrument_imports(include=["cube_tensor_driver.device"]):
    from cube_tensor_driver.device.scans.sequence import SampleAccount
    from cube_tensor_driver.device.wire import cobs
    from cube_tensor_driver.device.wire.decoder import Decoder
    from cube_tensor_driver.device.wire.protocol import Sample, Stats, encode


def sound(part: bytes, any_type: bool) -> bytes:
    """A frame with a right checksum around anything."""
    if not part:
        return b"\0"
    body = (
        bytes([part[0] if any_type else part[0] % 6, 1])
        + (len(part) - 1).to_bytes(2, "little")
        + part[1:]
    )
    return b"\0" + cobs.encode(body + zlib.crc32(body).to_bytes(4, "little")) + b"\0"


def one(data: bytes) -> None:
    provider = atheris.FuzzedDataProvider(data)
    mode, body = provider.ConsumeIntInRange(0, 2), provider.ConsumeBytes(4096)
    decoder, account = Decoder(), SampleAccount()
    received = 0
    parts = (
        [body, b"\0"] if mode == 0 else [sound(part, mode == 2) for part in body.split(b"\xff\xff")]
    )
    for frame in [frame for part in parts for frame in decoder.feed(part)]:
        if len(Decoder().feed(encode(frame))) != 1:
            raise RuntimeError(f"{frame} does not encode to itself")
        if isinstance(frame, Sample):
            account.classify(frame)
            received += 1
        elif isinstance(frame, Stats):
            account.add_stats(frame)
    counters = account.counters()
    rest = (
        counters["taken"]
        - counters["delivered"]
        - counters["dropped_in_hub"]
        - counters["lost_on_the_way"]
    )
    is_counted_once = counters["delivered"] + counters["duplicate"] == received
    if not is_counted_once or rest or min(counters.values()) < 0:
        raise RuntimeError(f"the account does not add up: {counters}")


if __name__ == "__main__":
    atheris.Setup(sys.argv, one)
    atheris.Fuzz()
