"""Load scripts: what indenters do to a simulated skin, in time. docs/simulation.md describes the
keys."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.errors import ConfigError
from .schema import NAME, TRIPLE, Schema, real, several, table
from .yaml import read_yaml

Array = NDArray[np.float64]
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
_SPAN: dict[str, Any] = {"from": _TIME, "to": _TIME}
_PLACE: dict[str, Any] = {"at": TRIPLE}
_PATH: dict[str, Any] = {"path": several(TRIPLE, "places [x, y, z]", 2)}
_TIMES = {
    "type": "integer",
    "minimum": 1,
    "maximum": 1000,
    "description": "an integer from 1 to 1000",
}
_PEAK = real("a force in N greater than 0", exclusiveMinimum=0)
_ACTION = table(
    (),
    {
        "press": table(
            ("from", "to", "at", "force"), {**_SPAN, **_PLACE, "force": _FORCE, "shear": _SHEAR}
        ),
        "slide": table(("from", "to", "path", "force"), {**_SPAN, **_PATH, "force": _FORCE}),
        "roll": table(
            ("from", "to", "path", "force"), {**_SPAN, **_PATH, "force": _FORCE, "shear": _SHEAR}
        ),
        "tap": table(
            ("from", "to", "at", "force"), {**_SPAN, **_PLACE, "force": _PEAK, "times": _TIMES}
        ),
    },
) | {"minProperties": 1, "maxProperties": 1, "description": "one of press, slide, roll, tap"}
_INDENTER = table(
    ("name", "shape", "radius", "does"),
    {
        "name": NAME,
        "shape": {"enum": ["disc", "sphere"], "description": "disc or sphere"},
        "radius": real(f"{_POSITIVE}, m", exclusiveMinimum=0),
        "friction": real("a number from 0 up", minimum=0),
        "does": several(_ACTION, "actions"),
    },
)
_SCHEMA = Schema(
    table(
        ("indenters",),
        {
            "period": real(f"{_POSITIVE}, s", exclusiveMinimum=0),
            "depth": real(f"{_POSITIVE}, m", exclusiveMinimum=0),
            "young": real(f"{_POSITIVE}, Pa", exclusiveMinimum=0),
            "poisson": real("-1 < poisson <= 0.5", exclusiveMinimum=-1, maximum=0.5),
            "places": {"enum": ["m", "skin"], "description": "m or skin"},
            "indenters": several(_INDENTER, "indenters"),
        },
    )
)


@dataclass(frozen=True)
class Action:
    """One thing that an indenter does from `start` to `end`, s.

    kind: press, slide, roll or tap. path (P, 3): where, at equal intervals of time; force (K,) N:
    normal, and shear (K, 3) or (1, 3) N: tangential in proportion to the normal force, on the skin;
    at equal intervals of time.
    """

    kind: str
    start: float
    end: float
    path: Array
    force: Array
    shear: Array


@dataclass(frozen=True)
class Indenter:
    """A rigid disc or sphere of a radius in m; friction: greatest tangential over normal force.
    Actions in order."""

    name: str
    shape: str
    radius: float
    friction: float
    actions: tuple[Action, ...]


@dataclass(frozen=True)
class Script:
    """A load script. period: when it begins anew, s, None: it plays once.

    depth: from the cubes' centres to the surface, m. young, poisson: of the skin, Pa. relative:
    whether places count in half extents of the skin about its centre instead of m in its parent
    frame.
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
    """Read and check a load script. ConfigError: the first mistake: file, key, what was found and
    what is allowed."""
    data = read_yaml(path)
    for _, mistake in _SCHEMA.mistakes(data):
        raise ConfigError(f"{path}: {mistake}")
    indenters = tuple(
        Indenter(
            item["name"],
            item["shape"],
            float(item["radius"]),
            float(item.get("friction", 0.0)),
            tuple(
                sorted((_action(*one) for does in item["does"] for one in does.items()), key=_start)
            ),
        )
        for item in data["indenters"]
    )
    period = data.get("period")
    script = Script(
        None if period is None else float(period),
        float(data.get("depth", 4e-3)),
        float(data.get("young", 0.3e6)),
        float(data.get("poisson", 0.48)),
        data.get("places", "m") == "skin",
        indenters,
    )
    for mistake in _contradictions(script):
        raise ConfigError(f"{path}: {mistake}")
    return script


def _start(action: Action) -> float:
    return action.start


def _action(kind: str, item: dict[str, Any]) -> Action:
    path = np.array(item["path"] if "path" in item else [item["at"]], float)
    force = np.array(item["force"], float)
    if kind == "tap":
        force = np.array([0.0, *[float(item["force"]), 0.0] * item.get("times", 1)])
    elif not force.ndim:
        force = np.array([0.0, force, force, 0.0])
    shear = np.atleast_2d(np.array(item.get("shear", [0.0, 0.0, 0.0]), float))
    return Action(kind, float(item["from"]), float(item["to"]), path, force, shear)


def _contradictions(script: Script) -> Iterator[str]:
    names = [indenter.name for indenter in script.indenters]
    for number, indenter in enumerate(script.indenters):
        key = f"indenters[{number}] ({indenter.name})"
        if indenter.name in names[:number]:
            yield f"{key}: the name is there twice; keep one"
        for action in indenter.actions:
            span = f"{key}: {action.kind} from {action.start:g} to {action.end:g} s"
            if action.end <= action.start:
                yield f"{span} ends before it begins; to must be later than from"
            if not action.force.any():
                yield f"{span} has no force; give one greater than 0"
            if script.period is not None and action.end > script.period:
                yield f"{span} is not over when the script begins anew; the period is {script.period:g} s"
            most = _shear_to_force(action)
            if most > indenter.friction * (1 + 1e-9):
                yield f"{span} would slip: shear is up to {most:.3g} of the force, friction is {indenter.friction:g}"
        for one, other in zip(indenter.actions, indenter.actions[1:], strict=False):
            if other.start < one.end:
                yield (
                    f"{key}: {other.kind} begins at {other.start:g} s, before its {one.kind} ends at {one.end:g} s; "
                    "an indenter does one thing at a time"
                )


def _shear_to_force(action: Action) -> float:
    """The greatest tangential force over the normal force."""
    if not action.shear.any():
        return 0.0
    if len(action.shear) == 1:
        return float(np.linalg.norm(action.shear) / action.force.max())
    when = np.linspace(0, 1, 1001)[1:-1]
    force, shear = between(action.force, when), np.linalg.norm(between(action.shear, when), axis=-1)
    return float(
        np.max(np.divide(shear, force, out=np.where(shear > 0, np.inf, 0.0), where=force > 0))
    )


def between(knots: Array, when: float | Array) -> Array:
    """Values between knots (K, ...) at equal intervals, when = 0 … 1: half a cosine from each to
    the next.

    Smooth, level at each knot, and never beyond the two knots around it.
    """
    place = np.clip(when, 0.0, 1.0) * (len(knots) - 1)
    first = np.minimum(np.floor(place).astype(int), len(knots) - 2)
    part = 0.5 - 0.5 * np.cos(np.pi * (place - first))
    part = part.reshape(part.shape + (1,) * (knots.ndim - 1))
    value: Array = knots[first] + part * (knots[first + 1] - knots[first])
    return value
