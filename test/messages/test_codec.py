# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The codec of the batch messages against rosbags' serialiser, and what it refuses."""

from __future__ import annotations

import dataclasses
import struct
import tracemalloc

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="needs rosbags: pip install rosbags")

from bag_maker import FREQUENCIES_TYPE, STRESS_TYPE, header, message

from cube_tensor_driver.bags.metadata import make_typestore
from cube_tensor_driver.core.errors import MessageError
from cube_tensor_driver.core.rows import FrequencyRows, StressRows
from cube_tensor_driver.messages.codec import frequency_codec, stress_codec

CODECS = {FREQUENCIES_TYPE: frequency_codec, STRESS_TYPE: stress_codec}
FRAMES = ("", "a", "skin", "skin_base")
STAMP_NS = 1_700_000_000_123_456_789


def rows_of(kind: str, n: int, pads: int = 8) -> FrequencyRows | StressRows:
    """Random bits in every field, but times behind STAMP_NS."""
    random = np.random.default_rng(n)
    widths = {"frequency": pads, "stress": 6, "gradient": 9}
    cls = FrequencyRows if kind == FREQUENCIES_TYPE else StressRows
    types = {
        "cube": "u2",
        "sequence": "u4",
        "stamp_ns": "i8",
        "status": "u2",
        "observed": "u2",
        "pad_fault": "u4",
        "left_out": "u4",
    }
    columns = {}
    for field in dataclasses.fields(cls):
        if field.name == "specific_force":
            continue  # is in another message
        shape = (n, widths[field.name]) if field.name in widths else (n,)
        item = np.dtype(types.get(field.name, "f4"))
        data = random.bytes(item.itemsize * int(np.prod(shape)))
        columns[field.name] = np.frombuffer(data, item).reshape(shape)
    columns["stamp_ns"] = STAMP_NS + random.integers(0, 2**31, n)
    return cls(**columns)


def counts_at(kind: str, n: int, pads: int = 8) -> dict[str, int]:
    """Where the length of each sequence stands in a message with the frame id "skin"."""
    head = "cube:2 sequence:4 time_offset:4"
    fields = f"{head} n_pads frequency:4 temperature:4 pad_fault:4 status:2"
    if kind == STRESS_TYPE:
        fields = f"{head} stress:24 gradient:36 residual:4 status:2 observed:2 left_out:4"
    places, at = {"frame_id": 12}, 16 + 5
    for field in fields.split():
        name, _, size = field.partition(":")
        if name == "n_pads":
            at += 1
            continue
        at += -at % 4
        places[name] = at
        at += 4 + n * int(size) * (pads if name == "frequency" else 1)
    return places


def by_rosbags(kind: str, rows: FrequencyRows | StressRows, frame_id: str) -> bytes:
    fields = {name: column.ravel() for name, column in rows.collect_columns().items()}
    fields["time_offset"] = (fields.pop("stamp_ns") - STAMP_NS).astype(np.int32)
    if kind == FREQUENCIES_TYPE:
        fields["n_pads"] = rows.frequency.shape[1]
    one = message(kind, header=header(STAMP_NS, frame_id), **fields)
    return bytes(make_typestore().serialize_cdr(one, kind))


def assert_equal(one: FrequencyRows | StressRows, other: FrequencyRows | StressRows) -> None:
    for name, a in one.collect_columns().items():
        b = getattr(other, name)
        assert (a.dtype, a.shape) == (b.dtype, b.shape), name
        assert a.tobytes() == b.tobytes(), name


@pytest.mark.parametrize("kind", [FREQUENCIES_TYPE, STRESS_TYPE])
@pytest.mark.parametrize("frame_id", FRAMES)
@pytest.mark.parametrize("n", [0, 1, 3, 64])
def test_bytes_are_those_of_rosbags_both_ways(kind, frame_id, n):
    codec, rows = CODECS[kind], rows_of(kind, n)
    data = by_rosbags(kind, rows, frame_id)
    name = frame_id.encode() + b"\0"
    assert codec.encode(rows, np.array([STAMP_NS]), name) == [data]
    read = codec.decode(data)
    assert read.stamp_ns.tolist() == [STAMP_NS] and read.frame_id == name
    assert_equal(read.rows, rows)


