# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""python without_posix.py BAG OUT: what must run on Windows, with what Windows lacks taken away.

Other libraries keep the modules, because on Linux they need them.
"""

from __future__ import annotations

import builtins
import importlib
import itertools
import os
import pkgutil
import select
import signal
import sys
from pathlib import Path

MODULES = {"fcntl", "grp", "pty", "pwd", "resource", "termios", "tty"}
ATTRIBUTES = {
    os: ("EX_CONFIG", "killpg", "mkfifo", "openpty", "set_blocking", "ttyname"),
    select: ("poll",),
    signal: ("SIGHUP", "SIGKILL", "SIGSTOP", "SIGCONT", "SIGPIPE", "pthread_kill"),
}
OWN = ("cube_tensor_driver", "cube_tensor_design", "cube_tensor_hub")

full_import = builtins.__import__


def windows_import(name, globals=None, *arguments):
    """Import as Windows would, where this package imports."""
    package = (globals or {}).get("__name__", "").partition(".")[0]
    if package in OWN and name in MODULES:
        raise ModuleNotFoundError(f"No module named {name!r}", name=name)
    return full_import(name, globals, *arguments)


def main(bag: Path, out: Path) -> None:
    for module, names in ATTRIBUTES.items():
        for name in names:
            if hasattr(module, name):  # not on Windows itself
                delattr(module, name)
    builtins.__import__ = windows_import
    import cube_tensor_driver as ctd

    for found in pkgutil.walk_packages(ctd.__path__, f"{ctd.__name__}.", onerror=lambda name: None):
        if found.name.endswith("__main__") or found.name.rpartition(".")[2].startswith("_"):
            continue
        try:
            importlib.import_module(found.name)
        except ImportError as error:
            # Other libraries may be missing here: those of ROS and of extras.
            assert error.name not in MODULES, f"{found.name}: {error}"

    from cube_tensor_driver.config.package_data import find_package_data

    skin = ctd.read_skin(find_package_data() / "config" / "skin_demo.yaml")
    for source in (ctd.simulate(skin), ctd.open_bag(bag)):
        with source:
            reconstruct = ctd.Reconstructor(source.skin)
            assert sum(len(reconstruct(rows)) for rows in itertools.islice(source, 50)) >= 50

    from cube_tensor_driver.bags.repair import repair
    from cube_tensor_driver.cli.main import main as cube
    from cube_tensor_driver.processes.children import Children
    from cube_tensor_driver.simulation.line import SimulatedLine

    assert cube(["reprocess", str(bag), "-o", str(out), "--format", "bag", "--jobs", "1"]) == 0
    repair(out / bag.name)
    for refused in (Children, SimulatedLine):
        try:
            refused(out / "refused")
        except ctd.CubeError as error:
            print(error)
        else:
            raise AssertionError(f"{refused} was not refused")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
