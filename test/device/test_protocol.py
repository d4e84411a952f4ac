# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Wire protocol: the dumps of docs/protocol.md are the golden data; every case whole, byte by byte
and in junk."""

from __future__ import annotations

import re
from dataclasses import asdict

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from conftest import ROOT
from cube_tensor_driver.core.errors import CubeError, ProtocolError
from cube_tensor_driver.device.wire.decoder import MAX_RUN, Decoder, PythonDecoder
from cube_tensor_driver.device.wire.protocol import (
    Ack,
    Command,
    Frame,
    Hello,
    Request,
    Result,
    Sample,
    Stats,
    Time,
    count_sample_bytes,
    encode,
)
from cube_tensor_driver.simulation.hub import SimulatedHub

DOC = (ROOT / "docs" / "protocol.md").read_text(encoding="utf-8")

FRAMES: dict[str, Frame] = {
    "hello": Hello(0x1122334455667788, 0x00010203, 4, 10_000, np.array([0xA1, 0xA2], "<u8")),
    "sample": Sample(
        sequence=258,
        first_cube=3,
        device_us=123_456_789,
        frequency=np.array([[98_765_432, 100_000_000], [0, 101_000_001]], "<u4"),
        pad_fault=np.array([0, 1], "<u4"),
        temperature=np.array([2150, -32768], "<i2"),
    ),
    "stats": Stats(3_600_000, 360_000, 2, 4_980),
    "time": Time(77, 123_456_789),
    "request": Request(Command.SET_PERIOD, 2_000),
    "ack": Ack(Command.SET_PERIOD, Result.DONE, 2_000),
}
CASES = list(FRAMES)
JUNK = b"\x07noise \xff\xfe"


def dump(kind: str, name: str) -> bytes:
    """The bytes of one block of the page: hex up to two blanks, then words."""
    block = re.search(rf"```{kind} {name}\n(.*?)```", DOC, re.DOTALL)
    if block is None:
        raise LookupError(f"docs/protocol.md has no block '{kind} {name}'")
    return bytes.fromhex(" ".join(line.split("  ")[0] for line in block[1].splitlines()))


def cobs_of(data: bytes) -> bytes:
    """COBS as in the paper, to check the golden bytes against something else than the library."""
    out = bytearray()
    for i, block in enumerate(blocks := data.split(b"\0")):
        while len(block) >= 254:
            out += b"\xff" + block[:254]
            block = block[254:]
            if not block and i == len(blocks) - 1:
                return bytes(out)
        out += bytes([len(block) + 1]) + block
    return bytes(out)


def crc_of(data: bytes) -> int:
    """CRC-32 bit by bit."""
    crc = 0xFFFFFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xEDB88320 if crc & 1 else 0)
    return crc ^ 0xFFFFFFFF


def wire(raw: bytes) -> bytes:
    """Header and payload to bytes on the wire, for frames that `encode` refuses to make."""
    return b"\0" + cobs_of(raw + crc_of(raw).to_bytes(4, "little")) + b"\0"


def same(got: list[Frame], want: list[Frame]) -> bool:
    return [encode(f) for f in got] == [encode(f) for f in want]


def errors(decoder: Decoder) -> dict[str, int]:
    counts = asdict(decoder.counters)
    return {name: n for name, n in counts.items() if n and name not in ("bytes", "frames")}


def by_byte(data: bytes, decoder: Decoder | None = None) -> list[Frame]:
    decoder = decoder or Decoder()
    return [frame for byte in data for frame in decoder.feed(bytes([byte]))]


@pytest.mark.parametrize("name", CASES)
def test_page_agrees_with_itself(name: str) -> None:
    raw = dump("frame", name)
    assert crc_of(b"123456789") == 0xCBF43926
    assert int.from_bytes(raw[2:4], "little") == len(raw) - 8
    assert int.from_bytes(raw[-4:], "little") == crc_of(raw[:-4])
    assert dump("wire", name) == b"\0" + cobs_of(raw) + b"\0"


@pytest.mark.parametrize(("n_cubes", "n_pads"), [(1, 8), (5, 24), (500, 8)])
def test_bytes_of_a_sample_are_known_beforehand(n_cubes: int, n_pads: int) -> None:
    frequency = np.full((n_cubes, n_pads), 0x01010101, "<u4")
    full = Sample(
        0x01010101,
        0,
        0x0101010101010101,
        frequency,
        np.full(n_cubes, 0x01010101, "<u4"),
        np.full(n_cubes, 0x0101, "<i2"),
    )
    assert abs(len(encode(full)) - count_sample_bytes(n_cubes, n_pads)) <= 1


@pytest.mark.parametrize("name", CASES)
def test_encode_gives_the_page(name: str) -> None:
    assert encode(FRAMES[name]).hex(" ") == dump("wire", name).hex(" ")


@pytest.mark.parametrize("name", CASES)
def test_decode_gives_the_frame(name: str) -> None:
    data = dump("wire", name)
    for frames in (
        Decoder().feed(data),
        by_byte(data),
        Decoder().feed(data[1:]),
        Decoder().feed(bytearray(data)),
    ):
        (frame,) = frames
        assert type(frame) is type(FRAMES[name])
        assert encode(frame) == data


def test_arrays_are_views_that_cannot_be_written() -> None:
    (sample,) = Decoder().feed(dump("wire", "sample"))
    assert isinstance(sample, Sample)
    for array in (sample.frequency, sample.pad_fault, sample.temperature):
        assert not array.flags.owndata
        assert not array.flags.writeable


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize(
    "feed", [lambda data, d: d.feed(data), by_byte], ids=["whole", "byte by byte"]
)
def test_junk_around_loses_no_frame(name: str, feed) -> None:
    good = FRAMES[name]
    cut = encode(good)[:-5]  # no closing zero: the next frame's opening zero ends it
    decoder = Decoder()
    stream = (
        JUNK
        + encode(good)
        + JUNK
        + encode(good)
        + cut
        + encode(good)
        + b"\0\0\0"
        + encode(good)[1:]
        + JUNK
    )
    assert same(feed(stream, decoder), [good] * 4)
    assert decoder.counters.frames == 4
    assert sum(errors(decoder).values()) == 3
    decoder.reset()
    assert sum(errors(decoder).values()) == 4


HEADER_1 = bytes([0x03, 1, 18, 0])
STATS_PAYLOAD = bytes(18)
BAD = {
    "not COBS": (b"\0\x1bab3456789abcdef\0", "framing"),
    "eight bytes on the wire": (b"\0\x08abcdefg\0", "length"),
    "thirteen bytes on the wire": (b"\0\x0dabcdefghijkl\0", "length"),
    "too short": (wire(b"\x03\x01\x00"), "length"),
    "seven bytes": (b"\0" + cobs_of(b"1234567") + b"\0", "length"),
    "checksum": (b"\0" + cobs_of(HEADER_1 + STATS_PAYLOAD + b"\0\0\0\0") + b"\0", "crc"),
    "version 2": (wire(bytes([0x03, 2, 18, 0]) + STATS_PAYLOAD), "version"),
    "version 2 of a type to come": (wire(bytes([0x77, 2, 9, 9]) + bytes(5)), "version"),
    "unknown type": (wire(bytes([0x05, 1, 18, 0]) + STATS_PAYLOAD), "unknown_type"),
    "length says less": (wire(bytes([0x03, 1, 17, 0]) + STATS_PAYLOAD), "length"),
    "length says more": (wire(bytes([0x03, 1, 19, 0]) + STATS_PAYLOAD), "length"),
    "stats too long": (wire(bytes([0x03, 1, 19, 0]) + STATS_PAYLOAD + b"\0"), "length"),
    "byte after the payload": (wire(bytes([0x03, 1, 18, 0]) + STATS_PAYLOAD + b"\0"), "length"),
    "sample with a byte too many": (wire(bytes([2, 1, 21, 0]) + bytes(21)), "length"),
    "empty hello": (wire(bytes([0x01, 1, 0, 0])), "length"),
    "hello says 1 cube, has none": (
        wire(bytes([1, 1, 20, 0]) + bytes(12) + b"\1" + bytes(7)),
        "length",
    ),
    "empty sample": (wire(bytes([0x02, 1, 0, 0])), "length"),
    "sample says 1 cube, has none": (
        wire(bytes([2, 1, 20, 0]) + bytes(6) + b"\1" + bytes(13)),
        "length",
    ),
    "request too short": (wire(bytes([0x10, 1, 4, 0]) + bytes(4)), "length"),
    "ack too short": (wire(bytes([0x11, 1, 5, 0]) + bytes(5)), "length"),
    "overrun": (b"\0" + b"\1" * (MAX_RUN + 1) + b"\0", "overrun"),
}


@pytest.mark.parametrize("name", list(BAD))
@pytest.mark.parametrize(
    "feed", [lambda data, d: d.feed(data), by_byte], ids=["whole", "byte by byte"]
)
def test_bad_run_is_counted_once_and_named(name: str, feed) -> None:
    data, counter = BAD[name]
    decoder = Decoder()
    good = FRAMES["ack"]
    assert same(feed(data + encode(good), decoder), [good])
    assert errors(decoder) == {counter: 1}
    assert decoder.counters.bytes == len(data + encode(good))


def test_other_version_is_remembered() -> None:
    decoder = Decoder()
    decoder.feed(dump("wire", "ack"))
    assert decoder.other_version is None
    decoder.feed(BAD["version 2"][0])
    assert decoder.other_version == 2


@pytest.mark.parametrize(
    "frame",
    [
        Hello(2**64 - 1, 2**32 - 1, 255, 2**32 - 1, np.array([2**64 - 1], "<u8"), 255),
        Sample(
            2**32 - 1,
            2**16 - 1,
            2**64 - 1,
            np.full((1, 255), 2**32 - 1, "<u4"),
            np.full(1, 2**32 - 1, "<u4"),
            np.full(1, -(2**15), "<i2"),
        ),
        Stats(2**64 - 1, 2**32 - 1, 2**32 - 1, 2**16 - 1),
        Time(2**32 - 1, 2**64 - 1),
        Request(255, 2**32 - 1),
        Ack(255, 255, 2**32 - 1),
    ],
    ids=CASES,
)
def test_every_field_holds_its_whole_range(frame: Frame) -> None:
    (got,) = Decoder().feed(encode(frame))
    assert repr(got) == repr(frame)


def test_longest_frame_passes() -> None:
    """65530 of 65535 bytes of payload, without a zero byte in the arrays: the worst case of
    COBS."""
    n = (65535 - 20) // 10
    ones = Sample(
        1,
        0,
        1,
        np.full((n, 1), 0x01010101, "<u4"),
        np.full(n, 0x01010101, "<u4"),
        np.full(n, 0x101, "<i2"),
    )
    assert same(Decoder().feed(encode(ones)), [ones])
    too_long = Sample(
        1, 0, 1, np.ones((n + 1, 1), "<u4"), np.ones(n + 1, "<u4"), np.ones(n + 1, "<i2")
    )
    with pytest.raises(ProtocolError, match=r"65540 bytes, the limit is 65535"):
        encode(too_long)


def test_memory_is_bounded() -> None:
    decoder = PythonDecoder()
    for _ in range(50):
        decoder.feed(b"\1" * 10_000)
        assert len(decoder._tail) <= MAX_RUN
    assert errors(decoder) == {"overrun": 1}


@pytest.mark.parametrize(
    ("frame", "match"),
    [
        (Request(256), "Request"),
        (Stats(0, -1, 0), "Stats"),
        (Hello(1 << 64, 0, 8, 1, np.zeros(0, "<u8")), "Hello"),
        (Hello(1, 0, 8, 1, np.zeros(2, "<i8")), "cube_uids is int64"),
        (
            Sample(0, 0, 0, np.zeros((2, 8)), np.zeros(2, "<u4"), np.zeros(2, "<i2")),
            "frequency is float64",
        ),
        (
            Sample(0, 0, 0, np.zeros(8, "<u4"), np.zeros(2, "<u4"), np.zeros(2, "<i2")),
            "1 dimensions, must have 2",
        ),
        (
            Sample(0, 0, 0, np.zeros((2, 8), "<u4"), np.zeros(3, "<u4"), np.zeros(2, "<i2")),
            r"pad_fault .*\(3,\)",
        ),
        (
            Sample(0, 0, 0, np.zeros((1, 300), "<u4"), np.zeros(1, "<u4"), np.zeros(1, "<i2")),
            "Sample",
        ),
        ("a string", "cannot encode str"),
    ],
)
def test_encode_refuses(frame: Frame, match: str) -> None:
    with pytest.raises(ProtocolError, match=match) as refused:
        encode(frame)
    assert isinstance(refused.value, CubeError)


def count_runs(data: bytes) -> int:
    return sum(1 for run in data.split(b"\0")[:-1] if run)


def conserved(decoder: Decoder, data: bytes) -> bool:
    return sum(errors(decoder).values()) + decoder.counters.frames == count_runs(data)


@settings(max_examples=300)
@given(st.lists(st.binary(max_size=200), max_size=10))
def test_fuzz_any_bytes(pieces: list[bytes]) -> None:
    decoder = Decoder()
    got = [frame for piece in pieces for frame in decoder.feed(piece)]
    data = b"".join(pieces)
    assert conserved(decoder, data)
    assert same(got, Decoder().feed(data))
    assert decoder.counters.bytes == len(data)


@settings(max_examples=300)
@given(st.data())
def test_fuzz_damaged_stream(data: st.DataObject) -> None:
    """Flips, cuts and insertions: each touches at most the runs it hits; every other frame comes
    through."""
    stream = bytearray(b"".join(encode(frame) for frame in FRAMES.values()) * 3)
    n_frames = 3 * len(FRAMES)
    damages = data.draw(st.integers(0, 5))
    for _ in range(damages):
        at = data.draw(st.integers(0, len(stream) - 1))
        kind = data.draw(st.sampled_from(["flip", "cut", "insert"]))
        if kind == "flip":
            stream[at] ^= data.draw(st.integers(1, 255))
        elif kind == "cut":
            del stream[at : at + 4]
        else:
            stream[at:at] = data.draw(st.binary(min_size=1, max_size=4))
    decoder = Decoder()
    step = data.draw(st.integers(1, 50))
    for start in range(0, len(stream), step):
        decoder.feed(bytes(stream[start : start + step]))
    assert conserved(decoder, bytes(stream))
    # One damage can hit two frames only where a cut takes the closing and the opening zero between
    # them.
    assert decoder.counters.frames >= n_frames - 2 * damages
    assert decoder.counters.frames <= n_frames


@settings(max_examples=200)
@given(
    st.integers(0, 40),
    st.integers(0, 30),
    st.integers(0, 2**32 - 1),
    st.integers(0, 2**64 - 1),
    st.integers(0, 2**32 - 1),
)
def test_fuzz_round_trip(
    n_cubes: int, n_pads: int, sequence: int, device_us: int, seed: int
) -> None:
    random = np.random.default_rng(seed)
    sample = Sample(
        sequence,
        int(random.integers(0, 2**16)),
        device_us,
        random.integers(0, 2**32, (n_cubes, n_pads)).astype("<u4"),
        random.integers(0, 2**32, n_cubes).astype("<u4"),
        random.integers(-(2**15), 2**15, n_cubes).astype("<i2"),
    )
    (got,) = Decoder().feed(encode(sample))
    assert isinstance(got, Sample)
    for name in ("sequence", "first_cube", "device_us"):
        assert getattr(got, name) == getattr(sample, name)
    for name in ("frequency", "pad_fault", "temperature"):
        assert np.array_equal(getattr(got, name), getattr(sample, name))


def answers(hub: SimulatedHub, request: int, argument: int = 0, now_us: int = 0) -> list[Frame]:
    return Decoder().feed(hub.receive(encode(Request(request, argument)), now_us))


def test_a_simulated_hub_keeps_the_rules_of_the_page():
    """By their numbers in docs/protocol.md."""
    hub = SimulatedHub(uid=1, cube_uids=[2], n_pads=3, period_us=1000)
    assert not hub.started  # R8
    assert hub.receive(encode(Request(2))[:-3] + b"\0", 0) == b""  # F2: damaged
    assert hub.receive(encode(Request(2), version=2), 0) == b""  # F2: another version
    assert not hub.started
    ack, hello = answers(hub, 1, 77)
    assert ack == Ack(1) and isinstance(hello, Hello)  # H1, R2
    assert answers(hub, 2, 77) == [Ack(2)]
    assert hub.next_us == 1000
    hub.sample(np.ones((1, 3), "<u4"))
    # R6: the sample of 2000 has not been taken yet, and START must not leave it out.
    assert answers(hub, 2, now_us=2500) == [Ack(2)]
    assert (hub.next_us, hub.sequence) == (2000, 1)
    (stats,) = Decoder().feed(hub.make_stats(2500))
    assert stats.taken == hub.sequence  # S7
    assert answers(hub, 4, 50) == [Ack(4, 2, 1000)]  # R4
    assert answers(hub, 4, 500, now_us=2500) == [Ack(4, 0, 500)]  # R3, R7
    assert hub.next_us == 3000
    assert answers(hub, 5, 3) == [Ack(5)]
    assert answers(hub, 9, 3) == [Ack(9, 1)]  # R2
    assert answers(hub, 3) == answers(hub, 3) == [Ack(3)]  # R6
    answers(hub, 2, now_us=10_000)
    assert hub.sequence == 1  # S1
    hub.boot_us = 50_000
    assert answers(hub, 6, 77, now_us=3000) == [Time(77, 53_000)]  # R1, T1, T2
    assert answers(hub, 3) == [Ack(3)]
    assert answers(hub, 6, 2**32 - 1, now_us=9000) == [Time(2**32 - 1, 59_000)]  # T2: stopped
    assert answers(hub, 7, 77) == [Ack(7, Result.UNKNOWN)]
