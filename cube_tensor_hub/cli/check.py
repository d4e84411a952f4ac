"""./cube check: does a hub keep every rule of docs/protocol.md?"""

from __future__ import annotations

import argparse

from cube_tensor_driver.cli.parser import Parser, count


def arguments(parser: Parser) -> None:
    parser.add_argument("port", metavar="PORT", help="device path, or socket://host:port")
    parser.add_argument(
        "--baud",
        type=count,
        default=921_600,
        metavar="N",
        help="rate of a serial port (default: %(default)s)",
    )
    parser.add_json()
    parser.epilog = (
        "Takes half a minute. The hub is started and stopped, its sample period changes and is set "
        "back at the end, and its port is closed and opened once. End a driver that has the port "
        "open first. docs/firmware.md says more."
    )


def run(options: argparse.Namespace) -> int:
    """1 if the hub breaks a rule, else 0."""
    from cube_tensor_driver.config.output_files import write_json
    from cube_tensor_driver.views.terminal.output import progress_bar

    from ..check import check
    from ..port_wire import PortWire
    from ..show_check import show_check

    with PortWire(options.port, options.baud) as wire, progress_bar() as report:
        result = check(wire, report)
    show_check(result)
    if options.json is not None:
        write_json(options.json, result.to_dict())
    return 1 if result.failed() else 0
