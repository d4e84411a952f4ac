"""Sends a fault to simulated hubs that run in another process: `./cube inject`."""

from __future__ import annotations

import errno
import os
import tempfile
from collections.abc import Sequence
from pathlib import Path

from ..config.yaml import parse_yaml, read_yaml, to_yaml
from ..core.errors import ConfigError
from .faults import KINDS, PAD_FAULTS, Fault, HubSize, check_target
from .simulator import FAULT_PIPE, HUBS_FILE


def inject(ports: Path | None, words: Sequence[str]) -> str:
    """Send the fault that words such as kind=unplug describe to a simulator.

    ports: its folder of ports; None: that of the demo that was started last.
    Returns what happens now, in words. ConfigError: no such fault, no simulator there, or a link,
    cube or pad that it does not have.
    """
    unclear = [word for word in words if "=" not in word]
    if unclear:
        raise ConfigError(
            f"fault: found {unclear[0]!r}, allowed: key=value, as in kind=unplug link=hub0 "
            "seconds=2"
        )
    pairs = dict(word.split("=", 1) for word in words)
    fault = {
        key: value if key in ("kind", "link") else parse_yaml(value, "fault")
        for key, value in pairs.items()
    }
    parsed = Fault.parse(fault, "fault")
    folder = ports or _newest_demo()
    pipe = folder / FAULT_PIPE
    try:
        # Without O_NONBLOCK, opening a pipe that nobody reads would wait for ever.
        writer = os.open(pipe, os.O_WRONLY | os.O_NONBLOCK)
    except OSError as error:
        reason = "no simulator reads it" if error.errno == errno.ENXIO else error.strerror
        raise ConfigError(
            f"{pipe}: {reason}; name the ports' folder of a running simulator"
        ) from None
    with os.fdopen(writer, "w") as stream:
        sizes = read_yaml(folder / HUBS_FILE)
        hubs = {name: HubSize(**size) for name, size in sizes.items()}
        links = check_target(parsed, hubs)
        stream.write(fault_line(fault))
    return f"{', '.join(links)}: {_in_words(parsed)}"


def _in_words(fault: Fault) -> str:
    """What a fault does, with its values."""
    text = KINDS[fault.kind]
    for name, unit in (("seconds", " s"), ("count", ""), ("value", "")):
        text = text.replace(f"`{name}`", f"{getattr(fault, name):g}{unit}")
    if fault.kind in PAD_FAULTS:
        text = text.replace("a pad", f"pad {fault.pad} of cube {fault.cube}")
    return text


def fault_line(fault: dict[str, object]) -> str:
    """A fault as one line for the pipe of a simulator."""
    return to_yaml(fault).replace("\n", " ").strip() + "\n"


def _newest_demo() -> Path:
    """The folder of ports of the demo that was started last. ConfigError: none runs."""
    pipes = Path(tempfile.gettempdir()).glob(f"cube_demo_*/ports/{FAULT_PIPE}")
    newest = max(pipes, key=os.path.getmtime, default=None)
    if newest is None:
        raise ConfigError(
            "no demo runs here; start ./cube demo, or name the folder of the ports with --ports"
        )
    return newest.parent
