# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The node `contacts` with the method `inverse`: contacts with ids, and the surface's traction; the
same out of a bag."""

from __future__ import annotations

import struct
import time
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import replace
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
from cube_tensor_driver.config.calibration import format_calibration
from cube_tensor_driver.config.grid import describe_grid
from cube_tensor_driver.config.influence import find_influence
from cube_tensor_driver.config.package_data import find_package_data
from cube_tensor_driver.config.skin import Elastomer, Skin, read_skin
from cube_tensor_driver.config.yaml import read_yaml, write_yaml
from cube_tensor_driver.core.calibration import make_illustrative_calibration
from cube_tensor_driver.core.compensation.models import CreepModel, WeightModel
from cube_tensor_driver.core.defaults import FREQUENCY_NOISE
from cube_tensor_driver.core.errors import ConfigError
from cube_tensor_driver.core.layout import LAYOUTS
from cube_tensor_driver.core.modes import to_matrix
from cube_tensor_driver.core.oscillator import compute_pad_frequency
from cube_tensor_driver.core.pipeline import Pipeline
from cube_tensor_driver.core.rate_limit import find_next_due_ns
from cube_tensor_driver.core.rows import FrequencyRows
from cube_tensor_driver.mechanics import contact
from cube_tensor_driver.mechanics.influence import read_influence
from cube_tensor_driver.messages.contacts import CLOUD
from cube_tensor_driver.messages.types import (
    COMPENSATION_TYPE,
    FREQUENCIES_TYPE,
    INFO_TYPE,
    STRESS_TYPE,
)
from cube_tensor_driver.simulation.motion import read_weight
from cube_tensor_driver.touch.contact_finder import ContactSettings

FRAME = b"skin_base\0"
FORCE = np.array([0.5, 0.0, -2.0])
WEAK = np.array([0.03, 0.0, -0.15])
"""Force whose pressure at the depth of the cubes is between 300 Pa and 1.2 kPa."""
SIDE = 5
PITCH = 12e-3
RATE_HZ = 50.0
STEP_NS = 10_000_000
IDLE_STEP_NS = 50_000_000
"""Step while the nodes start, which is real time."""
GAP_NS = 2_000_000_000
"""Time without scans after which everything that a node does periodically begins again."""
IDLE_SCANS = 12
"""Scans before the load, with which the detection of touch begins."""
SCANS = 8
"""Scans under each load."""
SHIFT = 2e-4
"""Movement of the load from scan to scan, in m."""
ELASTOMER = Elastomer(depth=5e-3, thickness=np.inf, poisson=0.46)
"""Half space whose depth and Poisson's ratio are not the defaults."""


def write_heavy_skin(folder: Path) -> Path:
    """The file of a skin whose calibration states the response to its weight, and creep."""
    weight = WeightModel(read_weight("cube_11mm", 24))
    amplitude = np.full((24, 2), 5e-3)
    creep = CreepModel(np.array([0.05, 1.0]), amplitude, amplitude[None])
    heavy = replace(make_illustrative_calibration("cube"), weight=weight, creep=creep)
    (folder / "heavy.yaml").write_text(format_calibration(heavy))
    skin = describe_grid(
        nx=SIDE, ny=SIDE, pitch=PITCH, rate=100.0, layout="cube", calibration="heavy.yaml"
    )
    elastomer = {"depth": ELASTOMER.depth, "thickness": 0.0, "poisson": ELASTOMER.poisson}
    write_yaml(folder / "skin.yaml", {**skin, "elastomer": elastomer})
    return folder / "skin.yaml"


