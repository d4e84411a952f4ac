# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Puts a mutation, a programming error that the checks of torture must find, into a node's process.

`mutations.yaml` lists them as edits of source files. The nodes do not know of them: the edited
modules exist only in the memory of the process.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib import import_module
from importlib.util import find_spec, module_from_spec
from pathlib import Path
from textwrap import indent
from typing import NamedTuple, cast

from cube_tensor_driver.config.yaml import read_yaml
from cube_tensor_driver.core.errors import ConfigError
from cube_tensor_driver.processes.skin_processes import Process

Edit = Mapping[str, str]
"""One edit of a source file, with the keys that `mutations.yaml` explains."""


class Mutation(NamedTuple):
    """A deliberate programming error that the checks must find.

    Attributes:
        node: Name of the node whose process has the error, "driver" or "reconstruction".
        edits: Edits of the source files.
    """

    node: str
    edits: Sequence[Edit]


_CONTENT = cast(
    "dict[str, dict[str, list[Edit]]]",
    read_yaml(Path(__file__).with_suffix(".yaml")),
)
"""Content of `mutations.yaml`: edits by name of the mutation, by node."""

MUTATIONS = {
    name: Mutation(node, edits)
    for node, by_name in _CONTENT.items()
    for name, edits in by_name.items()
}
"""All mutations by name."""

NEEDS_RESTART = ("tare not restored",)
"""Names of the mutations that show only when the reconstruction starts again."""


def apply_mutation(process: Process, name: str) -> Process:
    """Return the process with a mutation, or as it is if the mutation is of another process."""
    if not name or MUTATIONS[name].node != process.executable:
        return process
    return replace(process, module=__name__, arguments=(name,))


def edit_source(source: str, edit: Edit) -> str:
    """Return the text of a source file after an edit.

    Raises:
        ConfigError: The text to find does not occur exactly once.
    """
    found = edit["find"]
    if source.count(found) != 1:
        raise ConfigError(f"{edit['file']} has not exactly one {found!r}; adapt mutations.yaml")
    if "replace" in edit:
        return source.replace(found, edit["replace"])
    before, _, _ = source.partition(found)
    line_begin = before.rfind("\n") + 1
    margin = " " * (len(before) - line_begin)
    lines = indent(edit["insert"].rstrip(), margin)
    return f"{source[:line_begin]}{lines}\n{source[line_begin:]}"


def import_mutated(edits: Sequence[Edit]) -> None:
    """Import modules of the driver from edited sources, so that later imports get these modules.

    Raises:
        ConfigError: The text to find does not occur exactly once.
    """
    for file in dict.fromkeys(edit["file"] for edit in edits):
        name = "cube_tensor_driver." + file.removesuffix(".py").replace("/", ".")
        spec = find_spec(name)
        if spec is None or spec.origin is None:
            raise ConfigError(f"there is no file {file}; adapt mutations.yaml")
        source = Path(spec.origin).read_text(encoding="utf-8")
        for edit in edits:
            if edit["file"] == file:
                source = edit_source(source, edit)
        module = sys.modules[name] = module_from_spec(spec)
        exec(compile(source, spec.origin, "exec", dont_inherit=True), vars(module))


def main() -> None:
    """Run a node with a mutation: `python -m workshop.torture.mutations NAME --ros-args …`."""
    mutation = MUTATIONS[sys.argv.pop(1)]
    import_mutated(mutation.edits)
    import_module(f"cube_tensor_driver.ros.nodes.{mutation.node}").main()


if __name__ == "__main__":
    main()
