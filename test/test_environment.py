# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
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
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import psutil
import pytest

from conftest import ROOT
from cube_tensor_driver.cli.main import main
from cube_tensor_driver.cli.table import COMMANDS
from cube_tensor_driver.config.grid import describe_grid
from cube_tensor_driver.config.yaml import write_yaml

sys.path.insert(0, str(ROOT / "tools"))
import environment

MODULES = [
    path
    for path in ROOT.glob("*/cli/*.py")
    if path.stem not in ("__init__", "__main__", "main", "parser", "table")
]
CAPTURED = {"capture_output": True, "text": True, "check": False}


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
    ("machine", "version"), [("aarch64", (3, 11)), ("x86_64", (3, 15)), ("x86_64", (3, 9))]
)
def test_a_platform_without_wheels_is_told_the_way_out(monkeypatch, machine, version):
    monkeypatch.setattr(platform, "machine", lambda: machine)
    monkeypatch.setattr(environment.sys, "version_info", (*version, 0))
    with pytest.raises(environment.SetupError) as caught:
        environment.check_system()
    assert f"{machine} with Python {version[0]}.{version[1]}" in str(caught.value)
    assert "install ROS 2 Humble or newer" in str(caught.value)


def test_which_sourced_ros_is_used(monkeypatch, capsys):
    monkeypatch.setenv("AMENT_PREFIX_PATH", "/opt/ros/x")
    monkeypatch.setattr(environment.shutil, "which", lambda name: "/usr/bin/colcon")
    monkeypatch.setattr(environment.importlib.util, "find_spec", lambda name: object())
    for distro, used in {"foxy": False, "humble": True, "jazzy": True, "rolling": True}.items():
        monkeypatch.setenv("ROS_DISTRO", distro)
        assert environment.has_sourced_ros() is used
    assert "foxy is older than humble" in capsys.readouterr().err
    monkeypatch.delenv("ROS_DISTRO")
    assert not environment.has_sourced_ros()


@pytest.mark.parametrize("words", ["--distro kilted demo", "--distro=kilted demo"])
def test_a_distribution_is_named_in_front_of_the_command(monkeypatch, words):
    monkeypatch.delenv(environment.DISTRO_VARIABLE, raising=False)
    assert environment.split_distro(["demo", "--distro", "kilted"])[0] == ""
    assert environment.split_distro(words.split()) == ("kilted", ["demo"])
    monkeypatch.setenv(environment.DISTRO_VARIABLE, "kilted")
    assert environment.split_distro(["demo"]) == ("kilted", ["demo"])
    assert environment.split_distro(["--distro", "jazzy", "demo"]) == ("jazzy", ["demo"])


def test_a_sourced_ros_that_lacks_something_is_told_how_to_get_it(monkeypatch):
    monkeypatch.setenv("AMENT_PREFIX_PATH", "/opt/ros/jazzy")
    monkeypatch.setenv("ROS_DISTRO", "jazzy")
    monkeypatch.setattr(environment.shutil, "which", lambda name: None)
    monkeypatch.setattr(
        environment.importlib.util, "find_spec", lambda name: None if name == "numpy" else object()
    )
    with pytest.raises(environment.SetupError) as caught:
        environment.has_sourced_ros()
    for word in (
        "missing: numpy, colcon",
        "rosdep install --from-paths",
        "python3-colcon-common-extensions",
    ):
        assert word in str(caught.value)


def test_an_older_ros_leaves_no_trace_in_the_private_environment(monkeypatch):
    monkeypatch.setenv("ROS_DISTRO", "humble")
    monkeypatch.setenv("AMENT_PREFIX_PATH", "/opt/ros/humble")
    monkeypatch.setenv("PYTHONPATH", "/opt/ros/humble/lib")
    monkeypatch.setenv("COLCON_PREFIX_PATH", "/opt/ros/humble")
    assert "humble" not in " ".join(environment.make_private_variables(Path("/x")).values())


def test_a_step_is_done_again_until_it_succeeded_with_these_inputs(tmp_path):
    stamp = tmp_path / "s"
    with pytest.raises(KeyboardInterrupt), environment.step(stamp, "a") as needed:
        assert needed
        raise KeyboardInterrupt
    for value, expected in (("a", True), ("a", False), ("b", True), ("b", False)):
        with environment.step(stamp, value) as needed:
            assert needed is expected


def test_an_environment_of_another_folder_is_seen(tmp_path):
    venv = tmp_path / "a" / "venv"
    (venv / "bin").mkdir(parents=True)
    assert not environment.is_made_here(venv)
    (venv / "bin" / "pip").write_text(f"#!{venv}/bin/python3\nimport pip\n")
    assert environment.is_made_here(venv)
    (tmp_path / "link").symlink_to(venv)
    assert environment.is_made_here(tmp_path / "link")
    (tmp_path / "a").rename(tmp_path / "b")
    assert not environment.is_made_here(tmp_path / "b" / "venv")


