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
from unittest.mock import Mock

import pytest

pytest.importorskip("rclpy", reason="needs rclpy: run this with ./cube test")

import numpy as np
import rclpy
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from played_hub import SINGLE
from rclpy.executors import SingleThreadedExecutor
from std_msgs.msg import UInt32

from cube_tensor_driver.bags.read import Bag
from cube_tensor_driver.bags.summary import find_last_diagnostics
from cube_tensor_driver.bags.write import BagWriter
from cube_tensor_driver.browser import markup
from cube_tensor_driver.config.package_data import find_package_data
from cube_tensor_driver.config.skin import read_skin
from cube_tensor_driver.core.reconstructor import Reconstructor
from cube_tensor_driver.core.rows import FrequencyRows, StressRows
from cube_tensor_driver.core.status import INVALID, RESIDUAL
from cube_tensor_driver.device.chain import LinkReport
from cube_tensor_driver.device.links.link import LinkState
from cube_tensor_driver.device.scans.row_counts import RowCounts
from cube_tensor_driver.processes.children import Children
from cube_tensor_driver.processes.skin_processes import RECORDED, list_skin_processes
from cube_tensor_driver.ros.callbacks import CallbackErrors
from cube_tensor_driver.ros.commands import record
from cube_tensor_driver.ros.commands.echo import resolve_topics
from cube_tensor_driver.ros.compat import make_executor, wrap_with_number
from cube_tensor_driver.ros.diagnostics import reconstruction
from cube_tensor_driver.ros.diagnostics.links import LinkDiagnostics
from cube_tensor_driver.ros.diagnostics.reconstruction import (
    LostMessages,
    ReconstructionDiagnostics,
)
from cube_tensor_driver.ros.diagnostics.updater import Diagnostics
from cube_tensor_driver.ros.nodes.driver import Driver

DEPTH = 10
SKIN = read_skin(find_package_data() / "config" / "skin_demo.yaml")


def pairs(status: DiagnosticStatus) -> dict[str, str]:
    return {pair.key: pair.value for pair in status.values}


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
        UInt32, "late", wrap_with_number(take), DEPTH, event_callbacks=lost.begin_subscription()
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


def test_a_publisher_that_begins_again_is_no_loss(monkeypatch):
    lost = LostMessages()
    for number in (5, 6, 7, 1, 2, 3, 6, 7, 8, 11, 12):
        lost.note_arrival(number)
    assert lost.count == 4
    assert lost.begin_subscription().message_lost is None, "which can block the node"
    monkeypatch.setattr(reconstruction, "has_message_numbers", lambda: False)
    events = lost.begin_subscription()
    for number in (40, 41, 44, 45):
        lost.note_arrival(number)
    assert lost.count == 6
    for total, count in ((1, 6), (5, 9)):
        events.message_lost(SimpleNamespace(total_count=total))
        assert lost.count == count, "the same losses, as DDS counts them"


def test_each_count_of_the_reconstruction_is_in_its_pair():
    lost = LostMessages()
    tare = SimpleNamespace(uids={}, describe_age=lambda: {"cubes tared": "4"})
    diagnostics = ReconstructionDiagnostics(SKIN, Reconstructor(SKIN), tare, lost)

    def step(numbers, status):
        for number in numbers:
            lost.note_arrival(number)
        blank = np.zeros((len(status), 9))
        diagnostics.count(
            StressRows.from_values(
                np.arange(len(status)), blank[:, :6], blank, status=np.array(status)
            )
        )
        (rows,) = diagnostics.make_statuses(False)[0]
        return (rows.level, rows.message.partition("; ")[2]), pairs(rows)

    def expected(rows, rows_per_second, invalid_rows, lost, refused):
        return {
            "rows": str(rows),
            "rows per second": str(rows_per_second),
            "invalid rows": str(invalid_rows),
            "messages lost on the way": str(lost),
            "messages that contradict themselves": str(refused),
            "cubes tared": "4",
        }

    said, values = step((5, 8, 9), [0, INVALID, RESIDUAL, INVALID | RESIDUAL, 0])
    assert said[0] == b"\1" and said[1].startswith("2 messages lost")
    assert values == expected(5, 5, 2, 2, 0)
    said, values = step((10,), [0, INVALID, 0])
    assert said == (b"\0", "") and values == expected(8, 3, 3, 2, 0)
    diagnostics.refused_messages = 7
    said, values = step((14, 15), [])
    assert said[0] == b"\1" and said[1].startswith("3 messages lost")
    assert values == expected(8, 0, 3, 5, 7)


