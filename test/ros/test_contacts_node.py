# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The node `contacts` with the method `inverse`: contacts with ids, and the surface's traction; the
same out of a bag."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("pyarrow", reason="needs pyarrow: pip install pyarrow")
pytest.importorskip("rosbags", reason="needs rosbags: pip install rosbags")

from conftest import encoded
from cube_tensor_driver.bags.read import Bag
from cube_tensor_driver.bags.reprocess.contacts import ContactOptions
from cube_tensor_driver.bags.reprocess.job import ReprocessJob, reprocess
from cube_tensor_driver.bags.source import open_bag
from cube_tensor_driver.bags.write import BagWriter
from cube_tensor_driver.cli.main import main
from cube_tensor_driver.config.influence import find_influence
from cube_tensor_driver.config.package_data import find_package_data
from cube_tensor_driver.config.skin import Elastomer, Skin, read_skin
from cube_tensor_driver.core.defaults import FREQUENCY_NOISE
from cube_tensor_driver.core.errors import ConfigError
from cube_tensor_driver.core.layout import LAYOUTS
from cube_tensor_driver.core.modes import to_matrix
from cube_tensor_driver.core.oscillator import pad_frequency
from cube_tensor_driver.core.pipeline import Pipeline
from cube_tensor_driver.core.rows import FrequencyRows, StressRows
from cube_tensor_driver.mechanics import contact
from cube_tensor_driver.mechanics.influence import read_influence
from cube_tensor_driver.messages.contacts import CLOUD
from cube_tensor_driver.messages.types import FREQUENCIES, INFO
from cube_tensor_driver.touch.contact_finder import ContactSettings

FRAME = b"skin_base\0"
FORCE = np.array([0.5, 0.0, -2.0])
SCANS = 5
IDLE_SCANS = 12
"""Scans before the load, with which the detection of touch begins."""
ELASTOMER = Elastomer(depth=5e-3, thickness=np.inf, poisson=0.46)
"""Half space whose depth and Poisson's ratio are not the defaults."""


def frequencies(skin: Skin, centre: np.ndarray) -> np.ndarray:
    """(cubes, pads) Hz under a ball of 6 mm contact width, by Boussinesq's and Cerruti's forces."""
    places = np.array([cube.xyz for cube in skin.cubes])
    below = np.column_stack([places[:, :2], np.full(len(places), -ELASTOMER.depth)])
    load = contact.hertz(3e-3, FORCE, centre, order=12)
    stress, slope = contact.field(below, *load, ELASTOMER.poisson)
    calibration = skin.calibrations[0]
    gradient = np.moveaxis(to_matrix(slope.swapaxes(1, 2)), 1, 3)  # (cubes, 3, 3, axis)
    state = calibration.modes.state(to_matrix(stress), calibration.half_side * gradient)
    pads = state @ calibration.response.T
    rest, beta = calibration.rest_frequency, calibration.beta
    hertz = pad_frequency(pads, rest, beta, calibration.modulus)
    noise = np.random.default_rng(1).standard_normal(hertz.shape)
    return hertz * (1 + FREQUENCY_NOISE * noise)


def bag_of(folder: Path, skin: Skin, info: bytes, scans: list[np.ndarray]) -> Path:
    """A bag with `info` and frequencies."""
    now = time.time_ns()
    with BagWriter(folder) as writer:
        writer.add_topic("/info", INFO)
        writer.add_topic("/frequencies", FREQUENCIES)
        writer.write("/info", now, info)
        for number, hertz in enumerate(scans):
            stamp_ns = now + (number + 1) * 20_000_000
            rows = FrequencyRows.of(np.arange(len(hertz)), hertz, stamp_ns=stamp_ns)
            writer.write("/frequencies", stamp_ns, encoded(rows, FRAME))
    return folder


def messages(bag: Path, topic: str) -> list[bytes]:
    with Bag(bag) as opened:
        return [entry.data for entry in opened.entries({topic})]


def numbers(value: object) -> list[float]:
    """All of a message, or of a list of them, one after the other; without text."""
    if isinstance(value, str):
        return []
    if isinstance(value, (int, float)):
        return [float(value)]
    if hasattr(value, "get_fields_and_field_types"):
        value = [getattr(value, name) for name in value.get_fields_and_field_types()]
    return [number for one in value for number in numbers(one)]


def points_of(cloud: object) -> np.ndarray:
    """(M, 6) of a PointCloud2."""
    return np.frombuffer(cloud.data, "<f4").reshape(-1, len(CLOUD))


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (["guess"], "the methods are auto, interpolation, inverse"),
        (["inverse", "depth=4"], "use NAME:=VALUE with one of rate, depth"),
        (["inverse", "depth:=deep"], "allowed: 0, or 1e-05 to 1"),
        (["inverse", "poisson:=0.6"], "allowed: 0 to 0.5"),
        (["depth:=0.004", "thickness:=0.003"], "between 0 and the thickness"),
        (["inverse", "influence:=none"], "one of the shipped: cube_11mm"),
        (["inverse", f"influence:={5000 * 'x'}"], "one of the shipped: cube_11mm"),
        (["inverse", "--format", "csv"], "only a bag holds contacts"),
    ],
)
def test_what_reprocess_cannot_use_is_one_line(tmp_path, capsys, given, words):
    out = tmp_path / "out"
    assert main(["reprocess", str(tmp_path / "bag"), "-o", str(out), "--contacts", *given]) == 1
    error = capsys.readouterr().err
    assert words in " ".join(error.split()) and "Traceback" not in error and not out.exists()


