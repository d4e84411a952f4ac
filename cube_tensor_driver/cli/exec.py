# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""./cube exec: run any command inside the environment that ./cube has made."""

from __future__ import annotations

import argparse
import os
import signal
import sys

from .parser import Parser

NOT_FOUND = 127
"""Exit code if the command cannot be executed; shells use it for a command that is not found."""


def add_arguments(parser: Parser) -> None:
    """Add the options of the command."""
    parser.add_words(
        "CMD",
        "command and its arguments, as in ./cube exec python -c '...'",
        missing="name a command to run, as in ./cube exec python or ./cube exec bash",
    )


def run(options: argparse.Namespace) -> int:
    """Replace this process by the command; returns only if the command cannot be executed."""
    # Python ignores SIGPIPE. The command would inherit this, and would not end when the reader of
    # its output closes the pipe.
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    name = options.words[0]
    try:
        # The command keeps the process id, so signals reach it and its exit code is passed on.
        os.execvp(name, options.words)
    except OSError as error:
        print(f"cube: exec: {name}: {error.strerror}", file=sys.stderr)
        return NOT_FOUND
