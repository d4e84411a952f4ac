# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""A short torture: the whole chain in real processes under a mix of faults, checked to the last
sample and bit; and mutations of it that the checks must find."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import time
from contextlib import nullcontext
from types import SimpleNamespace

import pytest

from conftest import ROOT, encoded, stamped

pytest.importorskip("rclpy", reason="needs rclpy: run this with ./cube test")

from cube_tensor_driver.messages.codec import frequency_codec
from cube_tensor_driver.msg import SkinFrequencies
from cube_tensor_driver.processes import domain
from workshop.torture.actions import Actions
from workshop.torture.mutations import MUTATIONS, edit_source
from workshop.torture.recorder import TopicLog
from workshop.torture.torture import LIMITS, find_failures


def run(tmp_path, *arguments, seconds):
    """What `./cube torture` writes with these arguments, and what it says."""
    path = tmp_path / "torture.json"
    command = [sys.executable, "-m", "cube_tensor_driver.cli", "torture", "--json", str(path)]
    process = subprocess.Popen(
        [*command, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        cwd=ROOT,
    )
    try:
        output, _ = process.communicate(timeout=seconds)
    finally:
        process.kill()
    assert path.exists(), output
    return json.loads(path.read_text()), output


@pytest.mark.alone
@pytest.mark.campaign
def test_a_tortured_skin_loses_nothing_uncounted_and_says_nothing_wrong(tmp_path, effort):
    duration = 10 * effort
    result, output = run(tmp_path, "--duration", str(duration), "--seed", "1", seconds=150 * effort)
    # In 10 s one stall of a busy machine is a tenth of the stamps: only longer runs check the tail.
    tail = {"stamp_error_p90_ms", "stamp_error_p99_ms"} if effort == 1 else set()
    assert set(find_failures(result)) <= tail, output
    assert result["samples_sent"] > 32 * 300 * duration and result["counted"] > 0
    assert result["faults_to_flag"] >= 3 and result["actions"]["tare"]


@pytest.mark.alone
def test_a_mutation_is_caught_in_a_short_torture():
    """The frequencies are 1 ppm too high."""
    code = (
        "import threading\n"
        "from workshop.torture.torture import find_failures, torture\n"
        "print(*find_failures(torture(2.0, 1, threading.Event(), 'scaled')))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, timeout=120
    )
    assert "wrong" in done.stdout.split(), done.stderr


@pytest.mark.alone
@pytest.mark.campaign
def test_mutations_are_caught(tmp_path, effort):
    if effort == 1:
        pytest.skip("half an hour: ./cube test -m campaign")
    result, output = run(tmp_path, "--mutate", "all", "--seed", "1", seconds=7200)
    assert [name for name, found in result["mutations"].items() if not found["caught"]] == [], (
        output
    )


@pytest.mark.parametrize("name", MUTATIONS)
def test_each_mutation_can_be_put_into_a_process(name):
    """The text to edit is there once, and the edited file is Python."""
    for edit in MUTATIONS[name].edits:
        source = (ROOT / "cube_tensor_driver" / edit["file"]).read_text()
        assert compile(edit_source(source, edit), edit["file"], "exec")


def test_a_mutated_module_is_the_one_that_others_import():
    code = (
        "from workshop.torture.mutations import MUTATIONS, import_mutated\n"
        "import_mutated(MUTATIONS['losses unseen'].edits)\n"
        "from cube_tensor_driver.ros import node, qos\n"
        "from cube_tensor_driver.ros.diagnostics.reconstruction import LostMessages\n"
        "assert qos.make_batch_profile(1000.0).depth == 100\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_torture_has_a_domain_of_its_own(monkeypatch):
    """Where another skin ran in its domain, it ended with an IndexError."""
    monkeypatch.setenv("ROS_DOMAIN_ID", "42")
    with domain.use_own_domain() as one, domain.use_own_domain() as other:
        assert os.environ["ROS_DOMAIN_ID"] == str(other)
        assert len({42, one, other}) == 3
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as participant:
            # The first participant of the domain that would come next (DDSI-RTPS 9.6.2).
            participant.bind(("", 7400 + 250 * (other - 1) + 10))
            with domain.use_own_domain() as third:
                assert third < other - 1
    assert os.environ["ROS_DOMAIN_ID"] == "42"


def test_faults_wait_for_every_cube():
    """On a busy machine, two scans of one of two hubs came as one message, of as many rows as there
    are cubes. Faults then hit the first samples of the other hub, which nobody can count."""
    messages = []

    info = {"publication_sequence_number": 1, "source_timestamp": 0}

    def take_message(*_):
        return (messages.pop(), info) if messages else None

    handle = nullcontext()
    handle.take_message = take_message
    node = SimpleNamespace(create_subscription=lambda *_, **__: SimpleNamespace(handle=handle))
    skin = SimpleNamespace(parent_frame="skin", cubes=range(4))
    log = TopicLog(node, SkinFrequencies, "frequencies", None, frequency_codec, skin)
    assert not log.has_every_cube()
    for cubes, is_complete in (([0, 1, 0, 1], False), ([0, 1, 2, 3], True), ([2, 3], False)):
        messages.append(encoded(stamped(cubes, [[1.0]] * len(cubes), 0, 1), b"skin\0"))
        log.take()
        assert log.has_every_cube() == is_complete, cubes


def test_a_restart_of_the_driver_begins_when_the_last_one_is_dead(monkeypatch):
    """What it had taken before came later, and would end the gap between the two."""
    dead_ns = []

    def kill(_):
        dead_ns.append(time.time_ns())

    node = SimpleNamespace(
        create_client=lambda *_: None, get_publishers_info_by_topic=lambda topic: []
    )
    observer = SimpleNamespace(node=node, spin=lambda *_: None)
    children = SimpleNamespace(kill=kill, start=lambda _: None)
    monkeypatch.setattr(Actions, "_activate_driver", lambda *_: True)
    monkeypatch.setattr(Actions, "_wait_for_stress", lambda _: (True, ""))
    actions = Actions(observer, children, {"driver": None}, None, None, lambda: None)
    actions.do({"action": "restart driver"}, 0.0)
    assert actions.done[0].begin_ns >= dead_ns[0]


def test_limits_of_the_figures():
    good = dict.fromkeys(LIMITS, 0)
    assert find_failures(good) == []
    assert find_failures({**good, "lost": 1, "stamp_error_p50_ms": 0.8}) == [
        "lost",
        "stamp_error_p50_ms",
    ]
    assert find_failures({**good, "rss_slope_mb_per_min": None}) == []
