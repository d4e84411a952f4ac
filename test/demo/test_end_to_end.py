# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The main job in real processes: simulator, pseudo-terminal, driver, DDS, reconstruction, DDS,
subscriber."""

from __future__ import annotations

import contextlib
import itertools
import json
import math
import os
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

import numpy as np
import psutil
import pytest

pytest.importorskip("rclpy", reason="needs rclpy: run this with ./cube test")

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import WrenchStamped
from played_hub import REST, SINGLE, PlayedHub, greeting, sample
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import PointCloud2

from conftest import ROOT, decoded
from cube_tensor_driver.config.package_data import find_package_data
from cube_tensor_driver.config.skin import read_skin
from cube_tensor_driver.core.errors import CubeError
from cube_tensor_driver.core.forces import Forces
from cube_tensor_driver.core.reconstructor import Reconstructor
from cube_tensor_driver.demo.demo import DemoSettings
from cube_tensor_driver.demo.watching import DemoResult, SkinWatcher
from cube_tensor_driver.msg import (
    SkinFrequencies,
    SkinInfo,
    SkinStress,
    SkinTouch,
    StressTensorStamped,
)
from cube_tensor_driver.processes.children import Children, format_ros_arguments
from cube_tensor_driver.processes.skin_processes import SimulatedHubs, list_skin_processes
from cube_tensor_driver.ros.messages import to_ns
from cube_tensor_driver.views.terminal.live_table import LiveTable

SKIN = find_package_data() / "config" / "skin_demo.yaml"
LATCHED = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def demo(*arguments: str) -> subprocess.Popen:
    return subprocess.Popen(
        [sys.executable, "-m", "cube_tensor_driver.cli", "demo", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=ROOT,
        start_new_session=True,
    )


def test_the_processes_of_a_demo_start_before_this_one_imports_anything_heavy():
    """Else the first tensors come half a second later."""
    script = (
        "import sys, cube_tensor_driver.demo.demo\n"
        "print({'numpy', 'rclpy', 'rich', 'jsonschema'} & set(sys.modules))"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, cwd=ROOT, check=True
    )
    assert done.stdout == "set()\n"


def test_demo_loses_nothing_and_is_right(domain, tmp_path):
    path = tmp_path / "demo.json"
    skin = "--cubes", "16", "--rate", "100", "--noise", "0"
    process = demo("--headless", *skin, "--duration", "3", "--json", str(path))
    output, errors = process.communicate(timeout=60)
    assert process.returncode == 0, output + errors
    result = json.loads(path.read_text())
    assert result["cubes"] == 16 and result["rate_hz"] == 100
    sent = result["samples_sent"]
    # Fewer where the machine stalls: a simulator that is far behind leaves samples out.
    assert 0 < sent <= 16 * 100 * 3
    assert result["tensors_received"] == result["samples_received"] == sent
    assert result["lost"] == 0 and result["crc_errors"] == 0
    assert output == f"wrote {path}: {sent} samples sent, 0 lost\n"
    # float32 carries 6e-8; pads at a strain of 0.1 have 1e-6 of their stress, times what the
    # inversion adds
    assert result["error_rel_rms"] < 1e-5
    assert result["error_over_noise"] < 0.05
    assert 0 < result["latency_p50_ms"] <= result["latency_p99_ms"]
    for name in ("driver", "reconstruction"):
        assert 0 < result[f"rss_{name}_mb"] < 150
        assert result[f"cpu_{name}_percent"] >= 0


@pytest.mark.alone
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_ended_demo_leaves_no_process(domain, number):
    process = demo("--cubes", "4")
    family = psutil.Process(process.pid)
    until = time.monotonic() + 30
    while len(family.children()) < 3:  # simulator, reconstruction, driver
        assert time.monotonic() < until and process.poll() is None
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(0.05)
    children = family.children(recursive=True)
    start = time.monotonic()
    process.send_signal(number)
    process.communicate(timeout=10)
    if number == signal.SIGINT:
        # What the README promises; longer if each processor has more than two processes to run.
        crowded = os.getloadavg()[0] / (2 * len(os.sched_getaffinity(0)))
        assert time.monotonic() - start < 2.0 * max(1.0, crowded)
        assert process.returncode == 0
    # Killed, it ends none of its children: each ends by itself, which takes seconds under load.
    _, left = psutil.wait_procs(children, timeout=0 if number == signal.SIGINT else 15)
    for child in left:
        child.kill()
    assert not left


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--config", "none.yaml"], ["none.yaml", "No such file"]),
        (["--cubes", "5000"], ["--cubes is 5000", "1 to 4096"]),
        (["--headless", "--json", "/nowhere/x.json"], ["/nowhere/x.json", "can be written"]),
    ],
)
def test_demo_says_what_is_wrong_in_one_line(domain, arguments, words):
    process = demo(*arguments)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 1
    assert "Traceback" not in errors
    for word in words:
        assert word in errors


def test_demo_does_not_mix_with_another_skin(ros):
    ros.node.create_publisher(SkinStress, "stress", 10)
    process = demo("--headless", "--cubes", "4", "--duration", "1")
    ros.wait(lambda: process.poll() is not None, 60)
    errors = process.communicate()[1]
    assert process.returncode == 1 and "Traceback" not in errors
    assert "another skin publishes stress in DDS domain" in errors and "ROS_DOMAIN_ID" in errors


def test_a_demo_without_a_tensor_fails_and_its_figures_are_json(tmp_path):
    """JSON has no NaN, and a program that reads the figures would not read them."""
    figures = {"samples_sent": 0, "tensors_received": 0, "lost": 0, "error": [math.nan]}
    settings = DemoSettings(json=tmp_path / "figures.json")
    with pytest.raises(CubeError, match="no tensor arrived"):
        DemoResult(figures, None).publish(settings)
    assert json.loads(settings.json.read_text(), parse_constant=pytest.fail)["error"] == [None]


def test_the_address_of_the_view_is_printed_at_once_without_a_terminal(capsys):
    """A table that is drawn nowhere has no title that could show it."""
    line = "http://127.0.0.1:8080 shows the skin"
    children = SimpleNamespace(log=lambda _: line, wait_for_line=lambda *_: line)
    watcher = SkinWatcher(
        read_skin(SKIN),
        100.0,
        children,
        LiveTable(read_skin(SKIN), show=False),
        SimpleNamespace(listen=lambda *_: None, spin=lambda *_: None),
        None,
    )
    watcher.note_address()
    assert capsys.readouterr().err == "http://127.0.0.1:8080 shows the skin\n"


@pytest.mark.alone
def test_every_topic_of_a_skin(ros, tmp_path):
    """With batches of five samples of each cube in a message."""
    skin, scans = read_skin(SKIN), 5
    batches = ros.listen(SkinStress, "stress")
    raw = ros.listen(SkinFrequencies, "frequencies")
    tensors = ros.listen(StressTensorStamped, "cubes/c05/stress")
    wrenches = ros.listen(WrenchStamped, "cubes/c05/wrench")
    clouds = ros.listen(PointCloud2, "forces")
    touches = ros.listen(SkinTouch, "touch")
    diagnostics = ros.listen(DiagnosticArray, "/diagnostics")
    with Children(tmp_path) as children:
        for process in list_skin_processes(SKIN, simulated=SimulatedHubs(tmp_path / "ports")):
            if process.node:
                process.parameters["publish_period"] = scans / skin.rate
            if process.executable == "reconstruction":
                process.parameters.update(forces=True, touch_false_alarms=1.0)
            children.start(process)
        ros.wait(
            lambda: len(batches) > 50 and len(raw) > 80 and len(tensors) > 20 and len(wrenches) > 20
        )
        # The load of the simulation passes over cubes, and a touch is known in the very scan.
        ros.wait(lambda: len(clouds) > 20 and any(touch.cube for touch in touches))
        ros.wait(
            lambda: (
                {status.name for array in diagnostics for status in array.status}
                >= {
                    "/driver: rows",
                    "/driver: link hub0",
                    "/driver: link hub1",
                    "/reconstruction: rows",
                }
            )
        )
        # who comes late still gets what is latched: one info of each node
        infos = ros.listen(SkinInfo, "info", LATCHED)
        of_driver = ros.listen(SkinInfo, "driver/info", LATCHED)
        ros.wait(lambda: infos and of_driver)
        assert [info.sender for info in infos + of_driver] == ["reconstruction", "driver"]
        assert all(cube.uid for cube in infos[0].cubes)
        children.check()

    # whole hubs in order; where the machine paused, several samples of a hub come together
    for message in batches:
        assert set(map(tuple, np.reshape(message.cube, (-1, 8)).tolist())) <= {
            tuple(range(8)),
            tuple(range(8, 16)),
        }
    counts = np.bincount(np.concatenate([message.cube for message in batches]), minlength=16)
    assert counts.min() > 0.5 * counts.max()
    assert np.median([len(message.cube) for message in batches]) == 16 * scans
    stamps_ns = {stamp for message in batches for stamp in decoded(message).rows.stamp_ns.tolist()}
    assert {to_ns(touch.header.stamp) for touch in touches[-10:-5]} <= stamps_ns
    rows = decoded(batches[-1]).rows
    assert batches[-1].header.frame_id == "skin_base"
    # A busy machine makes stamps uncertain.
    assert set(rows.status.tolist()) <= {0, SkinStress.STAMP}
    names = ("xx", "yy", "zz", "yz", "zx", "xy")
    seen = [name for k, name in enumerate(names) if rows.observed[0] >> k & 1]
    assert seen == ["xx", "zz", "zx"]
    assert (
        np.isnan(rows.stress[:, [1, 3, 5]]).all() and np.isfinite(rows.stress[:, [0, 2, 4]]).all()
    )

    # what the batch says of a cube, its own topic says too, with the covariance of the core
    by_time = {}
    for message in batches:
        rows = decoded(message).rows
        for row in np.flatnonzero(rows.cube == 5):
            by_time[int(rows.stamp_ns[row])] = rows.stress[row]

    def newest(messages: list) -> object:
        """The newest message whose batch has come, too: topics arrive in any order."""
        return next(one for one in reversed(messages) if to_ns(one.header.stamp) in by_time)

    tensor = newest(tensors)
    stress = by_time[to_ns(tensor.header.stamp)]
    normal, shear = tensor.tensor.normal, tensor.tensor.shear
    np.testing.assert_array_equal([normal.x, normal.y, normal.z, shear.x, shear.y, shear.z], stress)
    assert tensor.header.frame_id == "skin_c05"
    expected = Reconstructor(skin).compute_covariance(5)
    np.testing.assert_allclose(
        np.reshape(tensor.tensor.covariance, (15, 15)), expected, rtol=1e-5
    )  # noise in float32

    assert newest(wrenches).header.frame_id == "skin_c05"

    # one point per cube: where it is, and the force of its last row in the message
    stamped = {(one.header.stamp.sec, one.header.stamp.nanosec): one for one in batches}
    cloud, batch = next(
        (one, stamped[key])
        for one in clouds
        if (key := (one.header.stamp.sec, one.header.stamp.nanosec)) in stamped
    )
    assert [field.name for field in cloud.fields] == ["x", "y", "z", "fx", "fy", "fz"]
    assert cloud.header.frame_id == "skin_base" and cloud.width == 16
    points = np.frombuffer(cloud.data, "<f4").reshape(16, 6)
    np.testing.assert_allclose(points[:, :3], [cube.xyz for cube in skin.cubes], rtol=1e-6)
    expected = Forces(skin).compute_in_parent_frame(decoded(batch).rows)
    np.testing.assert_array_equal(points[:, 3:], expected.astype(np.float32))


def test_one_process_sends_frequencies_to_who_listens(ros, tmp_path):
    hub = PlayedHub(tmp_path / "ports", "hub0")
    stress = ros.listen(SkinStress, "stress")
    numbers = itertools.count()

    def sent() -> bool:
        hub.send(sample(next(numbers), REST))
        return True

    with Children(tmp_path) as children:
        children.start(
            list_skin_processes(SINGLE, composed=True, simulated=SimulatedHubs(tmp_path / "ports"))[
                1
            ]
        )
        ros.wait(lambda: 1 in hub.listen())
        hub.send(greeting())
        ros.wait(lambda: 2 in hub.listen())
        ros.wait(lambda: sent() and stress)
        frequencies = ros.listen(SkinFrequencies, "frequencies")
        ros.wait(lambda: sent() and frequencies)
        ros.wait(lambda: stress[-1].sequence[-1] >= frequencies[-1].sequence[-1])
        newest = {message.sequence[-1]: message.header.stamp for message in stress}
        assert newest[frequencies[-1].sequence[-1]] == frequencies[-1].header.stamp
        children.check()
    hub.close()


@pytest.mark.parametrize(
    ("executable", "parameters", "words"),
    [
        ("driver", {"config": "none.yaml"}, ["none.yaml", "No such file"]),
        ("reconstruction", {"config": ""}, ["parameter config is empty"]),
        (
            "reconstruction",
            {"config": str(SKIN), "qos_reliability": "maybe"},
            ["maybe", "reliable, best_effort"],
        ),
    ],
)
def test_a_node_that_cannot_start_says_why_and_ends(domain, executable, parameters, words):
    command = [
        sys.executable,
        "-m",
        f"cube_tensor_driver.ros.nodes.{executable}",
        "--ros-args",
        *format_ros_arguments(parameters),
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=30, check=False)
    assert done.returncode == os.EX_CONFIG
    text = done.stdout + done.stderr
    assert "Traceback" not in text
    for word in words:
        assert word in text
