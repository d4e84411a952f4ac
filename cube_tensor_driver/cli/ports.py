# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""./cube ports: list the serial ports, and which of them answer as hubs."""

from __future__ import annotations

import argparse

from .parser import Parser


def add_arguments(parser: Parser) -> None:
    """Add the options of the command."""
    parser.epilog = (
        "Asks each port for one second who is there, and starts nothing. Ports that a running "
        "driver has open are busy: its diagnostics name their hubs."
    )


def run(options: argparse.Namespace) -> int:
    """Print one line per serial port: the hub that answers on it, or why none does.

    Raises:
        CubeError: This machine has no serial port.
    """
    from ..core.errors import CubeError
    from ..device.links.search import ask_ports, find_ports

    ports = find_ports()
    if not ports:
        raise CubeError("no serial port on this machine; plug a hub in, or start ./cube demo")
    ask_ports(ports)
    for port in ports:
        name = f"{port.path} ({port.description})" if port.description else port.path
        hello = port.hello
        if hello is not None:
            print(
                f"{name}: hub 0x{hello.hub_uid:x}, {hello.n_cubes} cubes of {hello.n_pads} pads, "
                f"{format_rate(hello.period_us)}, firmware 0x{hello.firmware:x}"
            )
        # The port could not be opened, because a driver uses it or this user has no permission.
        elif port.problem:
            print(port.problem)
        else:
            print(f"{name}: no answer within 1 s; not a hub, or no power")
    return 0


def format_rate(period_us: int) -> str:
    """Return the sample rate of a hub as text.

    Args:
        period_us: Time between two samples, in µs; 0 if the hub has not been given a rate yet.
    """
    return f"{1e6 / period_us:.4g} Hz" if period_us else "rate not set"
