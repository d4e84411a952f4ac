"""Faults of simulated hubs: which there are, and how they are written.

A fault is a table with the key `kind` and further keys where the kind needs them; `Fault` lists
them. `injector.py` carries faults out.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from ..config.schema import Schema, integer, mapping, real
from ..core.errors import ConfigError

KINDS = {
    "drop": "lose `count` samples on the way",
    "flip": "flip a bit in each of `count` samples",
    "insert": "insert noise into or between `count` samples",
    "duplicate": "send `count` samples twice",
    "reorder": "send each of `count` samples after the one that follows",
    "truncate": "cut the end off `count` samples",
    "stall": "send nothing for `seconds`; what does not fit the hub's buffer is dropped there",
    "burst": "send every 16 ms what has gathered, for `seconds`",
    "unplug": "cut the port and the power for `seconds`",
    "rename": "the same, and come back under another name",
    "reset": "restart the hub behind the open port",
    "wrap": "restart the hub with its sample count `count` before 2^32",
    "drift": "let the hub's clock run fast by `value` ppm",
    "step": "set the hub's clock forward by `value` s",
    "open": "break the lead of a pad for `seconds`",
    "short": "stop the oscillator of a pad for `seconds`",
    "stuck": "repeat the reading of a pad for `seconds`",
    "noisy": "add noise of `value` (relative, 1e-3) to a pad for `seconds`",
    "report": "have the hub report a pad as failed for `seconds`",
    "hold": "keep the load as it is for `seconds`",
    "temperature": "raise the temperature by `value` °C within `seconds`, "
    "and the rest frequencies by 50 ppm per °C",
    "uid": "name another hub uid for `seconds`",
    "pads": "send one pad too many for `seconds`",
    "version": "speak protocol version 2 for `seconds`",
}
"""What each kind of fault does, with the keys that it uses."""

MAX_COUNT = (1 << 32) - 1
"""Largest number of samples that a fault affects, and largest index of a cube or pad."""

FRAME_FAULTS = ("drop", "flip", "insert", "duplicate", "reorder", "truncate")
"""Faults of the frames of single samples."""

PAD_FAULTS = ("open", "short", "stuck", "noisy", "report")
"""Faults of one pad."""

CUT_FAULTS = (
    "stall",
    "burst",
    "unplug",
    "rename",
    "reset",
    "wrap",
    "drift",
    "step",
    "uid",
    "pads",
    "version",
)
"""Faults that interrupt a link, change what its hub reports of itself, or disturb the hub's
clock."""

MOMENTARY_FAULTS = (*FRAME_FAULTS, "reset", "wrap", "drift", "step")
"""Faults that end as soon as they have begun. All others last `seconds`."""


# Only `value` may be negative: a clock may run slow, a temperature may fall.
_AMOUNT = real("a number from 0 up", minimum=0)
_COUNT = integer(0, MAX_COUNT, "a whole number from 0 up")
_SCHEMA = Schema(
    mapping(
        ["kind"],
        {
            "kind": {"enum": list(KINDS), "description": ", ".join(KINDS)},
            "at": _AMOUNT,
            "link": {"type": "string", "description": "the name of a link"},
            "seconds": _AMOUNT,
            "count": _COUNT,
            "cube": _COUNT,
            "pad": _COUNT,
            "value": real("a finite number"),
        },
    )
)


@dataclass(frozen=True)
class Fault:
    """One fault.

    Attributes:
        kind: One of `KINDS`.
        at: Simulated time at which it begins, in s; 0 by default.
        link: Name of the link; empty for all links.
        seconds: Duration in s.
        count: Number of samples that are affected.
        cube: Index of the cube on the hub.
        pad: Index of the pad.
        value: Size of the fault, in the unit that `KINDS` names.
    """

    kind: str
    at: float = 0.0
    link: str = ""
    seconds: float = 1.0
    count: int = 1
    cube: int = 0
    pad: int = 0
    value: float = 1e-3

    @classmethod
    def parse(cls, data: Any, place: str) -> Fault:
        """Check the plain values of a fault.

        Args:
            data: Values as from YAML.
            place: Where they come from, for messages.

        Raises:
            ConfigError: A key or a value is wrong. The message names the key, the value and what is
                allowed.
        """
        for _, mistake in _SCHEMA.mistakes(data):
            raise ConfigError(f"{place}: {mistake}")
        # YAML may contain 2 for 2.0 and the reverse.
        types: dict[str, Any] = {field.name: type(field.default) for field in fields(cls)}
        types["kind"] = str
        return cls(**{key: types[key](value) for key, value in data.items()})


def parse_faults(data: Any, place: str) -> list[Fault]:
    """Check a list of faults; arguments and errors as in `Fault.parse`."""
    if not isinstance(data, list):
        raise ConfigError(f"{place}: found {str(data)[:60]!r}, allowed: a list of faults")
    return [Fault.parse(item, f"{place}: [{number}]") for number, item in enumerate(data)]


@dataclass(frozen=True)
class HubSize:
    """Number of cubes of a simulated hub, and of pads of each of them."""

    cubes: int
    pads: int


def check_target(fault: Fault, hubs: Mapping[str, HubSize]) -> list[str]:
    """Check the link, cube and pad of a fault.

    Args:
        fault: Fault to check.
        hubs: Size of each hub by the name of its link.

    Returns:
        Names of the links that the fault affects.

    Raises:
        ConfigError: The link, cube or pad does not exist.
    """
    names = [fault.link] if fault.link else list(hubs)
    for name in names:
        hub = hubs.get(name)
        if hub is None:
            raise ConfigError(f"fault {fault.kind}: link {name!r}, allowed: {', '.join(hubs)}")
        exists = fault.cube < hub.cubes and fault.pad < hub.pads
        if fault.kind in PAD_FAULTS and not exists:
            raise ConfigError(
                f"fault {fault.kind}: found cube {fault.cube}, pad {fault.pad} of link {name!r}; "
                f"allowed: below {hub.cubes}, {hub.pads}"
            )
    return names
