"""Load scripts: what indenters do to a simulated skin over time.

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
from .schema import NAME, TRIPLE, JsonSchema, Schema, integer, list_of, mapping, real
from .yaml import read_yaml

MAX_TAPS = 1000
"""Maximum number of taps of one action."""

SLIP_TOLERANCE = 1e-9
"""Relative amount by which shear may exceed friction times force, for rounding errors."""

FRICTION_SAMPLES = 1001
"""Number of instants of an action at which shear is compared with friction."""

_TIME = real("a time in s from 0 up", minimum=0)
_PEAK_FORCE = real("a force in N greater than 0", exclusiveMinimum=0)
_FORCE: JsonSchema = {
    "anyOf": [
        {"type": "number", "exclusiveMinimum": 0},
        {
            "type": "array",
            "items": {"type": "number", "minimum": 0},
            "minItems": 2,
        },
    ],
    "description": "a force in N greater than 0, or a list of at least two from 0 up",
}
_SHEAR: JsonSchema = {
    "anyOf": [
        TRIPLE,
        {
            "type": "array",
            "items": TRIPLE,
            "minItems": 2,
        },
    ],
    "description": "a force [x, y, z] in N, or a list of at least two",
}
_TIMES = integer(1, MAX_TAPS, f"an integer from 1 to {MAX_TAPS}")
_PATH = list_of(TRIPLE, "places [x, y, z]", 2)


def _action_schema(optional: JsonSchema, **required: JsonSchema) -> JsonSchema:
    """Return the schema of an action: its times, and these required and optional keys."""
    needed: JsonSchema = {
        "from": _TIME,
        "to": _TIME,
        **required,
    }
    return mapping(needed, needed | optional)


_ACTIONS: JsonSchema = {
    "press": _action_schema({"shear": _SHEAR}, at=TRIPLE, force=_FORCE),
    "slide": _action_schema({}, path=_PATH, force=_FORCE),
    "roll": _action_schema({"shear": _SHEAR}, path=_PATH, force=_FORCE),
    "tap": _action_schema({"times": _TIMES}, at=TRIPLE, force=_PEAK_FORCE),
}
# An action is a mapping with one key, its kind.
_ACTION = mapping((), _ACTIONS) | {
    "minProperties": 1,
    "maxProperties": 1,
    "description": f"one of {', '.join(_ACTIONS)}",
}
_INDENTER = mapping(
    ("name", "shape", "radius", "does"),
    {
        "name": NAME,
        "shape": {"enum": ["disc", "sphere"], "description": "disc or sphere"},
        "radius": real("a number greater than 0, m", exclusiveMinimum=0),
        "friction": real("a number from 0 up", minimum=0),
        "does": list_of(_ACTION, "actions"),
    },
)
_SCHEMA = Schema(
    mapping(
        ("indenters",),
        {
            "period": real("a number greater than 0, s", exclusiveMinimum=0),
            "depth": real("a number greater than 0, m", exclusiveMinimum=0),
            "young": real("a number greater than 0, Pa", exclusiveMinimum=0),
            "poisson": real("-1 < poisson <= 0.5", exclusiveMinimum=-1, maximum=0.5),
            "places": {"enum": ["m", "skin"], "description": "m or skin"},
            "indenters": list_of(_INDENTER, "indenters"),
        },
    )
)


@dataclass(frozen=True)
class Action:
    """One thing that an indenter does.

    The values of each array stand at equal intervals of time; `interpolate_knots` gives the values
    between them.

    Attributes:
        kind: press, slide, roll or tap.
        start: When it begins, in s.
        end: When it ends, in s.
        path: Positions of the indenter, (P, 3).
        force: Normal force, (K,), in N.
        shear: Tangential force on the skin, (K, 3) or (1, 3), in N. A single one is in proportion
            to the normal force.
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

    Attributes:
        name: Its name.
        shape: disc or sphere.
        radius: Radius in m.
        friction: Maximum ratio of tangential to normal force.
        actions: What it does, one after the other.
    """

    name: str
    shape: str
    radius: float
    friction: float
    actions: tuple[Action, ...]


@dataclass(frozen=True)
class Script:
    """A load script.

    Attributes:
        period: Time after which it begins again, in s; None: it runs once.
        depth: Distance from the cubes' centres to the surface of the skin, in m.
        young: Young's modulus of the skin, in Pa.
        poisson: Poisson's ratio of the skin.
        relative: Whether positions are multiples of the skin's half extents, measured from its
            centre. Otherwise they are in m in its parent frame.
        indenters: What presses on the skin.
    """

    period: float | None
    depth: float
    young: float
    poisson: float
    relative: bool
    indenters: tuple[Indenter, ...]

    @property
    def end(self) -> float:
        """Time when the last action is over, in s."""
        return max(indenter.actions[-1].end for indenter in self.indenters)


def read_script(path: Path) -> Script:
    """Read and check a load script.

    Raises:
        ConfigError: The first mistake: file, key, what was found and what is allowed.
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
        indenters=tuple(_make_indenter(item) for item in data["indenters"]),
    )
    for mistake in _find_contradictions(script):
        raise ConfigError(f"{path}: {mistake}")
    return script


