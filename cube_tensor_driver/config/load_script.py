# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Load scripts: YAML files that state which forces indenters exert on a simulated skin over time.

An indenter is a rigid disc or sphere. docs/simulation.md describes the keys of a script.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TypedDict, cast

import numpy as np

from ..core.arrays import Array
from ..core.defaults import POISSONS_RATIO, SURFACE_DEPTH, YOUNGS_MODULUS
from ..core.errors import ConfigError
from .schema import (
    NAME,
    TRIPLE,
    JsonSchema,
    Schema,
    make_integer_schema,
    make_list_schema,
    make_mapping_schema,
    make_number_schema,
)
from .yaml import read_yaml

MAX_TAPS = 1000
"""Maximum number of taps (short presses) that one action `tap` of a load script may ask for."""

SLIP_TOLERANCE = 1e-9
"""Relative amount by which the tangential force of an indenter may exceed the coefficient of
friction times its normal force without an error, to allow for rounding."""

FRICTION_SAMPLES = 1001
"""Number of equidistant instants of an action at which the tangential force is compared with the
limit of friction (coefficient of friction times normal force)."""

_TIME = make_number_schema("a time in s from 0 up", minimum=0)
"""Schema of a time, in s after the start of the load script."""
_PEAK_FORCE = make_number_schema("a force in N greater than 0", exclusiveMinimum=0)
"""Schema of the largest normal force of a tap."""
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
"""Schema of an indenter's normal force: its largest value, or values at equal intervals during the
action. With a single value, the force rises from 0 in the first third and falls to 0 in the last
third of the action."""
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
"""Schema of an indenter's tangential force: its value at the largest normal force, or values at
equal intervals during the action. With a single value, the tangential force is proportional to the
normal force."""
_TIMES = make_integer_schema(1, MAX_TAPS, f"an integer from 1 to {MAX_TAPS}")
"""Schema of the number of taps of one action."""
_PATH = make_list_schema(TRIPLE, "positions [x, y, z]", 2)
"""Schema of the positions on the surface along which an indenter moves."""


def _make_action_schema(optional: JsonSchema, **required: JsonSchema) -> JsonSchema:
    """Return the JSON schema of an action of an indenter.

    Args:
        optional: Optional keys and the schemas of their values.
        required: Required keys besides `from` and `to` (the times of start and end).
    """
    needed: JsonSchema = {
        "from": _TIME,
        "to": _TIME,
        **required,
    }
    return make_mapping_schema(needed, needed | optional)


_ACTIONS: JsonSchema = {
    "press": _make_action_schema({"shear": _SHEAR}, at=TRIPLE, force=_FORCE),
    "slide": _make_action_schema({}, path=_PATH, force=_FORCE),
    "roll": _make_action_schema({"shear": _SHEAR}, path=_PATH, force=_FORCE),
    "tap": _make_action_schema({"times": _TIMES}, at=TRIPLE, force=_PEAK_FORCE),
}
"""Kind of an indenter's action (press, slide, roll or tap) -> schema of the keys of the action."""
_ACTION = make_mapping_schema((), _ACTIONS) | {
    "minProperties": 1,
    "maxProperties": 1,
    "description": f"one of {', '.join(_ACTIONS)}",
}
"""Schema of an action. In YAML it is a mapping with a single key, its kind: {press: {from: 0, to:
1, ...}}."""
_INDENTER = make_mapping_schema(
    ("name", "shape", "radius", "does"),
    {
        "name": NAME,
        "shape": {"enum": ["disc", "sphere"], "description": "disc or sphere"},
        "radius": make_number_schema("a number greater than 0, m", exclusiveMinimum=0),
        "friction": make_number_schema("a number from 0 up", minimum=0),
        "does": make_list_schema(_ACTION, "actions"),
    },
)
"""Schema of an indenter and the list of its actions."""
_SCHEMA = Schema(
    make_mapping_schema(
        ("indenters",),
        {
            "period": make_number_schema("a number greater than 0, s", exclusiveMinimum=0),
            "depth": make_number_schema("a number greater than 0, m", exclusiveMinimum=0),
            "young": make_number_schema("a number greater than 0, Pa", exclusiveMinimum=0),
            "poisson": make_number_schema("-1 < poisson <= 0.5", exclusiveMinimum=-1, maximum=0.5),
            "places": {"enum": ["m", "skin"], "description": "m or skin"},
            "indenters": make_list_schema(_INDENTER, "indenters"),
        },
    )
)
"""Schema of a load script, the YAML file that states which forces indenters exert over time."""

