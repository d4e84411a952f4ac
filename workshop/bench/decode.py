"""./cube bench decode: how fast bytes are decoded, clean frames and noise in the same run."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from cube_tensor_driver.demo.running import report
from cube_tensor_driver.device.wire.decoder import Decoder, PythonDecoder
from cube_tensor_driver.device.wire.native import wire
from cube_tensor_driver.device.wire.protocol import Sample, encode

BYTES = 500_000
READ = 4096
"""Bytes that one call of the decoder is given, as a busy link gives them."""
ROUNDS = 5


def clean_frames(size: int) -> bytes:
    """At least `size` bytes of sound SAMPLE frames of 8 cubes with 8 pads."""
    random = np.random.default_rng(1)
    frames: list[bytes] = []
    length = 0
    while length < size:
        number = len(frames)
        frequency = random.integers(90_000_000, 110_000_000, (8, 8)).astype("<u4")
        no_fault, no_temperature = np.zeros(8, "<u4"), np.zeros(8, "<i2")
        frame = encode(Sample(number, 0, 1000 * number, frequency, no_fault, no_temperature))
        frames.append(frame)
        length += len(frame)
    return b"".join(frames)


def harmed_frames(size: int) -> bytes:
    """Frames in which one byte in a hundred was replaced by a random one."""
    random = np.random.default_rng(2)
    data = np.frombuffer(clean_frames(size), np.uint8).copy()
    where = random.integers(0, len(data), len(data) // 100)
    data[where] = random.integers(0, 256, len(where))
    return data.tobytes()


def random_bytes(size: int) -> bytes:
    return np.random.default_rng(3).bytes(size)


def random_zeros_and_ones(size: int) -> bytes:
    bits = np.random.default_rng(4).integers(0, 2, size)
    return bytes(bits.tolist())


# The shortest run that could be a frame, and fails in its last byte.
FAILS_LATE = b"\1" * 14 + b"\2\0"
SOUND_COBS = b"\2\7" * 7 + b"\1\0"
NOISE: dict[str, Callable[[int], bytes]] = {
    "random": random_bytes,
    "mostly zeros and ones": random_zeros_and_ones,
    "harmed frames": harmed_frames,
    "no zero at all": lambda size: b"\x55" * size,
    "late failures": lambda size: FAILS_LATE * (size // 16),
    "late failures, sound ones between": lambda size: (FAILS_LATE + SOUND_COBS) * (size // 32),
    "zeros and ones in turn": lambda size: b"\0\1" * (size // 2),
}
"""Bytes that are no frames, or few, each made for a size in bytes."""


def bench_decode(*, json_path: Path | None = None) -> int:
    """Time clean frames and each noise in turn, in GB of wire bytes per second of one core.

    `c`: the decoder in C, without objects of Python but the bytes of each frame; null if it was not
    compiled. `frames`: the decoder that the driver has, with its frames. `python`: the one in
    Python. The best of some rounds: other processes only ever add to a time.
    """
    decoders: dict[str, Callable[[], Any]] = {"frames": Decoder, "python": PythonDecoder}
    if wire is not None:
        decoders = {"c": wire.Decoder, **decoders}
    made = {"clean frames": clean_frames(BYTES)}
    made |= {name: make(BYTES) for name, make in NOISE.items()}
    best = {name: dict.fromkeys(decoders, 0.0) for name in made}
    for _ in range(ROUNDS):
        for name, data in made.items():
            for kind, make_decoder in decoders.items():
                speed = len(data) / _ns(make_decoder(), data)
                best[name][kind] = max(best[name][kind], speed)
    speeds = {
        name: {kind: float(f"{speed:.3g}") for kind, speed in by_kind.items()}
        for name, by_kind in best.items()
    }
    report({"bytes": BYTES, "gb_per_s": speeds}, json_path)
    return 0


def _ns(decoder: Any, data: bytes) -> int:
    """Processor time of decoding all of it."""
    start = time.process_time_ns()
    for at in range(0, len(data), READ):
        decoder.feed(data[at : at + READ])
    return time.process_time_ns() - start