def joined(*messages: bytes) -> np.ndarray:
    """The bytes of messages of equal length, one row each."""
    return np.frombuffer(b"".join(messages), np.uint8).reshape(len(messages), -1)


@pytest.mark.parametrize("kind", [FREQUENCIES_TYPE, STRESS_TYPE])
def test_several_messages_are_decoded_and_encoded_together(kind):
    codec = CODECS[kind]
    each = [rows_of(kind, 5) for _ in range(3)]
    data = [by_rosbags(kind, rows, "skin") for rows in each]
    read = codec.decode(joined(*data))
    assert len(read) == 3 and read.group_by_message(read.rows.cube).shape == (3, 5)
    for k, rows in enumerate(each):
        assert_equal(read.rows.select(slice(5 * k, 5 * k + 5)), rows)
    assert codec.encode(read.rows, read.stamp_ns, read.frame_id) == data


def test_a_buffer_is_filled_again_and_again():
    buffer = stress_codec.make_buffer(b"skin\0", 4)
    for n in (4, 4):
        rows = rows_of(STRESS_TYPE, n)
        for name in stress_codec.columns:
            getattr(buffer.rows, name)[:] = getattr(rows, name)
        assert_equal(stress_codec.decode(buffer.encode()).rows, rows)
    # written in place, stamped with its earliest row
    buffer.rows.status[:] = 3
    buffer.rows.stamp_ns[:] = STAMP_NS + np.array([5, 4, 9, 7])
    read = stress_codec.decode(buffer.encode())
    assert read.rows.status.tolist() == [3] * 4 and read.stamp_ns.tolist() == [STAMP_NS + 4]


@pytest.mark.parametrize("kind", [FREQUENCIES_TYPE, STRESS_TYPE])
def test_every_count_that_contradicts_the_rows_is_refused(kind):
    """Each 4-byte word that holds a length, set to other numbers of any size."""
    codec = CODECS[kind]
    data = by_rosbags(kind, rows_of(kind, 4), "skin")
    assert len(counts_at(kind, 4)) == (8 if kind == FREQUENCIES_TYPE else 10)
    for name, at in counts_at(kind, 4).items():
        for count in (0, 3, 2**15, 2**29, 2**31, 2**32 - 1):
            wrong = bytearray(data)
            struct.pack_into("<I", wrong, at, count)
            with pytest.raises(MessageError):
                codec.decode(bytes(wrong))
            if name != "cube":
                with pytest.raises(MessageError):
                    codec.decode(joined(data, bytes(wrong)))


@pytest.mark.parametrize("kind", [FREQUENCIES_TYPE, STRESS_TYPE])
def test_absurd_rows_are_refused_before_anything_is_allocated(kind):
    """A short message that says it has up to 2³² rows."""
    codec = CODECS[kind]
    data = bytearray(by_rosbags(kind, rows_of(kind, 1), "skin"))
    rows_at = counts_at(kind, 1)["cube"]
    assert struct.unpack_from("<I", data, rows_at) == (1,)
    for rows in (2**16, 2**28, 2**29, 2**31, 2**32 - 1):
        struct.pack_into("<I", data, rows_at, rows)
        tracemalloc.start()
        with pytest.raises(MessageError, match=f"{rows} rows"):
            codec.decode(bytes(data))
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 100_000  # a hundred times the message


@pytest.mark.parametrize("kind", [FREQUENCIES_TYPE, STRESS_TYPE])
def test_a_message_cut_off_anywhere_is_refused(kind):
    codec = CODECS[kind]
    data = by_rosbags(kind, rows_of(kind, 2), "skin")
    for end in range(len(data)):
        with pytest.raises(MessageError):
            codec.decode(data[:end])
    for padded in (data + bytes(3), joined(data + bytes(3))):
        assert len(codec.decode(padded).rows) == 2  # middleware fills up to a multiple of 4
    read = codec.decode(joined(data + bytes(3), data + bytes(3)))
    assert codec.encode(read.rows, read.stamp_ns, read.frame_id) == [data, data]
    with pytest.raises(MessageError, match="differ in the frame_id"):
        codec.decode(joined(data, data.replace(b"skin", b"skim")))
    with pytest.raises(MessageError):
        codec.decode(data + bytes(4))
    with pytest.raises(MessageError, match="little-endian"):
        codec.decode(b"\0\0" + data[2:])