_ActionEntry = TypedDict(
    "_ActionEntry",
    {
        "from": float,
        "to": float,
        "at": list[float],
        "path": list[list[float]],
        "force": float | list[float],
        "shear": list[float] | list[list[float]],
        "times": int,
    },
    total=False,
)
"""Keys of an action in a load script, see `_ACTIONS`."""


class _IndenterEntry(TypedDict, total=False):
    """Keys of an indenter in a load script, see `_INDENTER`."""

    name: str
    shape: str
    radius: float
    friction: float
    does: list[dict[str, _ActionEntry]]


class _ScriptContent(TypedDict, total=False):
    """Content of a load script, see `_SCHEMA`."""

    period: float
    depth: float
    young: float
    poisson: float
    places: str
    indenters: list[_IndenterEntry]


@dataclass(frozen=True)
class Action:
    """One action of an indenter: it presses, slides, rolls or taps.

    The values of each array belong to instants at equal intervals from `start` to `end`;
    `interpolate_knots` gives the values between them.

    Attributes:
        kind: press, slide, roll or tap.
        start: Time at which it begins, in s from the start of the script.
        end: Time at which it ends, in s from the start of the script.
        path: Positions of the indenter, (P, 3), in the unit that `Script.relative` states.
        force: Normal force on the skin, (K,), in N.
        shear: Tangential force on the skin, in N: (S, 3) values, or (1, 3) for the value at the
            largest normal force, to which the tangential force is then proportional over time.
    """

    kind: str
    start: float
    end: float
    path: Array
    force: Array
    shear: Array


@dataclass(frozen=True)
class Indenter:
    """A rigid disc or sphere that acts on the skin.

    Attributes:
        name: Name of the indenter, which errors and logs show.
        shape: disc or sphere.
        radius: Radius of the disc or sphere, in m.
        friction: Coefficient of friction: maximum ratio of tangential to normal force.
        actions: Its actions, sorted by their start; they do not overlap in time.
    """

    name: str
    shape: str
    radius: float
    friction: float
    actions: tuple[Action, ...]


@dataclass(frozen=True)
class Script:
    """The content of a load script, which states the forces on a simulated skin over time.

    Attributes:
        period: Time, in s, after which the script runs again from its start; None: it runs once.
        depth: Depth of the cubes' centres below the surface of the skin, in m.
        young: Young's modulus of the elastomer of the skin, in Pa.
        poisson: Poisson's ratio of the elastomer of the skin.
        relative: Whether positions are relative to the skin: (0, 0) is its centre, and 1 is half
            its extent along each axis. Otherwise they are in m in the parent frame of the skin.
        indenters: The indenters that press on the skin, possibly at the same time.
    """

    period: float | None
    depth: float
    young: float
    poisson: float
    relative: bool
    indenters: tuple[Indenter, ...]

    @property
    def end(self) -> float:
        """Time at which the last action ends, in s from the start of the script."""
        return max(indenter.actions[-1].end for indenter in self.indenters)


