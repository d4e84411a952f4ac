# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""./cube echo: print what comes on a topic of a running skin."""

from __future__ import annotations

import argparse
import math
import sys
from typing import TYPE_CHECKING

from .parser import Parser

if TYPE_CHECKING:
    from ..ros.commands.echo import StressReading


def add_arguments(parser: Parser) -> None:
    """Add the options of the command."""
    parser.add_value("topic", "TOPIC", "as in stress or cubes/c05/stress")
    parser.add_switch("--once", "end after the first message")
    parser.add_switch("--json", "print one JSON object per line")


def run(options: argparse.Namespace) -> int:
    """Print messages until Ctrl-C, which is the normal end."""
    from ..config.output_files import to_json
    from ..config.yaml import to_yaml
    from ..ros.commands.echo import StressReading, listen

    for items in listen(options.topic, options.once):
        for item in items:
            if isinstance(item, StressReading):
                print(encode_reading(item) if options.json else format_reading(item))
            elif options.json:
                print(to_json(item))
            else:
                print(f"{to_yaml(item)}---")
        # Without flushing, Python would hold messages back if stdout is a pipe.
        sys.stdout.flush()
    return 0


def format_reading(reading: StressReading) -> str:
    """Return a line of text: time, cube, observed components with units, residual and status.

    Args:
        reading: One row of a stress message: one cube at one time.
    """
    parts = [f"{reading.stamp_ns * 1e-9:.3f} s", reading.cube]
    for components, form, unit in (
        (reading.stress, "9.1f", "Pa"),
        (reading.gradient, "10.0f", "Pa/m"),
    ):
        observed = {name: value for name, value in components.items() if not math.isnan(value)}
        # The unit is written once, after the last component.
        if observed:
            texts = [f"{name} {value:{form}}" for name, value in observed.items()]
            parts.append(f"{'  '.join(texts)} {unit}")
    if not math.isnan(reading.residual):
        parts.append(f"residual {reading.residual:.2f}")
    words = name_conditions(reading.status)
    parts.append(", ".join(words) or "ok")
    return "  ".join(parts)


def encode_reading(reading: StressReading) -> str:
    """Return a row of a stress message as a JSON object on one line.

    Args:
        reading: The row: one cube at one time. Components that are not observed (NaN) become null.
    """
    from ..config.output_files import to_json

    content = {
        "stamp_ns": reading.stamp_ns,
        "cube": reading.cube,
        "stress_pa": reading.stress,
        "gradient_pa_per_m": reading.gradient,
        "residual": reading.residual,
        "status": name_conditions(reading.status),
    }
    return to_json(content)


def name_conditions(status: int) -> list[str]:
    """Return the status bits of a row in words, with the names in SkinStress.msg.

    The last words are the reasons for which pads were left out of the computation, if any were.
    """
    from ..core.status import STATUS, WORDS

    names = [name for name, bit in STATUS.items() if status & bit]
    return names + [f"pad {word}" for bit, word in WORDS.items() if status & bit]
