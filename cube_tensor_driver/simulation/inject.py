"""./cube inject: a fault for simulated hubs that run in another process."""

from __future__ import annotations

import errno
import os
import tempfile
from collections.abc import Sequence
from pathlib import Path

from ..config.yaml import parse_yaml, to_yaml
from ..core.errors import ConfigError
from .faults import Fault
from .simulator import CONTROL


def inject(ports: Path | None, words: Sequence[str]) -> None:
    """Send the fault that key=value words describe to the simulator with this folder of ports, or
    the newest demo's.

    ConfigError: no such fault, or no simulator there.
    """
    unclear = [word for word in words if "=" not in word]
    if unclear:
        raise ConfigError(
            f"fault: found {unclear[0]!r}, allowed: key=value, as in kind=unplug link=hub0 seconds=2"
        )
    pairs = dict(word.split("=", 1) for word in words)
    fault = {
        key: value if key in ("kind", "link") else parse_yaml(value, "fault")
        for key, value in pairs.items()
    }
    Fault.parse(fault, "fault")
    if ports is None:
        demos = sorted(
            Path(tempfile.gettempdir()).glob(f"cube_demo_*/ports/{CONTROL}"), key=os.path.getmtime
        )
        if not demos:
            raise ConfigError(
                "no demo runs here; start ./cube demo, or name the folder of the ports with --ports"
            )
        ports = demos[-1].parent
    try:
        # Without a reader, opening a pipe to write would wait for ever.
        pipe = os.open(ports / CONTROL, os.O_WRONLY | os.O_NONBLOCK)
    except OSError as error:
        reason = "no simulator reads it" if error.errno == errno.ENXIO else error.strerror
        raise ConfigError(
            f"{ports / CONTROL}: {reason}; name the ports' folder of a running simulator"
        ) from None
    with os.fdopen(pipe, "w") as control:
        control.write(to_yaml(fault).replace("\n", " ").strip() + "\n")
