# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Weight and inertia in the reconstruction node: from an IMU or TF to rows, a bag, and its bits."""

from __future__ import annotations

import sys
from dataclasses import replace
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs rclpy: run this with ./cube test")
pytest.importorskip("rosbags", reason="needs rosbags: pip install rosbags")

from moving_skin import G, MovingSkin
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import Imu

from conftest import decoded, encoded
from cube_tensor_driver.bags.metadata import describe_quality
from cube_tensor_driver.bags.read import Bag
from cube_tensor_driver.bags.reprocess.job import ReprocessJob, reconstruct, reprocess
from cube_tensor_driver.bags.reprocess.table import read_frequency_table, reprocess_table
from cube_tensor_driver.bags.source import open_bag
from cube_tensor_driver.bags.write import BagWriter
from cube_tensor_driver.config.calibration import write_calibration
from cube_tensor_driver.config.yaml import read_yaml, write_yaml
from cube_tensor_driver.core.calibration import make_illustrative_calibration
from cube_tensor_driver.core.compensation.models import CreepModel, ThermalModel, WeightModel
from cube_tensor_driver.core.oscillator import compute_pad_frequency
from cube_tensor_driver.core.reconstructor import Reconstructor
from cube_tensor_driver.core.rows import FrequencyRows, concatenate
from cube_tensor_driver.core.status import COMPENSATION, CREEP, THERMAL, WEIGHT
from cube_tensor_driver.core.tensor import rotation_from_rpy
from cube_tensor_driver.messages.codec import stress_codec
from cube_tensor_driver.messages.types import (
    COMPENSATION_TYPE,
    FREQUENCIES_TYPE,
    INFO_TYPE,
    STRESS_TYPE,
)
from cube_tensor_driver.msg import SkinCompensation, SkinStress
from cube_tensor_driver.processes.children import Children
from cube_tensor_driver.processes.skin_processes import SimulatedHubs, list_skin_processes
from cube_tensor_driver.ros.messages import to_ns, to_time
from cube_tensor_driver.ros.motion import _decode
from cube_tensor_driver.ros.nodes.contacts import Contacts
from cube_tensor_driver.ros.nodes.reconstruction import Reconstruction

START_NS = 1_700_000_000_000_000_000
CUBES = [((0.02, 0.0, 0.01), (0.3, 0.0, 0.0)), ((-0.2, 0.1, 0.0), (0.0, 1.2, 0.4))]
"""Positions in m and roll, pitch, yaw of the cubes in the parent frame."""
IMU_POINT = np.array([0.15, -0.2, 0.1])
"""Position of the IMU in the parent frame, in m."""
IMU_AXES = rotation_from_rpy(0.1, 0.2, -1.0)
"""Rotation from the axes of the IMU to those of the parent frame."""
IMU_PERIOD_S = 0.005
"""Sample period of the IMU, in s."""
ROW_PERIOD_S = 0.004
"""Sample period of the cubes, in s."""
IMU_DELAY_S = 0.003
"""Time from a sample of the IMU to its arrival, in s."""
RESPONSE = np.array(
    [
        [3.133, 0, -3.044],
        [-3.133, 0, -3.044],
        [-6.094, 0, -24.375],
        [6.094, 0, -24.375],
        [9.122, 0, -5.992],
        [0.775, 0, -4.738],
        [-9.122, 0, -5.992],
        [-0.775, 0, -4.738],
    ]
)
"""Stress of each pad of a steel bar per specific force along x, y and z, in Pa per m/s², from
./cube fem planar_slab --load weight."""
TRUE_RESPONSE = np.array(
    [
        [3.447, 0, -3.469],
        [-3.447, 0, -3.469],
        [-6.461, 0, -24.667],
        [6.461, 0, -24.667],
        [9.193, 0, -6.457],
        [0.367, 0, -5.146],
        [-9.193, 0, -6.457],
        [-0.367, 0, -5.146],
    ]
)
"""Stress of each pad per specific force, like `RESPONSE`, of a bar whose dimensions and materials
differ from the model of the compensation: a section of 58 x 11.3 mm with 1100 kg/m³ and Poisson's
ratio 0.475, and a bar of 7750 kg/m³ that lies 0.2 mm deeper. It is computed on one coarse mesh."""


