# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""./cube firmware build, run, test: build, run and test the hubs in C."""

from __future__ import annotations

import argparse
import subprocess
import sys
import threading
from pathlib import Path
from typing import TYPE_CHECKING

from cube_tensor_driver.cli import ROOT
from cube_tensor_driver.cli.parser import Parser

if TYPE_CHECKING:
    from cube_tensor_driver.config.skin import Skin
    from cube_tensor_driver.simulation.cubes import HubCubes

OUT = ROOT / ".cube" / "firmware"
"""Folder for the built firmware, inside of the checkout."""

SOURCE = ROOT / "firmware"
"""Folder of the C sources of the firmware."""

EMULATED_HUB = (4, 8)
"""Number of cubes of the emulated hub, and number of pads of each of them."""


def add_arguments(parser: Parser) -> None:
    """Add the options of the command."""
    parser.add_subcommand("build", "compile the hubs in C, and print how large one is")
    run = parser.add_subcommand("run", "run the hub of a microcontroller in QEMU, under a load")
    run.add_value(
        "--config",
        "FILE",
        "skin file of 4 cubes of 8 pads on one TCP link, at whose port the hub appears "
        "(default: skin_firmware.yaml of the package)",
        Path,
    )
    run.add_value(
        "--load",
        "FILE",
        "load script (default: an indenter that wanders)",
        Path,
    )
    parser.add_subcommand("test", "run the tests of the firmware")


def run(options: argparse.Namespace) -> int:
    """Build, run or test the hubs in C."""
    return {"build": build_all, "run": run_emulated, "test": run_tests}[options.what](options)


def build_all(options: argparse.Namespace) -> int:
    """Build the hub as a process and the hub for a microcontroller.

    Raises:
        FirmwareError: A compiler is missing; what was built before stays.
    """
    from ..firmware import build

    build(SOURCE, OUT, "posix")
    print(f"{OUT / 'cube_hub'}: hubs as a process of this machine")
    said = build(SOURCE, OUT, "an386")
    print(f"{OUT / 'hub.elf'}: a hub of 4 cubes of 8 pads for MPS2-AN386")
    print(said.splitlines()[-1])
    return 0


def run_emulated(options: argparse.Namespace) -> int:
    """Emulate a hub under a load until Ctrl-C."""
    from cube_tensor_driver.config.load_script import read_script
    from cube_tensor_driver.device.links.tcp import parse_url
    from cube_tensor_driver.simulation.load import Load, read_default_script

    from ..captures import Oscillators
    from ..firmware import Emulator, build, need

    need("the emulated hub", "make", "arm-none-eabi-gcc", "qemu-system-arm")
    skin, hub = read_skin_of_hub(options.config)
    script = read_default_script() if options.load is None else read_script(options.load)
    build(SOURCE, OUT, "an386")
    # The pads live in this process; the emulated hub measures them over a socket.
    pads = Oscillators(hub, Load(skin, script))
    with Emulator(OUT / "hub.elf", parse_url(hub.link.port)) as emulator:
        print(f"the hub is at {emulator.port}, under a load; Ctrl-C ends it", flush=True)
        server = threading.Thread(
            target=pads.serve,
            args=(emulator.pads,),
            daemon=True,
        )
        server.start()
        # The server ends when QEMU ends, which closes the line.
        server.join()
        emulator.check()
    return 0


def read_skin_of_hub(path: Path | None) -> tuple[Skin, HubCubes]:
    """Return the skin whose pads the emulated hub measures, and the cubes of the hub.

    Raises:
        CubeError: The skin file cannot be used, or has other cubes than the emulated hub.
    """
    from cube_tensor_driver.config.package_data import find_package_data
    from cube_tensor_driver.config.skin import read_skin
    from cube_tensor_driver.core.errors import ConfigError
    from cube_tensor_driver.simulation.cubes import make_hub_cubes

    skin = read_skin(path or find_package_data() / "config" / "skin_firmware.yaml")
    hubs = make_hub_cubes(skin)
    sizes = [(len(hub.members), hub.cubes.n_pads) for hub in hubs]
    if sizes != [EMULATED_HUB]:
        raise ConfigError(
            f"{path}: hubs with (cubes, pads) {sizes}; the emulated hub has 4 cubes of 8 pads"
        )
    return skin, hubs[0]


def run_tests(options: argparse.Namespace) -> int:
    """Run the tests of the firmware and return the exit code of pytest."""
    command = [sys.executable, "-m", "pytest", "test/hub/test_firmware.py", "-rs"]
    return subprocess.run(command, cwd=ROOT, check=False).returncode
