"""./cube exec: run any command inside the environment that ./cube has made."""

from __future__ import annotations

import argparse
import os
import signal
import sys

from .parser import Parser

NOT_FOUND = 127
"""Exit code that shells give for a command that is not found."""


def arguments(parser: Parser) -> None:
    parser.add_words(
        "words",
        "CMD",
        "command and its arguments, as in ./cube exec python -c '...'",
        missing="name a command to run, as in ./cube exec python or ./cube exec bash",
    )


def run(options: argparse.Namespace) -> int:
    """Replace this process by the command."""
    # Python ignores SIGPIPE, and the command would inherit that.
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    name = options.words[0]
    try:
        # The command takes the place of this process, with its signals and its exit code.
        os.execvp(name, options.words)
    except OSError as error:
        print(f"cube: exec: {name}: {error.strerror}", file=sys.stderr)
        return NOT_FOUND