@pytest.fixture
def skin_file(tmp_path):
    calibration = replace(make_illustrative_calibration("planar"), weight=WeightModel(RESPONSE))
    write_calibration(tmp_path / "heavy.yaml", calibration)
    cubes = [
        {
            "name": f"c{k}",
            "link": "hub0",
            "index": k,
            "pose": {"xyz": list(xyz), "rpy": list(rpy)},
            "layout": "planar",
            "calibration": "heavy.yaml",
        }
        for k, (xyz, rpy) in enumerate(CUBES)
    ]
    data = {
        "name": "skin",
        "parent_frame": "tool",
        "rate": 250.0,
        "links": [{"name": "hub0", "port": "/dev/ttyACM0"}],
        "cubes": cubes,
    }
    write_yaml(tmp_path / "skin.yaml", data)
    return tmp_path / "skin.yaml"


class Published:
    """Keeps what a publisher of the node would send."""

    def __init__(self) -> None:
        self.sent: list = []
        self.listeners = 1

    def publish(self, message) -> None:
        self.sent.append(message)

    def get_subscription_count(self) -> int:
        return self.listeners


@pytest.fixture
def start(ros, skin_file, tmp_path):
    """A function that starts a node with parameters; its messages are in its attribute `sent`."""
    nodes = []

    def start(**parameters):
        node = Reconstruction(subscribes=False)
        nodes.append(node)
        values = {"config": str(skin_file), "tare_folder": str(tmp_path), **parameters}
        node.set_parameters([Parameter(name, value=value) for name, value in values.items()])
        info = Published()
        original = node.create_publisher
        node.create_publisher = lambda *a, **k: info if a[1] == "info" else original(*a, **k)
        assert node.trigger_configure() == TransitionCallbackReturn.SUCCESS
        node.trigger_activate()
        assert node.is_active
        node._compensation = Published()
        node._publisher._publisher = Published()
        node._publisher._errors._publisher = Published()
        node.sent = {
            "info": info.sent,
            "compensation": node._compensation.sent,
            "stress": node._publisher._publisher.sent,
            "errors": node._publisher._errors._publisher.sent,
        }
        return node

    yield start
    for node in nodes:
        node.end()
        node.destroy_node()


def imu_message(moving: MovingSkin, t: float) -> Imu:
    message = Imu()
    message.header.stamp = to_time(START_NS + round(1e9 * t))
    message.header.frame_id = "imu"
    force = moving.compute_specific_force(t, IMU_POINT, IMU_AXES)
    velocity = moving.compute_angular_velocity(t, IMU_AXES)
    a, w = message.linear_acceleration, message.angular_velocity
    (a.x, a.y, a.z), (w.x, w.y, w.z) = force.tolist(), velocity.tolist()
    return message


def scan_at(t: float, moving: MovingSkin | None = None) -> FrequencyRows:
    """One row of each cube, the second 1 ms after the first; unloaded, or under its weight."""
    stamps = START_NS + np.array([round(1e9 * t), round(1e9 * t) + 1_000_000])
    pads = np.full((2, 8), -300.0)
    if moving is not None:
        pads = np.array([TRUE_RESPONSE @ true_force(moving, t + 1e-3 * c, c) for c in range(2)])
    c = make_illustrative_calibration("planar")
    f = compute_pad_frequency(pads, c.rest_frequency, c.beta, c.modulus).astype(np.float32)
    cube = np.arange(2, dtype=np.uint16)
    return FrequencyRows.from_values(
        cube, f, stamp_ns=stamps, sequence=round(t / ROW_PERIOD_S), temperature=25 + 10 * t
    )


