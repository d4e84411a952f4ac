# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Reads and writes YAML files, and refuses unsafe or ambiguous ones.

Refused are tags other than those of plain values (numbers, texts, lists, mappings), files above a
maximum size, deeply nested values, and mappings in which a key appears twice.
"""

from __future__ import annotations

from pathlib import Path
from typing import cast

import yaml

from ..core.errors import ConfigError
from .input_files import read_bounded
from .output_files import write_atomically

MAX_DEPTH = 100
"""Maximum number of nested lists and mappings in a YAML text.

PyYAML's loader in C recurses once per level, so a text of many opening brackets would overflow the
stack and kill the process. YAML texts also come from other hosts, inside of SkinInfo messages.
"""

_MERGE_TAG = "tag:yaml.org,2002:merge"
"""Tag that YAML gives to the key ``<<``, which copies the keys of another mapping."""

_INVALID_VALUE_ERRORS = (ValueError, TypeError, ArithmeticError, LookupError, AttributeError)
"""Exceptions that PyYAML lets escape if a value does not fit its tag, as in ``!!bool maybe``.

They do not derive from yaml.YAMLError.
"""

_Dumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
"""PyYAML's class that writes plain values, implemented in C where that is installed."""


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """PyYAML's safe loader (in C where installed) that refuses a key that appears twice.

    PyYAML itself silently keeps the last value of such a key. A key that was duplicated by copying
    lines of a skin file would then lose its first value unnoticed.
    """

    def construct_mapping(
        self,
        node: yaml.MappingNode,
        deep: bool = False,
    ) -> dict[object, object]:
        # A mapping may override keys that "<<" copies from another mapping. Therefore its own keys
        # are listed now, before PyYAML inserts the copied ones into the node.
        own_keys = [key for key, _ in node.value if key.tag != _MERGE_TAG]
        mapping: dict[object, object] = super().construct_mapping(node, deep)
        seen: set[object] = set()
        for key in own_keys:
            name = self.construct_object(key, deep=True)
            if name in seen:
                problem = f"the key {name!r} appears twice; keep one"
                raise yaml.MarkedYAMLError(problem=problem, problem_mark=key.start_mark)
            seen.add(name)
        return mapping


def parse_yaml(text: str | bytes, origin: str) -> object:
    """Return the plain Python value of a YAML text.

    Args:
        text: The YAML text.
        origin: Name of the text in error messages, such as the path of its file.

    Raises:
        ConfigError: The text is not YAML, has a key twice in a mapping, a tag other than those of
            plain values, or more than `MAX_DEPTH` levels. The message names the line, except for a
            value that does not fit its tag.
    """
    try:
        _check_depth(text)
        return yaml.load(text, _Loader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        where = f"{origin}, line {mark.line + 1}, column {mark.column + 1}" if mark else origin
        raise ConfigError(f"{where}: {error.problem or 'not YAML'}") from None
    except (yaml.YAMLError, *_INVALID_VALUE_ERRORS) as error:
        # The messages of PyYAML have several lines; errors of this package have one.
        first_line = (str(error) or type(error).__name__).splitlines()[0]
        raise ConfigError(f"{origin}: not YAML: {first_line}") from None


def _check_depth(text: str | bytes) -> None:
    """Raise MarkedYAMLError if lists and mappings are nested more than `MAX_DEPTH` deep.

    PyYAML parses a text into a sequence of events without recursion, so that this check cannot
    overflow the stack itself.
    """
    depth = 0
    for event in yaml.parse(text, _Loader):
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        if depth > MAX_DEPTH:
            problem = f"more than {MAX_DEPTH} lists and mappings within each other; use fewer"
            # PyYAML's marks in C have the attributes of those in Python.
            mark = cast("yaml.Mark", event.start_mark)
            raise yaml.MarkedYAMLError(problem=problem, problem_mark=mark)


def read_yaml(path: Path) -> object:
    """Return the plain Python value of a YAML file.

    Raises:
        ConfigError: The path leads to no regular file, the file cannot be read or is too
            large, or `parse_yaml` refuses its text.
    """
    try:
        data = read_bounded(path, "configuration file")
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}; name a YAML file that can be read") from None
    return parse_yaml(data, str(path))


def to_yaml(value: object) -> str:
    """Return plain values (numbers, texts, lists, mappings) as YAML text; keys keep their order."""
    return yaml.dump(
        value,
        Dumper=_Dumper,
        sort_keys=False,
        default_flow_style=None,
        width=110,
        allow_unicode=True,
    )


def write_yaml(path: Path, value: object, header: str = "") -> None:
    """Write plain values as a YAML file, completely or not at all.

    Args:
        path: The file, which is replaced if it exists.
        value: The plain values (numbers, texts, lists, mappings).
        header: Lines of text that are written as a YAML comment at the top of the file.

    Raises:
        ConfigError: The file cannot be written.
    """
    comment = "".join(f"# {line}".rstrip() + "\n" for line in header.splitlines())
    text = comment + to_yaml(value)
    with write_atomically(path) as temporary:
        temporary.write_text(text, "utf-8")
