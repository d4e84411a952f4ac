"""The command line: words become options, errors become exit codes.

Exit codes: 0 done, 1 an error (CubeError) or a check that failed, 2 usage, 130 Ctrl-C.
"""

from __future__ import annotations

import argparse
import importlib
import os
import re
import signal
import sys
import textwrap
import threading
from collections.abc import Sequence
from typing import Any

from .parser import Parser, check_outputs, columns, nearest, sentence
from .table import COMMANDS, GROUPS, PACKAGES

PROGRAM = "./cube"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; returns its exit code. SystemExit: help, the version or a usage error."""
    options = parse(sys.argv[1:] if arguments is None else arguments)
    from ..core.errors import CubeError

    try:
        check_outputs(options)
        return int(options.run(options))
    except CubeError as error:
        print(f"cube: {error}", file=sys.stderr)
        return 1
    except ModuleNotFoundError as error:
        # Not every command needs every library; those without a rosdep key are installed by hand.
        module = (error.name or "").split(".")[0]
        print(
            f"cube: this command needs the Python module {module}, which is not there: "
            f"pip install {module}",
            file=sys.stderr,
        )
        return 1
    except KeyboardInterrupt:
        return 130


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """The options of a command; its function is options.run.

    Needs the standard library only. SystemExit: help, the version or a usage error, said by now.
    """
    words = list(arguments)
    if words[:1] == ["help"]:
        words = [*words[1:], "--help"]
    if not words or words[0] in ("-h", "--help"):
        print(help_text())
        raise SystemExit(0)
    if words[0] == "--version":
        print(f"cube_tensor_driver {version()}")
        raise SystemExit(0)
    return command_parser(words[0]).parse_args(words[1:])


def command_parser(name: str) -> Parser:
    """SystemExit: there is no such command."""
    if name.startswith("--distro"):
        Parser(prog=PROGRAM).error("--distro is an option of ./cube in a checkout")
    if name not in COMMANDS:
        kind = "option" if name.startswith("-") else "command"
        close = nearest(name, [*COMMANDS, "help", "--help", "--version", "--distro"])
        Parser(prog=PROGRAM).error(f"unknown {kind} {name}; {close}")
    package = PACKAGES.get(name, __package__.partition(".")[0])
    try:
        module = importlib.import_module(f"{package}.cli.{name}")
    except ModuleNotFoundError as error:
        if error.name != package:
            raise
        Parser(prog=PROGRAM).error(
            f"the command {name} is not part of the driver: run it as ./cube {name} in a checkout"
        )
    parser = Parser(prog=f"{PROGRAM} {name}", description=sentence(COMMANDS[name]))
    module.arguments(parser)
    parser.set_defaults(run=module.run)
    return parser


def help_text() -> str:
    """All commands in groups, as wide as the terminal."""
    width = columns()
    indent = max(map(len, COMMANDS)) + 4
    lines = [
        f"usage: {PROGRAM} COMMAND [OPTION ...]",
        "",
        "Driver for cubic stress tensor sensors on ROS 2.",
    ]
    for heading, commands in GROUPS.items():
        lines += ["", f"{heading}:"]
        for name, text in commands.items():
            first = f"  {name}".ljust(indent)
            lines += textwrap.wrap(
                text, width, initial_indent=first, subsequent_indent=" " * indent
            )
    last = (
        f"{PROGRAM} COMMAND --help explains a command, {PROGRAM} --version prints the version, "
        f"{PROGRAM} --distro kilted COMMAND runs it with another ROS 2."
    )
    return "\n".join([*lines, "", *textwrap.wrap(last, width)])


def version() -> str:
    """Of package.xml in a checkout and an install space, of the metadata where pip installed it."""
    from importlib import metadata

    from ..config.package_data import package_data
    from ..core.errors import ConfigError

    try:
        text = (package_data() / "package.xml").read_text(encoding="utf-8")
        return re.findall(r"<version>(.+?)</version>", text)[0]
    except (ConfigError, OSError, IndexError):
        return metadata.version("cube_tensor_driver")


def interrupt_again(lost: Any) -> None:
    """sys.unraisablehook: sends SIGINT again.

    A Ctrl-C that arrives in a destructor or at the end of an import would be lost.
    """
    if lost.exc_type is KeyboardInterrupt:
        # At once it would be lost in here.
        threading.Timer(0.01, os.kill, (os.getpid(), signal.SIGINT)).start()
    else:
        sys.__unraisablehook__(lost)
