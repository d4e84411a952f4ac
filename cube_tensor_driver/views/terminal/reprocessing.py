"""What ./cube reprocess shows on stderr: a bar over the bags, a line for each, a summary."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console
from rich.progress import Progress

from ...bags.reprocess.job import ReprocessResult
from ...core.errors import CubeError


class ReprocessingReport:
    """A context that shows the bar; failed: bags that could not be reprocessed."""

    def __init__(self, folder: Path, *, jobs: int, waiting: int) -> None:
        self.failed = 0
        self._jobs = jobs
        self._console = Console(stderr=True, highlight=False)
        self._progress = Progress(console=self._console, disable=not waiting)
        self._task = self._progress.add_task("reprocessing", total=waiting)
        if waiting < jobs:
            self._console.print(f"{jobs - waiting} of {jobs} bags are there already in {folder}")

    def __enter__(self) -> ReprocessingReport:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def add(self, output: Path, result: ReprocessResult | CubeError) -> None:
        """A bag is done, or was given up with an error."""
        if isinstance(result, CubeError):
            self.failed += 1
            self._console.print(f"cube: {result}", style="red", markup=False)
        else:
            self._console.print(
                f"{output}: {result.messages} messages, {result.rows} rows, {result.seconds:.1f} s"
            )
        self._progress.advance(self._task)

    def summary(self) -> None:
        if self.failed:
            self._console.print(
                f"{self.failed} of {self._jobs} bags could not be reprocessed", style="red"
            )
