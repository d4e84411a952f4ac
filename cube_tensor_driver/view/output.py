"""What commands share that compute for long: a bar while they do, and files that are asked about before they do."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from ..core.errors import ConfigError


@contextmanager
def progress_bar() -> Iterator[Callable[[int, int, str], None]]:
    """A bar on stderr, where that is a terminal; yields report(done, total, what)."""
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.completed}/{task.total}"))
    with Progress(
        *columns, TimeElapsedColumn(), console=console, transient=True, disable=not console.is_terminal
    ) as bar:
        task = bar.add_task("meshing", total=None)
        yield lambda done, total, what: bar.update(task, completed=done, total=total, description=what)


def check_outputs(paths: dict[str, Path | None]) -> None:
    """ConfigError, before any work: a file to be written has no folder, or one that cannot be written."""
    for option, path in paths.items():
        if path is not None and (path.is_dir() or not os.access(path.resolve().parent, os.W_OK)):
            raise ConfigError(f"{option} {path}: cannot be written; name a file in a folder that exists and is yours")


def make_folder(path: Path | None) -> None:
    """ConfigError, before any work: the folder cannot be made or written. None: none is asked for."""
    try:
        if path is not None:
            path.mkdir(parents=True, exist_ok=True)
            check_outputs({"folder": path / "a file"})
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}; name a folder that can be made and written") from None


def write_json(path: Path, value: Any) -> None:
    """A file that is whole or not there at all. ConfigError: it cannot be written."""
    try:
        partial = path.with_name(path.name + ".part")  # whole or not at all
        partial.write_text(json.dumps(value, indent=2) + "\n", encoding="utf-8")
        partial.replace(path)
    except OSError as error:
        raise ConfigError(f"--json {path}: {error.strerror}; name a file that can be written") from None
