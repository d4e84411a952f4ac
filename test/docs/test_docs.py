# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The documentation builds without a warning, and every command on its pages runs: here, or in a
test named here."""

from __future__ import annotations

import itertools
import os
import pty
import re
import select
import shlex
import shutil
import signal
import subprocess
import sys
import time
import types
from pathlib import Path

import pytest

import cube_tensor_driver as ctd
from conftest import ROOT, end
from workshop.cli import docs

PAGES = [*sorted((ROOT / "docs").glob("*.md")), ROOT / "README.md", ROOT / "CONTRIBUTING.md"]
ELSEWHERE = {
    "./cube demo": "test_end_to_end.test_ended_demo_leaves_no_process",
    "./cube demo --headless --duration 3 --json figures.json": (
        "test_end_to_end.test_demo_loses_nothing_and_is_right"
    ),
    "./cube demo --config first.yaml --headless --duration 3": (
        "test_python_page.test_subscriber_of_the_page_prints_pressures"
    ),
    "./cube bringup /dev/ttyACM0 -o hand.yaml": (
        "test_bringup.test_a_turned_cube_is_found_and_written"
    ),
    "./cube firmware build": "test_firmware.test_hubs_keep_every_rule_on_real_lines",
    "./cube firmware run": "test_firmware.test_the_load_on_the_pads_comes_out_as_tensors",
    "./cube firmware test": "test_firmware.test_captures_are_those_of_the_oscillators",
    "./cube check socket://127.0.0.1:5331": (
        "test_firmware.test_hubs_keep_every_rule_on_real_lines"
    ),
    "./cube fem cube_11mm --load surface --meshes 2 -o mine.npz": (
        "test_fem_command.test_pads_under_loads_on_the_surface"
    ),
    "./cube record -o run1": "test_recording.test_recorded_is_published_and_reprocessed_is_live",
    "./cube fit run1 --cube c05 --reference /force --area 1.44e-4 --layout planar -o c05.yaml": (
        "test_files.test_fit_from_a_bag"
    ),
    "./cube inject kind=unplug link=hub0 seconds=2": (
        "test_faults.test_inject_speaks_to_the_pipe_or_says_that_nobody_listens"
    ),
    "./cube inject kind=stuck link=hub1 cube=3 pad=5 seconds=10": (
        "test_faults.test_inject_speaks_to_the_pipe_or_says_that_nobody_listens"
    ),
    "./cube torture --duration 600 --seed 7 --json torture.json": (
        "test_torture.test_a_tortured_skin_loses_nothing_uncounted_and_says_nothing_wrong"
    ),
    "./cube torture --mutate all --seed 1 --json mutations.json": (
        "test_torture.test_mutations_are_caught"
    ),
    "./cube demo --config config/examples/sole.yaml --load config/examples/gait.yaml "
    "--duration 3.3 --figure gait.png": (
        "test_examples.test_sole_finds_the_ground_reaction_force_and_its_centre"
    ),
    "./cube demo --config config/examples/forearm.yaml "
    "--load config/examples/forearm_load.yaml --view": (
        "test_examples.test_forearm_runs_with_both_layouts"
    ),
}
"""What runs for minutes, or needs what a page of its own does not have: the test that runs it."""
OF_CI = {"./cube test", "./cube lint", "./cube exec CMD", "./cube --distro kilted test"}
"""What .ci/run calls, and what makes an environment of its own."""
HERE = {"bag", "config", "export", "fem", "fit", "layout", "plot", "urdf", "--help"}
"""Commands that start no process: they run in this one, which has imported what they need."""
ENDLESS = {
    "./cube demo --view": "shows it",
    "./cube demo --config skin.yaml --load load.yaml": "c0 ",
    "./cube view": "http://",
}
"""Commands that Ctrl-C ends, and what they say once they run."""


def commands(page: Path) -> list[str]:
    """Lines of a page that call ./cube, each once, without what follows a # or several spaces."""
    lines = re.findall(
        r"^ {4,}(\./cube [^#\n]*?)(?: {2,}.*| *#.*)?$", page.read_text(), re.MULTILINE
    )
    return list(dict.fromkeys(lines))


