# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Bags as sources of rows, and what a recording says about them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

pytest.importorskip("pyarrow", reason="needs pyarrow: pip install pyarrow")
pytest.importorskip("rosbags", reason="needs rosbags: pip install rosbags")

from bag_maker import START_NS, frequencies_of, info_of, loads, make_bag

from cube_tensor_driver.bags import read
from cube_tensor_driver.bags.metadata import make_typestore
from cube_tensor_driver.bags.reprocess.job import reconstruct
from cube_tensor_driver.bags.reprocess.recorded_reconstruction import RecordedReconstruction
from cube_tensor_driver.bags.source import open_bag
from cube_tensor_driver.bags.write import BagWriter
from cube_tensor_driver.config.package_data import find_package_data
from cube_tensor_driver.config.skin import read_skin
from cube_tensor_driver.core.errors import BagError
from cube_tensor_driver.core.pipeline import Pipeline
from cube_tensor_driver.core.reconstructor import Reconstructor
from cube_tensor_driver.core.rows import StressRows, concatenate
from cube_tensor_driver.core.status import STUCK
from cube_tensor_driver.messages.codec import frequency_codec
from cube_tensor_driver.messages.types import FREQUENCIES_TYPE, INFO_TYPE

SKIN = find_package_data() / "config" / "skin_demo.yaml"
MESSAGES = 200
TARED_FROM = 90


def stuck(k: int) -> np.ndarray:
    return np.where(np.arange(16) == 3, 1 << 2, 0) * (k >= 100)


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    path = tmp_path_factory.mktemp("source") / "bag"
    return make_bag(path, SKIN, MESSAGES, left_out=stuck, tare=(TARED_FROM, 1.001))


def columns(parts: list) -> list[np.ndarray]:
    return list(concatenate(parts).collect_columns().values())


def assert_same(one: list, other: list) -> None:
    for a, b in zip(columns(one), columns(other), strict=True):
        assert a.tobytes() == b.tobytes()


def recorded_stress(source) -> list[StressRows]:
    return [messages.rows for messages, _ in source.bag.read_stress("/stress")]


def test_a_bag_is_a_source_of_its_rows(bag):
    with open_bag(bag) as source:
        assert not source.is_live
        assert [cube.name for cube in source.skin.cubes] == [f"c{k:02}" for k in range(16)]
        assert source.skin.parent_frame == "skin_base"
        parts = list(source)
        assert source.statistics() == {"messages": MESSAGES, "rows": 16 * MESSAGES, "skipped": 0}
    cube, sequence, stamp_ns, frequency, *_ = columns(parts)
    assert len(parts) < 10  # many messages at a time
    assert cube.tolist() == list(range(16)) * MESSAGES
    assert (sequence == np.repeat(np.arange(MESSAGES), 16)).all()
    assert stamp_ns[:2].tolist() == [START_NS, START_NS + 100]
    skin = read_skin(SKIN)
    rest = np.array([one.calibration.rest_frequency for one in skin.cubes])
    # the load begins with nothing
    np.testing.assert_allclose(frequency[:16], loads_at(rest, 0.0), rtol=1e-7)


def loads_at(rest: np.ndarray, seconds: float) -> np.ndarray:
    phase = np.arange(rest.size).reshape(rest.shape)
    return rest * (1 - 0.015 * (1 - np.cos(3 * seconds + phase)))


def test_the_recorded_stress_comes_again_whoever_iterates(bag):
    """By `reconstruct`, and by a loop over rows that asks the recording for settings and
    health."""
    with open_bag(bag) as source:
        recorded = recorded_stress(source)
        assert_same([stress for _, stress in reconstruct(source)], recorded)
        reconstructor = Reconstructor(source.skin)
        made, settings = [], None
        for rows in source:
            if settings is not (settings := source.recording.find_settings(rows)):
                reconstructor.rest_frequency = settings.rest_frequency
            made.append(reconstructor.process(rows, source.recording.health.find(rows)))
        assert_same(made, recorded)
    assert (np.concatenate([rows.status for rows in recorded]) & STUCK).any()


