# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""What the reconstruction reports: lost messages, also those that DDS drops without a word, and its
own state."""

from __future__ import annotations

import contextlib
import itertools
import time
from dataclasses import replace
from types import SimpleNamespace

import pytest

pytest.importorskip("rclpy", reason="needs rclpy: run this with ./cube test")

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from played_hub import SINGLE
from rclpy.executors import SingleThreadedExecutor
from std_msgs.msg import UInt32

from cube_tensor_driver.bags.read import Bag
from cube_tensor_driver.bags.summary import last_diagnostics
from cube_tensor_driver.bags.write import BagWriter
from cube_tensor_driver.browser import markup
from cube_tensor_driver.config.package_data import package_data
from cube_tensor_driver.config.skin import read_skin
from cube_tensor_driver.core.reconstructor import Reconstructor
from cube_tensor_driver.core.rows import FrequencyRows
from cube_tensor_driver.device.chain import LinkReport
from cube_tensor_driver.device.links.link import LinkState
from cube_tensor_driver.device.scans.row_counts import RowCounts
from cube_tensor_driver.processes.children import Children
from cube_tensor_driver.processes.skin_processes import RECORDED, skin_processes
from cube_tensor_driver.ros.commands import record
from cube_tensor_driver.ros.commands.echo import resolve_topics
from cube_tensor_driver.ros.compat import make_executor, with_number
from cube_tensor_driver.ros.diagnostics.links import LinkDiagnostics
from cube_tensor_driver.ros.diagnostics.reconstruction import (
    LostMessages,
    ReconstructionDiagnostics,
)

DEPTH = 10


@pytest.mark.parametrize("executor", [SingleThreadedExecutor, make_executor])
def test_what_a_late_subscriber_loses_is_counted(ros, executor):
    """Its queue holds DEPTH messages. What another publisher sends,
    also before the two met, is no loss."""
    lost, came = LostMessages(), []

    def take(message, number):
        lost.note_arrival(number)
        came.append(message.data)

    node = rclpy.create_node("late")
    node.create_subscription(
        UInt32, "late", with_number(take), DEPTH, event_callbacks=lost.new_subscription()
    )
    spinner = executor()
    spinner.add_node(node)
    publisher = ros.node.create_publisher(UInt32, "late", 1000)

    numbers = itertools.count()

    def publish(count, publisher):
        for _ in range(count):
            last = next(numbers)
            publisher.publish(UInt32(data=last))
        return last

    def receive(last):
        until = time.monotonic() + 20
        while not came or came[-1] != last:
            assert time.monotonic() < until
            spinner.spin_once(timeout_sec=0.05)

    try:
        ros.wait(publisher.get_subscription_count)
        receive(publish(1, publisher))
        receive(publish(50, publisher))
        assert len(came) == 1 + DEPTH and lost.count == 50 - DEPTH
        other = ros.node.create_publisher(UInt32, "late", 1000)
        publish(5, other)
        ros.wait(other.get_subscription_count)
        for _ in range(4):
            publish(3, other)
            receive(publish(2, publisher))
        ros.node.destroy_publisher(publisher)
        receive(publish(3, other))
        assert lost.count == 50 - DEPTH
    finally:
        spinner.shutdown()
        node.destroy_node()


def test_a_publisher_that_begins_again_is_no_loss():
    lost = LostMessages()
    for number in (5, 6, 7, 1, 2, 3, 6, 7, 8, 11, 12):
        lost.note_arrival(number)
    assert lost.count == 4
    lost.new_subscription()
    for number in (40, 41, 44, 45):
        lost.note_arrival(number)
    assert lost.count == 6


def test_an_inactive_node_says_so_and_blames_no_cube():
    skin = read_skin(package_data() / "config" / "skin_demo.yaml")
    reconstructor = Reconstructor(skin)
    tare = SimpleNamespace(uids={}, age=dict)
    diagnostics = ReconstructionDiagnostics(skin, reconstructor, tare, LostMessages())
    rest = np.array([cube.calibration.rest_frequency for cube in skin.cubes])

    def texts(active: bool, second: int | None = None) -> list[str]:
        if second is not None:
            cubes = np.arange(len(skin.cubes))
            stamps = np.full(len(cubes), second * 1_000_000_000)
            reconstructor(FrequencyRows.of(cubes, rest.astype(np.float32), stamp_ns=stamps))
        statuses, changes = diagnostics.statuses(active)
        assert not changes
        return [status.message for status in statuses]

    assert texts(True, 1) == [""]
    inactive = ["inactive: the node processes no rows until it is activated"]
    assert texts(False) == inactive and texts(False) == inactive
    # No rows in the second of the activation are no fault either.
    assert texts(True) == [""]
    assert texts(True, 5) == [""]


@pytest.mark.parametrize(
    ("state", "notes", "level"),
    [
        (LinkState.OPEN, (), b"\0"),
        (LinkState.OPEN, ("5 of 10 samples lost or dropped since the last report",), b"\1"),
        (LinkState.WAITING, ("5 of 10 samples lost", "no port"), b"\2"),
        (LinkState.SILENT, (), b"\3"),
    ],
)
def test_losses_of_a_link_are_a_warning_and_coloured_on_the_page(state, notes, level):
    report = LinkReport("hub0", 7, state, (), notes, {"lost_on_the_way": 5})
    links = SimpleNamespace(row_counts=RowCounts, report=lambda: [report])
    rows, link = LinkDiagnostics("skin").statuses(links, with_links=True)
    assert (rows.level, link.level) == (b"\0", level)
    assert link.message == "; ".join(notes) or state.value
    scan = SimpleNamespace(health=np.zeros(1, int), links=((link.message, link.level[0]),))
    html = markup.conditions(["c"], scan)
    colour = {b"\0": "inherit", b"\1": markup.AMBER}.get(level, markup.RED)
    assert f"color:{colour}'>{link.message}<" in html


def test_a_recording_of_a_namespace_has_no_diagnostics_of_another(ros, tmp_path, monkeypatch):
    """Though tools of ROS find those of all nodes in /diagnostics. The rate is an integer, as in a
    parameter file in which somebody has written `rate: 250`."""
    monkeypatch.setattr(record, "MAX_CONNECT_S", 0.0)  # a driver alone has not all topics
    heard = ros.listen(DiagnosticArray, "/diagnostics")
    recorder_node = rclpy.create_node("recorder", namespace="left")
    names = resolve_topics(recorder_node, RECORDED)
    recorder_node.destroy_node()
    (driver,) = skin_processes(SINGLE)[1:]
    parameters = driver.parameters | {"rate": 250}
    with (
        Children(tmp_path) as children,
        contextlib.closing(
            record.Recorder(ros.node, names, BagWriter(tmp_path / "bag"))
        ) as recorder,
    ):
        for name in ("left", "right"):
            arguments = ("--ros-args", "-r", f"__ns:=/{name}")
            children.start(
                replace(driver, executable=name, arguments=arguments, parameters=parameters)
            )

        def is_recorded():
            children.check()
            recorder.find_topics()
            if not recorder.has_begun:
                heard.clear()
            statuses = {status.name for array in heard for status in array.status}
            has_come = any(recorder.counts.get(name) for name in names if "diagnostics" in name)
            return has_come and {"/left/driver: rows", "/right/driver: rows"} <= statuses

        ros.wait(is_recorded)
    with Bag(tmp_path / "bag") as bag:
        recorded = {status.name for status in last_diagnostics(bag)}
    assert recorded == {"/left/driver: rows", "/left/driver: link hub0"}