def named(page: Path) -> list[str]:
    """Commands within sentences: names and options, not whole."""
    return [" ".join(text.split()) for text in re.findall(r"`(\./cube\s[^`]+)`", page.read_text())]


def run(arguments: list[str], folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "cube_tensor_driver.cli", *arguments],
        cwd=folder,
        text=True,
        capture_output=True,
        timeout=120,
        check=False,
    )


def run_until(arguments: list[str], folder: Path, said: str) -> None:
    """In a terminal of its own, until it has said that; then Ctrl-C, and it ends well."""
    near, far = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, "-m", "cube_tensor_driver.cli", *arguments],
        cwd=folder,
        stdin=far,
        stdout=far,
        stderr=far,
        start_new_session=True,
    )
    os.close(far)
    heard, until = "", time.monotonic() + 60
    try:
        while said not in heard:
            assert time.monotonic() < until and process.poll() is None, heard[-2000:]
            if select.select([near], [], [], 0.1)[0]:
                heard += os.read(near, 65536).decode(errors="replace")
        process.send_signal(signal.SIGINT)
        while process.poll() is None:
            assert time.monotonic() < until, heard[-2000:]
            if select.select([near], [], [], 0.1)[0]:
                os.read(near, 65536)
        assert process.returncode == 0
    except OSError:  # the terminal is gone with the process
        assert process.wait(10) == 0
    finally:
        end(process)
        os.close(near)


def stage(page: Path, folder: Path) -> None:
    """What a page speaks of as there already."""
    (folder / "config").symlink_to(ROOT / "config")
    (folder / "docs").symlink_to(ROOT / "docs")
    if page.name in ("bags.md", "learning.md"):
        from bag_maker import make_bag

        for name in ("run1", "run2"):
            make_bag(folder / name, ROOT / "config" / "skin_demo.yaml", 100)
        shutil.copy(ROOT / "config" / "calibration" / "planar.yaml", folder / "new.yaml")
    if page.name == "simulation.md":
        shutil.copy(ROOT / "config" / "cube.yaml", folder / "skin.yaml")
        worn, load, *_ = re.findall(r"^```yaml\n(.*?)^```", page.read_text(), re.M | re.S)
        (folder / "worn.yaml").write_text(worn)
        (folder / "load.yaml").write_text(load)


