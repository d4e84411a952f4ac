"""How words become options: a parser whose errors are short, and the types of arguments."""

from __future__ import annotations

import argparse
import difflib
import math
import shutil
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

WIDEST = 100
"""Columns of a help text, however wide the terminal is."""


@dataclass(frozen=True)
class Output:
    """A file or folder that a command writes, to be checked before any work.

    kind: file, yaml (its suffix says so), picture (its suffix must be a format) or folder.
    """

    flag: str
    name: str
    kind: str


class Parser(argparse.ArgumentParser):
    """An ArgumentParser whose errors are two lines and suggest the nearest word."""

    def __init__(self, **settings: Any) -> None:
        self._flags: list[str] = []
        self._outputs: list[Output] = []
        self._subcommands: Any = None
        self._words: str | None = None
        self._missing = ""
        settings.setdefault("formatter_class", formatter)
        super().__init__(**settings)

    def add_argument(self, *flags: Any, **settings: Any) -> argparse.Action:
        action = super().add_argument(*flags, **settings)
        self._flags += action.option_strings
        return action

    def add_output(self, *flags: str, kind: str = "file", **settings: Any) -> None:
        """An argument that names an output. Its default may be a function of the options."""
        metavar = "DIR" if kind == "folder" else "FILE"
        action = self.add_argument(*flags, **{"type": Path, "metavar": metavar} | settings)
        self._outputs.append(Output(flags[0], action.dest, kind))
        self.set_defaults(outputs=self._outputs)

    def add_json(self) -> None:
        """--json FILE, which has one meaning in all commands."""
        self.add_output("--json", help="write the figures to FILE as well")

    def add_subcommand(self, name: str, text: str) -> Parser:
        """The parser of a word that has to follow this command; it becomes options.what."""
        if self._subcommands is None:
            self._subcommands = self.add_subparsers(dest="what", metavar="WHAT", required=True)
        added: Parser = self._subcommands.add_parser(name, help=text, description=sentence(text))
        return added

    def add_words(self, name: str, metavar: str, text: str, missing: str = "") -> None:
        """All words that follow, options too, belong to another program; missing: what to say
        without any."""
        self.add_argument(name, nargs=argparse.REMAINDER, metavar=metavar, help=text)
        self.usage = f"%(prog)s {metavar} ..."
        self._words, self._missing = name, missing

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        words = list(args or ())
        if self._words is None:
            self._refuse_unknown(words)
            return super().parse_known_args(words, namespace)
        if words[:1] in (["-h"], ["--help"]):
            self.print_help()
            self.exit()
        if self._missing and not words:
            self.exit(2, f"{self._prefix()}{self._missing}\n")
        namespace, _ = super().parse_known_args([], namespace)
        setattr(namespace, self._words, words)
        return namespace, []

    def _refuse_unknown(self, words: list[str]) -> None:
        """Before argparse looks, which would call a mistyped option a missing one."""
        if self._subcommands is not None:
            known = list(self._subcommands.choices)
            word = next((word for word in words if not word.startswith("-")), None)
            if word is None and not {"-h", "--help"} & set(words):
                self.error(f"one of these has to follow: {', '.join(known)}")
            if word is not None and word not in known:
                self.error(f"unknown command {word}; {nearest(word, known)}")
            return
        for word in words:
            if word == "--":
                break
            flag = word.partition("=")[0]
            if flag.startswith("--"):
                fits = any(known.startswith(flag) for known in self._flags)
            elif flag[:1] == "-" and flag[1:2].isalpha():
                fits = flag[:2] in self._flags
            else:
                continue
            if not fits:
                self.error(f"unknown option {flag}; {nearest(flag, self._flags)}")

    def error(self, message: str) -> NoReturn:
        """Exit with 2. What is wrong in one line, where the help is in another."""
        message = self._prefix() + message.removeprefix("argument ")
        self.exit(2, f"{message}\n      {self.prog} --help lists what is possible\n")

    def _prefix(self) -> str:
        name = self.prog.partition(" ")[2]
        return f"cube: {name}: " if name else "cube: "


def formatter(prog: str) -> argparse.HelpFormatter:
    """As wide as the terminal, but not wider than a person likes to read."""
    return argparse.HelpFormatter(prog, width=columns() - 2)


def columns() -> int:
    return min(shutil.get_terminal_size().columns, WIDEST)


def sentence(text: str) -> str:
    """A line of the table as a sentence."""
    return f"{text[0].upper()}{text[1:]}."


def nearest(word: str, known: Iterable[str]) -> str:
    """The question after an unknown word, or all words that are known."""
    # Without the dashes, which would make all options alike.
    names = {one.lstrip("-"): one for one in known if len(one) > 2}
    close = difflib.get_close_matches(word.lstrip("-"), names, n=2)
    if close:
        return f"did you mean {' or '.join(names[one] for one in close)}?"
    return f"known: {', '.join(names.values())}"


def check_outputs(options: argparse.Namespace) -> None:
    """ConfigError, before any work: an output that cannot be written. Fills in their defaults."""
    from ..config.output_files import check_folder, check_outputs, check_yaml

    files: dict[str, Path | None] = {}
    pictures: list[Path] = []
    for output in getattr(options, "outputs", ()):
        value = getattr(options, output.name)
        if callable(value):
            value = value(options)
            setattr(options, output.name, value)
        if output.kind == "yaml":
            check_yaml(output.flag, value)
        if output.kind == "folder":
            check_folder(output.flag, value)
        else:
            files[output.flag] = value
        if output.kind == "picture" and value is not None:
            pictures.append(value)
    check_outputs(files)
    if pictures:
        from ..views.figures.style import check_picture

        for picture in pictures:
            check_picture(picture)


def _number(kind: Callable[[str], Any], text: str, what: str, fits: Callable[[Any], bool]) -> Any:
    try:
        value = kind(text)
    except ValueError:
        value = None
    if value is None or not fits(value):
        raise argparse.ArgumentTypeError(f"{text!r} is not {what}")
    return value


def number(text: str) -> float:
    return float(_number(float, text, "a finite number", math.isfinite))


def positive(text: str) -> float:
    return float(_number(float, text, "a number above 0", lambda x: 0 < x < math.inf))


def sample_rate(text: str) -> float:
    """What hubs and skin files take."""
    what = "a rate from 0.1 to 10000 samples per second"
    return float(_number(float, text, what, lambda x: 0.1 <= x <= 10_000))


def not_negative(text: str) -> float:
    return float(_number(float, text, "a number of at least 0", lambda x: 0 <= x < math.inf))


def count(text: str) -> int:
    return int(_number(int, text, "a whole number of at least 1", lambda n: n >= 1))


def whole_number(text: str) -> int:
    return int(_number(int, text, "a whole number of at least 0", lambda n: n >= 0))


def tcp_port(text: str) -> int:
    return int(_number(int, text, "a TCP port, 1 to 65535", lambda n: 1 <= n <= 65535))


def uid(text: str) -> int:
    """Decimal, or hexadecimal with 0x in front."""
    what = "a uid, 0 to 2^64 - 1"
    return int(_number(lambda word: int(word, 0), text, what, lambda n: 0 <= n < 1 << 64))
