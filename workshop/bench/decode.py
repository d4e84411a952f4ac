# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""`./cube bench decode`: how fast clean frames and noise are decoded, in the same run."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from cube_tensor_driver.device.wire.decoder import Decoder, PythonDecoder
from cube_tensor_driver.device.wire.native import wire
from cube_tensor_driver.device.wire.protocol import Sample, encode

BYTES = 500_000
"""Number of bytes of each kind of data (clean frames and noises) that are decoded."""

READ = 4096
"""Number of bytes in one call of the decoder, as a busy link delivers them."""

LATE_FAILURE = b"\1" * 14 + b"\2\0"
"""Shortest byte sequence (with the closing 0) whose COBS code is found to be invalid only at its
last byte, so that a decoder has done the work of a whole frame in vain."""

INTACT_COBS = b"\2\7" * 7 + b"\1\0"
"""Bytes of the same length as `LATE_FAILURE` that are correctly stuffed (COBS), but no frame."""

ROUNDS = 5
"""Number of measurements, of which the fastest is given: other processes only slow one down."""


def make_clean_frames(size: int) -> bytes:
    """Return at least `size` bytes of intact SAMPLE frames of 8 cubes with 8 pads."""
    random = np.random.default_rng(1)
    no_fault, no_temperature = np.zeros(8, "<u4"), np.zeros(8, "<i2")
    frames = bytearray()
    number = 0
    while len(frames) < size:
        frequency = random.integers(90_000_000, 110_000_000, (8, 8)).astype("<u4")
        sample = Sample(
            number,
            0,
            1000 * number,
            frequency,
            no_fault,
            no_temperature,
        )
        frames += encode(sample)
        number += 1
    return bytes(frames)


def bench_decode() -> dict[str, Any]:
    """Measure how fast each decoder decodes clean frames and noise, in GB per second of one core.

    The decoders are `c` (in C, gives only the bytes of each frame), `frames` (the driver's decoder,
    which makes Python objects from them) and `python` (the one in pure Python).
    """
    decoders: dict[str, Callable[[], Any]] = {"frames": Decoder, "python": PythonDecoder}
    # Without a compiler there is no decoder in C.
    if wire is not None:
        decoders = {"c": wire.Decoder, **decoders}
    worst = LATE_FAILURE + INTACT_COBS
    data = {
        "clean frames": make_clean_frames(BYTES),
        "random": np.random.default_rng(3).bytes(BYTES),
        "late failures, sound ones between": worst * (BYTES // len(worst)),
    }
    fastest = {name: dict.fromkeys(decoders, 0.0) for name in data}
    for _ in range(ROUNDS):
        for name, chunk in data.items():
            # The decoders alternate, so that other load of the machine slows down all of them.
            for kind, make_decoder in decoders.items():
                gb_per_s = len(chunk) / _time_decoding_ns(make_decoder(), chunk)
                fastest[name][kind] = max(fastest[name][kind], gb_per_s)
    speeds = {
        name: {kind: float(f"{gb_per_s:.3g}") for kind, gb_per_s in by_kind.items()}
        for name, by_kind in fastest.items()
    }
    return {"bytes": BYTES, "gb_per_s": speeds}


def _time_decoding_ns(decoder: Any, data: bytes) -> int:
    """Return the processor time of decoding all of the data, in ns."""
    start_ns = time.process_time_ns()
    for begin in range(0, len(data), READ):
        decoder.feed(data[begin : begin + READ])
    return time.process_time_ns() - start_ns
