# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Parser for the options of a command, with short error messages, and types of arguments."""

from __future__ import annotations

import argparse
import contextlib
import difflib
import math
import shutil
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn, TypeVar

Number = TypeVar("Number", int, float)

MAX_WIDTH = 100
"""Maximum width of help texts, in characters; longer lines are hard to read on wide terminals."""


@dataclass(frozen=True)
class Output:
    """An option that names a file or folder to write; `check_outputs` checks it before any work.

    Attributes:
        flag: The option, such as "--output".
        name: Name of its value in the parsed options.
        kind: `file`, `skin` (a YAML file that must not exist yet), `yaml` (a file with the suffix
            of YAML), `picture` (a file whose suffix names a picture format) or `folder`.
    """

    flag: str
    name: str
    kind: str


class Parser(argparse.ArgumentParser):
    """An ArgumentParser with error messages of two lines, which suggest similar known words."""

    _subcommands: argparse._SubParsersAction[Parser] | None = None
    # Whether all words are passed on (see `add_words`), and the error message if there is none.
    _passes_words = False
    _missing = ""

    def add_output(
        self,
        *flags: str,
        help: str,
        kind: str = "file",
        required: bool = False,
        default: Path | Callable[[argparse.Namespace], Path] | None = None,
    ) -> None:
        """Add an option that names a file or folder to write.

        Args:
            flags: Names of the option.
            help: Help text.
            kind: Kind of the output, see `Output`.
            required: Whether the option must be given.
            default: Path, or a function that computes it from the parsed options.
        """
        action = self.add_argument(
            *flags,
            type=Path,
            metavar="DIR" if kind == "folder" else "FILE",
            help=help,
            required=required,
            default=default,
        )
        earlier = self.get_default("outputs") or ()
        self.set_defaults(outputs=(*earlier, Output(flags[0], action.dest, kind)))

    def add_value(
        self,
        name: str,
        metavar: str,
        text: str,
        kind: Callable[[str], object] = str,
        *,
        nargs: str | None = None,
        default: object = None,
        required: bool = False,
    ) -> None:
        """Add an argument or option with a value.

        Args:
            name: Name of the argument or option.
            metavar: Name of its value in the help text.
            text: Help text.
            kind: Function that converts a text into the value and checks it, such as `positive`.
            nargs: "?" for at most one value, "*" or "+" for several; None for one.
            default: Value if it is not given.
            required: Whether an option must be given.
        """
        action = self.add_argument(
            name,
            type=kind,
            metavar=metavar,
            help=text,
            nargs=nargs,
            default=default,
        )
        action.required |= required

    def add_switch(self, flag: str, text: str) -> None:
        """Add an option without a value, which is true if it is given; `text` is its help text."""
        self.add_argument(flag, action="store_true", help=text)

    def add_json(self) -> None:
        """Add the option --json FILE, which writes the printed results to a file as JSON."""
        self.add_output("--json", help="write the figures to FILE as well")

    def add_bag(self) -> None:
        """Add the argument BAG, a bag (recording) to read."""
        self.add_value("bag", "BAG", "folder or file of the bag", Path)

    def add_bags(self) -> None:
        """Add the argument BAG ..., several bags to read."""
        self.add_value(
            "bags",
            "BAG",
            "folders or files of bags",
            Path,
            nargs="+",
        )

    def add_jobs(self) -> None:
        """Add the option --jobs N, the number of processes that work at the same time."""
        self.add_value(
            "--jobs",
            "N",
            "number of processes (default: one per core)",
            count,
        )

    def add_rate(self) -> None:
        """Add the option --rate HZ, the sample rate in a skin file."""
        self.add_value(
            "--rate",
            "HZ",
            "samples per second (default: %(default)g)",
            sample_rate,
            default=100.0,
        )

    def add_subcommand(self, name: str, text: str) -> Parser:
        """Add a subcommand, such as `grid` in ./cube config grid, and return its parser.

        Its name becomes the value of `options.what`.

        Args:
            name: Name of the subcommand.
            text: Its line of help, without a capital letter and a full stop.
        """
        if self._subcommands is None:
            self._subcommands = self.add_subparsers(
                dest="what",
                metavar="WHAT",
                required=True,
            )
        return self._subcommands.add_parser(
            name,
            help=text,
            description=make_sentence(text),
            formatter_class=make_formatter,
        )

    def add_words(
        self,
        metavar: str,
        text: str,
        missing: str = "",
    ) -> None:
        """Pass on all words that follow the command, including options, to another program.

        The parsed options have the words as the list `words`.

        Args:
            metavar: Name of the words in the help text.
            text: Help text about the words.
            missing: Error message if no word follows; empty if none is needed.
        """
        self.add_value("words", metavar, text, nargs=argparse.REMAINDER)
        self.usage = f"%(prog)s {metavar} ..."
        self._passes_words, self._missing = True, missing

    def parse(self, words: list[str]) -> argparse.Namespace:
        """Parse the words that follow the command.

        Raises:
            SystemExit: Help was printed, or the words are wrong.
        """
        if not self._passes_words:
            self._refuse_unknown(words)
            return self.parse_args(words)
        if words[:1] in (["-h"], ["--help"]):
            self.print_help()
            self.exit()
        # argparse itself does not report a missing word: it returns an empty list.
        if self._missing and not words:
            self.exit(2, f"{self._make_prefix()}{self._missing}\n")
        options = self.parse_args([])
        options.words = words
        return options

    def _refuse_unknown(self, words: list[str]) -> None:
        """Report unknown subcommands and options before argparse parses them.

        argparse would report a mistyped option as a missing one.

        Raises:
            SystemExit: A word is unknown, or a subcommand is missing.
        """
        if self._subcommands is not None:
            known = list(self._subcommands.choices)
            word = next((word for word in words if not word.startswith("-")), None)
            wants_help = "-h" in words or "--help" in words
            if word is None and not wants_help:
                self.error(f"one of these has to follow: {', '.join(known)}")
            if word is not None and word not in known:
                self.error(f"unknown command {word}; {suggest_nearest(word, known)}")
            if word is not None:
                following = words[words.index(word) + 1 :]
                self._subcommands.choices[word]._refuse_unknown(following)
            return
        flags = self._option_string_actions
        for word in words:
            if word == "--":
                break
            flag = word.partition("=")[0]
            if flag.startswith("--"):
                fits = any(known.startswith(flag) for known in flags)
            # A word such as -5 is a negative number and no option.
            elif flag[:1] == "-" and flag[1:2].isalpha():
                fits = flag[:2] in flags
            else:
                continue
            if not fits:
                self.error(f"unknown option {flag}; {suggest_nearest(flag, flags)}")

    def error(self, message: str) -> NoReturn:
        """Print an error message and the command that prints the help, and exit with code 2."""
        message = self._make_prefix() + message.removeprefix("argument ")
        self.exit(2, f"{message}\n      {self.prog} --help lists what is possible\n")

    def _make_prefix(self) -> str:
        name = self.prog.partition(" ")[2]
        return f"cube: {name}: " if name else "cube: "


