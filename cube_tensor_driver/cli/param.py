# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""./cube param: list, read or set parameters of running nodes."""

from __future__ import annotations

import argparse

from .parser import Parser


def add_arguments(parser: Parser) -> None:
    """Add the options of the command."""
    parser.add_value("node", "NODE", "as in reconstruction", nargs="?")
    parser.add_value(
        "name",
        "NAME",
        "the parameter (default: all)",
        nargs="?",
    )
    parser.add_value(
        "value",
        "VALUE",
        "set it to this, as in YAML",
        nargs="?",
    )


def run(options: argparse.Namespace) -> int:
    """List, read or set the parameters of nodes that run."""
    from ..ros.commands.services import list_nodes, read_parameters, set_parameter

    if options.node is None:
        print("\n".join(list_nodes()))
    elif options.value is not None:
        value = set_parameter(options.node, options.name, options.value)
        print(f"{options.name}: {format_value(value)}")
    else:
        for name, value in read_parameters(options.node, options.name).items():
            print(f"{name}: {format_value(value)}")
    return 0


def format_value(value: object) -> str:
    """Return the value of a parameter as YAML on one line."""
    from ..config.yaml import to_yaml

    # PyYAML writes an end-of-document mark ("...") after a single text. Therefore the value is
    # written as a list with one entry, and the brackets of the list are removed.
    text = to_yaml([value]).strip()
    return text.removeprefix("[").removesuffix("]")
