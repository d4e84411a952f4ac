"""What the package uses of rosbags' storage classes, which rosbags does not export."""

from __future__ import annotations

import inspect
import re
from importlib.metadata import version

import pytest

pytest.importorskip("rosbags", reason="needs rosbags: pip install rosbags")

from rosbags.rosbag2 import CompressionMode, Reader, Writer

from conftest import ROOT
from cube_tensor_driver.bags import rosbags_storage as storage


def test_rosbags_is_in_the_range_that_the_package_asks_for():
    text = (ROOT / "pyproject.toml").read_text()
    low, high = re.search(r'"rosbags>=([0-9.]+),<([0-9.]+)"', text).groups()
    installed, low, high = (
        tuple(map(int, text.split(".")[:2])) for text in (version("rosbags"), low, high)
    )
    assert low <= installed < high


@pytest.mark.parametrize(
    ("function", "parameters"),
    [
        (storage.McapReader.__init__, ["self", "path"]),
        (storage.McapReader.messages, ["self", "connections", "start", "stop"]),
        (storage.McapWriter.__init__, ["self", "path", "compression"]),
        (storage.McapWriter.add_msgtype, ["self", "connection"]),
        (storage.McapWriter.add_connection, ["self", "connection", "offered_qos_profiles"]),
        (storage.McapWriter.write, ["self", "connection", "timestamp", "data"]),
        (storage.McapWriter.close_chunk, ["self"]),
        (storage.McapWriter.close, ["self", "version", "metadata"]),
        (storage.Sqlite3Writer.__init__, ["self", "path", "compression"]),
        (storage.decompress, ["data", "compression", "size", "crc"]),
        (storage.read_exact, ["bio", "size"]),
    ],
)
def test_functions_take_what_they_are_given(function, parameters):
    assert list(inspect.signature(function).parameters) == parameters


def test_classes_have_the_attributes_that_are_used(tmp_path):
    (tmp_path / "m").mkdir()
    (tmp_path / "s").mkdir()
    mcap = storage.McapWriter(tmp_path / "m", CompressionMode.NONE)
    used = "bio chunk chunks channel_stats message_start_time message_end_time"
    assert set(used.split()) <= vars(mcap).keys()
    assert set(["message_start_time", "message_end_time", "bio", "msgs"]) <= vars(mcap.chunk).keys()
    mcap.abort()
    sqlite = storage.Sqlite3Writer(tmp_path / "s", CompressionMode.NONE)
    assert {"path", "conn", "cursor"} <= vars(sqlite).keys()
    sqlite.conn.close()
    used = (
        "message_start_time message_end_time chunk_start_offset chunk_length compression "
        "compressed_size uncompressed_size channel_count"
    )
    assert set(used.split()) <= set(storage.ChunkInfo._fields)
    assert {"bio", "chunks"} <= vars(storage.McapReader(tmp_path / "m" / "m.mcap")).keys()
    for owner in (Reader, storage.DirectoryReader, Writer):
        assert owner.STORAGE_PLUGINS
    writer = Writer(tmp_path / "bag", version=9)
    assert {"counts", "min_timestamp", "max_timestamp", "storage"} <= vars(writer).keys()