def true_force(moving: MovingSkin, t: float, cube: int) -> np.ndarray:
    point, angles = CUBES[cube]
    return moving.compute_specific_force(t, point, rotation_from_rpy(*angles))


def fake_tf(monkeypatch, **frames) -> None:
    """tf2_ros is in no wheel: frames are rotation, position and time in the target frame."""
    module = ModuleType("tf2_ros")

    class TransformException(Exception):
        pass

    class Buffer:
        def lookup_transform(self, target, source, when):
            if source not in frames or target != "tool":
                # tf2 ends this text with a space.
                raise TransformException(f"{source} does not exist. ")
            (x, y, z, w), p, stamp_ns = frames[source]
            return SimpleNamespace(
                transform=SimpleNamespace(
                    translation=SimpleNamespace(x=p[0], y=p[1], z=p[2]),
                    rotation=SimpleNamespace(x=x, y=y, z=z, w=w),
                ),
                header=SimpleNamespace(stamp=to_time(stamp_ns)),
            )

    module.TransformException, module.Buffer = TransformException, Buffer
    module.TransformListener = lambda buffer, node: SimpleNamespace(unregister=lambda: None)
    monkeypatch.setitem(sys.modules, "tf2_ros", module)


def quaternion(rotation: np.ndarray) -> tuple:
    """x, y, z, w of a rotation by less than 180°, by the trace."""
    w = np.sqrt(1 + np.trace(rotation)) / 2
    x, y, z = (rotation[[2, 0, 1], [1, 2, 0]] - rotation[[1, 2, 0], [2, 0, 1]]) / (4 * w)
    return x, y, z, w


IMU_FRAME = (quaternion(IMU_AXES), IMU_POINT, 0)


def played(node, moving: MovingSkin, seconds: float, imu_end_s: float = 1e9) -> FrequencyRows:
    """Play an IMU, until it stops, and rows, each when it arrives; returns the rows."""
    sent, scans = 0, []
    for k in range(round(seconds / ROW_PERIOD_S)):
        t = 0.1 + k * ROW_PERIOD_S
        while sent * IMU_PERIOD_S + IMU_DELAY_S <= min(t, imu_end_s):
            node._motion.on_imu(serialize_message(imu_message(moving, sent * IMU_PERIOD_S)))
            sent += 1
        scans.append(scan_at(t, moving))
        node.on_rows(scans[-1])
    return concatenate(scans)


def test_a_shaken_arm_leaves_no_weight_and_no_contact(start, monkeypatch):
    """With the lever arm, in the axes of each cube, while samples come late and rows between.

    The pads have the response of the bar as built, which the calibration does not know.
    """
    fake_tf(monkeypatch, imu=IMU_FRAME)
    # It turns through all poses within this second.
    node, moving = start(imu="/imu"), MovingSkin(turn_s=1.0)
    rows = played(node, moving, 1.0)
    stress = concatenate([stress_codec.decode(one).rows for one in node.sent["stress"]])
    assert (stress.status & (WEIGHT | COMPENSATION) == WEIGHT).all()
    # Nothing presses, so all that is left is wrong; a contact is 300 Pa.
    left = stress.stress[:, [0, 2, 4]]
    # Measured: 2.9, 3.0 and 4.9 Pa, and 13 Pa at most.
    assert (np.sqrt((left**2).mean(axis=0)) < 5).all()
    assert np.abs(left).max() < 30
    off = Reconstructor([make_illustrative_calibration("planar")] * 2).process(rows)
    assert np.abs(off.stress[:, [0, 2, 4]]).max() > 200


