"""The processes of a skin as our own children: started, watched, and surely ended."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from ..core.errors import CubeError
from .skin_processes import Process, Value

END_S = 1.2
"""How long a process has to end by itself before it is killed: hung rclpy ignores SIGTERM."""


LOOK_S = 0.05
LEASH = ("setpriv", "--pdeathsig", "TERM") if shutil.which("setpriv") else ()
"""Runs a command so that the kernel ends it when the thread that started it is gone, even by
SIGKILL; of util-linux."""


class ChildError(CubeError):
    """A process of the skin ended by itself."""


class Children:
    """Processes by executable name, each with its output in a log file; a context that ends them
    all."""

    def __init__(self, logs: Path) -> None:
        self._logs = logs
        self._processes: dict[str, subprocess.Popen[bytes]] = {}

    def __enter__(self) -> Children:
        return self

    def __exit__(self, *_: object) -> None:
        self.end(list(self._processes))

    def start(self, process: Process) -> None:
        """Start one. It has a session of its own: Ctrl-C reaches it through us, in order."""
        command = [*LEASH, sys.executable, "-m", process.module, *process.arguments]
        if process.node:
            command += ["--ros-args", *ros_arguments(process.parameters)]
        with (self._logs / f"{process.executable}.log").open("wb") as log:
            self._processes[process.executable] = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )

    def pid(self, executable: str) -> int:
        return self._processes[executable].pid

    def log(self, executable: str) -> str:
        return (self._logs / f"{executable}.log").read_text(errors="replace")

    def said(self, executable: str, text: str, seconds: float) -> str:
        """The first line of its log with `text`, once it is there. ChildError: it ended before, or
        takes too long."""
        until = time.monotonic() + seconds
        while True:
            for line in self.log(executable).splitlines():
                if text in line:
                    return line
            self.check()
            if time.monotonic() > until:
                raise ChildError(
                    f"the {executable} did not say {text!r} within {seconds:g} s:\n{self.log(executable)}"
                )
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._processes[executable].wait(LOOK_S)

    def check(self) -> None:
        """ChildError with the end of its log if one has ended."""
        for executable, process in self._processes.items():
            if process.poll() is not None:
                tail = "\n".join(self.log(executable).splitlines()[-10:])
                raise ChildError(f"the {executable} ended with code {process.returncode}:\n{tail}")

    def end(self, executables: Sequence[str]) -> None:
        """End these: asked first, killed after END_S."""
        running = [self._processes.pop(name) for name in executables]
        for process in running:
            _signal(process, signal.SIGTERM)
        until = time.monotonic() + END_S
        for process in running:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(timeout=max(0.0, until - time.monotonic()))
        for process in running:
            if process.poll() is None:
                _signal(process, signal.SIGKILL)
                process.wait()


def ros_arguments(parameters: dict[str, Value]) -> list[str]:
    """-p name:=value of each parameter, spelled as YAML so that a text stays a text."""
    spelled = {
        name: f"'{value}'" if isinstance(value, str) else str(value).lower()
        for name, value in parameters.items()
    }
    return [word for name, value in spelled.items() for word in ("-p", f"{name}:={value}")]


def _signal(process: subprocess.Popen[bytes], number: int) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, number)