def read_script(path: Path) -> Script:
    """Read and check a load script.

    Raises:
        ConfigError: The file cannot be read or has a mistake. The message names the file, the key
            of the first mistake, the value found there and the values that are allowed.
    """
    content = read_yaml(path)
    for _, mistake in _SCHEMA.find_mistakes(content):
        raise ConfigError(f"{path}: {mistake}")

    # The schema has checked the types of all values.
    data = cast("_ScriptContent", content)
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
    """Interpolate between knots (given values) at equal intervals of time.

    From each knot to the next the value follows half a period of a cosine. So the curve is smooth,
    its derivative is 0 at each knot, and it never exceeds the values of the two knots around it.

    Args:
        knots: The values at the knots, (K, ...), with K of at least 2.
        when: Normalised time, from 0 at the first knot to 1 at the last one; a number or an array.
    """
    last = len(knots) - 1
    position = np.clip(when, 0.0, 1.0) * last
    first = np.floor(position).astype(int)
    first = np.minimum(first, last - 1)
    weight = 0.5 - 0.5 * np.cos(np.pi * (position - first))
    # If the knots are vectors, the same weight applies to each component.
    weight = weight.reshape(weight.shape + (1,) * (knots.ndim - 1))
    change = knots[first + 1] - knots[first]
    value: Array = knots[first] + weight * change
    return value


def _make_indenter(item: _IndenterEntry) -> Indenter:
    actions = []
    for does in item["does"]:
        for kind, keys in does.items():
            actions.append(_make_action(kind, keys))
    # In the file the actions of an indenter may stand in any order.
    actions.sort(key=lambda action: action.start)
    return Indenter(
        name=item["name"],
        shape=item["shape"],
        radius=float(item["radius"]),
        friction=float(item.get("friction", 0.0)),
        actions=tuple(actions),
    )


def _make_action(kind: str, item: _ActionEntry) -> Action:
    places = item["path"] if "path" in item else [item["at"]]
    path = np.array(places, float)
    force = np.array(item["force"], float)
    if kind == "tap":
        peak = float(force)
        # In each tap the force rises from 0 to the peak and falls to 0.
        n_taps = item.get("times", 1)
        force = np.array([0.0, *[peak, 0.0] * n_taps])
    elif force.ndim == 0:
        # A single value is the maximum: the force rises from 0 to it in the first third of the
        # action and falls to 0 in the last third.
        force = np.array([0.0, force, force, 0.0])
    shear_knots = item.get("shear", [0.0, 0.0, 0.0])
    shear = np.atleast_2d(np.array(shear_knots, float))
    return Action(
        kind,
        float(item["from"]),
        float(item["to"]),
        path,
        force,
        shear,
    )


def _find_contradictions(script: Script) -> Iterator[str]:
    """Yield a line for each mistake that involves several keys, which a JSON schema cannot find.

    Examples are an action that ends before it begins and two indenters with the same name.
    """
    # Errors and logs identify indenters by name, so two of the same name would be ambiguous.
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


def _find_action_mistakes(
    action: Action,
    friction: float,
    period: float | None,
) -> Iterator[str]:
    if action.end <= action.start:
        yield "ends before it begins; to must be later than from"
    if not action.force.any():
        yield "has no force; give one greater than 0"
    if period is not None and action.end > period:
        yield f"is not over when the script begins again; the period is {period:g} s"
    ratio = _find_max_shear_ratio(action)
    if ratio > friction * (1 + SLIP_TOLERANCE):
        yield f"would slip: shear is up to {ratio:.3g} of the force, friction is {friction:g}"


def _find_max_shear_ratio(action: Action) -> float:
    """Return the maximum ratio of tangential to normal force during the action.

    It is infinite where an indenter has a tangential but no normal force.
    """
    # Without a tangential force the indenter cannot slip, even where the normal force is 0.
    if not action.shear.any():
        return 0.0
    if len(action.shear) == 1:
        return float(np.linalg.norm(action.shear) / action.force.max())

    # The first and last instants are left out, because both forces may be 0 there.
    when = np.linspace(0, 1, FRICTION_SAMPLES)[1:-1]
    force = interpolate_knots(action.force, when)
    shear_forces = interpolate_knots(action.shear, when)
    shear = np.linalg.norm(shear_forces, axis=-1)
    without_force = np.where(shear > 0, np.inf, 0.0)
    # A tangential force without a normal force makes the indenter slip: its ratio is infinite.
    ratio = np.divide(
        shear,
        force,
        out=without_force,
        where=force > 0,
    )
    return float(ratio.max())