def frequencies(skin: Skin, force: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """(cubes, pads) Hz under a ball of 6 mm contact width, by Boussinesq's and Cerruti's forces."""
    places = np.array([cube.xyz for cube in skin.cubes])
    below = np.column_stack([places[:, :2], np.full(len(places), -ELASTOMER.depth)])
    load = contact.hertz(3e-3, force, centre, order=12)
    stress, slope = contact.field(below, *load, ELASTOMER.poisson)
    calibration = skin.calibrations[0]
    gradient = np.moveaxis(to_matrix(slope.swapaxes(1, 2)), 1, 3)  # (cubes, 3, 3, axis)
    state = calibration.modes.compute_amplitudes(
        to_matrix(stress), calibration.half_side * gradient
    )
    pads = state @ calibration.response.T
    rest, beta = calibration.rest_frequency, calibration.beta
    return compute_pad_frequency(pads, rest, beta, calibration.modulus)


def read_stamp_ns(data: bytes) -> int:
    """The stamp of a serialised message that begins with a header."""
    seconds, nanoseconds = struct.unpack_from("<iI", data, 4)
    return 10**9 * seconds + nanoseconds


def write_bag(folder: Path, recorded: dict[str, list[bytes]]) -> Path:
    """A bag of serialised messages by topic, each recorded at its stamp."""
    kinds = {
        "info": INFO_TYPE,
        "frequencies": FREQUENCIES_TYPE,
        "stress": STRESS_TYPE,
        "compensation": COMPENSATION_TYPE,
    }
    entries = [(read_stamp_ns(data), name, data) for name in recorded for data in recorded[name]]
    with BagWriter(folder) as writer:
        for name in recorded:
            writer.add_topic(f"/{name}", kinds[name])
        for stamp_ns, name, data in sorted(entries):
            writer.write(f"/{name}", stamp_ns, data)
    return folder


def messages(bag: Path, topic: str) -> list[bytes]:
    with Bag(bag) as opened:
        return [entry.data for entry in opened.read_entries({topic})]


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
        (["inverse", "least=4"], "use NAME:=VALUE with one of rate, least, influence"),
        (["inverse", "least:=small"], "allowed: 0 to 1e+09"),
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
    """The force, by influence functions. Cubes that count as points in this layer miss much of it.

    A skin file adds the elastomer to a bag without one, as if it had been recorded.
    """
    pytest.importorskip("rclpy", reason="needs rclpy: run this with ./cube test")
    from rclpy.serialization import deserialize_message, serialize_message

    from cube_tensor_driver.msg import SkinContacts
    from cube_tensor_driver.ros.messages import make_info_message

    demo = find_package_data() / "config" / "skin_demo.yaml"
    skin = read_skin(demo)
    influence = read_influence(find_influence("cube_11mm"))
    layer = {"depth": influence.depth, "thickness": influence.layer.thickness}
    path = tmp_path / "layer.yaml"
    write_yaml(path, {**read_yaml(demo), "elastomer": layer})
    calibration, centre = skin.calibrations[0], np.array([1e-3, -2e-3])
    sources, forces = contact.hertz(3e-3, FORCE, centre, order=8)
    which = [LAYOUTS["cube"].pads.index(pad) for pad in calibration.layout.pads]
    pads = [
        np.einsum("psi,si->p", influence.interpolate(sources[:, :2] - cube.xyz[:2])[which], forces)
        for cube in skin.cubes
    ]
    law = calibration.rest_frequency, calibration.beta, calibration.modulus
    hertz = compute_pad_frequency(np.array(pads), *law)
    rows = FrequencyRows.from_values(np.arange(len(hertz)), hertz, stamp_ns=time.time_ns())
    scan = encoded(rows, FRAME)
    for name, recorded in (("without", skin), ("with", read_skin(path))):
        described = make_info_message(recorded, Pipeline(skin.calibrations), time.time_ns())
        described.sender = "reconstruction"
        content = {"info": [serialize_message(described)], "frequencies": [scan]}
        write_bag(tmp_path / name, content)
    found = []
    for number, (name, *given) in enumerate(
        (
            ["without", "--contacts", "influence:=cube_11mm"],
            ["without", "--skin", str(path), "--contacts"],
            ["with", "--contacts"],
        )
    ):
        out = tmp_path / str(number)
        assert main(["reprocess", str(tmp_path / name), "-o", str(out), *given]) == 0
        found += messages(out / name, "/contacts")
    by_pads, by_points, recorded_elastomer = found
    assert by_points == recorded_elastomer
    (by_pads,), (by_points,) = (
        [one.z for one in deserialize_message(data, SkinContacts).force]
        for data in (by_pads, by_points)
    )
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


def test_contacts_of_an_uncertain_compensation_live_and_out_of_a_bag(ros, tmp_path):
    """Reconstruction and contacts as nodes, and reprocessing of what they published, give the same
    but for rounding, which depends on the process.

    Under load, the motion of the skin is unknown. Because the errors that this causes are stated,
    the weak load is found, which without them had to exceed 1.2 kPa. Method and elastomer come from
    the skin file.
    """
    pytest.importorskip("rclpy", reason="needs rclpy: run this with ./cube test")
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from rclpy.serialization import deserialize_message
    from sensor_msgs.msg import Imu, PointCloud2
    from std_msgs.msg import Float32MultiArray

    from cube_tensor_driver.msg import (
        SkinCompensation,
        SkinContacts,
        SkinFrequencies,
        SkinInfo,
        SkinStress,
        SkinTouch,
    )
    from cube_tensor_driver.processes.children import Children
    from cube_tensor_driver.processes.skin_processes import Process
    from cube_tensor_driver.ros.messages import to_ns, to_time

    path = write_heavy_skin(tmp_path)
    skin = read_skin(path)
    n = len(skin.cubes)
    sent: list[bytes] = []
    published: dict[str, list[bytes]] = {"frequencies": sent}
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    for kind, name, quality in (
        (SkinInfo, "info", latched),
        (SkinCompensation, "compensation", 1000),
        (SkinStress, "stress", 1000),
    ):
        published[name] = kept = []
        ros.node.create_subscription(kind, name, kept.append, quality, raw=True)
    contacts = ros.listen(SkinContacts, "contacts")
    clouds = ros.listen(PointCloud2, "traction")
    touches = ros.listen(SkinTouch, "touch")
    errors = ros.listen(Float32MultiArray, "stress_errors")
    imu = ros.node.create_publisher(Imu, "imu", 100)
    still = Imu()
    still.header.frame_id = skin.parent_frame
    still.linear_acceleration.z = 9.8
    publisher = ros.node.create_publisher(SkinFrequencies, "frequencies", 100)
    random = np.random.default_rng(2)
    now_ns = 0

    def send(hertz: np.ndarray, step_ns: int = STEP_NS) -> None:
        """Publish a scan, `step_ns` after the last one."""
        nonlocal now_ns
        now_ns += step_ns
        noise = FREQUENCY_NOISE * random.standard_normal(hertz.shape)
        rows = FrequencyRows.from_values(np.arange(n), hertz * (1 + noise), stamp_ns=now_ns)
        sent.append(encoded(rows, FRAME))
        publisher.publish(sent[-1])

    def is_answered(found: list) -> bool:
        return to_ns(found[-1].header.stamp) == now_ns

    middle = np.zeros(2)
    idle = frequencies(skin, 0 * FORCE, middle)
    given = {"config": str(path), "imu": "imu", "tare_folder": str(tmp_path / "tare")}
    with Children(tmp_path) as children:
        for name, parameters in (("reconstruction", given), ("contacts", {"rate": RATE_HZ})):
            module = f"cube_tensor_driver.ros.nodes.{name}"
            children.start(Process(name, module, parameters=parameters))
        ros.wait(lambda: publisher.get_subscription_count() and published["info"])
        now_ns = time.time_ns()
        ros.wait(lambda: imu.get_subscription_count())

        def send_idle() -> None:
            still.header.stamp = to_time(now_ns + IDLE_STEP_NS)
            imu.publish(still)
            send(idle, IDLE_STEP_NS)

        timer = ros.node.create_timer(1e-9 * IDLE_STEP_NS, send_idle)
        ros.wait(lambda: contacts and clouds and touches and len(errors) > 3, seconds=60)
        ros.node.destroy_timer(timer)
        ros.wait(lambda: is_answered(touches))
        scans = [idle] * IDLE_SCANS
        for force in (WEAK, FORCE):
            for _ in range(SCANS):
                middle = middle + np.array([SHIFT, 0])
                scans.append(frequencies(skin, force, middle))
        # The node was ready later than the first scan, with which reprocessing begins. In the gap,
        # the samples of the IMU become too old, so that both get much larger errors.
        begin_ns, due_ns = now_ns + GAP_NS, 0
        for number, hertz in enumerate(scans):
            send(hertz, STEP_NS if number else GAP_NS)
            ros.wait(lambda: read_stamp_ns(published["stress"][-1]) == now_ns)
            ros.wait(lambda: is_answered(touches))
            next_ns = find_next_due_ns(now_ns, due_ns, round(1e9 / RATE_HZ))
            if next_ns is not None:
                due_ns = next_ns
                ros.wait(lambda: is_answered(contacts) and is_answered(clouds))
        children.check()

    bag = write_bag(tmp_path / "bag", published)
    with open_bag(bag) as source:
        assert source.skin.elastomer == ELASTOMER
    options = ContactOptions(ContactSettings(), RATE_HZ)
    reprocess(ReprocessJob(bag, tmp_path / "out", "bag", contacts=options))

    def select(found: list) -> list:
        return [one for one in found if to_ns(one.header.stamp) >= begin_ns]

    def read_again(topic: str, kind: type) -> list:
        return select(
            [deserialize_message(data, kind) for data in messages(tmp_path / "out", topic)]
        )

    # The stamps come twice as often as the node's rate.
    assert len(select(clouds)) == len(scans) // 2 + 1
    # BLAS sums in an order that depends on memory addresses, and the fit amplifies rounding.
    for topic, kind, found, rounding in (
        ("/contacts", SkinContacts, contacts, {"rtol": 1e-6, "atol": 1e-9}),
        ("/touch", SkinTouch, touches, {"rtol": 1e-5}),
    ):
        live, again = select(found), read_again(topic, kind)
        assert [one.header for one in live] == [one.header for one in again]
        for one, other in zip(live, again, strict=True):
            np.testing.assert_allclose(numbers(one), numbers(other), **rounding)
    surfaces = read_again("/traction", PointCloud2)
    for one, other in zip(select(clouds), surfaces, strict=True):
        np.testing.assert_allclose(points_of(one), points_of(other), rtol=1e-4, atol=1e-2)

    # Touch begins with a scan under load, and keeps the number that states its time.
    touched = [one for one in select(touches) if len(one.id)]
    assert {tuple(one.id) for one in touched} == {(to_ns(touched[0].header.stamp),)}
    live = select(contacts)
    found = [one for one in live if one.id]
    assert {tuple(one.id) for one in found} == {(0,)} and found[-1].touch_id == touched[-1].id
    # The weak load is found within its first scans.
    assert len(found) >= SCANS - 3
    last, cloud = live[-1], clouds[-1]
    assert last.header.frame_id == cloud.header.frame_id == skin.parent_frame
    assert last.normal_force[0] == pytest.approx(2, rel=0.05)
    assert last.force[0].x == pytest.approx(0.5, abs=0.1)
    np.testing.assert_allclose([last.position[0].x, last.position[0].y], middle, atol=0.5e-3)
    assert 0 < last.force_uncertainty[0] < 0.2 and len(last.moment) == 1 and last.refined[0]
    points = points_of(cloud)
    assert tuple(field.name for field in cloud.fields) == CLOUD and cloud.width == len(points)
    assert np.isfinite(points).all() and (points[:, 5] > 0).all()
    peak = points[points[:, 3].argmax()]
    assert np.linalg.norm(peak[:2] - middle) < 5e-3 and peak[3] > 5e3
