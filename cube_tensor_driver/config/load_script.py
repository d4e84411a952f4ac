"""Load scripts: what indenters do to a simulated skin, in time.

docs/simulation.md describes the keys.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from ..core.arrays import Array
from ..core.defaults import POISSONS_RATIO, SURFACE_DEPTH, YOUNGS_MODULUS
from ..core.errors import ConfigError
from .schema import NAME, TRIPLE, Schema, list_of, mapping, real
from .yaml import read_yaml

MOST_TAPS = 1000
SLIP_TOLERANCE = 1e-9

_TIME = real("a time in s from 0 up", minimum=0)
_POSITIVE = "a number greater than 0"
_FORCE = {
    "anyOf": [
        {"type": "number", "exclusiveMinimum": 0},
        {"type": "array", "items": {"type": "number", "minimum": 0}, "minItems": 2},
    ],
    "description": "a force in N greater than 0, or a list of at least two from 0 up",
}
_SHEAR = {
    "anyOf": [TRIPLE, {"type": "array", "items": TRIPLE, "minItems": 2}],
    "description": "a force [x, y, z] in N, or a list of at least two",
}
_PEAK_FORCE = real("a force in N greater than 0", exclusiveMinimum=0)
_TIMES = {
    "type": "integer",
    "minimum": 1,
    "maximum": MOST_TAPS,
    "description": f"an integer from 1 to {MOST_TAPS}",
}
_SPAN: dict[str, Any] = {"from": _TIME, "to": _TIME}
_AT: dict[str, Any] = {"at": TRIPLE}
_PATH: dict[str, Any] = {"path": list_of(TRIPLE, "places [x, y, z]", 2)}
_PRESS = mapping(("from", "to", "at", "force"), {**_SPAN, **_AT, "force": _FORCE, "shear": _SHEAR})
_SLIDE = mapping(("from", "to", "path", "force"), {**_SPAN, **_PATH, "force": _FORCE})
_ROLL = mapping(
    ("from", "to", "path", "force"), {**_SPAN, **_PATH, "force": _FORCE, "shear": _SHEAR}
)
_TAP = mapping(
    ("from", "to", "at", "force"), {**_SPAN, **_AT, "force": _PEAK_FORCE, "times": _TIMES}
)
_ACTION = mapping((), {"press": _PRESS, "slide": _SLIDE, "roll": _ROLL, "tap": _TAP}) | {
    "minProperties": 1,
    "maxProperties": 1,
    "description": "one of press, slide, roll, tap",
}
_INDENTER = mapping(
    ("name", "shape", "radius", "does"),
    {
        "name": NAME,
        "shape": {"enum": ["disc", "sphere"], "description": "disc or sphere"},
        "radius": real(f"{_POSITIVE}, m", exclusiveMinimum=0),
        "friction": real("a number from 0 up", minimum=0),
        "does": list_of(_ACTION, "actions"),
    },
)
_SCHEMA = Schema(
    mapping(
        ("indenters",),
        {
            "period": real(f"{_POSITIVE}, s", exclusiveMinimum=0),
            "depth": real(f"{_POSITIVE}, m", exclusiveMinimum=0),
            "young": real(f"{_POSITIVE}, Pa", exclusiveMinimum=0),
            "poisson": real("-1 < poisson <= 0.5", exclusiveMinimum=-1, maximum=0.5),
            "places": {"enum": ["m", "skin"], "description": "m or skin"},
            "indenters": list_of(_INDENTER, "indenters"),
        },
    )
)


@dataclass(frozen=True)
class Action:
    """One thing that an indenter does from `start` to `end`, s.

    kind: press, slide, roll or tap.
    path: (P, 3) places of the indenter.
    force: (K,) normal force, N.
    shear: (K, 3) or (1, 3) tangential force on the skin, N; a single one is in proportion to the
        normal force.

    The values of each array are at equal intervals of time; see `between`.
    """

    kind: str
    start: float
    end: float
    path: Array
    force: Array
    shear: Array


@dataclass(frozen=True)
class Indenter:
    """A rigid disc or sphere with its actions in order of time.

    radius: m. friction: the greatest ratio of tangential to normal force.
    """

    name: str
    shape: str
    radius: float
    friction: float
    actions: tuple[Action, ...]


@dataclass(frozen=True)
class Script:
    """A load script.

    period: after how many s it begins again; None: it runs once.
    depth: from the cubes' centres to the surface, m.
    young, poisson: of the skin; Pa and 1.
    relative: whether places are multiples of the skin's half extents, measured from its centre;
        otherwise they are in m in its parent frame.
    """

    period: float | None
    depth: float
    young: float
    poisson: float
    relative: bool
    indenters: tuple[Indenter, ...]

    @property
    def end(self) -> float:
        """When the last action is over, s."""
        return max(indenter.actions[-1].end for indenter in self.indenters)


def read_script(path: Path) -> Script:
    """Read and check a load script.

    Raises ConfigError with the first mistake: file, key, what was found and what is allowed.
    """
    data = read_yaml(path)
    for _, mistake in _SCHEMA.mistakes(data):
        raise ConfigError(f"{path}: {mistake}")
    period = data.get("period")
    script = Script(
        period=None if period is None else float(period),
        depth=float(data.get("depth", SURFACE_DEPTH)),
        young=float(data.get("young", YOUNGS_MODULUS)),
        poisson=float(data.get("poisson", POISSONS_RATIO)),
        relative=data.get("places", "m") == "skin",
        indenters=tuple(_indenter(item) for item in data["indenters"]),
    )
    for mistake in _contradictions(script):
        raise ConfigError(f"{path}: {mistake}")
    return script


def _indenter(item: dict[str, Any]) -> Indenter:
    actions = [_action(kind, keys) for does in item["does"] for kind, keys in does.items()]
    actions.sort(key=lambda action: action.start)
    return Indenter(
        name=item["name"],
        shape=item["shape"],
        radius=float(item["radius"]),
        friction=float(item.get("friction", 0.0)),
        actions=tuple(actions),
    )


def _action(kind: str, item: dict[str, Any]) -> Action:
    path = np.array(item["path"] if "path" in item else [item["at"]], float)
    force = np.array(item["force"], float)
    if kind == "tap":
        peak = float(item["force"])
        force = np.array([0.0, *[peak, 0.0] * item.get("times", 1)])
    elif force.ndim == 0:
        force = np.array([0.0, force, force, 0.0])
    shear = np.atleast_2d(np.array(item.get("shear", [0.0, 0.0, 0.0]), float))
    return Action(kind, float(item["from"]), float(item["to"]), path, force, shear)


def _contradictions(script: Script) -> Iterator[str]:
    names = [indenter.name for indenter in script.indenters]
    for number, indenter in enumerate(script.indenters):
        key = f"indenters[{number}] ({indenter.name})"
        if indenter.name in names[:number]:
            yield f"{key}: the name appears twice; keep one"
        for action in indenter.actions:
            what = f"{key}: {action.kind} from {action.start:g} to {action.end:g} s"
            for mistake in _action_mistakes(action, indenter.friction, script.period):
                yield f"{what} {mistake}"
        for first, second in pairwise(indenter.actions):
            if second.start < first.end:
                yield (
                    f"{key}: {second.kind} begins at {second.start:g} s, before its {first.kind} "
                    f"ends at {first.end:g} s; an indenter does one thing at a time"
                )


def _action_mistakes(action: Action, friction: float, period: float | None) -> Iterator[str]:
    if action.end <= action.start:
        yield "ends before it begins; to must be later than from"
    if not action.force.any():
        yield "has no force; give one greater than 0"
    if period is not None and action.end > period:
        yield f"is not over when the script begins again; the period is {period:g} s"
    ratio = _shear_to_force(action)
    if ratio > friction * (1 + SLIP_TOLERANCE):
        yield f"would slip: shear is up to {ratio:.3g} of the force, friction is {friction:g}"


def _shear_to_force(action: Action) -> float:
    """The greatest ratio of tangential to normal force during the action."""
    if not action.shear.any():
        return 0.0
    if len(action.shear) == 1:
        return float(np.linalg.norm(action.shear) / action.force.max())
    when = np.linspace(0, 1, 1001)[1:-1]
    force = between(action.force, when)
    shear = np.linalg.norm(between(action.shear, when), axis=-1)
    without_force = np.where(shear > 0, np.inf, 0.0)
    ratio = np.divide(shear, force, out=without_force, where=force > 0)
    return float(ratio.max())


def between(knots: Array, when: float | Array) -> Array:
    """Values between knots (K, ...) that stand at equal intervals; `when` runs from 0 to 1.

    From each knot to the next the value follows half a cosine. So it is smooth, level at each knot,
    and never beyond the two knots around it.
    """
    position = np.clip(when, 0.0, 1.0) * (len(knots) - 1)
    first = np.minimum(np.floor(position).astype(int), len(knots) - 2)
    part = 0.5 - 0.5 * np.cos(np.pi * (position - first))
    part = part.reshape(part.shape + (1,) * (knots.ndim - 1))
    value: Array = knots[first] + part * (knots[first + 1] - knots[first])
    return value