def test_each_count_of_the_driver_is_in_its_pair():
    """Only what was lost since the last report is a problem now."""
    counts = RowCounts(
        delivered=100,
        unknown_cube=1,
        wrong_pads=2,
        unaccounted=0,
        duplicate=3,
        overload=4,
        lost=5,
        lost_reason="OSError()",
    )
    links = SimpleNamespace(count_rows=lambda: replace(counts))
    diagnostics = LinkDiagnostics("skin")

    def report():
        (rows,) = diagnostics.make_statuses(links, with_links=False)
        return (rows.level, rows.message), pairs(rows)

    said, values = report()
    assert said == (b"\2", "5 rows lost by an error: OSError()")
    assert values == {
        "rows published": "100",
        "rows per second": "100",
        "rows of unknown cubes": "1",
        "rows with another number of pads": "2",
        "rows that came twice": "3",
        "rows dropped by a slow host": "4",
        "rows lost by errors": "5",
        "rows unaccounted": "0",
    }
    counts.delivered, counts.overload = 140, 14
    said, values = report()
    assert said[0] == b"\1" and said[1].startswith("10 of 50 rows dropped since the last report")
    assert (values["rows published"], values["rows per second"]) == ("140", "40")
    assert report()[0] == (b"\0", "")
    counts.unaccounted = 6
    said, values = report()
    assert said[0] == b"\2" and said[1].startswith("6 rows are lost in the driver")
    assert values["rows unaccounted"] == "6"


def test_errors_of_callbacks_are_counted_in_the_first_status():
    """Those in both threads of the driver. Only new ones are a problem now."""
    errors = CallbackErrors(SimpleNamespace(get_logger=lambda: Mock()))
    links = SimpleNamespace(callback_errors=0)
    published = []
    node = Mock(spec=Driver, callback_errors=errors, is_configured=True, _links=links)
    node.count_errors = lambda: Driver.count_errors(node)
    node.create_publisher.return_value = SimpleNamespace(publish=published.append)
    node.resolve_topic_name.return_value = "/diagnostics"
    node.get_fully_qualified_name.return_value = "/driver"
    node.get_clock.return_value.now.return_value.to_msg.return_value = Time()
    Diagnostics(node, lambda: [DiagnosticStatus(name="rows"), DiagnosticStatus(name="link")])
    _, publish = node.create_timer.call_args.args

    def report():
        publish()
        rows, link = published[-1].status
        assert (rows.name, link.name, link.values) == ("/driver: rows", "/driver: link", [])
        return rows.level, rows.message, pairs(rows)["callback errors"]

    assert report() == (b"\0", "", "0")
    errors.catch(lambda: 1 / 0)()
    links.callback_errors = 2
    assert report() == (b"\2", "3 callbacks failed: see the log of the node", "3")
    assert report() == (b"\0", "", "3")


def test_an_inactive_node_says_so_and_blames_no_cube():
    reconstructor = Reconstructor(SKIN)
    tare = SimpleNamespace(uids={}, describe_age=dict)
    diagnostics = ReconstructionDiagnostics(SKIN, reconstructor, tare, LostMessages())
    rest = np.array([cube.calibration.rest_frequency for cube in SKIN.cubes])

    def texts(active: bool, second: int | None = None) -> list[str]:
        if second is not None:
            cubes = np.arange(len(SKIN.cubes))
            stamps = np.full(len(cubes), second * 1_000_000_000)
            reconstructor(
                FrequencyRows.from_values(cubes, rest.astype(np.float32), stamp_ns=stamps)
            )
        statuses, changes = diagnostics.make_statuses(active)
        assert not changes
        return [status.message for status in statuses]

    assert texts(True, 1) == [""]
    inactive = ["inactive: the node processes no rows until it is activated"]
    assert texts(False) == inactive and texts(False) == inactive
    # No rows in the second of the activation are no fault either.
    assert texts(True) == [""]
    assert texts(True, 5) == [""]


@pytest.mark.parametrize(
    ("states", "notes", "level"),
    [
        ([LinkState.OPEN], (), b"\0"),
        ([LinkState.OPEN], ("5 of 10 samples lost or dropped since the last report",), b"\1"),
        ([LinkState.WAITING], ("5 of 10 samples lost", "no port"), b"\2"),
        ([LinkState.SILENT], (), b"\3"),
        ([LinkState.OPEN, LinkState.WAITING, LinkState.CLOSED], ("no port",), b"\2"),
    ],
)
def test_losses_of_a_link_are_a_warning_and_coloured_on_the_page(states, notes, level):
    state, *past_states = states
    report = LinkReport("hub0", 0xAB, state, tuple(past_states), notes, {"lost_on_the_way": 5})
    links = SimpleNamespace(count_rows=RowCounts, report=lambda: [report])
    rows, link = LinkDiagnostics("skin").make_statuses(links, with_links=True)
    assert (rows.level, link.level) == (b"\0", level)
    assert (link.name, link.hardware_id) == ("link hub0", "0xab")
    assert pairs(link) == {"lost_on_the_way": "5"}
    assert link.message == "; ".join(notes) or state.value
    scan = SimpleNamespace(health=np.zeros(1, int), links=((link.message, link.level[0]),))
    html = markup.describe_conditions(["c"], scan)
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
    (driver,) = list_skin_processes(SINGLE)[1:]
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
        recorded = {status.name for status in find_last_diagnostics(bag)}
    assert recorded == {"/left/driver: rows", "/left/driver: link hub0"}
