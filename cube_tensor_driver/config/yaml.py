"""YAML files: plain values only, bounded in size, and with no key twice in a mapping."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from ..core.errors import ConfigError
from .input_files import read_bounded
from .output_files import atomic_write

MAX_BYTES = 16 << 20
"""Maximum size of a YAML file, in bytes.

The largest skin, of 65536 cubes on a grid, has 9 MB. A bag or a disk image that is named by mistake
has more.
"""

MAX_DEPTH = 100
"""Maximum number of lists and mappings within each other.

PyYAML's loader in C recurses once per level, so a text of brackets alone would overflow the stack
and kill the process. Texts also come from other hosts, inside of SkinInfo messages.
"""

_MERGE_TAG = "tag:yaml.org,2002:merge"

_INVALID_VALUE_ERRORS = (ValueError, TypeError, ArithmeticError, LookupError, AttributeError)
"""Errors that PyYAML raises itself where a value does not fit its tag, as in ``!!bool maybe``."""

_Dumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """The safe loader, in C where it is installed, which refuses a key that appears twice.

    PyYAML would silently take the last one, and half of a copied cube would be lost.
    """

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        # The call also merges "<<" into the node. Merged keys may be overridden, so the keys that
        # stand in the mapping itself are listed before.
        own_keys = [key for key, _ in node.value if key.tag != _MERGE_TAG]
        mapping: dict[Any, Any] = super().construct_mapping(node, deep)
        seen: set[Any] = set()
        for key in own_keys:
            name = self.construct_object(key, deep=True)
            if name in seen:
                problem = f"the key {name!r} appears twice; keep one"
                raise yaml.MarkedYAMLError(problem=problem, problem_mark=key.start_mark)
            seen.add(name)
        return mapping


def parse_yaml(text: str | bytes, origin: str) -> Any:
    """Return the plain Python value of a YAML text.

    Args:
        text: The YAML text.
        origin: What error messages call the text, such as the path of its file.

    Raises:
        ConfigError: The text is not YAML, has a key twice in a mapping, a tag other than those of
            plain values, or too many levels. The message names the line where one is known.
    """
    try:
        _check_depth(text)
        return yaml.load(text, _Loader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        where = f"{origin}, line {mark.line + 1}, column {mark.column + 1}" if mark else origin
        raise ConfigError(f"{where}: {error.problem or 'not YAML'}") from None
    except (yaml.YAMLError, *_INVALID_VALUE_ERRORS) as error:
        # PyYAML explains itself in several lines, and an error here is one.
        first_line = (str(error) or type(error).__name__).splitlines()[0]
        raise ConfigError(f"{origin}: not YAML: {first_line}") from None


def _check_depth(text: str | bytes) -> None:
    """Raise MarkedYAMLError if the text has more than `MAX_DEPTH` levels.

    Events are read one after the other without recursion, whatever the text is.
    """
    depth = 0
    for event in yaml.parse(text, _Loader):
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        if depth > MAX_DEPTH:
            problem = f"more than {MAX_DEPTH} lists and mappings within each other; use fewer"
            mark: Any = event.start_mark
            raise yaml.MarkedYAMLError(problem=problem, problem_mark=mark)


def read_yaml(path: Path) -> Any:
    """Return the plain Python value of a YAML file.

    Raises:
        ConfigError: There is no regular file, it cannot be read, it is larger than `MAX_BYTES`, or
            `parse_yaml` refuses its text.
    """
    try:
        data = read_bounded(path, MAX_BYTES, "configuration file")
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}; name a YAML file that can be read") from None
    return parse_yaml(data, str(path))


def to_yaml(value: Any) -> str:
    """Return plain values as YAML text, with the keys in the order of their mapping."""
    text: str = yaml.dump(
        value,
        Dumper=_Dumper,
        sort_keys=False,
        default_flow_style=None,
        width=110,
        allow_unicode=True,
    )
    return text


def write_yaml(path: Path, value: Any, header: str = "") -> None:
    """Write plain values as a YAML file, completely or not at all.

    Args:
        path: The file, which is replaced if it exists.
        value: The plain values.
        header: Lines for a comment at the top of the file.

    Raises:
        ConfigError: The file cannot be written.
    """
    comment = "".join(f"# {line}".rstrip() + "\n" for line in header.splitlines())
    text = comment + to_yaml(value)
    with atomic_write(path) as temporary:
        temporary.write_text(text)
