# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Child processes, none of which outlives the process that started it, and signals to end."""

from __future__ import annotations

import contextlib
import shutil
import signal
import subprocess
import sys

import psutil
import pytest

from conftest import ROOT

PARENT = """
import subprocess, sys
from cube_tensor_driver.processes.children import end_with_parent
print(subprocess.Popen([*end_with_parent(), "sleep", "60"]).pid, flush=True)
sys.stdin.read()
"""


@pytest.mark.parametrize("late", [False, True], ids=["asked", "before the kernel was asked"])
@pytest.mark.skipif(shutil.which("setpriv") is None, reason="needs setpriv, of util-linux")
def test_a_child_ends_with_a_parent_that_is_killed(tmp_path, monkeypatch, late):
    if late:
        asks_late = tmp_path / "setpriv"
        asks_late.write_text(f'#!/bin/sh\nsleep 0.5\nexec {shutil.which("setpriv")} "$@"\n')
        asks_late.chmod(0o755)
        monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    parent = subprocess.Popen(
        [sys.executable, "-c", PARENT],
        cwd=ROOT,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    child = psutil.Process(int(parent.stdout.readline()))
    if not late:
        _wait_for_name(child, "sleep")
    parent.send_signal(signal.SIGKILL)
    parent.communicate(timeout=10)
    _, left = psutil.wait_procs([child], timeout=10)
    for process in left:
        process.kill()
    assert not left


IGNORING = """
import os, signal
from cube_tensor_driver.processes.stop_signals import stop_event
signal.signal(signal.SIGHUP, signal.SIG_IGN)
stop = stop_event()
os.kill(os.getpid(), signal.SIGHUP)
print(stop.is_set())
os.kill(os.getpid(), signal.SIGTERM)
print(stop.is_set())
"""


def test_a_process_under_nohup_survives_its_terminal():
    done = subprocess.run(
        [sys.executable, "-c", IGNORING], cwd=ROOT, capture_output=True, text=True
    )
    assert done.stdout.split() == ["False", "True"], done.stderr


def _wait_for_name(process: psutil.Process, name: str) -> None:
    """Until the process runs this program."""
    for _ in range(1000):
        if process.name() == name:
            return
        with contextlib.suppress(psutil.TimeoutExpired):
            process.wait(0.01)
    pytest.fail(f"the child is {process.name()} after 10 s, not {name}")
