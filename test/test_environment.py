"""Set-up: what is missing is said before any work, an interrupted step is done again, nothing is
left running."""

from __future__ import annotations

import os
import platform
import signal
import subprocess
import sys
import sysconfig
import threading
from pathlib import Path

import psutil
import pytest

from conftest import ROOT

sys.path.insert(0, str(ROOT / "tools"))
import environment


def test_missing_system_packages_are_named_with_the_command(monkeypatch):
    monkeypatch.setattr(
        environment.shutil, "which", lambda name: None if name in ("c++", "cmake") else "/usr/bin/x"
    )
    monkeypatch.setattr(
        environment.importlib.util,
        "find_spec",
        lambda name: None if name == "ensurepip" else object(),
    )
    monkeypatch.setattr(sysconfig, "get_paths", lambda: {"include": "/none"})
    python = f"python{sys.version_info.major}.{sys.version_info.minor}"
    with pytest.raises(environment.SetupError) as caught:
        environment.check_system()
    assert f"sudo apt install -y build-essential cmake {python}-venv {python}-dev" in str(
        caught.value
    )


@pytest.mark.parametrize(
    ("machine", "version"), [("aarch64", (3, 11)), ("x86_64", (3, 14)), ("x86_64", (3, 9))]
)
def test_a_platform_without_wheels_is_told_the_way_out(monkeypatch, machine, version):
    monkeypatch.setattr(platform, "machine", lambda: machine)
    monkeypatch.setattr(environment.sys, "version_info", (*version, 0))
    with pytest.raises(environment.SetupError) as caught:
        environment.check_system()
    assert f"{machine} with Python {version[0]}.{version[1]}" in str(caught.value)
    assert "install ROS 2 Jazzy or newer" in str(caught.value)


def test_which_sourced_ros_is_used(monkeypatch, capsys):
    monkeypatch.setenv("AMENT_PREFIX_PATH", "/opt/ros/x")
    monkeypatch.setattr(environment.shutil, "which", lambda name: "/usr/bin/colcon")
    monkeypatch.setattr(environment.importlib.util, "find_spec", lambda name: object())
    for distro, used in {"humble": False, "jazzy": True, "kilted": True, "rolling": True}.items():
        monkeypatch.setenv("ROS_DISTRO", distro)
        assert environment.sourced_ros() is used
    assert "humble is older than jazzy" in capsys.readouterr().err
    monkeypatch.delenv("ROS_DISTRO")
    assert not environment.sourced_ros()


def test_a_sourced_ros_that_lacks_something_is_told_how_to_get_it(monkeypatch):
    monkeypatch.setenv("AMENT_PREFIX_PATH", "/opt/ros/jazzy")
    monkeypatch.setenv("ROS_DISTRO", "jazzy")
    monkeypatch.setattr(environment.shutil, "which", lambda name: None)
    monkeypatch.setattr(
        environment.importlib.util, "find_spec", lambda name: None if name == "cobs" else object()
    )
    with pytest.raises(environment.SetupError) as caught:
        environment.sourced_ros()
    for word in (
        "missing: cobs, colcon",
        "rosdep install --from-paths",
        "python3-colcon-common-extensions",
    ):
        assert word in str(caught.value)


def test_an_older_ros_leaves_no_trace_in_the_private_environment(monkeypatch):
    monkeypatch.setenv("ROS_DISTRO", "humble")
    monkeypatch.setenv("AMENT_PREFIX_PATH", "/opt/ros/humble")
    monkeypatch.setenv("PYTHONPATH", "/opt/ros/humble/lib")
    monkeypatch.setenv("COLCON_PREFIX_PATH", "/opt/ros/humble")
    assert "humble" not in " ".join(environment.private_variables().values())


def test_a_step_is_done_again_until_it_succeeded_with_these_inputs(tmp_path):
    stamp = tmp_path / "s"
    with pytest.raises(KeyboardInterrupt), environment.step(stamp, "a") as needed:
        assert needed
        raise KeyboardInterrupt
    for value, expected in (("a", True), ("a", False), ("b", True), ("b", False)):
        with environment.step(stamp, value) as needed:
            assert needed is expected


def test_a_failed_step_shows_the_end_of_its_log(tmp_path):
    log = tmp_path / "log"
    with pytest.raises(environment.SetupError) as caught:
        environment.run(
            [sys.executable, "-c", "print('the reason'); exit(3)"], dict(os.environ), log
        )
    assert (
        "code 3" in str(caught.value)
        and "the reason" in str(caught.value)
        and str(log) in str(caught.value)
    )


def test_an_interrupted_step_leaves_no_process(tmp_path):
    # A step with a child of its own that ignores SIGTERM, as compilers under colcon may.
    grandchild = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print('up', flush=True); time.sleep(600)"
    child = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {grandchild!r}])"
    script = (
        f"import sys, signal; sys.path.insert(0, {str(ROOT / 'tools')!r})\n"
        "import environment; from pathlib import Path\n"
        "signal.signal(signal.SIGTERM, environment.interrupt)\n"
        f"environment.run([sys.executable, '-c', {child!r}], {{}},"
        f" Path({str(tmp_path / 'log')!r}),"
        " lambda line: print(line, end='', flush=True))"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", script], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    watchdog = threading.Timer(30, process.kill)
    watchdog.start()
    try:
        assert process.stdout.readline() == "up\n"
        family = psutil.Process(process.pid).children(recursive=True)
        assert len(family) == 2
        process.send_signal(signal.SIGTERM)
        process.wait(10)
        _, alive = psutil.wait_procs(family, timeout=5)
        assert not alive
    finally:
        watchdog.cancel()


def test_help_needs_no_environment(tmp_path):
    done = subprocess.run(
        [ROOT / "cube", "--help"],
        capture_output=True,
        text=True,
        check=False,
        env={"PATH": os.environ["PATH"]},
    )
    assert done.returncode == 0
    for command in ("demo", "test", "lint", "exec"):
        assert f"\n    {command} " in done.stdout


def test_no_python_is_said_with_the_way_out(tmp_path):
    for name in ("sh", "dirname", "readlink", "cat"):
        (tmp_path / name).symlink_to(
            Path("/bin") / name if Path("/bin", name).exists() else Path("/usr/bin") / name
        )
    done = subprocess.run(
        [ROOT / "cube", "demo"],
        capture_output=True,
        text=True,
        check=False,
        env={"PATH": str(tmp_path)},
    )
    assert done.returncode == 1
    assert "no Python 3.10 to 3.13 found" in done.stderr and "sudo apt install" in done.stderr
