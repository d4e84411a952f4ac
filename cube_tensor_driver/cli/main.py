# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Main function of the command line, which runs a command and turns errors into exit codes.

The exit code is 0 after success, 1 after an error (CubeError) or a failed check, 2 if the command
line is wrong, and 130 after Ctrl-C.
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

from ..processes.stop_signals import INTERRUPTED
from .parser import (
    Parser,
    check_outputs,
    find_help_width,
    make_formatter,
    make_sentence,
    suggest_nearest,
)
from .table import COMMANDS, GROUPS, PACKAGES

PROGRAM = "./cube"
"""Name of the program in help texts and error messages."""

BROKEN_PIPE = 141
"""Exit code if the reader of the standard output has closed the pipe, as in `./cube topics | head`.

It is 128 plus the number of the signal SIGPIPE: shells report it for programs that this signal has
ended.
"""

RESEND_S = 0.2
"""Time, in seconds, after which SIGINT is sent again if Python has lost the KeyboardInterrupt of a
Ctrl-C (see `interrupt_again`).

A signal that arrives before `sys.unraisablehook` has returned would be lost as well. The time is
long enough for this function to return even on a busy machine, and so short that a user does not
notice it.
"""

WHEELS = {
    "PIL": "pillow",
    "serial": "pyserial",
    "skfem": "scikit-fem",
    "yaml": "pyyaml",
}
"""Name of a Python module -> name of its package on PyPI, for modules whose names differ."""

DEBIAN_MODULES = {
    *("PIL", "jsonschema", "matplotlib", "numpy", "psutil", "rich", "scipy", "serial"),
    *("transforms3d", "websockets", "yaml", "zstandard"),
}
"""Names of Python modules that Debian and Ubuntu offer as a package.

The name of the package is "python3-" and the name of the module in lower case.
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code.

    Args:
        arguments: The command and its options; None: those with which this process was started.

    Raises:
        SystemExit: Help or the version was printed, or the command line is wrong.
    """
    options = parse(sys.argv[1:] if arguments is None else arguments)
    from ..core.errors import CubeError

    try:
        check_outputs(options)
        return int(options.run(options))
    except CubeError as error:
        print(f"cube: {error}", file=sys.stderr)
        return 1
    except ModuleNotFoundError as error:
        # Libraries that only some commands need are not installed with the package.
        print(f"cube: {explain_missing_module(error.name or '')}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return INTERRUPTED


def explain_missing_module(name: str) -> str:
    """Return an error message of one line that tells how to install a missing Python module."""
    module = name.partition(".")[0]
    needs = f"this command needs the Python module {module}, which is not installed: "
    if module in ("rclpy", __package__.partition(".")[0]) or module.endswith("_msgs"):
        needs = f"this command needs ROS 2, and {name} is not there: "
        return f"{needs}run it as ./cube, or source a workspace in which the package was built"
    text = f"{needs}pip install {WHEELS.get(module, module)}"
    if module in DEBIAN_MODULES:
        text += f", or sudo apt install python3-{module.lower()}"
    return text


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """Return the options of a command, with the function that executes it as `options.run`.

    Only the standard library is required, because ./cube also parses before other libraries are
    installed.

    Args:
        arguments: The command and its options.

    Raises:
        SystemExit: Help or the version was printed, or the command line is wrong.
    """
    words = list(arguments)
    # ./cube help COMMAND is the same as ./cube COMMAND --help.
    if words[:1] == ["help"]:
        words = [*words[1:], "--help"]
    if not words or words[0] in ("-h", "--help"):
        print(make_help_text())
        raise SystemExit(0)
    if words[0] == "--version":
        print(f"cube_tensor_driver {find_version()}")
        raise SystemExit(0)
    return make_command_parser(words[0]).parse(words[1:])


def make_command_parser(name: str) -> Parser:
    """Return the parser of the options of a command.

    Args:
        name: Name of the command.

    Raises:
        SystemExit: There is no such command, or it is not part of this installation.
    """
    # The script ./cube of a checkout handles --distro before it starts Python. If the option
    # arrives here, the package was started without that script.
    if name.startswith("--distro"):
        Parser(prog=PROGRAM).error("--distro is an option of ./cube in a checkout")
    if name not in COMMANDS:
        kind = "option" if name.startswith("-") else "command"
        close = suggest_nearest(name, [*COMMANDS, "help", "--help", "--version", "--distro"])
        Parser(prog=PROGRAM).error(f"unknown {kind} {name}; {close}")

    # Commands for designers and developers are not part of the driver's package, see `PACKAGES`.
    package = PACKAGES.get(name, __package__.partition(".")[0])
    try:
        # Importing the modules of all commands would make the start slow.
        module = importlib.import_module(f"{package}.cli.{name}")
    except ModuleNotFoundError as error:
        if error.name != package:
            raise
        Parser(prog=PROGRAM).error(
            f"the command {name} is not part of the driver: run it as ./cube {name} in a checkout"
        )
    parser = Parser(
        prog=f"{PROGRAM} {name}",
        description=make_sentence(COMMANDS[name]),
        formatter_class=make_formatter,
    )
    module.add_arguments(parser)
    parser.set_defaults(run=module.run)
    return parser


def make_help_text() -> str:
    """Return the text of ./cube --help: all commands in groups, wrapped to the terminal's width."""
    width = find_help_width()
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
                text,
                width,
                initial_indent=first,
                subsequent_indent=" " * indent,
            )
    last = (
        f"{PROGRAM} COMMAND --help explains a command, {PROGRAM} --version prints the version, "
        f"{PROGRAM} --distro kilted COMMAND runs it with another ROS 2."
    )
    return "\n".join([*lines, "", *textwrap.wrap(last, width)])


def find_version() -> str:
    """Return the version of the package.

    In a checkout and in an install space of ROS, it is read from package.xml. If pip installed the
    package without its data files, it is read from the metadata of pip.
    """
    from importlib import metadata

    from ..config.package_data import find_package_data
    from ..core.errors import ConfigError

    try:
        text = (find_package_data() / "package.xml").read_text(encoding="utf-8")
        return str(re.findall(r"<version>(.+?)</version>", text)[0])
    except (ConfigError, OSError, IndexError):
        return metadata.version("cube_tensor_driver")


def interrupt_again(lost: sys.UnraisableHookArgs) -> None:
    """Send SIGINT again after Python has lost a Ctrl-C; a function for `sys.unraisablehook`.

    Python drops the KeyboardInterrupt of a Ctrl-C that arrives in a destructor or at the end of an
    import.

    Args:
        lost: The exception that Python could not raise, as it passes it to the hook.
    """
    if lost.exc_type is KeyboardInterrupt:
        # A signal that is sent at once would arrive inside of this hook and be lost as well.
        threading.Timer(
            RESEND_S,
            os.kill,
            (os.getpid(), signal.SIGINT),
        ).start()
    else:
        sys.__unraisablehook__(lost)