def test_documentation_builds_without_a_warning(tmp_path):
    """As text, in two thirds of the time of ./cube docs, which .ci/run calls."""
    pytest.importorskip("sphinx", reason="needs sphinx: run this with ./cube test")
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "text", "docs"]
    done = subprocess.run(
        [*command, str(tmp_path)], cwd=ROOT, text=True, capture_output=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert (tmp_path / "index.txt").is_file()
    # A link shows the title of its page, not its file name.
    links = set(re.findall(r"\]\((\w+\.md)", (ROOT / "docs" / "start.md").read_text()))
    assert links and not [one for one in links if one in (tmp_path / "start.txt").read_text()]
    # The public names, and the tables that are generated from the code.
    api = (tmp_path / "api.txt").read_text()
    assert all(f"cube_tensor_driver.{name}" in api for name in ctd.__all__)
    messages = (tmp_path / "messages.txt").read_text()
    assert '"left_out"' in messages and '"PAD_DRIFT"' in messages and "table:" not in messages
    assert '"tare_folder"' in (tmp_path / "parameters.txt").read_text()


@pytest.mark.parametrize(("code", "said"), [(0, "wrote {}/index.html\n"), (2, "")])
def test_the_command_names_the_pages_that_it_wrote(tmp_path, monkeypatch, capsys, code, said):
    ended = types.SimpleNamespace(returncode=code)
    monkeypatch.setattr(docs.subprocess, "run", lambda *_, **options: ended)
    assert docs.run(types.SimpleNamespace(output=tmp_path)) == code
    assert capsys.readouterr().out == said.format(tmp_path)


@pytest.mark.parametrize(
    "page", [page for page in PAGES if commands(page)], ids=lambda page: page.name
)
def test_commands_of_a_page_run(page, tmp_path, domain, monkeypatch, capfd):
    from cube_tensor_driver.cli.main import main

    stage(page, tmp_path)
    monkeypatch.chdir(tmp_path)
    for command in commands(page):
        arguments = shlex.split(command)[1:]
        if command in {*ELSEWHERE, *OF_CI}:
            continue
        if "--mujoco" in arguments:
            pytest.importorskip("mujoco", reason=f"{command} needs MuJoCo: pip install mujoco")
        if command in ENDLESS:
            run_until(arguments, tmp_path, ENDLESS[command])
        elif arguments[0] in HERE:
            try:
                code = main(arguments)
            except SystemExit as ended:
                code = ended.code
            assert code == 0, f"{command}\n{''.join(capfd.readouterr())}"
        else:
            done = run(arguments, tmp_path)
            assert done.returncode == 0, f"{command}\n{done.stdout}{done.stderr}"


def test_commands_that_are_run_elsewhere_are_on_a_page_and_name_a_test():
    on_pages = {command for page in PAGES for command in commands(page)}
    assert {*ELSEWHERE, *ENDLESS, *OF_CI} <= on_pages
    for where in ELSEWHERE.values():
        module, name = where.split(".")
        (path,) = ROOT.glob(f"test/*/{module}.py")
        assert f"\ndef {name}(" in path.read_text(), where


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_in_sentences_exist_with_their_options(page, capsys):
    from cube_tensor_driver.cli.main import main

    for command in named(page):
        words = [word.strip("[],|…") for word in command.split()[1:]]
        names = list(itertools.takewhile(lambda word: not word.startswith("-"), words))
        options = {word.partition("=")[0] for word in words if word.startswith("-")}
        if names[:1] in (["test"], ["exec"]):
            names, options = names[:1], set()  # the rest belongs to another program
        with pytest.raises(SystemExit) as ended:
            main([*names, "--help"])
        assert ended.value.code == 0, f"{page.name}: {command}"
        shown = set(re.findall(r"-[-\w]+", capsys.readouterr().out))
        assert options <= shown, f"{page.name}: {command}"


def test_ros_commands_name_what_the_package_has():
    """ros2 itself is not on every machine; test_launch.py runs it where it is."""
    text = "\n".join(page.read_text() for page in PAGES)
    runs = re.findall(r"ros2 run cube_tensor_driver (\S+?)[`\s]", text)
    assert runs and all((ROOT / "scripts" / name).is_file() for name in runs)


@pytest.mark.parametrize("name", ["calibrate.md", "contacts.md"])
def test_programs_of_a_page_run(name):
    import numpy as np

    from cube_tensor_driver.core.calibration import make_illustrative_calibration
    from cube_tensor_driver.core.poses import CubePoses

    poses = CubePoses(np.zeros((1, 3)), np.eye(3)[None], np.full(1, 0.002))
    there = {
        "skin": types.SimpleNamespace(
            poses=poses,
            calibrations=[make_illustrative_calibration("planar")],
            elastomer=None,
            rate=None,
        ),
        "source": (),
        "reconstruct": types.SimpleNamespace(errors=None),
        "poses": poses,
        "values": np.zeros((1, 15)),
    }
    programs = re.findall(
        r"^```python\n(.*?)^```", (ROOT / "docs" / name).read_text(), re.MULTILINE | re.DOTALL
    )
    assert programs
    for program in programs:
        exec(program, there)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_files_and_links_of_a_page_exist(page):
    """Links, and files that a sentence names by their path in the checkout or in the package; a
    path may leave out the suffix. Programs are not looked into."""
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    links = [link for link in re.findall(r"\]\(([^)#\s]+)", text) if "://" not in link]
    missing = [link for link in links if not (page.parent / link).exists()]
    rooms = "|".join(folder.name for folder in (ROOT / "cube_tensor_driver").iterdir())
    pattern = rf"`((?:{rooms}|docs|launch|msg|rviz|scripts|srv|test|tools)/[\w./]+)(?:::\w+)?`"
    for name in re.findall(pattern, text):
        here, package = ROOT.glob(f"{name}*"), ROOT.glob(f"cube_tensor_driver/{name}*")
        if "NAME" not in name and not [*here, *package]:
            missing.append(name)
    assert not missing
