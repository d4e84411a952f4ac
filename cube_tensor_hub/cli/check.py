# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""./cube check: test whether a hub keeps every rule of docs/protocol.md."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from cube_tensor_driver.cli.parser import Parser, count

if TYPE_CHECKING:
    from ..check import Checked


def add_arguments(parser: Parser) -> None:
    """Add the options of the command."""
    parser.add_value("port", "PORT", "device path, or socket://host:port")
    parser.add_value(
        "--baud",
        "N",
        "rate of a serial port (default: %(default)s)",
        count,
        default=921_600,
    )
    parser.add_json()
    parser.epilog = (
        "Takes half a minute. The hub is started and stopped, its sample period changes and is set "
        "back at the end, and its port is closed and opened twice. End a driver that has the port "
        "open first. docs/firmware.md says more."
    )


def run(options: argparse.Namespace) -> int:
    """Return 1 if the hub breaks a rule, else 0."""
    from cube_tensor_driver.config.output_files import write_json
    from cube_tensor_driver.views.terminal.output import show_progress_bar

    from ..check import check
    from ..port_wire import PortWire

    with PortWire(options.port, options.baud) as wire, show_progress_bar() as report:
        checked = check(wire, report)
    show_check(checked)
    if options.json is not None:
        write_json(options.json, checked.to_dict())
    return 1 if checked.list_failed() else 0


def show_check(checked: Checked) -> None:
    """Print the hub, a line for each rule, and how many rules have each outcome."""
    from rich.console import Console
    from rich.text import Text

    from ..rule import RULES, Outcome

    styles = {Outcome.PASSED: "green", Outcome.FAILED: "bold red", Outcome.NOT_TRIED: "dim"}
    console = Console(highlight=False, soft_wrap=True)
    hello = checked.hello
    if hello is not None:
        console.print(
            f"{checked.port}: hub 0x{hello.hub_uid:x}, {hello.n_cubes} cubes of {hello.n_pads} "
            f"pads, firmware 0x{hello.firmware:x}",
            markup=False,
        )
    for number, result in checked.results.items():
        line = Text(f"{number}  ")
        line.append(f"{result.outcome.value:<9}", styles[result.outcome])
        line.append(f"  {result.text}")
        if result.outcome is Outcome.FAILED:
            rule = RULES[number]
            line.append(f". The page says: {rule.says} (docs/protocol.md, {rule.section})")
        console.print(line)
    counts = [f"{checked.count(outcome)} {outcome.value}" for outcome in Outcome]
    console.print(f"{len(checked.results)} rules: {', '.join(counts)}")