def interpolate_knots(knots: Array, when: float | Array) -> Array:
    """Return values between knots that stand at equal intervals of time.

    From each knot to the next the value follows half a cosine. So it is smooth, level at each knot,
    and never beyond the two knots around it.

    Args:
        knots: The values at the knots, (K, ...).
        when: Time from 0 at the first knot to 1 at the last one.
    """
    position = np.clip(when, 0.0, 1.0) * (len(knots) - 1)
    first = np.minimum(np.floor(position).astype(int), len(knots) - 2)
    part = 0.5 - 0.5 * np.cos(np.pi * (position - first))
    # The values may be vectors: the share holds for each component.
    part = part.reshape(part.shape + (1,) * (knots.ndim - 1))
    value: Array = knots[first] + part * (knots[first + 1] - knots[first])
    return value


def _make_indenter(item: dict[str, Any]) -> Indenter:
    actions = [_make_action(kind, keys) for does in item["does"] for kind, keys in does.items()]
    # People may write the actions of an indenter in any order.
    actions.sort(key=lambda action: action.start)
    return Indenter(
        name=item["name"],
        shape=item["shape"],
        radius=float(item["radius"]),
        friction=float(item.get("friction", 0.0)),
        actions=tuple(actions),
    )


def _make_action(kind: str, item: dict[str, Any]) -> Action:
    path = np.array(item["path"] if "path" in item else [item["at"]], float)
    force = np.array(item["force"], float)
    if kind == "tap":
        peak = float(item["force"])
        # Each tap rises from 0 to the peak and falls to 0.
        force = np.array([0.0, *[peak, 0.0] * item.get("times", 1)])
    elif force.ndim == 0:
        # A single force rises in the first third of the time and falls in the last one.
        force = np.array([0.0, force, force, 0.0])
    shear = np.atleast_2d(np.array(item.get("shear", [0.0, 0.0, 0.0]), float))
    return Action(kind, float(item["from"]), float(item["to"]), path, force, shear)


def _find_contradictions(script: Script) -> Iterator[str]:
    """Yield what a schema cannot say: values of several keys that do not fit together."""
    # Errors and logs name indenters, so two of one name could not be told apart.
    names = [indenter.name for indenter in script.indenters]
    for number, indenter in enumerate(script.indenters):
        key = f"indenters[{number}] ({indenter.name})"
        if indenter.name in names[:number]:
            yield f"{key}: the name appears twice; keep one"
        for action in indenter.actions:
            what = f"{key}: {action.kind} from {action.start:g} to {action.end:g} s"
            for mistake in _find_action_mistakes(action, indenter.friction, script.period):
                yield f"{what} {mistake}"
        for first, second in pairwise(indenter.actions):
            if second.start < first.end:
                yield (
                    f"{key}: {second.kind} begins at {second.start:g} s, before its {first.kind} "
                    f"ends at {first.end:g} s; an indenter does one thing at a time"
                )


def _find_action_mistakes(action: Action, friction: float, period: float | None) -> Iterator[str]:
    if action.end <= action.start:
        yield "ends before it begins; to must be later than from"
    if not action.force.any():
        yield "has no force; give one greater than 0"
    if period is not None and action.end > period:
        yield f"is not over when the script begins again; the period is {period:g} s"
    ratio = _max_shear_ratio(action)
    if ratio > friction * (1 + SLIP_TOLERANCE):
        yield f"would slip: shear is up to {ratio:.3g} of the force, friction is {friction:g}"


def _max_shear_ratio(action: Action) -> float:
    """Return the maximum ratio of tangential to normal force during the action."""
    # Without shear nothing can slip, also where the force is 0.
    if not action.shear.any():
        return 0.0
    if len(action.shear) == 1:
        return float(np.linalg.norm(action.shear) / action.force.max())

    # At the very ends both forces may be 0.
    when = np.linspace(0, 1, FRICTION_SAMPLES)[1:-1]
    force = interpolate_knots(action.force, when)
    shear = np.linalg.norm(interpolate_knots(action.shear, when), axis=-1)
    without_force = np.where(shear > 0, np.inf, 0.0)
    # Shear without a normal force would slip, however small it is: its ratio is infinite.
    ratio = np.divide(
        shear,
        force,
        out=without_force,
        where=force > 0,
    )
    return float(ratio.max())
