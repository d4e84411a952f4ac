"""Progress of long work, and warnings."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Column
from rich.text import Text


@contextmanager
def progress_bar() -> Iterator[Callable[[float, float, str], None]]:
    """A bar of one line on stderr, where that is a terminal; yields report(done, total, what)."""
    console = Console(stderr=True)
    if not console.is_terminal:
        # rich 11 ends even a bar that is disabled with an empty line.
        yield lambda done, total, what: None
        return
    what_column = TextColumn(
        "{task.description}", table_column=Column(no_wrap=True, overflow="ellipsis", ratio=1)
    )
    bar = Progress(
        what_column,
        BarColumn(bar_width=20),
        TextColumn("{task.percentage:>3.0f}%"),
        TimeElapsedColumn(),
        console=console,
        transient=True,
        expand=True,
    )
    with bar:
        task = bar.add_task("meshing", total=1.0)

        def report(done: float, total: float, what: str) -> None:
            bar.update(task, completed=done, total=total, description=what)

        yield report
        bar.update(task, completed=bar.tasks[0].total)


def working(text: str) -> AbstractContextManager[object]:
    """A moving line on stderr, where that is a terminal, while something takes long whose progress
    is not known."""
    return Console(stderr=True).status(Text(text))


def warn(text: str) -> None:
    """A red line on stdout."""
    Console(highlight=False).print(text, style="red", markup=False, soft_wrap=True)