def test_rows_wait_for_the_second_sample_of_an_imu(start, monkeypatch):
    """The first sample tells no angular acceleration, without which up to 80 Pa are left."""
    fake_tf(monkeypatch, imu=IMU_FRAME)
    node, moving = start(imu="/imu"), MovingSkin()
    for k in range(3):
        node._motion.on_imu(serialize_message(imu_message(moving, k * IMU_PERIOD_S)))
    for t in (0.002, 0.006, 0.009):
        node.on_rows(scan_at(t, moving))
    first, *later = [stress_codec.decode(one).rows for one in node.sent["stress"]]
    assert (first.status & (WEIGHT | COMPENSATION) == COMPENSATION).all()
    later = concatenate(later)
    assert (later.status & (WEIGHT | COMPENSATION) == WEIGHT).all()
    # Measured: 2.2 Pa at most.
    assert np.abs(later.stress[:, [0, 2, 4]]).max() < 10


def write_lasting_effects(folder, ramp: float = 0.0) -> None:
    """Give the cubes of the skin file creep and an effect of temperature, too.

    The effect is uncertain by `ramp`, in Pa per K by which the elastomer lags, alike for all pads.
    """
    pads = np.linspace(0.5, 1.5, 8)[:, None]
    creep = CreepModel(np.array([0.1, 3.0]), 0.05 * np.hstack([pads, 2 * pads]))
    thermal = ThermalModel(
        np.array(25.0), np.array([20.0, 5.0]), 10 * pads, ramp=np.full((8, 1), ramp)
    )
    cube = replace(make_illustrative_calibration("planar"), weight=WeightModel(RESPONSE))
    write_calibration(folder / "heavy.yaml", replace(cube, creep=creep, thermal=thermal))


def decode_compensation(node) -> list[SkinCompensation]:
    """The messages on the topic `compensation` that the node has sent."""
    return [deserialize_message(data, SkinCompensation) for data in node.sent["compensation"]]


def write_bag(folder, node, rows: FrequencyRows, dropped: range) -> None:
    """What a recorder keeps of a node, without some messages of compensation."""
    topics = {"info": INFO_TYPE, "frequencies": FREQUENCIES_TYPE, "stress": STRESS_TYPE}
    topics["compensation"] = COMPENSATION_TYPE
    scans = [rows.select(slice(k, k + 2)) for k in range(0, len(rows), 2)]
    frequencies = [encoded(scan, b"tool\0") for scan in scans]
    with BagWriter(folder) as writer:
        for topic, kind in topics.items():
            writer.add_topic(f"/{topic}", kind, [describe_quality(latched=topic == "info")])
        writer.write("/info", START_NS, serialize_message(node.sent["info"][-1]))
        for k, scan in enumerate(scans):
            time_ns = int(scan.stamp_ns[0])
            writer.write("/frequencies", time_ns, frequencies[k])
            if k not in dropped:
                writer.write("/compensation", time_ns + 1, node.sent["compensation"][k])
            writer.write("/stress", time_ns + 2, node.sent["stress"][k])


def test_a_bag_gives_the_bits_of_the_node_from_every_state_on(start, monkeypatch, tmp_path):
    """Also where the IMU failed; a bag that begins later follows from the next recorded state."""
    fake_tf(monkeypatch, imu=IMU_FRAME)
    write_lasting_effects(tmp_path)
    monkeypatch.setattr("cube_tensor_driver.ros.nodes.reconstruction.STATES_PERIOD_NS", 100_000_000)
    node = start(imu="/imu")
    rows = played(node, MovingSkin(), 0.5)
    node._motion._samples.clear()
    for k in range(150, 200):
        scan = scan_at(0.1 + k * ROW_PERIOD_S)
        node.on_rows(scan)
        rows = concatenate([rows, scan])
    expected = concatenate([stress_codec.decode(one).rows for one in node.sent["stress"]])
    effects = WEIGHT | CREEP | THERMAL
    # Earlier loads and temperatures are unknown until the second step.
    found_bits = set((expected.status[60:] & (effects | COMPENSATION)).tolist())
    assert found_bits == {effects, COMPENSATION | CREEP | THERMAL}

    write_bag(tmp_path / "whole", node, rows, range(0))
    with open_bag(tmp_path / "whole") as source:
        found = concatenate([stress for _, stress in reconstruct(source)])
    for name, column in expected.collect_columns().items():
        assert column.tobytes() == getattr(found, name).tobytes(), name

    later = rows.select(slice(20, None))
    for sent in (node.sent["compensation"], node.sent["stress"]):
        del sent[:10]
    write_bag(tmp_path / "later", node, later, range(40, 42))
    with open_bag(tmp_path / "later") as source:
        found = concatenate([stress for _, stress in reconstruct(source)])
    with open_bag(tmp_path / "later") as source:
        table = reprocess_table(read_frequency_table(source), source.skin)
    for name in ("residual", "status", "left_out"):
        assert table[name].to_numpy().tobytes() == getattr(found, name).tobytes(), name
    assert table["stress_zz_Pa"].to_numpy().tobytes() == found.stress[:, 2].tobytes()
    expected = expected.select(slice(20, None))
    differs = (found.stress != expected.stress)[:, [0, 2, 4]].any(axis=1)
    # The state comes every 0.1 s; two messages of motion are lost until the next one.
    assert not differs[30:80].any() and not differs[130:].any()
    assert (found.status[80:84] & COMPENSATION).all()


