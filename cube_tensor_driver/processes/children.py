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
"""Time, in seconds, that a process has to end when asked.

Then it is killed, because a rclpy that hangs ignores SIGTERM.
"""

POLL_PERIOD_S = 0.05
"""Time, in seconds, between two looks into a log file."""

SHOWN_LINES = 10
"""Number of lines at the end of a log that an error message shows."""

HAS_SETPRIV = shutil.which("setpriv") is not None
"""Whether the program setpriv is there. It is part of util-linux."""


class ChildError(CubeError):
    """A process ended by itself, or did not come up in time."""


class Children:
    """Child processes by the name of their executable; a context manager that ends them all."""

    def __init__(self, logs: Path) -> None:
        """Write the output of each process to a file in the folder `logs`.

        Raises:
            ConfigError: ROS_DOMAIN_ID is no domain.
        """
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
        # A demo that is killed must not leave a driver that holds the ports.
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
        _signal_session(process, signal.SIGKILL)
        process.wait()

    def pause(self, executable: str) -> None:
        """Stop a process where it is, until `resume`."""
        _signal_session(self._processes[executable], signal.SIGSTOP)

    def resume(self, executable: str) -> None:
        """Let a stopped process go on."""
        _signal_session(self._processes[executable], signal.SIGCONT)

    def names(self) -> list[str]:
        """Return the names of the processes that were started and not ended."""
        return list(self._processes)

    def pid(self, executable: str) -> int:
        """Return the id of a process."""
        return self._processes[executable].pid

    def log(self, executable: str) -> str:
        """Return what a process has written so far."""
        return self._log_file(executable).read_text(errors="replace")

    def wait_for_line(self, executable: str, text: str, seconds: float) -> str:
        """Return the first line of a log that contains `text`, once it is there.

        Raises:
            ChildError: A process has ended before, or it takes longer than `seconds`.
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
                self._processes[executable].wait(POLL_PERIOD_S)

    def check(self) -> None:
        """Raise ChildError, with the end of its log, if a process has ended."""
        for executable, process in self._processes.items():
            if process.poll() is not None:
                # The last lines usually name the reason.
                end_of_log = "\n".join(self.log(executable).splitlines()[-SHOWN_LINES:])
                raise ChildError(
                    f"the {executable} ended with code {process.returncode}:\n{end_of_log}"
                )

    def end(self, executables: Iterable[str]) -> None:
        """End processes: ask all of them first, kill after `END_S` what is still there."""
        ending = [self._processes.pop(name) for name in executables]
        for process in ending:
            _signal_session(process, signal.SIGTERM)
        until = time.monotonic() + END_S
        for process in ending:
            with contextlib.suppress(subprocess.TimeoutExpired):
                # All have the same time to end, as all were asked at once.
                process.wait(timeout=max(0.0, until - time.monotonic()))
        for process in ending:
            if process.poll() is None:
                _signal_session(process, signal.SIGKILL)
                process.wait()

    def _log_file(self, executable: str) -> Path:
        return self._logs / f"{executable}.log"


def ros_arguments(parameters: dict[str, Value]) -> list[str]:
    """Return `-p name:=value` for each parameter."""
    words = []
    for name, value in parameters.items():
        # ROS reads a value as YAML, in which a text in quotes stays a text.
        written = f"'{value}'" if isinstance(value, str) else str(value).lower()
        words += ["-p", f"{name}:={written}"]
    return words


def end_with_parent() -> list[str]:
    """Return words in front of a command that end it when this process ends, even by SIGKILL.

    The kernel does that. The command does not start at all if this process has ended before the
    kernel was asked.
    """
    if not HAS_SETPRIV:
        return []
    is_parent_there = '[ "$PPID" = "$0" ] && exec "$@"'
    return ["setpriv", "--pdeathsig", "TERM", "sh", "-c", is_parent_there, str(os.getpid())]


def _signal_session(process: subprocess.Popen[bytes], number: int) -> None:
    """Send a signal to all processes of a child's session."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, number)
