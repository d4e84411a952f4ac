"""YAML files, read safely: limited in size, plain values only, no key twice in a mapping."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from ..core.errors import ConfigError
from .atomic_write import atomic_write

MAX_BYTES = 64 << 20
"""Far more than any skin or calibration file has; a bag or a disk image named by mistake has
more."""
_MERGE_TAG = "tag:yaml.org,2002:merge"


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """The safe loader, in C where it is installed, which refuses a key that appears twice.

    PyYAML would silently take the last one.
    """

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        # Keys that come from a merge (<<) may be overridden.
        own_keys = [key for key, _ in node.value if key.tag != _MERGE_TAG]
        mapping: dict[Any, Any] = super().construct_mapping(node, deep)
        seen: set[Any] = set()
        for key in own_keys:
            name = self.construct_object(key, deep=True)
            if name in seen:
                raise yaml.MarkedYAMLError(
                    problem=f"the key {name!r} appears twice; keep one",
                    problem_mark=key.start_mark,
                )
            seen.add(name)
        return mapping


def parse_yaml(text: str | bytes, origin: str) -> Any:
    """The plain Python value of a YAML text; `origin` names the text in error messages.

    Raises ConfigError, with the line, if it is not YAML, if a key appears twice or if a tag stands
    for something else than plain data.
    """
    try:
        return yaml.load(text, _Loader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        where = f"{origin}, line {mark.line + 1}, column {mark.column + 1}" if mark else origin
        raise ConfigError(f"{where}: {error.problem or 'not YAML'}") from None
    except (yaml.YAMLError, ValueError, TypeError, RecursionError) as error:
        lines = str(error).splitlines()
        reason = lines[0] if lines else type(error).__name__
        raise ConfigError(f"{origin}: not YAML: {reason}") from None


def read_yaml(path: Path) -> Any:
    """The plain Python value of a YAML file.

    Raises ConfigError if the file does not exist, cannot be read or is larger than 64 MB, and in
    the cases of `parse_yaml`.
    """
    try:
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise ConfigError(
                f"{path}: {size} bytes, the limit is {MAX_BYTES}: this is no configuration file"
            )
        return parse_yaml(path.read_bytes(), str(path))
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}; name a YAML file that can be read") from None


def to_yaml(value: Any) -> str:
    """Plain values as YAML text."""
    text: str = yaml.safe_dump(
        value, sort_keys=False, default_flow_style=None, width=110, allow_unicode=True
    )
    return text


def write_yaml(path: Path, value: Any, header: str = "") -> None:
    """Write plain values as a YAML file, completely or not at all.

    header: comment lines at the top. Raises ConfigError if the file cannot be written.
    """
    comment = "".join(f"# {line}".rstrip() + "\n" for line in header.splitlines())
    text = comment + to_yaml(value)
    with atomic_write(path) as temporary:
        temporary.write_text(text)
