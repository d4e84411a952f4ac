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

INTERRUPTED = 130
"""Exit code after Ctrl-C: 128 plus the number of SIGINT, as shells count."""

RESEND_S = 0.01
"""Time, in seconds, after which a lost Ctrl-C is sent again."""

WHEELS = {
    "PIL": "pillow",
    "serial": "pyserial",
    "skfem": "scikit-fem",
    "yaml": "pyyaml",
}
"""Name of a module -> name of its package on PyPI, where they differ."""

DEBIAN_MODULES = {
    *("PIL", "jsonschema", "matplotlib", "numpy", "psutil", "rich", "scipy", "serial"),
    *("transforms3d", "websockets", "yaml", "zstandard"),
}
"""Modules that Debian and Ubuntu have as python3-MODULE, in small letters."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code.

    Args:
        arguments: The words of the command; None: those of this process.

    Raises:
        SystemExit: Help or the version was printed, or the usage is wrong.
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
        print(f"cube: {missing_module_text(error.name or '')}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return INTERRUPTED


def missing_module_text(name: str) -> str:
    """Return what to install where a module is missing, as one line."""
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
    """Return the options of a command; its function is `options.run`.

    It needs the standard library only.

    Raises:
        SystemExit: Help or the version was printed, or the usage is wrong.
    """
    words = list(arguments)
    # ./cube help demo is the same as ./cube demo --help.
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
    """Return the parser of a command.

    Raises:
        SystemExit: There is no such command.
    """
    # ./cube handles --distro before Python starts; without the checkout nobody does.
    if name.startswith("--distro"):
        Parser(prog=PROGRAM).error("--distro is an option of ./cube in a checkout")
    if name not in COMMANDS:
        kind = "option" if name.startswith("-") else "command"
        close = nearest(name, [*COMMANDS, "help", "--help", "--version", "--distro"])
        Parser(prog=PROGRAM).error(f"unknown {kind} {name}; {close}")

    # Commands for designers and developers are in packages of their own.
    package = PACKAGES.get(name, __package__.partition(".")[0])
    try:
        # Only the module of this command is imported, to start quickly.
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
    """Return the list of all commands in groups, as wide as the terminal."""
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
    """Return the version of the package.

    In a checkout and in an install space package.xml states it; where pip installed the package
    without its data, the metadata do.
    """
    from importlib import metadata

    from ..config.package_data import package_data
    from ..core.errors import ConfigError

    try:
        text = (package_data() / "package.xml").read_text(encoding="utf-8")
        return str(re.findall(r"<version>(.+?)</version>", text)[0])
    except (ConfigError, OSError, IndexError):
        return metadata.version("cube_tensor_driver")


def interrupt_again(lost: Any) -> None:
    """Send SIGINT again where Python has lost it; a value for `sys.unraisablehook`.

    Python drops the KeyboardInterrupt of a Ctrl-C that arrives in a destructor or at the end of an
    import.
    """
    if lost.exc_type is KeyboardInterrupt:
        # Sent at once, it would arrive in this hook and be lost as well.
        threading.Timer(RESEND_S, os.kill, (os.getpid(), signal.SIGINT)).start()
    else:
        sys.__unraisablehook__(lost)