def test_what_was_built_in_another_folder_is_built_again(tmp_path):
    source, package = tmp_path / "src" / "package", tmp_path / "build" / "package"
    for folder, stays in ((source, True), (Path("/elsewhere/src/package"), False)):
        package.mkdir(parents=True, exist_ok=True)
        (tmp_path / "install").mkdir(exist_ok=True)
        line = f"CMAKE_HOME_DIRECTORY:INTERNAL={folder}\n"
        (package / "CMakeCache.txt").write_text(f"# a cache\n{line}")
        environment.remove_foreign_build(tmp_path, source)
        assert package.exists() is (tmp_path / "install").exists() is stays
    environment.remove_foreign_build(tmp_path, source)


def test_a_folder_of_another_user_is_one_line(monkeypatch, capsys):
    def refuse(distro):
        raise PermissionError(13, "Permission denied", "/x/.cube/lock")

    monkeypatch.setattr(environment, "prepare", refuse)
    assert environment.main(["exec", "true"]) == 1
    line = capsys.readouterr().err
    assert line.count("\n") == 1 and "/x/.cube/lock cannot be written" in line
    assert "belongs to user" in line


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
    grandchild = (
        "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN);"
        "print('up', flush=True); time.sleep(600)"
    )
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


def bare(*arguments: str, columns: int = 80) -> subprocess.CompletedProcess[str]:
    """As on a fresh clone: without site-packages, and where set-up could not even begin."""
    script = (
        "import sys\n"
        f"sys.path.insert(0, {str(ROOT / 'tools')!r})\n"
        "import environment\n"
        "environment.prepare = None\n"
        "sys.exit(environment.main(sys.argv[1:]))"
    )
    return subprocess.run(
        [sys.executable, "-I", "-S", "-c", script, *arguments],
        capture_output=True,
        text=True,
        check=False,
        env={"PATH": os.environ["PATH"], "COLUMNS": str(columns)},
    )


def test_distro_without_the_checkout_is_refused(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["--distro", "kilted", "demo"])
    assert ended.value.code == 2 and "an option of ./cube" in capsys.readouterr().err


@pytest.mark.parametrize("arguments", [[], ["--help"], ["-h"], ["help"]], ids=" ".join)
def test_help_lists_every_command_without_the_environment(arguments):
    done = bare(*arguments)
    assert done.returncode == 0 and not done.stderr
    for command in COMMANDS:
        assert f"\n  {command} " in done.stdout
    assert {f"{path.stem}" for path in MODULES} == set(COMMANDS)


@pytest.mark.parametrize("columns", [60, 80, 120])
def test_help_is_readable(columns, monkeypatch, capsys):
    """Of every command no line is wider than the terminal, however wide that is."""
    monkeypatch.setenv("COLUMNS", str(columns))
    for words in ([], *([name] for name in COMMANDS), ["config", "grid"], ["bench", "scale"]):
        with pytest.raises(SystemExit) as ended:
            main([*words, "--help"])
        lines = capsys.readouterr().out.splitlines()
        assert ended.value.code == 0 and lines[0].startswith(" ".join(["usage: ./cube", *words]))
        assert max(map(len, lines)) <= min(columns, 100), words


def test_help_of_every_command_needs_no_environment():
    script = (
        "from cube_tensor_driver.cli.main import parse\n"
        f"for name in {list(COMMANDS)}:\n"
        "    try: parse([name, '--help'])\n"
        "    except SystemExit as ended: assert ended.code == 0\n"
    )
    done = subprocess.run([sys.executable, "-S", "-c", script], cwd=ROOT, env={}, **CAPTURED)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("usage: ./cube ") == len(COMMANDS)


def test_help_of_a_command_in_three_ways():
    texts = [bare(*words.split()).stdout for words in ("demo --help", "demo -h", "help demo")]
    assert "--duration S" in texts[0] and len(set(texts)) == 1


