# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""./cube topics: list the topics that are published, with types and rates."""

from __future__ import annotations

import argparse

from .parser import Parser


def add_arguments(parser: Parser) -> None:
    """Add the options of the command."""
    parser.epilog = (
        "Listens for one second. Topics of single cubes are sent while somebody listens; "
        "of each kind it listens to the first cube's."
    )


def run(options: argparse.Namespace) -> int:
    """List the topics that are published, with types and rates."""
    from ..ros.commands.topics import list_topics

    topics = list_topics()
    # All names are padded to the same width, so that the rates stand in one column.
    width = max(len(topic.name) for topic in topics)
    for topic in topics:
        rate = "not installed here" if topic.rate is None else f"{topic.rate:.0f} Hz"
        kinds = ", ".join(topic.kinds)
        print(f"{topic.name:{width}}  {rate:>8}  {kinds}{describe_cubes(topic.cubes)}")
    return 0


def describe_cubes(cubes: list[str]) -> str:
    """Return the number and names of the cubes that have a topic of the same kind, as a text.

    Args:
        cubes: Names of the cubes. For a topic of the whole skin the list is empty, and the function
            returns an empty text.
    """
    from ..views.terminal.output import format_count

    if not cubes:
        return ""
    names = ", ".join(cubes) if len(cubes) < 3 else f"{cubes[0]} … {cubes[-1]}"
    return f", {format_count(len(cubes), 'cube')}: {names}"
