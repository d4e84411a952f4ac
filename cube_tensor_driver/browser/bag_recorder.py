# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Recording of a bag from the page: `./cube record` as a child process."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

from ..core.errors import ConfigError
from ..processes.children import end_with_parent

MAX_END_S = 10.0
"""Maximum time, in seconds, from SIGINT until the process that records must have finished its file.

A process that takes longer is killed.
"""


class BagRecorder:
    """Runs `./cube record` as a child process, at most one at a time, each into a new folder.

    Attributes:
        path: Folder of the bag that was begun last; before the first one, the folder for all bags.
    """

    def __init__(self, folder: Path) -> None:
        """Set the parent folder of all bags; `start` makes it if it does not exist."""
        self._folder = folder
        self.path = folder
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def recording(self) -> bool:
        """Whether the child process that records has been started and not yet been ended."""
        return self._process is not None

    def start(self) -> None:
        """Start to record into a new folder whose name contains the local time.

        Raises:
            ConfigError: The parent folder of the bags does not exist and cannot be made.
        """
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(
                f"{self._folder}: {error.strerror}; name another folder with --recordings"
            ) from None
        self.path = self._folder / time.strftime("skin_%Y%m%d_%H%M%S")
        record = ["-m", "cube_tensor_driver.cli", "record", "-o", str(self.path)]
        self._process = subprocess.Popen(
            [*end_with_parent(), sys.executable, *record],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            # Ctrl-C in the terminal reaches every process of its session. In a session of its own,
            # the recorder does not get it and can finish its file when `end` asks for that.
            start_new_session=True,
        )

    def end(self) -> None:
        """Ask the recorder to finish its bag, and wait up to `MAX_END_S` for it.

        Without a recording nothing happens.
        """
        if self._process is None:
            return
        self._process.send_signal(signal.SIGINT)
        try:
            self._process.wait(MAX_END_S)
        except subprocess.TimeoutExpired:
            # ./cube bag repair can make the unfinished bag readable.
            self._process.kill()
            self._process.wait()
        self._process = None

    def ended_by_itself(self) -> int | None:
        """Check whether the recorder has ended although `end` was not called.

        Returns:
            Its exit code, in the first call after it has ended; otherwise None.
        """
        code = None if self._process is None else self._process.poll()
        if code is not None:
            self._process = None
        return code
