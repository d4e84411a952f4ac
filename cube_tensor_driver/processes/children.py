# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Starts and watches the processes of a skin as child processes, and ends them in every case."""

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
"""Maximum time, in seconds, between SIGTERM and the end of a child process.

A process that still runs afterwards is killed (SIGKILL), because a process whose rclpy hangs does
not react to SIGTERM.
"""

POLL_PERIOD_S = 0.05
"""Time, in seconds, between two reads of a log file while a certain line is awaited."""

SHOWN_LINES = 10
"""Number of lines from the end of a process's log that the message of a `ChildError` quotes."""

HAS_SETPRIV = shutil.which("setpriv") is not None
"""Whether the program setpriv (part of util-linux) is installed. It ends a child process when its
parent is killed."""


class ChildError(CubeError):
    """A child process ended unexpectedly, or did not write an expected line in time."""


class Children:
    """The child processes of a skin; a context manager that ends all of them at its exit.

    Methods identify a process by the name of its executable, such as "driver".
    """

    def __init__(self, logs: Path) -> None:
        """Make an empty set of child processes.

        Args:
            logs: Folder of the log files. Each process writes its output to one of them.

        Raises:
            ConfigError: The environment variable ROS_DOMAIN_ID is no valid DDS domain.
            ChildError: The system is Windows, which has no signals to groups of processes.
        """
        if not hasattr(os, "killpg"):
            raise ChildError("commands that start other processes need Linux or macOS")
        check_domain()
        self._logs = logs
        self._processes: dict[str, subprocess.Popen[bytes]] = {}

    def __enter__(self) -> Children:
        return self

    def __exit__(self, *_: object) -> None:
        self.end(list(self._processes))

    def start(self, process: Process) -> None:
        """Start a process in a session of its own.

        The terminal sends SIGINT (Ctrl-C) only to the session of this process, not to the child. So
        the order in which `end` is called decides in which order the children end.

        Args:
            process: Executable, arguments and parameters of the process.
        """
        program = [process.program] if process.program else [sys.executable, "-m", process.module]
        # `end_with_parent` ends the command when this process is killed. Otherwise a driver would
        # go on and keep its ports open.
        command = [*end_with_parent(), *program, *process.arguments]
        if process.node:
            command += ["--ros-args", *format_ros_arguments(process.parameters)]
        with self._log_file(process.executable).open("ab") as log:
            self._processes[process.executable] = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )

    def kill(self, executable: str) -> None:
        """End a process with SIGKILL, as a crash would end it, and wait for its end."""
        process = self._processes.pop(executable)
        _signal_session(process, signal.SIGKILL)
        process.wait()

    def pause(self, executable: str) -> None:
        """Suspend a process (SIGSTOP) until `resume` is called."""
        _signal_session(self._processes[executable], signal.SIGSTOP)

    def resume(self, executable: str) -> None:
        """Let a process that `pause` has suspended run again (SIGCONT)."""
        _signal_session(self._processes[executable], signal.SIGCONT)

    def list_names(self) -> list[str]:
        """Return the names of the processes that were started and that `end` has not ended yet."""
        return list(self._processes)

    def find_pid(self, executable: str) -> int:
        """Return the process id of the child process with this executable."""
        return self._processes[executable].pid

    def log(self, executable: str) -> str:
        """Return the text that a process has written to its log file so far."""
        return self._log_file(executable).read_text(errors="replace")

    def end_of_log(self, executable: str) -> str:
        """Return the last `SHOWN_LINES` lines of a log, which usually state why a process ended."""
        return "\n".join(self.log(executable).splitlines()[-SHOWN_LINES:])

    def wait_for_line(self, executable: str, text: str, seconds: float) -> str:
        """Wait until a process writes a line that contains `text`, and return that line.

        Args:
            executable: Name of the process.
            text: Text that the line contains.
            seconds: Maximum time to wait, in seconds.

        Raises:
            ChildError: One of the processes has ended, or no such line came in time.
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
        """Raise ChildError, with the end of its log, if any of the processes has ended."""
        for executable, process in self._processes.items():
            if process.poll() is not None:
                raise ChildError(
                    f"the {executable} ended with code {process.returncode}:\n"
                    f"{self.end_of_log(executable)}"
                )

    def end(self, executables: Iterable[str]) -> None:
        """End child processes: SIGTERM to all, and SIGKILL to those that still run after `END_S`.

        Args:
            executables: Names of the processes.
        """
        ending = [self._processes.pop(name) for name in executables]
        for process in ending:
            _signal_session(process, signal.SIGTERM)
        until = time.monotonic() + END_S
        for process in ending:
            with contextlib.suppress(subprocess.TimeoutExpired):
                # The deadline is common to all, as SIGTERM was sent to all at the same time.
                process.wait(timeout=max(0.0, until - time.monotonic()))
        for process in ending:
            if process.poll() is None:
                _signal_session(process, signal.SIGKILL)
                process.wait()

    def _log_file(self, executable: str) -> Path:
        return self._logs / f"{executable}.log"


def format_ros_arguments(parameters: dict[str, Value]) -> list[str]:
    """Return the command-line arguments `-p name:=value` that set parameters of a ROS node.

    Args:
        parameters: Name of a parameter -> its value.
    """
    words = []
    for name, value in parameters.items():
        # ROS parses the value as YAML. Without the quotes, a text such as 12 would be a number.
        written = f"'{value}'" if isinstance(value, str) else str(value).lower()
        words += ["-p", f"{name}:={written}"]
    return words


def end_with_parent() -> list[str]:
    """Return a prefix for a command line that ends the command when this process ends.

    It uses setpriv: the kernel sends SIGTERM to the command when its parent dies, even by SIGKILL.
    If this process ended before the kernel was asked to do so, the command does not start at all.
    Without setpriv the prefix is empty, and the command goes on after a SIGKILL of this process.
    """
    if not HAS_SETPRIV:
        return []
    is_parent_there = '[ "$PPID" = "$0" ] && exec "$@"'
    return ["setpriv", "--pdeathsig", "TERM", "sh", "-c", is_parent_there, str(os.getpid())]


def _signal_session(process: subprocess.Popen[bytes], number: int) -> None:
    """Send a signal to a child and to all processes that the child has started.

    Nothing happens if they have ended already.

    Args:
        process: The child, which is the leader of its session.
        number: Number of the signal.
    """
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, number)
