# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Every Python block of docs/python.md runs in order, and so does the example of the README."""

from __future__ import annotations

import itertools
import re
import shlex
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="needs rosbags: pip install rosbags")

from bag_maker import make_bag

import cube_tensor_driver as ctd
from conftest import ROOT, end

PAGE = ROOT / "docs" / "python.md"
TIMEOUT_S = 60.0


def blocks(page: Path, language: str) -> list[str]:
    """The blocks of a page in a language. Blank lines stand before each, so that a traceback names
    the line of the page."""
    text = page.read_text()
    pattern = rf"^```{language}\n(.*?)^```"
    found = re.finditer(pattern, text, re.MULTILINE | re.DOTALL)
    return ["\n" * text.count("\n", 0, block.start(1)) + block[1] for block in found]


def start(program: list[str], folder: Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, *program],
        cwd=folder,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        bufsize=1,
    )


def lines(process: subprocess.Popen[str], number: int) -> list[str]:
    """The first lines that a process prints; fewer if it ends before, or is killed for its time."""
    too_late = threading.Timer(TIMEOUT_S, process.kill)
    too_late.start()
    try:
        return [line.strip() for line in itertools.islice(process.stdout, number)]
    finally:
        too_late.cancel()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with the skin file that the page makes, by the page's command."""
    command = re.search(r"^ {4}\./cube (config grid .*)$", PAGE.read_text(), re.MULTILINE)
    arguments = ["-m", "cube_tensor_driver.cli", *shlex.split(command[1])]
    subprocess.run([sys.executable, *arguments], cwd=tmp_path, check=True, timeout=TIMEOUT_S)
    return tmp_path


@pytest.fixture
def hubs(folder: Path) -> Iterator[None]:
    """The hubs of that skin, played by the page's command."""
    command = next(block for block in blocks(PAGE, "bash") if "simulation.main" in block)
    process = start(shlex.split(command)[1:], folder)
    try:
        until = time.monotonic() + TIMEOUT_S
        while not (folder / "ports" / "hub1").exists():
            assert process.poll() is None, process.stdout.read()
            assert time.monotonic() < until, "the simulated hubs have no ports"
            time.sleep(0.05)
        yield
    finally:
        end(process)


def test_blocks_of_the_page_run_in_their_order(folder, hubs, monkeypatch):
    monkeypatch.chdir(folder)
    monkeypatch.setenv("MPLBACKEND", "Agg")
    make_bag(folder / "run1", folder / "skin.yaml", 100, tare=(50, 1.01))
    there: dict = {"__name__": "page"}
    for block in blocks(PAGE, "python"):
        exec(compile(block, PAGE, "exec"), there)
    skin, simulated, recorded = there["skin"], there["simulated"], there["recorded"]
    assert len(there["stress"]) > 0 and len(recorded) == 100 * len(skin.cubes)
    assert set(simulated.cube) == set(range(len(skin.cubes)))
    # A planar cube does not see yy, yz and xy; the load of the simulated skin does reach the cubes.
    tared = there["reconstruct"].rest_frequency
    assert np.allclose(tared, 1.01 * ctd.Reconstructor(skin).rest_frequency)
    assert not there["observed"][:, [1, 3, 5]].any() and there["observed"][:, [0, 2, 4]].all()
    assert np.nanmin(simulated.stress[:, 2]) < -100.0
    assert (folder / "c05.png").stat().st_size > 1000


def test_example_of_the_readme_runs(folder, hubs):
    [example] = blocks(ROOT / "README.md", "python")
    (folder / "example.py").write_text(example)
    process = start(["-u", "example.py"], folder)
    try:
        # On a busy machine links log what they note, such as a clock in doubt.
        said = [line for line in lines(process, 20) if not line.startswith("link ")]
    finally:
        end(process)
    assert len(said) >= 10, said
    numbers = " ".join(said).replace("[", " ").replace("]", " ").split()
    assert np.isfinite([float(number) for number in numbers]).all()


def test_subscriber_of_the_page_prints_pressures(folder, domain):
    pytest.importorskip("rclpy")
    demo = ["-m", "cube_tensor_driver.cli", "demo", "--config", "skin.yaml", "--headless"]
    running = [start([*demo, "--duration", str(TIMEOUT_S)], folder)]
    [program] = [
        block
        for block in blocks(ROOT / "docs" / "messages.md", "python")
        if "import rclpy" in block
    ]
    (folder / "listen.py").write_text(program)
    try:
        running.append(start(["listen.py"], folder))
        said = lines(running[1], 20)
        expected = r"c\d\d: .* kPa, shear zx .* kPa"
        assert len(said) == 20 and all(re.fullmatch(expected, line) for line in said), said
    finally:
        for process in reversed(running):
            end(process)
