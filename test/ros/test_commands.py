# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""./cube tare and its neighbours, which need no ros2: with one simulated skin that runs for all
tests, and with none."""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import subprocess
import sys
import tempfile
import threading
import time
import types

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs rclpy: run this with ./cube test")

from played_hub import PlayedHub, greeting
from serial.tools import list_ports

from conftest import free_domain
from cube_tensor_driver.cli.echo import encode_reading, format_reading
from cube_tensor_driver.cli.main import BROKEN_PIPE, main
from cube_tensor_driver.config.grid import describe_grid
from cube_tensor_driver.config.yaml import parse_yaml, write_yaml
from cube_tensor_driver.core.modes import GRADIENT, STRESS
from cube_tensor_driver.device.wire.protocol import Command
from cube_tensor_driver.processes.children import Children
from cube_tensor_driver.processes.skin_processes import SimulatedHubs, list_skin_processes
from cube_tensor_driver.ros.commands.echo import StressReading

pytestmark = pytest.mark.xdist_group("ros commands")
STILL = {
    "indenters": [
        {
            "name": "weight",
            "shape": "disc",
            "radius": 0.006,
            "does": [{"press": {"from": 0.0, "to": 3600.0, "at": [0, 0, 0], "force": [1.0, 1.0]}}],
        }
    ]
}
"""1 N on the middle, for an hour."""


@pytest.fixture(scope="module")
def skin(tmp_path_factory):
    """A skin of two cubes, c0 and c1, under a load that does not change; gives the folder of
    its ports."""
    folder = tmp_path_factory.mktemp("skin")
    write_yaml(folder / "skin.yaml", describe_grid(nx=2, ny=1, pitch=0.012, links=1, rate=50.0))
    write_yaml(folder / "load.yaml", STILL)
    hubs = SimulatedHubs(folder / "ports", load=folder / "load.yaml")
    with free_domain(), pytest.MonkeyPatch.context() as patch, Children(folder) as children:
        patch.setenv("ROS_HOME", str(folder))
        for process in list_skin_processes(folder / "skin.yaml", composed=True, simulated=hubs):
            children.start(process)
        children.wait_for_line("composed", "with 2 cubes", 30.0)
        yield folder / "ports"
        children.check()


@pytest.fixture(autouse=True)
def signals():
    """Commands that end by Ctrl-C catch it themselves."""
    names = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = [signal.getsignal(name) for name in names]
    yield
    for name, handler in zip(names, before, strict=True):
        signal.signal(name, handler)


@pytest.fixture
def nobody(domain, monkeypatch):
    """A domain without a skin, where commands do not wait as long as they would."""
    monkeypatch.setattr("cube_tensor_driver.ros.commands.services.MAX_DISCOVERY_S", 0.5)
    monkeypatch.setattr("cube_tensor_driver.ros.commands.services.ANNOUNCE_S", 0.5)
    return domain


def test_tare_is_done_or_refused_in_words(skin, capfd):
    assert main(["tare", "nope"]) == 1
    captured = capfd.readouterr()
    assert not captured.out
    assert captured.err == (
        "cube: /reconstruction: tare refused: no cube 'nope' in the skin; its cubes: c0, c1\n"
    )
    wait_for_tare(capfd)
    assert main(["tare", "c1"]) == 0
    assert "tare done: 1 cubes, rest frequencies moved by up to " in capfd.readouterr().out
    assert main(["tare", "--clear"]) == 0
    assert "clearing the tare done: rest freq" in capfd.readouterr().out


def wait_for_tare(capfd):
    """The skin has just started: there are data enough after a second or two."""
    for _ in range(10):
        if main(["tare"]) == 0:
            break
    said = capfd.readouterr()
    assert "/reconstruction: tare done: 2 cubes" in said.out, said.err


def test_without_a_skin_tare_says_that_in_one_line(nobody, capfd):
    assert main(["tare"]) == 1
    said = capfd.readouterr().err
    assert said == (
        f"cube: no reconstruction runs in DDS domain {nobody}; "
        "start ./cube demo or the launch file\n"
    )


def test_tare_clears_all_cubes_or_none(capfd):
    assert main(["tare", "c1", "--clear"]) == 1
    assert "leave out their names" in capfd.readouterr().err


def test_a_reading_as_a_line_and_as_json():
    stress = dict.fromkeys(STRESS, np.nan) | {"zz": -1234.56, "zx": 7.0}
    gradient = dict.fromkeys(GRADIENT, np.nan) | {"zz_z": 3e5}
    reading = StressReading(12_345_000_000, "c05", stress, gradient, np.nan, status=1 | 16)
    assert format_reading(reading) == (
        "12.345 s  c05  zz   -1234.6  zx       7.0 Pa  zz_z     300000 Pa/m  PAD_FAULT, pad open"
    )
    read = json.loads(encode_reading(reading))
    assert read["stress_pa"] == dict.fromkeys(["xx", "yy", "yz", "xy"]) | {"zz": -1234.56, "zx": 7}
    assert read["gradient_pa_per_m"]["zz_z"] == 3e5 and read["residual"] is None
    assert read["status"] == ["PAD_FAULT", "pad open"] and read["stamp_ns"] == 12_345_000_000


def test_echo_of_a_skin_has_a_line_per_cube_with_names_and_units(skin, capfd):
    assert main(["echo", "stress", "--once"]) == 0
    lines = capfd.readouterr().out.splitlines()
    assert [line.split()[2] for line in lines] == ["c0", "c1"]
    assert all(" Pa  " in line and " Pa/m  " in line for line in lines)


def test_echo_of_one_cube_as_json(skin, capfd):
    assert main(["echo", "/cubes/c1/stress", "--once", "--json"]) == 0
    [line] = capfd.readouterr().out.splitlines()
    read = json.loads(line)
    assert read["cube"] == "c1" and read["status"] == []
    assert abs(read["stamp_ns"] * 1e-9 - time.time()) < 30


def test_echo_of_other_topics_is_yaml_or_json(skin, capfd):
    assert main(["echo", "info", "--once"]) == 0
    said = capfd.readouterr().out
    assert said.endswith("---\n")
    assert parse_yaml(said.removesuffix("---\n"), "echo")["cubes"][1]["name"] == "c1"
    assert main(["echo", "/diagnostics", "--once", "--json"]) == 0
    assert json.loads(capfd.readouterr().out)["status"][0]["level"] in (0, 1, 2, 3)


def test_echo_ends_well_by_ctrl_c_and_when_its_reader_has_enough(skin):
    command = [sys.executable, "-m", "cube_tensor_driver.cli", "echo", "stress"]
    for how, code in (("ctrl-c", 0), ("reader", BROKEN_PIPE)):
        with subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        ) as process:
            assert " c0 " in process.stdout.readline()
            if how == "ctrl-c":
                os.kill(process.pid, signal.SIGINT)
                process.stdout.read()
            else:
                process.stdout.close()
            assert process.stderr.read() == "" and process.wait(10) == code, how


def test_echo_of_nothing_says_so_in_one_line(nobody, capfd):
    assert main(["echo", "cubes/c05/stress", "--once"]) == 1
    assert capfd.readouterr().err == (
        f"cube: nobody publishes /cubes/c05/stress in DDS domain {nobody}; "
        "./cube topics lists what there is\n"
    )
    assert main(["echo", "bad topic"]) == 1
    assert "topic 'bad topic', allowed: " in capfd.readouterr().err


def test_topics_are_listed_with_rate_and_type(skin, capfd):
    assert main(["topics"]) == 0
    lines = [line.split(maxsplit=3) for line in capfd.readouterr().out.splitlines()]
    listed = {name: (float(rate), kind) for name, rate, _, kind in lines}
    assert listed["/info"] == (0, "cube_tensor_driver/msg/SkinInfo")
    rate, kind = listed["/stress"]
    assert 25 < rate < 75 and kind == "cube_tensor_driver/msg/SkinStress"
    rate, kind = listed["/cubes/<name>/stress"]
    assert 25 < rate < 75
    assert kind == "cube_tensor_driver/msg/StressTensorStamped, 2 cubes: c0, c1"
    assert {"/cubes/<name>/wrench", "/diagnostics"} <= listed.keys()


def test_no_topics_is_said_in_one_line(nobody, capfd):
    assert main(["topics"]) == 1
    assert capfd.readouterr().err == (
        f"cube: nobody publishes in DDS domain {nobody}; start ./cube demo or a skin\n"
    )


@pytest.fixture
def ports(tmp_path, monkeypatch):
    """The folder for ports of a demo on a machine that has no others."""
    folder = tmp_path / "cube_demo_x" / "ports"
    folder.mkdir(parents=True)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(list_ports, "comports", lambda: [])
    return folder


def test_ports_that_answer_are_silent_or_busy_are_told_apart(skin, ports, capfd):
    hub, silent = PlayedHub(ports, "a"), PlayedHub(ports, "b")
    (ports / "c").symlink_to((skin / "hub0").resolve())

    def answer():
        select.select([hub.fd], [], [], 10)  # it has been asked
        hub.send(greeting())

    thread = threading.Thread(target=answer)
    thread.start()
    try:
        assert main(["ports"]) == 0
        asked = hub.listen(), silent.listen()
    finally:
        thread.join()
        hub.close()
        silent.close()
    lines = capfd.readouterr().out.splitlines()
    a, b, c = (str(ports / name) for name in "abc")
    assert lines[0] == f"{a} (demo): hub 0xab, 1 cubes of 8 pads, 100 Hz, firmware 0x1"
    assert lines[1] == f"{b} (demo): no answer within 1 s; not a hub, or no power"
    assert lines[2].startswith(c) and "another program has it open" in lines[2]
    assert asked == ([Command.HELLO], [Command.HELLO])


def test_no_port_is_said_in_one_line(ports, capfd):
    assert main(["ports"]) == 1
    assert capfd.readouterr().err == (
        "cube: no serial port on this machine; plug a hub in, or start ./cube demo\n"
    )


def test_parameters_are_listed_read_and_set(skin, capfd):
    assert main(["param"]) == 0
    assert capfd.readouterr().out.splitlines() == ["/driver", "/reconstruction"]
    assert main(["param", "reconstruction"]) == 0
    assert "\ntare_duration: " in capfd.readouterr().out
    assert main(["param", "/reconstruction", "use_sim_time"]) == 0
    assert capfd.readouterr().out == "use_sim_time: false\n"
    assert main(["param", "reconstruction", "tare_duration", "2"]) == 0  # of a real number
    assert capfd.readouterr().out == "tare_duration: 2.0\n"
    assert main(["param", "reconstruction", "tare_duration", "1.5"]) == 0
    assert capfd.readouterr().out == "tare_duration: 1.5\n"


def test_parameters_that_are_not_there_or_refused_are_said(skin, capfd):
    assert main(["param", "nope"]) == 1
    assert "no node /nope in DDS domain" in capfd.readouterr().err
    assert main(["param", "reconstruction", "nope"]) == 1
    assert "/reconstruction has no parameter nope; it has: " in capfd.readouterr().err
    assert main(["param", "reconstruction", "tare_duration", "banana"]) == 1
    assert "tare_duration is not set to banana: needed is a number" in capfd.readouterr().err


def test_parameters_of_nobody(nobody, capfd):
    # A process of an earlier test in this domain may still be ending.
    until = time.monotonic() + 20
    while main(["param"]) != 1:
        assert time.monotonic() < until
    assert "no node runs in DDS domain" in capfd.readouterr().err


def test_nodes_that_are_found_late_are_listed_too(monkeypatch):
    """Each of three comes a little later than the one before, as on a busy machine."""
    from cube_tensor_driver.ros.commands import services

    monkeypatch.setattr(services, "SETTLE_S", 0.02)
    rounds: list[int] = []
    executor = types.SimpleNamespace(spin_once=lambda timeout_sec: rounds.append(1))

    def found() -> list[str]:
        return ["/demo", "/driver", "/reconstruction"][: len(seen)]

    seen: list[list[str]] = []
    assert services.discover(executor, lambda: seen.append(found()) or seen[-1])
    assert seen[-1] == ["/demo", "/driver", "/reconstruction"] and rounds


def test_a_list_of_nodes_waits_until_lost_announcements_are_repeated(monkeypatch):
    """The second node is found when the first one has long been known and nothing has changed."""
    from cube_tensor_driver.ros.commands import services

    monkeypatch.setattr(services, "SETTLE_S", 0.02)
    monkeypatch.setattr(services, "ANNOUNCE_S", 0.3)
    begin = time.monotonic()

    def found() -> list[tuple[str, list[str]]]:
        nodes = ["/driver", "/reconstruction"][: 1 if time.monotonic() < begin + 0.2 else 2]
        return [
            (f"{name}/list_parameters", ["rcl_interfaces/srv/ListParameters"]) for name in nodes
        ]

    node = types.SimpleNamespace(
        get_service_names_and_types=found, get_fully_qualified_name=lambda: "/parameters"
    )
    executor = types.SimpleNamespace(spin_once=lambda timeout_sec: None)
    session = contextlib.nullcontext(services.NodeSession(node, executor))
    monkeypatch.setattr(services, "run_node_session", lambda _: session)
    assert services.list_nodes() == ["/driver", "/reconstruction"]
