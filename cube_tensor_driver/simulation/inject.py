# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Sends a fault to simulated hubs that run in another process: `./cube inject`."""

from __future__ import annotations

import errno
import os
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import cast

from ..config.yaml import parse_yaml, read_yaml, to_yaml
from ..core.errors import ConfigError
from .faults import KINDS, PAD_FAULTS, Fault, HubSize, check_target
from .simulator import FAULT_PIPE, HUBS_FILE


def inject(ports: Path | None, words: Sequence[str]) -> str:
    """Send a fault to a simulator.

    Args:
        ports: Folder of the simulator's ports; None: the folder of the demo that was started last.
        words: Keys and values of the fault, such as ``kind=unplug``.

    Returns:
        Description of the fault and its links, for the user.

    Raises:
        ConfigError: The fault is wrong, no simulator runs with this folder, or the link, cube or
            pad does not exist there.
    """
    unclear = [word for word in words if "=" not in word]
    if unclear:
        raise ConfigError(
            f"fault: found {unclear[0]!r}, allowed: key=value, as in kind=unplug link=hub0 "
            "seconds=2"
        )
    pairs = dict(word.split("=", 1) for word in words)
    # The values of `kind` and `link` stay texts, even if they look like numbers.
    fault = {
        key: value if key in ("kind", "link") else parse_yaml(value, "fault")
        for key, value in pairs.items()
    }
    parsed = Fault.parse(fault, "fault")
    folder = ports or _find_newest_demo()

    with os.fdopen(_open_pipe(folder / FAULT_PIPE), "w") as stream:
        # The simulator writes the file with the sizes of its hubs before it creates the pipe, so
        # the file exists.
        sizes = cast("dict[str, dict[str, int]]", read_yaml(folder / HUBS_FILE))
        hubs = {name: HubSize(**size) for name, size in sizes.items()}
        links = check_target(parsed, hubs)
        stream.write(format_fault(fault))
    return f"{', '.join(links)}: {_describe(parsed)}"


def format_fault(fault: dict[str, object]) -> str:
    """Return a fault as one line of YAML, which a simulator reads from its pipe.

    Args:
        fault: Keys and values of the fault, as `Fault` lists them.
    """
    return to_yaml(fault).replace("\n", " ").strip() + "\n"


def _open_pipe(pipe: Path) -> int:
    """Open the pipe for writing from which a simulator reads faults.

    Raises:
        ConfigError: The pipe does not exist, or no simulator reads it.
    """
    try:
        # Without O_NONBLOCK, opening the pipe would block until a simulator reads it.
        return os.open(pipe, os.O_WRONLY | os.O_NONBLOCK)
    except OSError as error:
        reason = "no simulator reads it" if error.errno == errno.ENXIO else error.strerror
        raise ConfigError(
            f"{pipe}: {reason}; name the ports' folder of a running simulator"
        ) from None


def _describe(fault: Fault) -> str:
    """Return the effect of a fault in words, with its values."""
    text = KINDS[fault.kind].replace("`seconds`", f"{fault.seconds:g} s")
    for name in ("count", "value"):
        text = text.replace(f"`{name}`", f"{getattr(fault, name):g}")
    if fault.kind in PAD_FAULTS:
        text = text.replace("a pad", f"pad {fault.pad} of cube {fault.cube}")
    return text


def _find_newest_demo() -> Path:
    """Return the folder of ports of the demo that was started last.

    Raises:
        ConfigError: No demo runs.
    """
    pipes = Path(tempfile.gettempdir()).glob(f"cube_demo_*/ports/{FAULT_PIPE}")
    newest = max(pipes, key=os.path.getmtime, default=None)
    if newest is None:
        raise ConfigError(
            "no demo runs here; start ./cube demo, or name the folder of the ports with --ports"
        )
    return newest.parent