def test_pads_in_a_thin_layer_out_of_a_bag(tmp_path, one_process):
    """The force, by influence functions; cubes that count as points in this layer say 4 % more."""
    pytest.importorskip("rclpy", reason="needs rclpy: run this with ./cube test")
    from rclpy.serialization import deserialize_message, serialize_message

    from cube_tensor_driver.msg import SkinContacts
    from cube_tensor_driver.ros.messages import make_info_message

    skin = read_skin(find_package_data() / "config" / "skin_demo.yaml")
    influence = read_influence(find_influence("cube_11mm"))
    calibration, centre = skin.calibrations[0], np.array([1e-3, -2e-3])
    sources, forces = contact.hertz(3e-3, FORCE, centre, order=8)
    which = [LAYOUTS["cube"].pads.index(pad) for pad in calibration.layout.pads]
    pads = [
        np.einsum("psi,si->p", influence.at(sources[:, :2] - cube.xyz[:2])[which], forces)
        for cube in skin.cubes
    ]
    law = calibration.rest_frequency, calibration.beta, calibration.modulus
    described = make_info_message(skin, Pipeline(skin.calibrations), time.time_ns())
    described.sender = "reconstruction"
    info = serialize_message(described)
    bag = bag_of(tmp_path / "bag", skin, info, [pad_frequency(np.array(pads), *law)])
    forces = []
    for number, more in enumerate(
        (["influence:=cube_11mm"], ["depth:=0.0055", "thickness:=0.011"])
    ):
        out = tmp_path / str(number)
        assert main(["reprocess", str(bag), "-o", str(out), "--contacts", "inverse", *more]) == 0
        (found,) = messages(out / bag.name, "/contacts")
        forces.append(deserialize_message(found, SkinContacts))
    (by_pads,), (by_points,) = ([one.z for one in found.force] for found in forces)
    assert by_pads == pytest.approx(FORCE[2], rel=0.01)
    assert abs(by_points / FORCE[2] - 1) > 0.03


def test_a_node_that_cannot_get_ready_says_so_and_tries_again(monkeypatch):
    from cube_tensor_driver.ros.nodes import contacts as module

    failures = [ConfigError("a.npz: damaged; make it again"), MemoryError()]
    logged: list[str] = []

    def set_up() -> str:
        if failures:
            raise failures.pop(0)
        return "finder"

    monkeypatch.setattr(module, "RETRY_PERIOD_S", 0.0)
    node = module.Contacts.__new__(module.Contacts)
    node.get_logger = lambda: SimpleNamespace(error=logged.append)
    node._finder, node._problem, node._set_up = None, "", set_up
    with ThreadPoolExecutor(1) as node._worker:
        node._future_finder = node._worker.submit(set_up)
        said: list[str] = []
        until = time.monotonic() + 10
        while node._take_finder() is None:
            assert time.monotonic() < until
            said += [
                status.message for status in node._make_statuses() if status.message not in said
            ]
            wait([node._future_finder], timeout=10)
    assert said == ["no contacts: a.npz: damaged; make it again", "no contacts: MemoryError"]
    assert logged == ["a.npz: damaged; make it again", "MemoryError"]
    assert node._take_finder() == "finder" and node._make_statuses() == []


