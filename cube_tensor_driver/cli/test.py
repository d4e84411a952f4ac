"""./cube test: the test suite."""

from __future__ import annotations

import argparse
import os
import sys

from . import ROOT
from .parser import Parser


def arguments(parser: Parser) -> None:
    parser.add_words(
        "words", "ARGUMENT", "arguments of pytest, as in -k name; ./cube exec pytest --help"
    )


def run(options: argparse.Namespace) -> int:
    os.chdir(ROOT)
    os.execv(sys.executable, [sys.executable, "-m", "pytest", *(options.words or ["test"])])
