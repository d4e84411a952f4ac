"""The processes of a skin as child processes: started, watched, and ended in every case."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterable
from pathlib import Path

from ..core.errors import CubeError
from .domain import check_domain
from .skin_processes import Process, Value

END_S = 1.2
"""How long a process has to end when asked; then it is killed. A hung rclpy ignores SIGTERM."""
POLL_S = 0.05
LOG_LINES = 10
"""Of a process that ended are part of the error message."""
HAS_SETPRIV = shutil.which("setpriv") is not None
"""Part of util-linux."""


class ChildError(CubeError):
    """A process ended by itself, or did not come up in time."""


class Children:
    """Child processes by the name of their executable; a context manager that ends them all.

    Each writes its output to a log file in the folder `logs`. ConfigError: ROS_DOMAIN_ID is none.
    """

    def __init__(self, logs: Path) -> None:
        check_domain()
        self._logs = logs
        self._processes: dict[str, subprocess.Popen[bytes]] = {}

    def __enter__(self) -> Children:
        return self

    def __exit__(self, *_: object) -> None:
        self.end(list(self._processes))

    def start(self, process: Process) -> None:
        """Start a process, in a session of its own.

        So Ctrl-C does not reach it directly: it is ended by `end`, after what depends on it.
        """
        program = [process.program] if process.program else [sys.executable, "-m", process.module]
        command = [*end_with_parent(), *program, *process.arguments]
        if process.node:
            command += ["--ros-args", *ros_arguments(process.parameters)]
        with self._log_file(process.executable).open("ab") as log:
            self._processes[process.executable] = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )

    def kill(self, executable: str) -> None:
        """End a process by force, as a crash would."""
        process = self._processes.pop(executable)
        _signal(process, signal.SIGKILL)
        process.wait()

    def pause(self, executable: str) -> None:
        """Stop a process where it is, until `resume`."""
        _signal(self._processes[executable], signal.SIGSTOP)

    def resume(self, executable: str) -> None:
        """Let a process go on that was stopped."""
        _signal(self._processes[executable], signal.SIGCONT)

    def names(self) -> list[str]:
        """Of those that were started and not ended."""
        return list(self._processes)

    def pid(self, executable: str) -> int:
        """The process id."""
        return self._processes[executable].pid

    def log(self, executable: str) -> str:
        """What the process has written so far."""
        return self._log_file(executable).read_text(errors="replace")

    def wait_for_line(self, executable: str, text: str, seconds: float) -> str:
        """The first line of the log that contains `text`, once it is there.

        Raises ChildError if any process ends before, or if it takes longer than `seconds`.
        """
        until = time.monotonic() + seconds
        while True:
            for line in self.log(executable).splitlines():
                if text in line:
                    return line
            self.check()
            if time.monotonic() > until:
                raise ChildError(
                    f"the {executable} did not say {text!r} within {seconds:g} s:\n"
                    f"{self.log(executable)}"
                )
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._processes[executable].wait(POLL_S)

    def check(self) -> None:
        """Raise ChildError, with the end of its log, if a process has ended."""
        for executable, process in self._processes.items():
            if process.poll() is not None:
                end_of_log = "\n".join(self.log(executable).splitlines()[-LOG_LINES:])
                raise ChildError(
                    f"the {executable} ended with code {process.returncode}:\n{end_of_log}"
                )

    def end(self, executables: Iterable[str]) -> None:
        """End these processes: ask all of them first, kill after END_S what is still there."""
        ending = [self._processes.pop(name) for name in executables]
        for process in ending:
            _signal(process, signal.SIGTERM)
        until = time.monotonic() + END_S
        for process in ending:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(timeout=max(0.0, until - time.monotonic()))
        for process in ending:
            if process.poll() is None:
                _signal(process, signal.SIGKILL)
                process.wait()

    def _log_file(self, executable: str) -> Path:
        return self._logs / f"{executable}.log"


def ros_arguments(parameters: dict[str, Value]) -> list[str]:
    """`-p name:=value` for each parameter. Values are written as YAML, so that a text stays one."""
    words = []
    for name, value in parameters.items():
        written = f"'{value}'" if isinstance(value, str) else str(value).lower()
        words += ["-p", f"{name}:={written}"]
    return words


def end_with_parent() -> list[str]:
    """In front of a command: the kernel ends it when the thread that started it is gone, even by
    SIGKILL; and it does not start if this process was gone before the kernel was asked."""
    if not HAS_SETPRIV:
        return []
    is_there = '[ "$PPID" = "$0" ] && exec "$@"'
    return ["setpriv", "--pdeathsig", "TERM", "sh", "-c", is_there, str(os.getpid())]


def _signal(process: subprocess.Popen[bytes], number: int) -> None:
    """To all processes of its session."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, number)