@pytest.mark.parametrize(
    ("imu_end_s", "ramp", "certain_s", "uncertain"),
    [
        pytest.param(0.0, 0.0, 0.0, WEIGHT, id="no_imu"),
        # The last sample is of 0.295 s, and is extrapolated by 20 ms.
        pytest.param(0.3, 0.0, 0.315, WEIGHT, id="stale_imu"),
        # At the step at 0.4 s the elastomer lags by 3 K, which make 24 Pa, and the unknown start
        # makes 10 Pa: more than 30 Pa.
        pytest.param(1e9, 8.0, 0.4, THERMAL, id="temperature_ramp"),
    ],
)
def test_uncertain_rows_are_reprocessed_to_the_bytes_of_the_node(
    start, monkeypatch, tmp_path, imu_end_s, ramp, certain_s, uncertain
):
    fake_tf(monkeypatch, imu=IMU_FRAME)
    write_lasting_effects(tmp_path, ramp)
    node = start(imu="/imu")
    rows = played(node, MovingSkin(), 0.5, imu_end_s)
    sent = node.sent["stress"]
    status = concatenate([stress_codec.decode(one).rows for one in sent]).status
    effects = WEIGHT | CREEP | THERMAL
    is_certain = np.repeat(rows.stamp_ns[::2] < START_NS + round(1e9 * certain_s), 2)
    expected = np.where(is_certain, effects, effects ^ uncertain | COMPENSATION)
    # Before 0.2 s, the second step, earlier loads and temperatures are unknown.
    found = status & (effects | COMPENSATION)
    np.testing.assert_array_equal(found[50:], expected[50:])

    write_bag(tmp_path / "bag", node, rows, range(0))
    reprocess(ReprocessJob(tmp_path / "bag", tmp_path / "again", "bag"))
    with Bag(tmp_path / "again") as bag:
        again = [entry.data for entry in bag.read_entries({"/stress"})]
    assert again == sent


@pytest.mark.parametrize(
    ("case", "text"),
    [
        ("none", "no message on /imu: start the IMU"),
        ("damaged", "no message on /imu: start the IMU"),
        ("frame", "no transform from imu to tool: imu does not exist; publish it"),
        ("stopped", "samples on /imu are 0.5"),
        ("clock", "s newer than the rows"),
        ("no_acceleration", "states no acceleration"),
        ("no_tf2", "TF needs tf2_ros: apt install"),
    ],
)
def test_a_missing_imu_is_one_line_and_the_node_goes_on(start, monkeypatch, case, text):
    if case == "no_tf2":
        monkeypatch.setitem(sys.modules, "tf2_ros", None)
    else:
        fake_tf(monkeypatch, **({} if case == "frame" else {"imu": IMU_FRAME}))
    node, moving = start(imu="/imu"), MovingSkin()
    row_s = {"stopped": 0.6, "clock": -40.0}.get(case, 0.1)
    for k in range(0 if case == "none" else 20):
        message = imu_message(moving, k * IMU_PERIOD_S)
        if case == "no_acceleration":
            message.linear_acceleration_covariance[0] = -1.0
        data = serialize_message(message)
        node._motion.on_imu(data[:200] if case == "damaged" else data)
    node.on_rows(scan_at(row_s))
    (stress,) = node.sent["stress"]
    assert (stress_codec.decode(stress).rows.status & COMPENSATION).all()
    (motion,) = decode_compensation(node)
    assert motion.weight and not len(motion.time_offset)
    status = node._make_statuses()[0]
    assert text in status.message and "weight is not compensated" in status.message
    assert "\n" not in status.message and status.level != b"\0"


