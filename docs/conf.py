# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Sphinx settings: ./cube docs builds the pages, and every warning is an error.

The tables of message fields and of parameters are generated from the code. A page asks for one
with a comment, `<!-- table: SkinStress -->` or `<!-- table: parameters -->`, which GitHub does not
show.
"""

import re
from pathlib import Path

from pygments.lexers.special import TextLexer

from cube_tensor_driver.config.parameters import (
    CONTACTS,
    DRIVER,
    MARKERS,
    RECONSTRUCTION,
    SIMULATED_IMU,
)

project = "cube_tensor_driver"
author = "the cube_tensor_driver authors"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
html_theme = "furo"
html_static_path = ["static"]
html_css_files = ["lines.css"]
myst_heading_anchors = 3
myst_enable_extensions = ["dollarmath"]
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autodoc_typehints = "description"
autodoc_type_aliases = {"NDArray": "NDArray"}
autodoc_typehints_description_target = "documented_params"
napoleon_use_ivar = True
default_role = "py:obj"
exclude_patterns = ["_build"]

ROOT = Path(__file__).parent.parent
NODES = {
    "driver": DRIVER,
    "reconstruction": RECONSTRUCTION,
    "markers": MARKERS,
    "contacts": CONTACTS,
    "simulated_imu": SIMULATED_IMU,
}
PAGE_NAME = re.compile(r"\[([a-z_]+\.md)\]\((?=\1[)#])")
"""Text of a link that is the file name of a page. The HTML page shows its title instead."""
TABLE = re.compile(r"<!-- table: (\w+) -->")


def markdown_table(head: list[str], rows: list[list[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def interface_tables(path: Path) -> str:
    """Describe a .msg or .srv file: its introduction, its constants and its fields.

    A comment belongs to the field below it, and before an empty line to the whole file.
    """
    introduction: list[str] = []
    constants: list[list[str]] = []
    fields: list[list[str]] = []
    comment: list[str] = []
    part = "request" if path.suffix == ".srv" else ""

    for line in path.read_text().splitlines():
        definition, _, text = line.partition("#")
        if line.startswith("#"):
            comment.append(text.strip())
        elif line == "---":
            part = "response"
        elif not line:
            introduction += comment
            comment = []
        elif "=" in definition:
            name, value = definition.split()[1].split("=")
            constants.append([f"`{name}`", value, text.strip()])
            introduction += comment
            comment = []
        else:
            kind, name = definition.split()
            fields.append([f"`{name}`", f"`{kind}`", " ".join(comment)])
            fields[-1][1:1] = [part] if part else []
            comment = []

    tables = [" ".join(introduction)]
    head = ["field", "in", "type", "meaning"] if part else ["field", "type", "meaning"]
    tables.append(markdown_table(head, fields))
    if constants:
        tables.append(markdown_table(["constant", "value", "meaning"], constants))
    return "\n\n".join(tables)


def parameter_table() -> str:
    """List the parameters of all nodes. A parameter that several nodes share has one row."""
    users: dict = {}
    for node, parameters in NODES.items():
        for parameter in parameters:
            users.setdefault(parameter, []).append(f"`{node}`")

    rows = []
    for parameter, nodes in users.items():
        default = f"`{parameter.default}`" if parameter.default != "" else "empty"
        allowed = parameter.choices or {bool: "true, false"}.get(type(parameter.default), "text")
        if parameter.span:
            low, high = parameter.span
            allowed = f"{parameter.minimum or low:.12g} to {high:.12g}"
            allowed = f"0, {allowed}" if parameter.minimum else allowed
        live = "yes" if parameter.live else "no"
        name, text = f"`{parameter.name}`", parameter.description
        rows.append([name, ", ".join(nodes), default.lower(), allowed, live, text])
    return markdown_table(["parameter", "node", "default", "allowed", "live", "meaning"], rows)


def generated_table(name: str) -> str:
    if name == "parameters":
        return parameter_table()
    [path] = [*ROOT.glob(f"msg/{name}.msg"), *ROOT.glob(f"srv/{name}.srv")]
    return interface_tables(path)


def setup(app) -> None:
    def prepare_page(app, page: str, source: list[str]) -> None:
        text = PAGE_NAME.sub("[](", source[0])
        source[0] = TABLE.sub(lambda found: generated_table(found[1]), text)

    for name in ("frame", "wire"):  # the blocks of protocol.md, which tests read as bytes
        app.add_lexer(name, TextLexer)
    app.connect("source-read", prepare_page)
