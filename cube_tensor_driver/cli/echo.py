"""./cube echo: what comes on a topic of a running skin."""

from __future__ import annotations

import argparse
import os
import sys

from .parser import Parser


def arguments(parser: Parser) -> None:
    parser.add_argument("topic", metavar="TOPIC", help="as in stress or cubes/c05/stress")
    parser.add_argument("--once", action="store_true", help="end after the first message")
    parser.add_argument("--json", action="store_true", help="print one JSON object per line")


def run(options: argparse.Namespace) -> int:
    """Until Ctrl-C, or until the reader of a pipe has enough: neither is an error."""
    from ..config.yaml import to_yaml
    from ..ros.commands.listening import listen
    from ..views.terminal.echo import Reading, message_json, reading_json, reading_line

    try:
        for items in listen(options.topic, options.once):
            for item in items:
                if isinstance(item, Reading):
                    print(reading_json(item) if options.json else reading_line(item))
                elif options.json:
                    print(message_json(item))
                else:
                    print(f"{to_yaml(item)}---")
            sys.stdout.flush()
    except BrokenPipeError:
        # What is left, at the end of the process too, goes nowhere.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 0