def make_formatter(prog: str) -> argparse.HelpFormatter:
    """Return a formatter of help texts for the width of the terminal."""
    return argparse.HelpFormatter(prog, width=find_help_width() - 2)


def find_help_width() -> int:
    """Return the width of help texts, in characters: that of the terminal, at most `MAX_WIDTH`."""
    return min(shutil.get_terminal_size().columns, MAX_WIDTH)


def make_sentence(text: str) -> str:
    """Return a line of help with a capital letter at its beginning and a full stop at its end."""
    return f"{text[0].upper()}{text[1:]}."


def suggest_nearest(word: str, known: Iterable[str]) -> str:
    """Return a question that suggests similar words, or else the list of all known words.

    Args:
        word: The unknown word.
        known: The known commands or options.
    """
    # The words are compared without their dashes, which would make all options similar. Short
    # options such as -o are left out, because they are similar to every short word.
    names = {one.lstrip("-"): one for one in known if len(one) > 2}
    close = difflib.get_close_matches(word.lstrip("-"), names, n=2)
    if close:
        meant = " or ".join(names[one] for one in close)
        return f"did you mean {meant}?"
    return f"known: {', '.join(names.values())}"


def check_outputs(options: argparse.Namespace) -> None:
    """Check that all outputs of a command can be written, before it begins its work.

    Defaults of outputs that are functions of the options are replaced by their values.

    Args:
        options: The parsed options of the command, which this function changes.

    Raises:
        ConfigError: A file or folder cannot be written, or its suffix is wrong.
    """
    from ..config.output_files import check_folder, check_outputs, check_yaml
    from ..core.errors import ConfigError

    files: dict[str, Path] = {}
    for output in getattr(options, "outputs", ()):
        value = getattr(options, output.name)
        # A default that depends on other options is a function, see `Parser.add_output`.
        if callable(value):
            value = value(options)
            setattr(options, output.name, value)
        if value is None:
            continue
        if output.kind == "folder":
            check_folder(output.flag, value)
            continue
        files[output.flag] = value
        if output.kind in ("yaml", "skin"):
            check_yaml(output.flag, value)
        # Users edit skin files, so none is overwritten.
        if output.kind == "skin" and value.exists():
            raise ConfigError(
                f"{output.flag} {value}: the file exists; remove it, or name another one"
            )
        if output.kind == "picture":
            # Checking a picture format needs matplotlib, whose import is slow.
            from ..views.figures.style import check_picture

            check_picture(value)
    check_outputs(files)


def _make_number_type(
    kind: Callable[[str], Number],
    what: str,
    is_allowed: Callable[[Number], bool],
) -> Callable[[str], Number]:
    """Return a function that converts the text of an argument into a number and checks its range.

    Args:
        kind: Function that converts a text into a number, such as `float`.
        what: Description of the allowed numbers, for the error message.
        is_allowed: Function that returns whether a number is in the allowed range.
    """

    def convert(text: str) -> Number:
        with contextlib.suppress(ValueError):
            value = kind(text)
            if is_allowed(value):
                return value
        raise argparse.ArgumentTypeError(f"{text!r} is not {what}")

    return convert


number = _make_number_type(float, "a finite number", math.isfinite)
positive = _make_number_type(
    float,
    "a number above 0",
    lambda x: 0 < x < math.inf,
)
not_negative = _make_number_type(
    float,
    "a number of at least 0",
    lambda x: 0 <= x < math.inf,
)
sample_rate = _make_number_type(
    float,
    "a rate from 0.1 to 10000 samples per second",
    # Hubs and skin files have the same limits.
    lambda rate: 0.1 <= rate <= 10_000,
)
count = _make_number_type(
    int,
    "a whole number of at least 1",
    lambda n: n >= 1,
)
whole_number = _make_number_type(
    int,
    "a whole number of at least 0",
    lambda n: n >= 0,
)
tcp_port = _make_number_type(
    int,
    "a TCP port, 1 to 65535",
    lambda n: 1 <= n <= 65535,
)
uid = _make_number_type(
    # With base 0, `int` accepts decimal numbers, and hexadecimal numbers that begin with 0x.
    lambda text: int(text, 0),
    "a uid, 0 to 2^64 - 1",
    lambda n: 0 <= n < 1 << 64,
)
