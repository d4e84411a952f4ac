"""Checks of plain values against a JSON schema.

Each mistake becomes one line that names the key, what was found and what is allowed. What is
allowed is the `description` of the schema at that key.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from typing import Any

import jsonschema

KeyPath = tuple[str | int, ...]
"""Keys and list indices from the top level down to a value."""

JsonSchema = dict[str, Any]
"""A JSON schema, draft 7."""

MAX_SHOWN_CHARACTERS = 60
"""Maximum length of a value in an error message, in characters."""

# Names become topics and frames. ROS allows 247 characters including the namespace.
NAME: JsonSchema = {
    "type": "string",
    "pattern": r"^[A-Za-z][A-Za-z0-9_]{0,63}\Z",
    "description": "a name of at most 64 letters, digits and _, a letter first",
}

TEXT: JsonSchema = {
    "type": "string",
    "minLength": 1,
    "description": "a text that is not empty",
}

TRIPLE: JsonSchema = {
    "type": "array",
    "items": {"type": "number", "description": "a finite number"},
    "minItems": 3,
    "maxItems": 3,
    "description": "three finite numbers",
}

_NUMBER_WORDS = {1: "one", 2: "two"}


def mapping(required: Iterable[str], properties: JsonSchema) -> JsonSchema:
    """Return the schema of a mapping that may have the keys of `properties` and no others."""
    return {
        "type": "object",
        "required": list(required),
        "properties": properties,
        "additionalProperties": False,
        "description": "the keys " + ", ".join(properties),
    }


def list_of(item: JsonSchema, what: str, minimum: int = 1) -> JsonSchema:
    """Return the schema of a list.

    Args:
        item: Schema of an item.
        what: What the items are, in the plural.
        minimum: Minimum number of items, 1 or 2.
    """
    return {
        "type": "array",
        "items": item,
        "minItems": minimum,
        "description": f"a list of {what}, at least {_NUMBER_WORDS[minimum]}",
    }


def real(description: str, **limits: float) -> JsonSchema:
    """Return the schema of a number, with limits such as `minimum` and `exclusiveMinimum`."""
    return {
        "type": "number",
        "description": description,
        **limits,
    }


def integer(minimum: int, maximum: int, description: str) -> JsonSchema:
    """Return the schema of an integer from `minimum` to `maximum`."""
    limits = {"minimum": minimum, "maximum": maximum}
    return {
        "type": "integer",
        "description": description,
        **limits,
    }


class Schema:
    """A JSON schema that values can be checked against. Its numbers are finite."""

    def __init__(self, schema: JsonSchema) -> None:
        base = jsonschema.Draft7Validator
        number = base.TYPE_CHECKER.redefine("number", _is_finite_number)
        self._validator = jsonschema.validators.extend(base, type_checker=number)(schema)

    def mistakes(self, data: Any) -> list[tuple[KeyPath, str]]:
        """Return the place and the line of every mistake, sorted by key."""
        # A set, because jsonschema reports each missing key of a mapping by itself.
        found = {
            (tuple(error.absolute_path), _describe(error))
            for error in self._validator.iter_errors(data)
        }
        return sorted(found, key=_sort_key)


def _is_finite_number(_: Any, value: Any) -> bool:
    """Return whether a value is a number that a float can hold. YAML has .nan and .inf."""
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    # NaN compares false. math.isfinite would raise OverflowError for a huge integer.
    return is_number and abs(value) <= sys.float_info.max


def _sort_key(mistake: tuple[KeyPath, str]) -> list[tuple[bool, str | int]]:
    """Return a key that puts indices before names: Python does not compare numbers with texts."""
    path, _ = mistake
    return [(isinstance(part, str), part) for part in path]


def _key_name(path: Iterable[str | int]) -> str:
    """Return a path of keys as people write it: cubes[3].pose."""
    parts = [f"[{part}]" if isinstance(part, int) else f".{part}" for part in path]
    return "".join(parts).lstrip(".") or "top level"


def _describe(error: jsonschema.ValidationError) -> str:
    key = _key_name(error.absolute_path)
    schema: JsonSchema = error.schema
    if error.validator == "additionalProperties":
        allowed = schema["properties"]
        unknown = ", ".join(repr(name) for name in error.instance if name not in allowed)
        return f"{key}: unknown key {unknown}, allowed: {', '.join(allowed)}"
    if error.validator == "required":
        missing = ", ".join(repr(name) for name in schema["required"] if name not in error.instance)
        return f"{key}: the key {missing} is missing"

    found = repr(error.instance)
    if len(found) > MAX_SHOWN_CHARACTERS:
        found = found[: MAX_SHOWN_CHARACTERS - 3] + "..."
    return f"{key}: found {found}, allowed: {schema.get('description', error.message)}"