@pytest.mark.parametrize("frame", ["", "a", "imu_link", "base/imu", "left_imu_"])
def test_an_imu_is_decoded_as_by_rclpy_whatever_its_frame(frame):
    message = imu_message(MovingSkin(), 0.123)
    message.header.frame_id = frame
    time_ns, force, velocity, found = _decode(serialize_message(message))
    assert found == frame
    assert time_ns == to_ns(message.header.stamp)
    for vector, expected in (
        (force, message.linear_acceleration),
        (velocity, message.angular_velocity),
    ):
        assert vector == (expected.x, expected.y, expected.z)


def test_gravity_comes_from_tf_alone(start, monkeypatch):
    """A turned frame gives a turned weight; a transform that is no longer sent is an old one."""
    turned = rotation_from_rpy(0.4, -0.3, 2.0)
    stamp_ns = START_NS + 100_000_000
    fake_tf(monkeypatch, world=(quaternion(turned), np.zeros(3), stamp_ns))
    node = start(gravity="world")
    node.on_rows(scan_at(0.1))
    node.on_rows(scan_at(1.5))
    known, old = decode_compensation(node)
    np.testing.assert_allclose(known.specific_force, turned[:, 2] * G)
    assert not len(old.time_offset)
    assert "transform from world to tool is 1.4 s older" in node._make_statuses()[0].message
    stress = [stress_codec.decode(one).rows for one in node.sent["stress"]]
    assert [rows.status[0] & (WEIGHT | COMPENSATION) for rows in stress] == [WEIGHT, COMPENSATION]
    node.on_rows(scan_at(-49.9))
    assert "transform from world to tool is 50.0 s newer" in node._make_statuses()[0].message


def test_what_nobody_records_is_not_sent_but_compensated(start, monkeypatch):
    """Also while samples of the IMU are dropped, because they are too many."""
    fake_tf(monkeypatch, imu=IMU_FRAME)
    monkeypatch.setattr("cube_tensor_driver.ros.motion.MAX_SAMPLES", 8)
    node = start(imu="/imu")
    node._compensation.listeners = 0
    played(node, MovingSkin(), 0.1)
    assert not node.sent["compensation"]
    assert len(node._motion._samples) <= 8
    stress = [stress_codec.decode(one).rows for one in node.sent["stress"]]
    assert all((rows.status & WEIGHT).all() for rows in stress)


def test_the_errors_of_the_stress_are_sent_twice_a_second_and_when_they_grow(start, monkeypatch):
    fake_tf(monkeypatch, imu=IMU_FRAME)
    node, contacts = start(imu="/imu"), SimpleNamespace(_errors=None)
    node.on_rows(scan_at(0.0))  # without an IMU
    node.on_rows(scan_at(0.004))
    (unknown,) = node.sent["errors"]
    Contacts._on_errors(contacts, unknown)
    found = Contacts._find_errors(contacts, 2)
    matrix = node._reconstructor.pipeline.find_matrix(0)
    expected = matrix @ (make_illustrative_calibration("planar").gain[:, None] * RESPONSE * G)
    np.testing.assert_allclose(found[0, :, :3], expected, rtol=1e-5)
    assert Contacts._find_errors(contacts, 3) is None
    played(node, MovingSkin(), 1.1)
    assert len(node.sent["errors"]) == 3
    assert not np.nan_to_num(np.array(node.sent["errors"][-1].data)).any()
    node._motion._samples.clear()
    node.on_rows(scan_at(1.2))
    assert len(node.sent["errors"]) == 4
    node = start()
    node.on_rows(scan_at(0.0))
    assert not node.sent["errors"]


