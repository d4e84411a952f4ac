# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Compressed bags, and what is no bag at all: one line says why it was refused."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest
import zstandard

pytest.importorskip("mcap", reason="needs mcap: pip install mcap")
pytest.importorskip("rosbags", reason="needs rosbags: pip install rosbags")

from mcap.writer import CompressionType, IndexType, Writer

from cube_tensor_driver.bags.metadata import make_typestore
from cube_tensor_driver.bags.read import MAX_MESSAGE_BYTES, Bag
from cube_tensor_driver.bags.write import BagWriter
from cube_tensor_driver.config.yaml import read_yaml, write_yaml
from cube_tensor_driver.core.errors import BagError

MB = 1 << 20
TEXT = "std_msgs/msg/String"


def write_mcap(
    path: Path,
    messages: list[bytes],
    *,
    chunk: int = 1024 * MB,
    compression: CompressionType = CompressionType.ZSTD,
    index: IndexType = IndexType.ALL,
) -> Path:
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=chunk, compression=compression, index_types=index)
        writer.start("ros2")
        schema = writer.register_schema(TEXT, "ros2msg", b"string data\n")
        channel = writer.register_channel("/text", "cdr", schema)
        for time, data in enumerate(messages):
            writer.add_message(channel, time, data, time)
        writer.finish()
    return path


def read_all(path: Path) -> int:
    with Bag(path) as bag:
        return sum(1 for _ in bag.read_entries())


def a_large_chunk(folder: Path) -> Path:
    return write_mcap(folder / "b.mcap", [bytes(8 * MB)] * 33)


def a_folder(folder: Path) -> Path:
    bag = folder / "bag"
    data = bytes(make_typestore().serialize_cdr(make_typestore().types[TEXT](data="x"), TEXT))
    with BagWriter(bag) as writer:
        writer.add_topic("/text", TEXT)
        writer.write("/text", 1, data)
    return bag


def packed(bag: Path, mode: str) -> dict:
    """The metadata of a bag, which then says that it is compressed in this way."""
    said = read_yaml(bag / "metadata.yaml")
    said["rosbag2_bagfile_information"] |= {
        "compression_format": "zstd",
        "compression_mode": mode,
    }
    write_yaml(bag / "metadata.yaml", said)
    return said["rosbag2_bagfile_information"]


def a_large_message(folder: Path) -> Path:
    bag = folder / "bag"
    with BagWriter(bag) as writer:
        writer.add_topic("/text", TEXT)
        writer.write("/text", 1, zstandard.compress(bytes(MAX_MESSAGE_BYTES + 1)))
    packed(bag, "MESSAGE")
    return bag


def a_pipe(folder: Path) -> Path:
    os.mkfifo(folder / "b.mcap")
    return folder / "b.mcap"


def a_pipe_as_database(folder: Path) -> Path:
    os.mkfifo(folder / "b.db3")
    return folder / "b.db3"


def a_pipe_as_metadata(folder: Path) -> Path:
    bag = a_folder(folder)
    (bag / "metadata.yaml").unlink()
    os.mkfifo(bag / "metadata.yaml")
    return bag


def a_device(folder: Path) -> Path:
    (folder / "b.mcap").symlink_to("/dev/zero")
    return folder / "b.mcap"


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (a_large_chunk, "the limit is 268435456"),
        (a_pipe, "no regular file"),
        (a_pipe_as_database, "no regular file"),
        (a_pipe_as_metadata, "no metadata.yaml"),
        (a_device, "no regular file"),
    ],
)
def test_beyond_the_bounds_is_one_line(
    tmp_path: Path, make: Callable[[Path], Path], words: str
) -> None:
    path = make(tmp_path)
    with pytest.raises(BagError, match=words) as caught:
        read_all(path)
    assert "\n" not in str(caught.value)


def test_a_message_beyond_the_bounds_is_left_out(tmp_path: Path, caplog) -> None:
    assert read_all(a_large_message(tmp_path)) == 0
    assert "more than 67108864 bytes" in caplog.text


@pytest.mark.parametrize("name", ["zstd", "lz4"])
def test_within_the_bounds_all_is_as_before(tmp_path: Path, name: str) -> None:
    compression = CompressionType[name.upper()]
    messages = [os.urandom(1000) for _ in range(100)]
    path = write_mcap(tmp_path / "b.mcap", messages, chunk=10_000, compression=compression)
    with Bag(path) as bag:
        assert [entry.data for entry in bag.read_entries()] == messages
    bare = write_mcap(tmp_path / "c.mcap", messages, compression=compression, index=IndexType.NONE)
    with Bag(bare) as bag:
        assert [entry.data for entry in bag.read_entries()] == messages


def test_bags_that_ros2_compressed_are_read(tmp_path: Path) -> None:
    """Whole files, or each message."""
    bag = a_folder(tmp_path)
    (entry,) = Bag(bag).__enter__().read_entries()
    (name,) = packed(bag, "FILE")["relative_file_paths"]
    said = read_yaml(bag / "metadata.yaml")
    said["rosbag2_bagfile_information"]["relative_file_paths"] = [f"{name}.zstd"]
    write_yaml(bag / "metadata.yaml", said)
    (bag / f"{name}.zstd").write_bytes(zstandard.compress((bag / name).read_bytes()))
    (bag / name).unlink()
    assert read_all(bag) == 1
    (tmp_path / "m").mkdir()
    with BagWriter(tmp_path / "m" / "bag") as writer:
        writer.add_topic("/text", TEXT)
        writer.write("/text", 1, zstandard.compress(entry.data))
    packed(tmp_path / "m" / "bag", "MESSAGE")
    with Bag(tmp_path / "m" / "bag") as opened:
        assert [one.data for one in opened.read_entries()] == [entry.data]


@pytest.mark.parametrize("text", ["[7", "7", "[7]", "!!bool maybe"])
def test_damaged_quality_of_service_counts_as_none(tmp_path: Path, caplog, text: str) -> None:
    path = tmp_path / "b.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2")
        schema = writer.register_schema(TEXT, "ros2msg", b"string data\n")
        about = {"offered_qos_profiles": text}
        writer.add_message(writer.register_channel("/text", "cdr", schema, about), 1, b"x", 1)
        writer.finish()
    with Bag(path) as bag:
        assert [entry.data for entry in bag.read_entries()] == [b"x"]
        assert not bag.connections[0].qos and not bag.connections[0].is_latched
    assert "/text: its quality of service profiles are damaged" in caplog.text
