# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Lines, tables and progress in a terminal, as all commands print them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Column, Table
from rich.text import Text

BAR_WIDTH = 20
"""Width of a progress bar, in characters; the name of the step takes the rest of the line."""


def say(
    text: str,
    style: str = "",
) -> None:
    """Print a line as it is: square brackets are no markup, and long lines are not broken.

    Args:
        text: The line.
        style: Colour or weight of the text in the notation of rich, such as "red" or "bold". It is
            ignored if the output is not a terminal.
    """
    console = Console(highlight=False)
    console.print(
        text,
        style=style,
        markup=False,
        soft_wrap=True,
    )


def format_count(number: int, noun: str) -> str:
    """Return a number with its noun, such as "1 cube" or "5 cubes"."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def make_table(
    names: Iterable[str],
    numbers: Iterable[str],
    title: str = "",
) -> Table:
    """Make a table without rows, with left-justified columns and then right-justified columns.

    Args:
        names: Headings of the left-justified columns, which are for names.
        numbers: Headings of the right-justified columns, which are for numbers.
        title: Line above the table; empty: none.
    """
    # Without lines between the columns, most tables fit into 80 characters.
    table = Table(
        title=title or None,
        title_justify="left",
        box=SIMPLE_HEAD,
        pad_edge=False,
    )
    for heading in names:
        table.add_column(heading, overflow="fold")
    for heading in numbers:
        table.add_column(heading, justify="right")
    return table


def print_table(
    names: Iterable[str],
    numbers: Iterable[str],
    rows: Iterable[Iterable[str]],
    *,
    title: str = "",
    footer: Iterable[Iterable[str]] = (),
) -> None:
    """Print a table with left-justified columns and then right-justified columns.

    Args:
        names: Headings of the left-justified columns, which are for names.
        numbers: Headings of the right-justified columns, which are for numbers.
        rows: Cells of each row.
        title: Line above the table; empty: none.
        footer: Cells of each row below a line.
    """
    table = make_table(names, numbers, title)
    for cells in rows:
        table.add_row(*cells)
    table.add_section()
    for cells in footer:
        table.add_row(*cells)
    Console(highlight=False).print(table)


@contextmanager
def show_progress_bar() -> Iterator[Callable[[float, float, str], None]]:
    """Show a progress bar of one line on stderr inside a `with` block, if stderr is a terminal.

    Yields:
        A function ``report(done, total, what)`` that updates the bar. Its arguments are the work
        done, the whole work in the same unit, and the name of the present step.
    """
    console = Console(stderr=True)
    if not console.is_terminal:
        # A disabled progress bar would not do: rich 11 (Ubuntu 22.04) prints an empty line at its
        # end.
        yield lambda done, total, what: None
        return

    what_column = TextColumn(
        "{task.description}",
        table_column=Column(
            no_wrap=True,
            overflow="ellipsis",
            ratio=1,
        ),
    )
    bar = Progress(
        what_column,
        BarColumn(bar_width=BAR_WIDTH),
        TextColumn("{task.percentage:>3.0f}%"),
        TimeElapsedColumn(),
        console=console,
        transient=True,
        expand=True,
    )
    with bar:
        task = bar.add_task("starting", total=1.0)

        def report(
            done: float,
            total: float,
            what: str,
        ) -> None:
            bar.update(
                task,
                completed=done,
                total=total,
                description=what,
            )

        yield report
        bar.update(task, completed=bar.tasks[0].total)


def show_working(text: str) -> AbstractContextManager[object]:
    """Show a text with an animation on stderr, if that is a terminal, inside a `with` block.

    It is for work whose progress is unknown.
    """
    return Console(stderr=True).status(Text(text))
