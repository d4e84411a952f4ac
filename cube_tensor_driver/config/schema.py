"""Plain values against a JSON schema: every mistake is one line with the key, what was found and
what is allowed."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import jsonschema

# Names become topics and frames: a limit far below that of ROS (247 characters with the namespace).
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


_COUNT = {1: "one", 2: "two"}


def table(required: Iterable[str], properties: dict[str, Any]) -> dict[str, Any]:
    """A mapping with these keys and no others."""
    return {
        "type": "object",
        "required": list(required),
        "properties": properties,
        "additionalProperties": False,
        "description": "the keys " + ", ".join(properties),
    }


def several(item: dict[str, Any], what: str, least: int = 1) -> dict[str, Any]:
    """A list of items, at least so many: 1 or 2."""
    return {
        "type": "array",
        "items": item,
        "minItems": least,
        "description": f"a list of {what}, at least {_COUNT[least]}",
    }


def real(description: str, **limits: float) -> dict[str, Any]:
    """A number within JSON schema's limits."""
    return {"type": "number", "description": description, **limits}


class Schema:
    """A schema made ready. Its numbers are finite: JSON knows no others, YAML does."""

    def __init__(self, schema: dict[str, Any]) -> None:
        base = jsonschema.Draft7Validator
        checker = base.TYPE_CHECKER.redefine(
            "number",
            lambda _, value: base.TYPE_CHECKER.is_type(value, "number") and math.isfinite(value),
        )
        self._validator = jsonschema.validators.extend(base, type_checker=checker)(schema)

    def mistakes(self, data: Any) -> list[tuple[tuple[Any, ...], str]]:
        """Every mistake as (path of keys, line), in the order of the file."""
        # A set: each key that is missing is an error of its own.
        found = {
            (tuple(error.absolute_path), _words(error))
            for error in self._validator.iter_errors(data)
        }
        return sorted(found, key=lambda one: [(isinstance(part, str), part) for part in one[0]])


def place(path: Iterable[Any]) -> str:
    """cubes[3].pose from its parts."""
    return (
        "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in path).lstrip(".")
        or "top level"
    )


def _words(error: Any) -> str:
    key, schema = place(error.absolute_path), error.schema
    if error.validator == "additionalProperties":
        unknown = ", ".join(
            repr(name) for name in error.instance if name not in schema["properties"]
        )
        return f"{key}: unknown key {unknown}, allowed: {', '.join(schema['properties'])}"
    if error.validator == "required":
        missing = ", ".join(repr(name) for name in schema["required"] if name not in error.instance)
        return f"{key}: the key {missing} is missing"
    found = repr(error.instance)
    found = found if len(found) <= 60 else found[:57] + "..."
    return f"{key}: found {found}, allowed: {schema.get('description', error.message)}"