def test_version_is_that_of_the_package():
    version = ElementTree.parse(ROOT / "package.xml").findtext("version")
    assert bare("--version").stdout == f"cube_tensor_driver {version}\n"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("dmo", "unknown command dmo; did you mean demo?"),
        ("--versoin", "unknown option --versoin; did you mean --version?"),
        ("demo --cubs 3", "demo: unknown option --cubs; did you mean --cubes?"),
        ("record --outptu x", "record: unknown option --outptu; did you mean --output?"),
        ("record", "record: the following arguments are required: -o/--output"),
        ("config", "config: one of these has to follow: grid, check"),
        ("config gird", "config: unknown command gird; did you mean grid?"),
        ("bench skin --rat x", "bench skin: --rate: 'x' is not a rate from 0.1 to 10000"),
        ("demo --rate 1e9", "demo: --rate: '1e9' is not a rate from 0.1 to 10000 samples"),
        ("demo --cubes -1", "demo: --cubes: '-1' is not a whole number of at least 1"),
        ("demo --duration inf", "demo: --duration: 'inf' is not a number above 0"),
        ("reprocess x -o y --jobs -1", "--jobs: '-1' is not a whole number of at least 1"),
        ("torture --seed -1", "--seed: '-1' is not a whole number of at least 0"),
        ("replay x --start -1", "--start: '-1' is not a number of at least 0"),
        ("plot x -o y --from nan", "--from: 'nan' is not a finite number"),
        ("view --port 99999", "--port: '99999' is not a TCP port, 1 to 65535"),
        ("fit x --layout cube -o y --uid 0xg", "--uid: '0xg' is not a uid, 0 to 2^64 - 1"),
        ("urdf a b", "urdf: unrecognized arguments: b"),
        ("exec", "exec: name a command to run"),
        ("--distro humble demo", "--distro humble: there are wheels of jazzy and kilted"),
        ("--distor kilted demo", "unknown option --distor; did you mean --distro?"),
    ],
)
def test_a_usage_error_is_short_and_needs_no_environment(arguments, said):
    done = bare(*arguments.split())
    assert done.returncode == 2 and not done.stdout
    assert done.stderr.startswith("cube: ") and said in done.stderr
    assert done.stderr.count("\n") <= 2 and "usage" not in done.stderr


@pytest.mark.parametrize("words", ["--help", "urdf {skin}", "layout planar --figure {figure}"])
def test_a_full_disk_is_one_line(words, tmp_path):
    skin, figure = ROOT / "config" / "skin_demo.yaml", tmp_path / "planar.png"
    command = [sys.executable, "-m", "cube_tensor_driver.cli"]
    command += words.format(skin=skin, figure=figure).split()
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert (done.returncode, done.stderr) == (1, "cube: stdout: No space left on device\n")


def test_set_up_reports_its_progress_without_a_terminal(tmp_path, capsys):
    lock = tmp_path / "lock"
    lock.write_text("".join(f"wheel{number}==1\n" for number in range(60)))
    with environment.show_pip_progress(lock) as on_line:
        for number in range(60):
            on_line(f"Collecting wheel{number}")
        on_line("Installing collected packages")
    assert capsys.readouterr().err.splitlines() == [
        "cube: 25 of 60 wheels",
        "cube: 50 of 60 wheels",
        "cube: installing them",
    ]


@pytest.mark.parametrize("words", ["--help", "urdf {skin}"])
def test_a_reader_that_has_enough_is_no_error(words, tmp_path):
    skin = tmp_path / "skin.yaml"
    write_yaml(skin, describe_grid(nx=20, ny=20, pitch=0.01, links=1, rate=100.0))
    command = f"{sys.executable} -m cube_tensor_driver.cli {words.format(skin=skin)} | head -c 5"
    done = subprocess.run(["bash", "-c", command], **CAPTURED)
    assert len(done.stdout) == 5 and not done.stderr
    # The exit code of a program that SIGPIPE has ended, as other programs are.
    command = command.partition("|")[0] + "| true; exit ${PIPESTATUS[0]}"
    assert subprocess.run(["bash", "-c", command], **CAPTURED).returncode in (0, 141)


def test_exec_becomes_the_command():
    command = [sys.executable, "-m", "cube_tensor_driver.cli", "exec"]
    done = subprocess.run([*command, "sh", "-c", "echo $0 -x; exit 7"], **CAPTURED)
    assert (done.returncode, done.stdout) == (7, "sh -x\n")
    done = subprocess.run([*command, "no-such-command"], **CAPTURED)
    assert done.returncode == 127 and "no-such-command: No such file" in done.stderr
    # As below any shell: a reader that has enough ends the writer.
    done = subprocess.run([*command, "sh", "-c", "yes | head -n 1"], **CAPTURED)
    assert (done.stdout, done.stderr) == ("y\n", "")


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
    assert "no Python 3.10 to 3.14 found" in done.stderr and "sudo apt install" in done.stderr


@pytest.mark.parametrize(
    ("module", "words", "remedy"),
    [
        ("rosbags", ["bag", "info", "."], "pip install rosbags\n"),
        ("rich", ["bag", "info", "."], "pip install rich, or sudo apt install python3-rich\n"),
        (
            "matplotlib",
            ["plot", "x", "-o", "x.png"],
            "pip install matplotlib, or sudo apt install python3-matplotlib\n",
        ),
        ("rclpy", ["topics"], "run it as ./cube, or source a workspace"),
    ],
)
def test_a_command_whose_library_is_missing_names_it(module, words, remedy):
    """Only some commands need these libraries, so a robot may be without them."""
    script = f"""
import sys
sys.modules[{module!r}] = None
from cube_tensor_driver.cli.main import main
sys.exit(main({words}))
"""
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, **CAPTURED)
    assert done.returncode == 1 and done.stderr.count("\n") == 1
    assert remedy in done.stderr
