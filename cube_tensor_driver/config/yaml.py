"""YAML files read safely: bounded in size, no Python objects, no key twice. What goes wrong is a
`ConfigError`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from ..core.errors import ConfigError
from .atomic_write import atomic_write

MAX_BYTES = 64 << 20
"""No skin or calibration comes near; a wrong path to a bag or a disk image does."""


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """The safe loader, in C where there is one, that refuses a key written twice instead of taking
    the last."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        own = [key for key, _ in node.value if key.tag != "tag:yaml.org,2002:merge"]
        mapping: dict[Any, Any] = super().construct_mapping(node, deep)
        seen: set[Any] = set()
        for key in own:
            name = self.construct_object(key, deep=True)
            if name in seen:
                raise yaml.MarkedYAMLError(
                    problem=f"the key {name!r} is there twice; keep one",
                    problem_mark=key.start_mark,
                )
            seen.add(name)
        return mapping


def parse_yaml(text: str | bytes, origin: str) -> Any:
    """The plain Python value of a YAML text; `origin` names it in errors.

    ConfigError: not YAML, a key twice, a tag that is not plain data, with the line.
    """
    try:
        return yaml.load(text, _Loader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        place = f"{origin}, line {mark.line + 1}, column {mark.column + 1}" if mark else origin
        raise ConfigError(f"{place}: {error.problem or 'not YAML'}") from None
    except (yaml.YAMLError, ValueError, TypeError, RecursionError) as error:
        raise ConfigError(
            f"{origin}: not YAML: {str(error).splitlines()[0] if str(error) else type(error).__name__}"
        ) from None


def read_yaml(path: Path) -> Any:
    """The plain Python value of a YAML file.

    ConfigError: no such file, not readable, larger than 64 MB, or as `parse_yaml`.
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
    """Write plain values as YAML, whole or not at all; `header` becomes comment lines at the top.

    ConfigError: it cannot be written.
    """
    lines = "".join(f"# {line}".rstrip() + "\n" for line in header.splitlines())
    text = lines + to_yaml(value)
    with atomic_write(path) as partial:
        partial.write_text(text)
