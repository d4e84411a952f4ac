"""Ten million bytes of all kinds of noise through the decoder, and any text through the readers of
files."""

from __future__ import annotations

import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cube_tensor_driver.config.calibration import read_calibration
from cube_tensor_driver.config.package_data import package_data
from cube_tensor_driver.config.skin import read_skin
from cube_tensor_driver.core.errors import CubeError
from cube_tensor_driver.device.decoder import MAX_RUN, Decoder
from cube_tensor_driver.device.protocol import Ack, Request, Sample, Stats, encode

EACH = 2_000_000
SHIPPED = {
    read_calibration: package_data() / "config" / "calibration" / "cube.yaml",
    read_skin: package_data() / "config" / "skin_demo.yaml",
}


def clean(size: int) -> bytes:
    random = np.random.default_rng(1)
    frames, length, number = [], 0, 0
    while length < size:
        frequency = random.integers(90_000_000, 110_000_000, (8, 8)).astype("<u4")
        frame = encode(
            Sample(number, 0, 1000 * number, frequency, np.zeros(8, "<u4"), np.zeros(8, "<i2"))
        )
        frames.append(frame)
        length, number = length + len(frame), number + 1
    return b"".join(frames)


def harmed(size: int) -> bytes:
    random = np.random.default_rng(2)
    data = np.frombuffer(clean(size), np.uint8).copy()
    places = random.integers(0, len(data), len(data) // 100)
    data[places] = random.integers(0, 256, len(places))
    return data.tobytes()


NOISE = {
    "random": lambda size: np.random.default_rng(3).bytes(size),
    "mostly zeros and ones": lambda size: (
        np.random.default_rng(4).integers(0, 2, size).astype(np.uint8).tobytes()
    ),
    "harmed frames": harmed,
    "no zero at all": lambda size: b"\x55" * size,
    # The shortest runs that could be frames, and fail in their last byte.
    "late failures": lambda size: (b"\1" * 14 + b"\2\0") * (size // 16),
    "late failures, sound ones between": lambda size: (
        (b"\1" * 14 + b"\2\0" + b"\2\7" * 7 + b"\1\0") * (size // 32)
    ),
    "zeros and ones in turn": lambda size: b"\0\1" * (size // 2),
}


def feed(decoder: Decoder, data: bytes) -> float:
    """Seconds of processor time."""
    start = time.process_time()
    for at in range(0, len(data), 4096):
        decoder.feed(data[at : at + 4096])
        assert len(decoder._tail) <= MAX_RUN
    return time.process_time() - start


@pytest.mark.parametrize("name", list(NOISE))
def test_ten_million_bytes_of_noise(name: str) -> None:
    """No exception, bounded memory, every run counted once, and no slower than three times clean
    frames."""
    good, bad = clean(EACH // 4), NOISE[name](EACH)
    decoder = Decoder()
    feed(decoder, bad)
    feed(decoder, b"\0")
    counters = decoder.counters
    counted = sum(value for key, value in counters.as_dict().items() if key != "bytes")
    runs = sum(1 for run in bad.split(b"\0") if run)
    assert counted == runs and counters.bytes == len(bad) + 1
    alone = Decoder()
    for run in bad.split(b"\0"):
        alone.feed(run + b"\0")
    assert alone.counters == counters  # runs in a crowd are counted as what they are one by one
    part = bad[: EACH // 4]
    # The best of several, one after the other: other processes only ever add.
    ratios = [
        (feed(Decoder(), part) / len(part)) / (feed(Decoder(), good) / len(good)) for _ in range(5)
    ]
    assert min(ratios) < 3.0


FRAMES = [
    encode(frame)
    for frame in (Request(1), Request(4, 10_000), Ack(4, 0, 10_000), Stats(5, 4, 3, 2))
]
PIECES = st.one_of(
    st.sampled_from(FRAMES),
    st.sampled_from(FRAMES).map(lambda frame: encode(Stats(1, 2, 3), version=2) + frame),
    st.tuples(st.sampled_from(FRAMES), st.integers(1, 30), st.integers(0, 255)).map(
        lambda harm: harm[0][: harm[1]] + bytes([harm[2]]) + harm[0][harm[1] + 1 :]
    ),
    st.lists(st.integers(1, 40), max_size=34).map(lambda run: bytes(run) + b"\0"),
    st.binary(max_size=40),
)


@settings(max_examples=200, deadline=None)
@given(pieces=st.lists(PIECES, min_size=20, max_size=60), cut=st.integers(0, 500))
def test_a_crowd_of_short_runs_is_what_they_are_one_by_one(pieces: list[bytes], cut: int) -> None:
    """Frames and counters, however noise and frames mix, and wherever the bytes are cut."""
    data = b"".join(pieces) + b"\0"
    together, alone = Decoder(), Decoder()
    found = together.feed(data[:cut]) + together.feed(data[cut:])
    expected = [frame for run in data.split(b"\0") for frame in alone.feed(run + b"\0")]
    assert repr(found) == repr(expected)
    counts, others = together.counters.as_dict(), alone.counters.as_dict()
    del counts["bytes"], others["bytes"]
    assert counts == others


@settings(max_examples=60, deadline=None)
@given(data=st.data())
@pytest.mark.parametrize("read", list(SHIPPED), ids=lambda read: read.__name__)
def test_damaged_files_are_read_or_our_error(
    tmp_path_factory: pytest.TempPathFactory, read, data
) -> None:
    lines = SHIPPED[read].read_text().splitlines()
    path = tmp_path_factory.mktemp("fuzz") / "file.yaml"
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(lines) - 1))
        line = lines[at]
        cut = data.draw(st.integers(0, len(line)))
        lines[at] = (
            line[:cut] + data.draw(st.text(max_size=6)) + line[cut + data.draw(st.integers(0, 4)) :]
        )
    path.write_text("\n".join(lines), errors="replace")
    try:
        read(path)
    except CubeError as error:
        assert str(error)
