# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""./cube test: the test suite."""

from __future__ import annotations

import argparse
import importlib.util
import os
import sys

from cube_tensor_driver.cli import ROOT
from cube_tensor_driver.cli.parser import Parser


def add_arguments(parser: Parser) -> None:
    """Add arguments that pytest gets."""
    parser.add_words("ARGUMENT", "arguments of pytest, as in -k name; ./cube exec pytest --help")


def run(options: argparse.Namespace) -> int:
    """Run the whole suite on all processors, or the given tests in one process."""
    words = options.words
    if not words:
        words = ["test"]
        if importlib.util.find_spec("xdist") is not None:
            # Tests wait half of the time, for processes that they started. So there are two workers
            # for each processor.
            workers = 2 * len(os.sched_getaffinity(0))
            words += ["-n", str(workers), "--dist", "loadgroup"]
    os.chdir(ROOT)
    # The suite starts hundreds of processes, each of which would compile the package.
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    os.execv(
        sys.executable,
        [
            sys.executable,
            "-m",
            "pytest",
            *words,
        ],
    )
