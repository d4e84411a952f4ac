"""What commands share that compute for long: a bar while they do, and files that are asked about
before they do."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn
from rich.table import Column

from ..config.atomic_write import atomic_write, check_writable
from ..core.errors import ConfigError


@contextmanager
def progress_bar() -> Iterator[Callable[[float, float, str], None]]:
    """A bar of one line on stderr, where that is a terminal; yields report(done, total, what)."""
    console = Console(stderr=True)
    what = TextColumn(
        "{task.description}", table_column=Column(no_wrap=True, overflow="ellipsis", ratio=1)
    )
    columns = (what, BarColumn(bar_width=20), TaskProgressColumn(), TimeElapsedColumn())
    with Progress(
        *columns, console=console, transient=True, expand=True, disable=not console.is_terminal
    ) as bar:
        task = bar.add_task("meshing", total=None)
        yield lambda done, total, what: bar.update(
            task, completed=done, total=total, description=what
        )
        bar.update(task, completed=bar.tasks[0].total)


def make_folder(option: str, path: Path | None) -> None:
    """ConfigError, before any work: the folder cannot be made or written. None: none is asked
    for."""
    if path is None:
        return
    try:
        path.mkdir(parents=True, exist_ok=True)
        check_writable(path / "a file")
    except (OSError, ConfigError) as error:
        what = error.strerror if isinstance(error, OSError) else "no file can be made in it"
        raise ConfigError(
            f"{option} {path}: {what}; name a folder that can be made and written"
        ) from None


def write_json(path: Path, value: Any) -> None:
    """A file that is whole or not there at all. ConfigError: it cannot be written."""
    with atomic_write(path) as partial:
        partial.write_text(json.dumps(value, indent=2) + "\n", encoding="utf-8")
