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
"""Time, in seconds, that the recorder may take to finish its file; then it is killed."""


class BagRecorder:
    """Makes at most one recording at a time, each in a new folder.

    Attributes:
        path: Folder of the last bag.
    """

    def __init__(self, folder: Path) -> None:
        """folder: for all bags; it is made when it is needed."""
        self._folder = folder
        self.path = folder
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def recording(self) -> bool:
        """Whether a recording goes on."""
        return self._process is not None

    def start(self) -> None:
        """Start a recording.

        Raises:
            ConfigError: The folder cannot be made.
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
            # Ctrl-C in the terminal of the view must not cut off the file.
            start_new_session=True,
        )

    def end(self) -> None:
        """Finish the bag; without a recording nothing happens."""
        if self._process is None:
            return
        self._process.send_signal(signal.SIGINT)
        try:
            self._process.wait(MAX_END_S)
        except subprocess.TimeoutExpired:
            # The bag can be repaired then: ./cube bag repair.
            self._process.kill()
            self._process.wait()
        self._process = None

    def ended_by_itself(self) -> int | None:
        """Return, once, the exit code of a recording that ended unasked; None: it did not."""
        code = None if self._process is None else self._process.poll()
        if code is not None:
            self._process = None
        return code
