"""Checks plain values against a JSON schema.

Each mistake becomes one line that names the key, what was found and what is allowed. What is
allowed is the `description` of the schema there.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import jsonschema

KeyPath = tuple[str | int, ...]
"""Keys and list indices from the top level down to a value."""

# Names become topics and frames. ROS allows 247 characters including the namespace.
NAME = {
    "type": "string",
    "pattern": r"^[A-Za-z][A-Za-z0-9_]{0,63}\Z",
    "description": "a name of at most 64 letters, digits and _, a letter first",
}
TEXT = {"type": "string", "minLength": 1, "description": "a text that is not empty"}
TRIPLE = {
    "type": "array",
    "items": {"type": "number", "description": "a finite number"},
    "minItems": 3,
    "maxItems": 3,
    "description": "three finite numbers",
}
_NUMBER_WORDS = {1: "one", 2: "two"}


def mapping(required: Iterable[str], properties: dict[str, Any]) -> dict[str, Any]:
    """The schema of a mapping that may have these keys and no others."""
    return {
        "type": "object",
        "required": list(required),
        "properties": properties,
        "additionalProperties": False,
        "description": "the keys " + ", ".join(properties),
    }


def list_of(item: dict[str, Any], what: str, least: int = 1) -> dict[str, Any]:
    """The schema of a list with at least `least` items, 1 or 2."""
    return {
        "type": "array",
        "items": item,
        "minItems": least,
        "description": f"a list of {what}, at least {_NUMBER_WORDS[least]}",
    }


def real(description: str, **limits: float) -> dict[str, Any]:
    """The schema of a number, with the limits of JSON schema (`minimum`, `exclusiveMinimum` …)."""
    return {"type": "number", "description": description, **limits}


class Schema:
    """A schema that values can be checked against. Its numbers are finite: YAML has nan and inf."""

    def __init__(self, schema: dict[str, Any]) -> None:
        base = jsonschema.Draft7Validator

        def is_finite_number(_: Any, value: Any) -> bool:
            return base.TYPE_CHECKER.is_type(value, "number") and math.isfinite(value)

        checker = base.TYPE_CHECKER.redefine("number", is_finite_number)
        self._validator = jsonschema.validators.extend(base, type_checker=checker)(schema)

    def mistakes(self, data: Any) -> list[tuple[KeyPath, str]]:
        """Every mistake: where it is, and its line; sorted by key."""
        # A set, because jsonschema reports each missing key of a mapping by itself.
        found = {
            (tuple(error.absolute_path), _describe(error))
            for error in self._validator.iter_errors(data)
        }
        return sorted(found, key=_sort_key)


def _sort_key(mistake: tuple[KeyPath, str]) -> list[tuple[bool, str | int]]:
    """Indices before keys: Python does not compare numbers with texts."""
    path, _ = mistake
    return [(isinstance(part, str), part) for part in path]


def _key_name(path: Iterable[str | int]) -> str:
    """A path of keys as people write it: cubes[3].pose."""
    parts = [f"[{part}]" if isinstance(part, int) else f".{part}" for part in path]
    return "".join(parts).lstrip(".") or "top level"


def _describe(error: jsonschema.ValidationError) -> str:
    key = _key_name(error.absolute_path)
    schema: dict[str, Any] = error.schema
    if error.validator == "additionalProperties":
        allowed = schema["properties"]
        unknown = ", ".join(repr(name) for name in error.instance if name not in allowed)
        return f"{key}: unknown key {unknown}, allowed: {', '.join(allowed)}"
    if error.validator == "required":
        missing = ", ".join(repr(name) for name in schema["required"] if name not in error.instance)
        return f"{key}: the key {missing} is missing"
    found = repr(error.instance)
    if len(found) > 60:
        found = found[:57] + "..."
    return f"{key}: found {found}, allowed: {schema.get('description', error.message)}"
