# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""One bad message in a bag is left out and reported; the others give what they gave without it."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="needs rosbags: pip install rosbags")

from bag_maker import make_bag

from cube_tensor_driver.bags.metadata import make_typestore
from cube_tensor_driver.bags.read import Bag
from cube_tensor_driver.bags.reprocess.job import ReprocessJob, reprocess
from cube_tensor_driver.bags.write import BagWriter
from cube_tensor_driver.config.package_data import find_package_data
from cube_tensor_driver.core.errors import BagError
from cube_tensor_driver.messages.types import FREQUENCIES_TYPE, INFO_TYPE

SKIN = find_package_data() / "config" / "skin_demo.yaml"
MESSAGES = 30


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    return make_bag(tmp_path_factory.mktemp("made") / "bag", SKIN, MESSAGES)


def cut(data: bytes) -> bytes:
    return data[: len(data) // 2]


def no_utf8(data: bytes) -> bytes:
    at = data.index(b"skin_base")
    return data[:at] + b"\xff" + data[at + 1 :]


def changed(kind: str, change) -> object:
    """A message that can be read, of which something is wrong."""

    def apply(data: bytes) -> bytes:
        message = make_typestore().deserialize_cdr(data, kind)
        change(message)
        return bytes(make_typestore().serialize_cdr(message, kind))

    return apply


def without_rest(info) -> None:
    info.cubes[2].rest_frequency = info.cubes[2].rest_frequency * np.nan


def without_calibrations(info) -> None:
    info.calibrations[0] = "schema: [7"


def of_version_9(info) -> None:
    info.version = 9


def with_a_pad_less(message) -> None:
    message.n_pads -= 1
    message.frequency = message.frequency.reshape(len(message.cube), -1)[:, 1:].ravel()


def with_longer_columns(message) -> None:
    message.cube = np.append(message.cube, 3).astype(np.uint16)


def damaged_copy(bag: Path, folder: Path, topic: str, damage, which: int, **options) -> Path:
    """A bag with one more message: a damaged copy of one, just before it."""
    with Bag(bag) as source, BagWriter(folder, **options) as writer:
        for one in source.connections:
            writer.add_topic(one.topic, one.msgtype, one.qos)
        count = 0
        for entry in source.read_entries():
            if entry.topic == topic:
                if count == which:
                    writer.write(topic, entry.time_ns, damage(entry.data))
                count += 1
            writer.write(entry.topic, entry.time_ns, entry.data)
    return folder


def stress_bytes(path: Path, folder: Path) -> list[bytes]:
    result = reprocess(ReprocessJob(path, folder, "bag"))
    assert (result.messages, result.rows) == (MESSAGES, 16 * MESSAGES)
    assert result.skipped == (path.name == "bad")
    with Bag(folder) as made:
        return [entry.data for entry in made.read_entries({"/stress"})]


@pytest.mark.parametrize(
    ("topic", "damage"),
    [
        ("/info", no_utf8),
        ("/info", cut),
        ("/info", changed(INFO_TYPE, without_rest)),
        ("/info", changed(INFO_TYPE, without_calibrations)),
        ("/info", changed(INFO_TYPE, of_version_9)),
        ("/frequencies", cut),
        ("/frequencies", changed(FREQUENCIES_TYPE, with_a_pad_less)),
        ("/frequencies", changed(FREQUENCIES_TYPE, with_longer_columns)),
        ("/stress", cut),
    ],
)
def test_one_bad_message_is_left_out(bag, tmp_path, caplog, topic, damage):
    options = {"storage": "sqlite3"} if damage is cut else {}
    which = 0 if topic == "/info" else 7
    path = damaged_copy(bag, tmp_path / "bad", topic, damage, which, **options)
    assert stress_bytes(bag, tmp_path / "other") == stress_bytes(path, tmp_path / "one")
    (record,) = caplog.records
    said = record.getMessage()
    assert f"{path}: {topic}: a message at" in said and "left out" in said and "\n" not in said


def test_without_any_good_info_that_of_the_driver_counts(bag, tmp_path):
    path = tmp_path / "bad"
    with Bag(bag) as source, BagWriter(path) as writer:
        for one in source.connections:
            writer.add_topic(one.topic, one.msgtype, one.qos)
        writer.add_topic("/driver/info", INFO_TYPE)
        for entry in source.read_entries():
            if entry.topic == "/info":
                writer.write("/driver/info", entry.time_ns, entry.data)
                entry = entry._replace(data=no_utf8(entry.data))
            writer.write(entry.topic, entry.time_ns, entry.data)
    assert stress_bytes(path, tmp_path / "one") == stress_bytes(bag, tmp_path / "other")


def test_a_bag_without_any_good_message_says_why(bag, tmp_path):
    path = tmp_path / "bad"
    with Bag(bag) as source, BagWriter(path) as writer:
        for one in source.connections:
            writer.add_topic(one.topic, one.msgtype, one.qos)
        for entry in source.read_entries():
            damage = changed(FREQUENCIES_TYPE, with_a_pad_less)
            is_bad = entry.topic == "/frequencies"
            writer.write(entry.topic, entry.time_ns, damage(entry.data) if is_bad else entry.data)
    with pytest.raises(BagError, match=r"bad: /frequencies: .*shape"):
        reprocess(ReprocessJob(path, tmp_path / "out", "bag"))


def test_one_bad_row_of_a_database_is_left_out(bag, tmp_path, caplog):
    path = damaged_copy(bag, tmp_path / "bad", "/stress", cut, 99, storage="sqlite3")
    (file,) = path.glob("*.db3")
    with sqlite3.connect(file) as database:
        for column, value in (("timestamp", "'late'"), ("data", "7"), ("topic_id", "77")):
            database.execute(
                "INSERT INTO messages(topic_id, timestamp, data)"
                " SELECT topic_id, timestamp, data FROM messages WHERE id = 9"
            )
            database.execute(
                f"UPDATE messages SET {column} = {value} WHERE id = (SELECT max(id) FROM messages)"
            )
    database.close()
    reprocess(ReprocessJob(path, tmp_path / "one", "bag"))
    with Bag(tmp_path / "one") as made:
        again = [entry.data for entry in made.read_entries({"/stress"})]
    assert again == stress_bytes(bag, tmp_path / "other")
    assert "3 damaged messages are left out" in caplog.text


@pytest.mark.campaign
def test_no_single_message_makes_a_bag_unreadable(bag, tmp_path, effort):
    """Whatever a byte of it is, in whichever place."""
    rng = np.random.default_rng(11)

    def damage(data: bytes) -> bytes:
        changed = bytearray(data)
        for at in rng.integers(0, len(data), rng.integers(1, 4)):
            changed[at] = rng.integers(256)
        return bytes(changed[: len(data) - rng.integers(3) * rng.integers(40)])

    for number in range(40 * effort):
        topic = ("/info", "/frequencies", "/stress")[number % 3]
        path = damaged_copy(bag, tmp_path / f"bad{number}", topic, damage, 0)
        result = reprocess(ReprocessJob(path, tmp_path / f"out{number}", "bag"))
        assert result.messages >= MESSAGES, (number, topic)
