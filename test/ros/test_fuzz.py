# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Two million bytes of each kind of noise through the decoder, and any text through the readers
of files."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from dataclasses import asdict

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs rclpy: run this with ./cube test")

from hypothesis import given, settings
from hypothesis import strategies as st
from rclpy.serialization import serialize_message

from cube_tensor_driver.config.calibration import read_calibration
from cube_tensor_driver.config.package_data import find_package_data
from cube_tensor_driver.config.skin import read_skin
from cube_tensor_driver.core.errors import CubeError
from cube_tensor_driver.device.wire.decoder import MAX_RUN, Decoder
from cube_tensor_driver.device.wire.protocol import Ack, Request, Stats, encode
from cube_tensor_driver.msg import SkinInfo
from cube_tensor_driver.ros import messages
from cube_tensor_driver.ros.markers.legend import format_in_four_characters
from workshop.bench.decode import INTACT_COBS, LATE_FAILURE, READ, make_clean_frames

EACH = 2_000_000
SHIPPED = {
    read_calibration: find_package_data() / "config" / "calibration" / "cube.yaml",
    read_skin: find_package_data() / "config" / "skin_demo.yaml",
}


def damaged_frames(size: int) -> bytes:
    """Frames of which one byte in a hundred was replaced."""
    random = np.random.default_rng(2)
    data = np.frombuffer(make_clean_frames(size), np.uint8).copy()
    where = random.integers(0, len(data), len(data) // 100)
    data[where] = random.integers(0, 256, len(where))
    return bytes(data)


NOISE: dict[str, Callable[[int], bytes]] = {
    "random": np.random.default_rng(3).bytes,
    "mostly zeros and ones": lambda n: bytes(np.random.default_rng(4).integers(0, 2, n).tolist()),
    "harmed frames": damaged_frames,
    "no zero at all": lambda n: b"\x55" * n,
    "late failures": lambda n: LATE_FAILURE * (n // 16),
    "late failures, sound ones between": lambda n: (LATE_FAILURE + INTACT_COBS) * (n // 32),
    "zeros and ones in turn": lambda n: b"\0\1" * (n // 2),
}


def feed(decoder: Decoder, data: bytes) -> None:
    for at in range(0, len(data), READ):
        decoder.feed(data[at : at + READ])


@pytest.mark.campaign
@pytest.mark.parametrize("name", list(NOISE))
def test_two_million_bytes_of_noise(name: str, effort: int) -> None:
    """No exception, and every run is counted once, as what it is when it comes alone."""
    noise = NOISE[name](EACH * effort)
    decoder = Decoder()
    feed(decoder, noise)
    feed(decoder, b"\0")
    counters = decoder.counters
    counted = sum(value for key, value in asdict(counters).items() if key != "bytes")
    runs = sum(1 for run in noise.split(b"\0") if run)
    assert counted == runs and counters.bytes == len(noise) + 1
    alone = Decoder()
    for run in noise.split(b"\0"):
        alone.feed(run + b"\0")
    assert alone.counters == counters


@pytest.mark.parametrize("name", list(NOISE))
def test_noise_takes_no_memory(name: str) -> None:
    """A decoder keeps no more than one frame's bytes between two reads."""
    noise = NOISE[name](EACH // 4)
    decoder = Decoder()
    feed(decoder, noise[: len(noise) // 10])
    tracemalloc.start()
    try:
        before, _ = tracemalloc.get_traced_memory()
        feed(decoder, noise)
        after, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert after - before < 2 * MAX_RUN
    assert peak - before < 64 * READ + 2 * MAX_RUN


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


@settings(max_examples=200)
@given(pieces=st.lists(PIECES, min_size=20, max_size=60), cut=st.integers(0, 500))
def test_a_crowd_of_short_runs_is_what_they_are_one_by_one(pieces: list[bytes], cut: int) -> None:
    """Frames and counters, however noise and frames mix, and wherever the bytes are cut."""
    data = b"".join(pieces) + b"\0"
    together, alone = Decoder(), Decoder()
    found = together.feed(data[:cut]) + together.feed(data[cut:])
    expected = [frame for run in data.split(b"\0") for frame in alone.feed(run + b"\0")]
    assert repr(found) == repr(expected)
    counts, others = asdict(together.counters), asdict(alone.counters)
    del counts["bytes"], others["bytes"]
    assert counts == others


@settings(max_examples=60)
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


def test_many_bad_messages_are_one_line_and_the_newest_good_one_is_taken(ros, capfd, monkeypatch):
    """Libraries below rclpy print a line of their own about each message that they decode."""
    monkeypatch.setattr(messages, "LOG_PERIOD_S", 0.5)
    got = []
    taken = messages.CheckedSubscription(ros.node, SkinInfo, "info", got.append, 100)
    sender = ros.node.create_publisher(SkinInfo, "info", 100)
    bad = bytearray(serialize_message(SkinInfo(name="abc")))
    bad[-12:] = b"\xff" * 12
    ros.wait(sender.get_subscription_count)
    sender.publish(SkinInfo(name="first"))
    ros.wait(lambda: got)
    for _ in range(50):
        sender.publish(bytes(bad))
    sender.publish(SkinInfo(name="last"))
    ros.wait(lambda: len(got) == 2)
    taken.close()
    taken._receive(serialize_message(SkinInfo(name="taken just before")))
    lines = capfd.readouterr().err.splitlines()
    assert [info.name for info in got] == ["first", "last"]
    assert 1 <= len(lines) <= 3 and any("info: failed to deserialize" in line for line in lines)


@pytest.mark.parametrize("value", [-5000.0, -1e-9, float("nan"), 1e38])
def test_the_legend_has_four_characters_for_any_number(value):
    assert format_in_four_characters(value) == "----"
