"""YAML files, read safely: limited in size, depth and number of values, plain values only, no key
twice in a mapping."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from ..core.errors import ConfigError
from .atomic_write import atomic_write
from .input_files import read_bounded

MAX_BYTES = 16 << 20
"""Far more than any skin or calibration file has; a bag or a disk image named by mistake has
more."""
MAX_DEPTH = 100
"""Of lists and mappings within each other. The parser in C calls itself once for each and would
overflow its stack."""
MAX_VALUES = 2_000_000
"""Values, each alias counted with all that it stands for: the largest skin, of 65536 cubes, has
1.5 million."""
MAX_DIGITS = 100
"""Characters of a number: the time to read some grows with the square of their length."""
MAX_INTEGER = 1 << 64
"""No uid is larger, and much larger integers have no float and cannot be printed."""
_MERGE_TAG = "tag:yaml.org,2002:merge"
_INT_TAG = "tag:yaml.org,2002:int"
_FLOAT_TAG = "tag:yaml.org,2002:float"
_NOT_YAML = (
    yaml.YAMLError,
    ValueError,
    TypeError,
    RecursionError,
    ArithmeticError,
    LookupError,
    AttributeError,
)
"""What PyYAML lets through where a value does not fit its tag."""


_Dumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
"""In C where it is installed: half of the time for a large skin, and the same text."""


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

    def construct_number(self, node: yaml.ScalarNode) -> int | float:
        if len(node.value) > MAX_DIGITS:
            self._refuse(node, f"a number of {len(node.value)} characters, limit {MAX_DIGITS}")
        if node.tag == _FLOAT_TAG:
            return float(self.construct_yaml_float(node))
        value = int(self.construct_yaml_int(node))
        if abs(value) > MAX_INTEGER:
            self._refuse(node, f"an integer of {value.bit_length()} bits, the limit is 64")
        return value

    @staticmethod
    def _refuse(node: yaml.ScalarNode, text: str) -> None:
        raise yaml.MarkedYAMLError(problem=f"{text}: correct it", problem_mark=node.start_mark)


_Loader.add_constructor(_INT_TAG, _Loader.construct_number)
_Loader.add_constructor(_FLOAT_TAG, _Loader.construct_number)


class _Bounds:
    """Follows the events of a YAML text, and refuses what would cost too much to build.

    Events come one by one whatever the text is; only building values of them recurses. Aliases cost
    nothing to build but all that they stand for whenever somebody walks through the value.
    """

    def __init__(self) -> None:
        self._open: list[tuple[str | None, int]] = []  # anchor, values before it
        self._values = 0
        self._sizes: dict[str | None, int] = {}  # of what is anchored

    def check(self, event: yaml.Event) -> None:
        """MarkedYAMLError: the text goes beyond a bound here."""
        if isinstance(event, yaml.CollectionEndEvent):
            anchor, before = self._open.pop()
            self._anchored(anchor, self._values - before)
            return
        if isinstance(event, yaml.CollectionStartEvent):
            self._open.append((event.anchor, self._values))
            self._values += 1
            if len(self._open) > MAX_DEPTH:
                self._refuse(event, f"more than {MAX_DEPTH} lists and mappings within each other")
        elif isinstance(event, yaml.ScalarEvent):
            self._values += 1
            self._anchored(event.anchor, 1)
        elif isinstance(event, yaml.AliasEvent):
            if any(anchor == event.anchor for anchor, _ in self._open):
                self._refuse(event, f"the alias {event.anchor!r} stands within what it stands for")
            self._values += self._sizes.get(event.anchor, 1)
        if self._values > MAX_VALUES:
            self._refuse(event, f"more than {MAX_VALUES} values, aliases written out")

    def _anchored(self, anchor: str | None, size: int) -> None:
        if anchor is not None:
            self._sizes[anchor] = size

    @staticmethod
    def _refuse(event: Any, text: str) -> None:
        raise yaml.MarkedYAMLError(
            problem=f"{text}: this is no configuration file", problem_mark=event.start_mark
        )


def parse_yaml(text: str | bytes, origin: str) -> Any:
    """The plain Python value of a YAML text; `origin` names the text in error messages.

    Raises ConfigError, with the line, if it is not YAML, if a key appears twice, if a tag stands
    for something else than plain data, or beyond the limits of depth, number and length above.
    """
    try:
        bounds = _Bounds()
        for event in yaml.parse(text, _Loader):
            bounds.check(event)
        return yaml.load(text, _Loader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        where = f"{origin}, line {mark.line + 1}, column {mark.column + 1}" if mark else origin
        raise ConfigError(f"{where}: {error.problem or 'not YAML'}") from None
    except _NOT_YAML as error:
        lines = str(error).splitlines()
        reason = lines[0] if lines else type(error).__name__
        raise ConfigError(f"{origin}: not YAML: {reason}") from None


def read_yaml(path: Path) -> Any:
    """The plain Python value of a YAML file.

    Raises ConfigError if there is no regular file, if it cannot be read or is larger than 16 MB,
    and in the cases of `parse_yaml`.
    """
    try:
        data = read_bounded(path, MAX_BYTES, "configuration file")
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}; name a YAML file that can be read") from None
    return parse_yaml(data, str(path))


def to_yaml(value: Any) -> str:
    """Plain values as YAML text."""
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

    header: comment lines at the top. Raises ConfigError if the file cannot be written.
    """
    comment = "".join(f"# {line}".rstrip() + "\n" for line in header.splitlines())
    text = comment + to_yaml(value)
    with atomic_write(path) as temporary:
        temporary.write_text(text)
