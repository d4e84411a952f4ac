# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Kinds of faults of simulated hubs, and how they are written in YAML.

A fault is a table with the key `kind` and further keys where the kind needs them; `Fault` lists
them. `injector.py` carries faults out.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypedDict, cast

from ..config.schema import Schema, make_integer_schema, make_mapping_schema, make_number_schema
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
    "rename": "cut the port and the power for `seconds`, and come back under another name",
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
"""Effect of each kind of fault of simulated hubs, as a text for the user.

Words in backquotes are the attributes of `Fault` that the kind uses. For "noisy", `value` is the
standard deviation of the noise divided by the frequency of the pad, and 1e-3 is its default.
"""

MAX_COUNT = (1 << 32) - 1
"""Maximum value of the whole numbers of a fault: number of affected samples, index of a cube, index
of a pad."""

FRAME_FAULTS = ("drop", "flip", "insert", "duplicate", "reorder", "truncate")
"""Kinds of faults that alter or lose single frames (messages of a hub) with a sample."""

PAD_FAULTS = ("open", "short", "stuck", "noisy", "report")
"""Kinds of faults of one pad (sensing element) of a cube: its lead is broken, its oscillator stops,
its frequency does not change or is noisy, or the hub reports the pad as failed although it is good.
"""

MOMENTARY_FAULTS = (*FRAME_FAULTS, "reset", "wrap", "drift", "step")
"""Kinds of faults without a duration: they alter or lose a number of samples, restart the hub, or
change the time or the rate of its clock without changing it back. All other kinds last for the time
`seconds` of the fault."""

_AMOUNT = make_number_schema("a number from 0 up", minimum=0)
"""Schema of a time in s, which is not negative. Only the size of a fault (`value`) may be negative:
a clock may run slow, and a temperature may fall."""
_COUNT = make_integer_schema(0, MAX_COUNT, "a whole number from 0 up")
"""Schema of a number of samples and of an index of a cube or pad."""
_SCHEMA = Schema(
    make_mapping_schema(
        ["kind"],
        {
            "kind": {"enum": list(KINDS), "description": ", ".join(KINDS)},
            "at": _AMOUNT,
            "link": {"type": "string", "description": "the name of a link"},
            "seconds": _AMOUNT,
            "count": _COUNT,
            "cube": _COUNT,
            "pad": _COUNT,
            "value": make_number_schema("a finite number"),
        },
    )
)
"""Schema of a fault."""


class _FaultContent(TypedDict, total=False):
    """A fault in YAML that follows the schema. `Fault` describes its values."""

    kind: str
    at: float
    link: str
    seconds: float
    count: float
    cube: float
    pad: float
    value: float


@dataclass(frozen=True)
class Fault:
    """One fault of a simulated hub. `KINDS` names the attributes that each kind uses.

    Attributes:
        kind: Kind of the fault, a key of `KINDS`.
        at: Simulated time in s at which the fault begins.
        link: Name of the link; empty for all links.
        seconds: Duration in s.
        count: Number of samples that are affected.
        cube: Index of the cube on its hub.
        pad: Index of the pad on its cube.
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
    def parse(cls, data: object, place: str) -> Fault:
        """Create a fault from plain values and check them.

        Args:
            data: Dictionary as read from YAML.
            place: Source of the values (such as a file name), with which error messages begin.

        Raises:
            ConfigError: A key or a value is wrong. The message names the key, the value and the
                allowed values.
        """
        for _, mistake in _SCHEMA.find_mistakes(data):
            raise ConfigError(f"{place}: {mistake}")
        values = cast(_FaultContent, data)
        # YAML may contain 2 where a float is needed, and 2.0 where an integer is needed.
        return cls(
            kind=values["kind"],
            at=float(values.get("at", cls.at)),
            link=values.get("link", cls.link),
            seconds=float(values.get("seconds", cls.seconds)),
            count=int(values.get("count", cls.count)),
            cube=int(values.get("cube", cls.cube)),
            pad=int(values.get("pad", cls.pad)),
            value=float(values.get("value", cls.value)),
        )


def parse_faults(data: object, place: str) -> list[Fault]:
    """Create faults from a list of dictionaries and check them.

    Args:
        data: List of dictionaries as read from YAML, one per fault.
        place: Source of the values (such as a file name), with which error messages begin.

    Raises:
        ConfigError: The data are no list, or a key or a value of a fault is wrong.
    """
    if not isinstance(data, list):
        raise ConfigError(f"{place}: found {str(data)[:60]!r}, allowed: a list of faults")
    return [Fault.parse(item, f"{place}: [{number}]") for number, item in enumerate(data)]


@dataclass(frozen=True)
class HubSize:
    """Number of cubes on a simulated hub, and number of pads of each of these cubes."""

    cubes: int
    pads: int


def check_target(fault: Fault, hubs: Mapping[str, HubSize]) -> list[str]:
    """Check that the link, cube and pad of a fault exist.

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