def test_the_weight_of_a_simulated_arm_that_moves_is_subtracted(ros, tmp_path, skin_file):
    """Simulator, its IMU, driver and reconstruction. The second cube has no block `weight`."""
    heavy = replace(make_illustrative_calibration("planar"), weight=WeightModel(TRUE_RESPONSE))
    write_calibration(tmp_path / "truth.yaml", heavy)
    skin = read_yaml(skin_file)
    skin["cubes"][1]["calibration"] = "planar"
    write_yaml(skin_file, skin)
    # It turns over, and moves to and fro with 2 m/s², in half a second each.
    poses = [[0.5 * k, 0.1 * (k % 2), 0, 0, np.pi * (k % 4 // 2), 0.2, 0] for k in range(240)]
    weight = {"poses": poses, "weight": str(tmp_path / "truth.yaml")}
    write_yaml(tmp_path / "moves.yaml", weight)
    late = {"press": {"from": 1000.0, "to": 1001.0, "at": [0.0, 0.0, 0.0], "force": 1e-3}}
    finger = {"name": "finger", "shape": "disc", "radius": 0.005, "does": [late]}
    write_yaml(tmp_path / "load.yaml", {"indenters": [finger]})
    hubs = SimulatedHubs(
        tmp_path / "ports",
        load=tmp_path / "load.yaml",
        noise=0.0,
        imperfections=tmp_path / "moves.yaml",
    )
    batches = ros.listen(SkinStress, "stress")
    with Children(tmp_path) as children:
        for process in list_skin_processes(skin_file, simulated=hubs):
            children.start(process)
        ros.wait(lambda: batches and batches[-1].status[0] & WEIGHT)
        del batches[:]
        ros.wait(lambda: len(batches) > 500)
        children.check()
    rows = concatenate([decoded(one).rows for one in batches])
    error = np.sqrt((rows.stress[:, [0, 2, 4]] ** 2).mean(axis=1))
    # On a busy machine the IMU may be late.
    is_known = rows.status & WEIGHT > 0
    assert 0.25 < is_known.mean() <= 0.5
    on, off = error[is_known], error[rows.cube == 1]
    # Measured: 2.7 Pa rms and 8.2 Pa at most; without the block, 66 Pa rms.
    assert np.sqrt((on**2).mean()) < 5 and on.max() < 20
    assert np.sqrt((off**2).mean()) > 50


def test_without_a_parameter_nothing_is_compensated_and_two_are_refused(start):
    node = start()
    node.on_rows(scan_at(0.1))
    assert not node.sent["compensation"]
    assert not (stress_codec.decode(node.sent["stress"][0]).rows.status & COMPENSATION).any()
    with pytest.raises(AssertionError):
        start(gravity="world", imu="/imu")


def test_the_tensor_of_a_cube_states_what_is_not_known_of_its_weight(start, monkeypatch):
    """A covariance is kept from row to row, but what the compensation adds to it changes."""
    fake_tf(monkeypatch, imu=IMU_FRAME)
    node = start(imu="/imu")
    node.on_rows(scan_at(0.1))
    unknown = node._reconstructor.compute_covariance(0)
    played(node, MovingSkin(), 0.1)
    known = node._reconstructor.compute_covariance(0)
    np.testing.assert_array_equal(known, node._reconstructor.pipeline.compute_covariance(0))
    # zz: 1 g along x and z, which RESPONSE turns into about 115 Pa
    assert 80**2 < unknown[2, 2] - known[2, 2] < 150**2