def test_message_by_message_too_and_again_after_a_jump_back(bag):
    """As in a replay: every message alone, some of them twice."""
    recording = RecordedReconstruction(bag)
    reconstructor = Reconstructor(recording.skin)
    with open_bag(bag) as source:
        recorded = [
            messages.rows.select(slice(k, k + 16))
            for messages, _ in source.bag.read_stress("/stress")
            for k in range(0, len(messages.rows), 16)
        ]
        rows = [
            messages.rows.select(slice(k, k + 16))
            for messages, _ in source.bag.read_frequencies("/frequencies")
            for k in range(0, len(messages.rows), 16)
        ]
    for k in [*range(MESSAGES), *range(80, 120), *range(0, 10), 150, 3]:
        stress = reconstructor.process(rows[k], recording.find_health(rows[k], reconstructor))
        assert_same([stress], [recorded[k]])
    recording.close()


def test_health_goes_by_cube_and_stamp(bag):
    with open_bag(bag) as source:
        rows = next(iter(source))
        later = rows.select(rows.stamp_ns > START_NS + 1_200_000_000)
        some = rows.select(np.random.default_rng(1).permutation(len(rows))[:300])
        health = source.recording.health.find(some)
        assert health.known.all()
        shifted = dataclasses.replace(some, stamp_ns=some.stamp_ns + 1)
        assert not source.recording.health.find(shifted).known.any()
        health = source.recording.health.find(later)
        assert (health.left_out == np.where(later.cube == 3, 4, 0)).all()
        assert ((health.status & STUCK != 0) == (later.cube == 3)).all()


def test_health_of_rows_far_back_is_read_again(bag, monkeypatch):
    """In batches of 10 messages, so that the first one does not stay in memory."""
    monkeypatch.setattr(read, "MAX_BATCH_ROWS", 160)
    with open_bag(bag) as source:
        first, *_, last = source
        for rows in (first, last, first):
            assert source.recording.health.find(rows).known.all()


def test_messages_whose_scans_would_join_come_one_by_one(tmp_path):
    """A message has cubes 1, 2, 0: joined, 0 1 2 of two messages would be a scan."""
    skin = read_skin(SKIN)
    pipeline = Pipeline([cube.calibration for cube in skin.cubes], np.float32)
    store = make_typestore()
    with BagWriter(tmp_path / "bag") as writer:
        for topic, kind in (("/frequencies", FREQUENCIES_TYPE), ("/info", INFO_TYPE)):
            writer.add_topic(topic, kind)
        info = info_of(skin, pipeline, START_NS)
        writer.write("/info", START_NS, bytes(store.serialize_cdr(info, INFO_TYPE)))
        for k in range(6):
            stamp_ns = START_NS + 10_000_000 * k
            raw = frequencies_of(k, stamp_ns, loads(pipeline, 0.01 * k)[[1, 2, 0]])
            raw.cube[:] = [1, 2, 0] if k < 4 else [4, 5, 6]
            data = bytes(store.serialize_cdr(raw, FREQUENCIES_TYPE))
            writer.write("/frequencies", stamp_ns, data)
    with open_bag(tmp_path / "bag") as source:
        assert [rows.cube.tolist() for rows in source] == [[1, 2, 0]] * 4 + [[4, 5, 6] * 2]


def test_what_is_wrong_is_said(bag, tmp_path):
    with pytest.raises(BagError, match="name a bag"):
        open_bag(tmp_path / "nothing")
    with pytest.raises(BagError, match="no frequencies on /other/frequencies; there are /freq"):
        open_bag(bag, "/other/frequencies")
    with BagWriter(tmp_path / "two") as writer:
        for name in "ab":
            writer.add_topic(f"/{name}/frequencies", FREQUENCIES_TYPE)
    with pytest.raises(BagError, match="2 topics"):
        open_bag(tmp_path / "two")
    with BagWriter(tmp_path / "bare") as writer:
        writer.add_topic("/frequencies", FREQUENCIES_TYPE)
        row = frequencies_of(0, START_NS, np.full((1, 8), 1e5))
        writer.write(
            "/frequencies", START_NS, bytes(make_typestore().serialize_cdr(row, FREQUENCIES_TYPE))
        )
    with pytest.raises(BagError, match="no message on /info"):
        open_bag(tmp_path / "bare")
    assert (
        frequency_codec.decode(
            bytes(make_typestore().serialize_cdr(row, FREQUENCIES_TYPE))
        ).rows.cube
        == 0
    )
