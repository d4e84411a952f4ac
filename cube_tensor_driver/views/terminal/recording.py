"""What ./cube record shows while it records, on stderr."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from rich.console import Console


class RecordingStatus:
    """One line that is updated, and a red line for each thing that is lost; a context."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._console = Console(stderr=True, highlight=False)
        self._status = self._console.status("")
        self._refused: set[str] = set()
        self._dropped = 0

    def __enter__(self) -> RecordingStatus:
        self._status.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._status.stop()

    def show(
        self,
        seconds: float,
        *,
        received: int,
        dropped: int,
        missing: Sequence[str],
        refused: Mapping[str, str],
    ) -> None:
        """received, dropped: messages. missing: topics without publisher; refused: topic -> why."""
        waiting = f"; waiting for {', '.join(missing)}" if missing else ""
        self._status.update(f"{self._path}: {seconds:.0f} s, {received} messages{waiting}")
        for topic in refused.keys() - self._refused:
            self._console.print(f"not recorded: {refused[topic]}", style="red")
        self._refused |= refused.keys()
        if dropped > self._dropped:
            self._dropped = dropped
            self._console.print(
                f"the disk is too slow: {dropped} messages dropped so far", style="red"
            )

    def summary(self, counts: Mapping[str, int], *, dropped: int, missing: Sequence[str]) -> None:
        """counts: topic -> messages received."""
        self._console.print(f"{self._path}: {sum(counts.values()) - dropped} messages")
        for topic, count in sorted(counts.items()):
            self._console.print(f"  {count:8} {topic}")
        for topic in missing:
            self._console.print(f"         0 {topic}: nobody offers it", style="yellow")
        if dropped:
            self._console.print(f"{dropped} messages dropped: the disk is too slow", style="red")
