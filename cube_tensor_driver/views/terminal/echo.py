"""Stress as lines to read, and as JSON: what ./cube echo prints."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ...core.modes import COMPONENTS, STRESS
from ...core.status import STATUS, WORDS


@dataclass(frozen=True)
class Reading:
    """The stress of one cube at one instant.

    stamp_ns: when the pads were read. values: one per name of `COMPONENTS`, Pa and Pa/m, NaN where
    it is not observed. status: bits of `core/status.py`.
    """

    stamp_ns: int
    cube: str
    values: list[float]
    residual: float
    status: int


def reading_line(reading: Reading) -> str:
    """What the cube observes, with units."""
    pairs = zip(COMPONENTS, reading.values, strict=True)
    observed = {name: value for name, value in pairs if not math.isnan(value)}
    stress = [f"{name} {value:9.1f}" for name, value in observed.items() if name in STRESS]
    gradient = [f"{name} {value:10.0f}" for name, value in observed.items() if name not in STRESS]
    parts = [f"{reading.stamp_ns * 1e-9:.3f} s  {reading.cube}"]
    if stress:
        parts.append(f"{'  '.join(stress)} Pa")
    if gradient:
        parts.append(f"{'  '.join(gradient)} Pa/m")
    if not math.isnan(reading.residual):
        parts.append(f"residual {reading.residual:.2f}")
    parts.append(", ".join(status_words(reading.status)) or "fine")
    return "  ".join(parts)


def reading_json(reading: Reading) -> str:
    """One object on one line; null for what is not observed."""
    values = dict(zip(COMPONENTS, map(number, reading.values), strict=True))
    content = {
        "stamp_ns": reading.stamp_ns,
        "cube": reading.cube,
        "stress_pa": {name: values[name] for name in COMPONENTS if name in STRESS},
        "gradient_pa_per_m": {name: values[name] for name in COMPONENTS if name not in STRESS},
        "residual": number(reading.residual),
        "status": status_words(reading.status),
    }
    return json.dumps(content)


def status_words(status: int) -> list[str]:
    """The status bits that are set: names of SkinStress, and why pads were left out."""
    rows = [name for name, bit in STATUS.items() if status & bit]
    return rows + [f"pad {word}" for bit, word in WORDS.items() if status & bit]


def message_json(content: Mapping[str, Any]) -> str:
    """A message as plain values on one line; JSON has no NaN: null."""
    return json.dumps(_without_nan(content))


def number(value: float) -> float | None:
    """None for what JSON has no word for: NaN and infinity."""
    return value if math.isfinite(value) else None


def _without_nan(value: Any) -> Any:
    if isinstance(value, float):
        return number(value)
    if isinstance(value, Mapping):
        return {name: _without_nan(field) for name, field in value.items()}
    if isinstance(value, list):
        return [_without_nan(one) for one in value]
    return value
