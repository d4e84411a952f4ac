"""Records a bag while the page is open: `./cube record` as a child process."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

from ..core.errors import ConfigError
from ..processes.children import end_with_parent

END_S = 10.0
"""How long the recorder may take to finish its file."""


class BagRecorder:
    """At most one recording at a time, below a folder that is made if need be.

    path: of the last bag.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.path = folder
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def recording(self) -> bool:
        return self._process is not None

    def start(self) -> None:
        """Start to record. ConfigError: there is no such folder."""
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(
                f"{self._folder}: {error.strerror}; name another folder with --recordings"
            ) from None
        self.path = self._folder / time.strftime("skin_%Y%m%d_%H%M%S")
        command = [
            *end_with_parent(),
            sys.executable,
            "-m",
            "cube_tensor_driver.cli",
            "record",
            "-o",
            str(self.path),
        ]
        self._process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, start_new_session=True
        )

    def end(self) -> None:
        """Finish the bag; safe to call without a recording."""
        if self._process is None:
            return
        self._process.send_signal(signal.SIGINT)
        try:
            self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process = None

    def ended_by_itself(self) -> int | None:
        """The exit code of a recording that ended unasked, once; None: it did not."""
        code = None if self._process is None else self._process.poll()
        if code is not None:
            self._process = None
        return code