def test_contacts_and_traction_of_a_pressed_skin_live_and_out_of_a_bag(ros, tmp_path):
    """The node is given the stress that reprocessing made of a bag, scan by scan; what it publishes
    is what reprocessing wrote, but for rounding, which depends on the process.

    Both take the method and the elastomer from `info`, as do settings that state all of it.
    """
    pytest.importorskip("rclpy", reason="needs rclpy: run this with ./cube test")
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from rclpy.serialization import deserialize_message, serialize_message
    from sensor_msgs.msg import PointCloud2

    from cube_tensor_driver.msg import SkinContacts, SkinInfo, SkinStress, SkinTouch
    from cube_tensor_driver.processes.children import Children
    from cube_tensor_driver.processes.skin_processes import Process
    from cube_tensor_driver.ros.messages import make_info_message

    skin = replace(
        read_skin(find_package_data() / "config" / "skin_demo.yaml"), elastomer=ELASTOMER
    )
    middle = np.array([cube.xyz for cube in skin.cubes])[:, :2].mean(axis=0)
    described = make_info_message(skin, Pipeline(skin.calibrations), time.time_ns())
    described.sender = "reconstruction"
    scans = [frequencies(skin, middle + np.array([2e-4 * number, 0])) for number in range(SCANS)]
    rest = np.array([one.rest_frequency for one in skin.calibrations])
    noise = np.random.default_rng(2).standard_normal((IDLE_SCANS, *rest.shape))
    scans = [*(rest * (1 + FREQUENCY_NOISE * noise)), *scans]
    bag = bag_of(tmp_path / "bag", skin, serialize_message(described), scans)
    with open_bag(bag) as source:
        assert source.skin.elastomer == ELASTOMER
    result = tmp_path / "out"
    wanted = ContactOptions(ContactSettings(), rate=50.0)
    reprocess(ReprocessJob(bag, result, "bag", contacts=wanted))
    stress, touches = (messages(result, topic)[IDLE_SCANS:] for topic in ("/stress", "/touch"))
    topics = ("/contacts", "/traction")
    expected = [messages(result, topic)[IDLE_SCANS:] for topic in topics]
    stated = ContactSettings("inverse", depth=ELASTOMER.depth, poisson=ELASTOMER.poisson)
    wanted = ContactOptions(stated, rate=50.0)
    reprocess(ReprocessJob(bag, tmp_path / "stated", "bag", contacts=wanted))
    assert messages(tmp_path / "stated", "/contacts")[IDLE_SCANS:] == expected[0]
    assert {len(one) for one in (*expected, stress, touches)} == {SCANS}
    # Touch begins with the first scan under load, and keeps the number that states its time.
    begin = deserialize_message(stress[0], SkinStress).header.stamp
    found = [deserialize_message(data, SkinTouch) for data in touches]
    assert {tuple(one.id) for one in found} == {(begin.sec * 10**9 + begin.nanosec,)}

    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    info = ros.node.create_publisher(SkinInfo, "info", latched)
    info.publish(described)
    publisher = ros.node.create_publisher(SkinStress, "stress", 10)
    touch_publisher = ros.node.create_publisher(SkinTouch, "touch", 10)
    contacts = ros.listen(SkinContacts, "contacts")
    clouds = ros.listen(PointCloud2, "traction")
    untouched = StressRows.of(
        np.arange(len(skin.cubes)), np.zeros((len(skin.cubes), 6)), np.zeros((len(skin.cubes), 9))
    )

    def ready() -> bool:
        publisher.publish(encoded(untouched, FRAME))
        return bool(contacts and clouds)

    def answered(wanted: SkinContacts) -> bool:
        stamp = wanted.header.stamp
        if any(one[-1].header.stamp != stamp for one in (contacts, clouds)):
            return False
        # A contact that begins to slip is reported first at the place of the scan before.
        return (
            abs(contacts[-1].position[0].x - wanted.position[0].x) < 1e-5
            and contacts[-1].touch_id == wanted.touch_id
        )

    with Children(tmp_path) as children:
        given = {"rate": 100.0}
        children.start(
            Process("contacts", "cube_tensor_driver.ros.nodes.contacts", parameters=given)
        )
        ros.wait(ready)
        live = []
        for number, data in enumerate(stress):
            touch_publisher.publish(touches[number])
            time.sleep(0.05)  # two topics may arrive in any order
            publisher.publish(data)
            ros.wait(partial(answered, deserialize_message(expected[0][number], SkinContacts)))
            live.append((contacts[-1], clouds[-1]))
        children.check()

    for number, (touch, cloud) in enumerate(live):
        again = deserialize_message(expected[0][number], SkinContacts)
        assert touch.header == again.header
        # BLAS sums in an order that depends on memory addresses, and the fit amplifies rounding.
        np.testing.assert_allclose(numbers(touch), numbers(again), rtol=1e-7)
        surface = deserialize_message(expected[1][number], PointCloud2)
        np.testing.assert_allclose(points_of(cloud), points_of(surface), rtol=1e-4, atol=1e-2)
        assert list(touch.touch_id) == list(found[number].id)
        assert list(touch.id) == [0] and touch.header.frame_id == skin.parent_frame
    last, cloud = live[-1]
    centre = middle + np.array([2e-4 * (SCANS - 1), 0])
    assert last.normal_force[0] == pytest.approx(2, rel=0.05)
    assert last.force[0].x == pytest.approx(0.5, abs=0.1)
    np.testing.assert_allclose([last.position[0].x, last.position[0].y], centre, atol=0.5e-3)
    assert 0 < last.force_uncertainty[0] < 0.2 and len(last.moment) == 1 and last.refined[0]
    points = points_of(cloud)
    assert tuple(field.name for field in cloud.fields) == CLOUD
    assert cloud.header.frame_id == skin.parent_frame and cloud.width == len(points)
    assert np.isfinite(points).all() and (points[:, 5] > 0).all()
    peak = points[points[:, 3].argmax()]
    assert np.linalg.norm(peak[:2] - centre) < 5e-3 and peak[3] > 5e3
