# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Tares and the uids of cubes that become known only later, when the driver says them."""

from __future__ import annotations

import contextlib
import logging
from datetime import datetime, timedelta, timezone
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs rclpy: run this with ./cube test")

from std_srvs.srv import Trigger

from cube_tensor_driver.config.package_data import find_package_data
from cube_tensor_driver.config.skin import read_skin
from cube_tensor_driver.config.tare import read_tare, write_tare
from cube_tensor_driver.core.reconstructor import Reconstructor
from cube_tensor_driver.core.rows import FrequencyRows
from cube_tensor_driver.msg import CubeInfo, SkinInfo
from cube_tensor_driver.ros.callbacks import CallbackErrors
from cube_tensor_driver.ros.nodes import taring
from cube_tensor_driver.ros.nodes.taring import Taring
from cube_tensor_driver.srv import Tare

UID = 0xABC0
SKIN = read_skin(find_package_data() / "config" / "cube.yaml")
CALIBRATION = SKIN.cubes[0].calibration
KEPT = 1.001 * CALIBRATION.rest_frequency
RATE = 500


class Node:
    """What a node is to `Taring`."""

    def __init__(self) -> None:
        self.services = {}
        self.errors = CallbackErrors(self)
        self.now_ns = 0

    def create_service(self, _, name, callback):
        self.services[name] = self.errors.catch_in_service(callback)

    def own(self, entity):
        return entity

    def get_logger(self):
        return logging.getLogger()

    def get_clock(self):
        return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=self.now_ns))


@pytest.fixture
def skin(tmp_path):
    """A reconstruction that has seen 3 s of data, and a tare on disk of a cube whose uid it does
    not know."""
    write_tare(tmp_path, UID, CALIBRATION, KEPT, datetime.now(timezone.utc))
    node, reconstructor = Node(), Reconstructor(SKIN)
    tares = Taring(node, SKIN, reconstructor, tmp_path, contextlib.nullcontext(), lambda: None)
    for row in range(3 * RATE):
        node.now_ns = row * 1_000_000_000 // RATE
        frequency = 1.002 * CALIBRATION.rest_frequency[None].astype(np.float32)
        reconstructor.process(FrequencyRows.from_values([0], frequency, stamp_ns=node.now_ns))
    return SimpleNamespace(
        services=node.services,
        errors=node.errors,
        rest=lambda: reconstructor.rest_frequency[0],
        learn_uid=lambda uid=UID: tares.on_info(
            SkinInfo(name=SKIN.name, cubes=[CubeInfo(uid=uid)])
        ),
        on_disk=lambda: read_tare(tmp_path, UID, CALIBRATION),
        tares=tares,
    )


def test_the_tare_of_a_cube_is_restored_when_its_uid_is_known(skin):
    skin.learn_uid()
    np.testing.assert_allclose(skin.rest(), KEPT)


def test_a_cube_that_was_exchanged_does_not_keep_the_tare_of_the_other(skin):
    skin.learn_uid()
    answer = skin.services["~/tare"](Tare.Request(duration=1.0), Tare.Response())
    assert answer.success, answer.message
    skin.learn_uid(UID + 1)
    np.testing.assert_array_equal(skin.rest(), CALIBRATION.rest_frequency)
    skin.learn_uid(UID)
    np.testing.assert_allclose(skin.rest(), 1.002 * CALIBRATION.rest_frequency, rtol=1e-7)


def test_a_tare_writes_one_file_per_cube_and_its_answer_is_short(skin, monkeypatch):
    """However often the request names the cube, and however long the name of another."""
    skin.learn_uid()
    written = []
    monkeypatch.setattr(taring, "write_tare", lambda *_: written.append(1))
    request = Tare.Request(duration=1.0, cubes=[SKIN.names[0]] * 5000)
    answer = skin.services["~/tare"](request, Tare.Response())
    assert answer.success and answer.message.startswith("1 cubes") and len(written) == 1
    request = Tare.Request(cubes=["x" * 1_000_000, *map(str, range(5000))])
    answer = skin.services["~/tare"](request, Tare.Response())
    assert not answer.success and answer.message.startswith("no cube 'xxx")
    assert len(answer.message) < 2000 and not skin.errors.count


def test_a_tare_that_was_cleared_before_the_uid_was_known_does_not_come_back(skin):
    assert skin.services["~/clear_tare"](Trigger.Request(), Trigger.Response()).success
    skin.learn_uid()
    np.testing.assert_allclose(skin.rest(), CALIBRATION.rest_frequency)
    assert skin.on_disk() is None


def test_a_tare_that_was_taken_before_the_uid_was_known_stays_and_is_kept(skin):
    answer = skin.services["~/tare"](Tare.Request(duration=1.0), Tare.Response())
    assert answer.success, answer.message
    skin.learn_uid()
    np.testing.assert_allclose(skin.rest(), 1.002 * CALIBRATION.rest_frequency, rtol=1e-7)
    np.testing.assert_allclose(skin.on_disk().rest_frequency, skin.rest())


def test_tared_cubes_are_counted_and_the_oldest_tare_gives_the_age(skin):
    now = datetime.now(timezone.utc)
    skin.tares.created = {0: None}
    assert skin.tares.describe_age() == {"cubes tared": "0"}
    skin.tares.created |= {number: now - timedelta(hours=number) for number in (1, 3, 2)}
    age = skin.tares.describe_age()
    assert age.keys() == {"cubes tared", "oldest tare s"} and age["cubes tared"] == "3"
    assert int(age["oldest tare s"]) == pytest.approx(3 * 3600, abs=60)
