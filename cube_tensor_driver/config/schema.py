# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Checks of plain values (the content of a YAML file) against a JSON schema.

Each mistake becomes one line that names the key, the value found there and the values that are
allowed. The text for the allowed values is the `description` of the schema at that key.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping

import jsonschema

KeyPath = tuple[str | int, ...]
"""Position of a value in nested mappings and lists: the keys and list indices that lead to it from
the top level, as in ("cubes", 3, "pose")."""

JsonSchema = dict[str, object]
"""A JSON schema, draft 7."""

MAX_SHOWN_CHARACTERS = 60
"""Maximum number of characters of a wrong value that an error message quotes."""

NAME: JsonSchema = {
    "type": "string",
    "pattern": r"^[A-Za-z][A-Za-z0-9_]{0,63}\Z",
    "description": "a name of at most 64 letters, digits and _, a letter first",
}
"""Schema of the name of a skin, a link, a cube or an indenter.

Names become parts of topics and frame ids. ROS allows 247 characters for a topic including its
namespace, so 64 per name leave room.
"""

TEXT: JsonSchema = {
    "type": "string",
    "minLength": 1,
    "description": "a text that is not empty",
}
"""Schema of any text that is not empty."""

TRIPLE: JsonSchema = {
    "type": "array",
    "items": {"type": "number", "description": "a finite number"},
    "minItems": 3,
    "maxItems": 3,
    "description": "three finite numbers",
}
"""Schema of a list of three numbers, such as a position [x, y, z]."""

_NUMBER_WORDS = {1: "one", 2: "two"}
"""Words for small numbers in error messages."""


def make_mapping_schema(
    required: Iterable[str],
    properties: Mapping[str, object],
) -> JsonSchema:
    """Return the JSON schema of a mapping.

    Args:
        required: Keys that the mapping must have.
        properties: All keys that the mapping may have -> the schema of the value.
    """
    return {
        "type": "object",
        "required": list(required),
        "properties": properties,
        "additionalProperties": False,
        "description": "the keys " + ", ".join(properties),
    }


def make_list_schema(item: JsonSchema, what: str, minimum: int = 1) -> JsonSchema:
    """Return the schema of a list.

    Args:
        item: Schema of an item.
        what: Noun for the items in the plural, such as "links", for error messages.
        minimum: Minimum number of items, 1 or 2.
    """
    return {
        "type": "array",
        "items": item,
        "minItems": minimum,
        "description": f"a list of {what}, at least {_NUMBER_WORDS[minimum]}",
    }


def make_number_schema(description: str, **limits: float) -> JsonSchema:
    """Return the JSON schema of a number.

    Args:
        description: The allowed values in words, for error messages.
        limits: Limits under their names in JSON schema, such as `minimum` or `exclusiveMinimum`.
    """
    return {
        "type": "number",
        "description": description,
        **limits,
    }


def make_integer_schema(
    minimum: int,
    maximum: int,
    description: str,
) -> JsonSchema:
    """Return the JSON schema of an integer from `minimum` to `maximum`, both included.

    Args:
        minimum: Smallest allowed value.
        maximum: Largest allowed value.
        description: The allowed values in words, for error messages.
    """
    limits = {"minimum": minimum, "maximum": maximum}
    return {
        "type": "integer",
        "description": description,
        **limits,
    }


class Schema:
    """Checks plain values against a JSON schema. NaN and infinity do not pass as numbers."""

    def __init__(self, schema: JsonSchema) -> None:
        base = jsonschema.Draft7Validator
        number = base.TYPE_CHECKER.redefine("number", _is_finite_number)
        self._validator = jsonschema.validators.extend(base, type_checker=number)(schema)

    def find_mistakes(self, data: object) -> list[tuple[KeyPath, str]]:
        """Return all mistakes in plain values (mappings, lists, numbers, texts), sorted by key.

        Args:
            data: The values, for example the content of a YAML file.

        Returns:
            For each mistake, the path of keys to the wrong value and the error message (one line).
        """
        # jsonschema reports each missing key of a mapping as an error of its own, but the messages
        # here name all missing keys. The set keeps one of these equal messages.
        found = {
            (tuple(error.absolute_path), _describe(error))
            for error in self._validator.iter_errors(data)
        }
        return sorted(found, key=_sort_key)


def _is_finite_number(_: object, value: object) -> bool:
    """Return whether a value is a number in the range of a float.

    The result is false for NaN and infinity, which YAML writes as .nan and .inf. The library
    jsonschema passes its checker of types as the first argument, which is not used.
    """
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    # The comparison is false for NaN. math.isfinite would raise OverflowError for an integer above
    # the range of a float.
    return abs(value) <= sys.float_info.max


def _sort_key(mistake: tuple[KeyPath, str]) -> list[tuple[bool, str | int]]:
    """Return a sort key for a mistake: list indices sort before keys at the same level.

    Python cannot compare numbers with texts, so each part is paired with whether it is a text.
    """
    path, _ = mistake
    return [(isinstance(part, str), part) for part in path]


def _format_key(path: Iterable[str | int]) -> str:
    """Return a path of keys in the notation of error messages, as in cubes[3].pose."""
    parts = [f"[{part}]" if isinstance(part, int) else f".{part}" for part in path]
    return "".join(parts).lstrip(".") or "top level"


def _describe(error: jsonschema.ValidationError) -> str:
    key = _format_key(error.absolute_path)
    if error.validator == "additionalProperties":
        allowed: JsonSchema = error.schema["properties"]
        unknown = ", ".join(repr(name) for name in error.instance if name not in allowed)
        return f"{key}: unknown key {unknown}, allowed: {', '.join(allowed)}"
    if error.validator == "required":
        required: list[str] = error.schema["required"]
        missing = ", ".join(repr(name) for name in required if name not in error.instance)
        return f"{key}: the key {missing} is missing"

    found = repr(error.instance)
    if len(found) > MAX_SHOWN_CHARACTERS:
        found = found[: MAX_SHOWN_CHARACTERS - 3] + "..."
    return f"{key}: found {found}, allowed: {error.schema.get('description', error.message)}"
