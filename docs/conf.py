"""Sphinx settings: ./cube docs builds the pages, every warning an error."""

import re

from pygments.lexers.special import TextLexer

project = "cube_tensor_driver"
author = "the cube_tensor_driver authors"
extensions = ["myst_parser", "sphinx.ext.autodoc"]
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
default_role = "py:obj"
exclude_patterns = ["_build"]

ENTRY = re.compile(r"([a-z]\w*(?:, \w+)*): (.*)")
"""`name: text` at the beginning of a paragraph, or right after another such line."""
ERROR = re.compile(r"([A-Z]\w*Error): (.*)")
MARKUP = re.compile(r"(`[^`]*`|``[^`]*``)|([*|\\]|_\b(?!\w))")
"""What reStructuredText would read as markup: quoted words stay, all else is escaped."""


PAGE = re.compile(r"\[([a-z_]+\.md)\]\((?=\1[)#])")
"""The begin of a link whose text is the page's file name, for those who read the files."""


def plain(line: str) -> str:
    return MARKUP.sub(lambda found: found[1] or "\\" + found[2], line)


def restructured(lines: list[str], field: str) -> list[str]:
    """A docstring in plain text as reStructuredText.

    `name: text` becomes a field, a name with `Error` what is raised, and what is indented after a
    blank line stays as it stands: an equation or a program.
    """
    done: list[str] = []
    kind = "text"  # of the paragraph that a line may go on: text, entry, error or literal
    for line in lines:
        entry, error = ENTRY.fullmatch(line), ERROR.fullmatch(line)
        begins = not done or not done[-1]
        if not line:
            done.append("")
        elif line.startswith(" "):
            if begins and kind != "literal":
                done += ["::", ""]
                kind = "literal"
            done.append(line if kind == "literal" else plain(line))
        elif error or (entry and (begins or kind in ("entry", "error"))):
            if not begins and kind not in ("entry", "error"):
                done.append("")
            if error:
                kind = "error"
                done.append(f":raises {error[1]}: {plain(error[2])}")
            else:
                kind = "entry"
                done += [f":{field} {name}: {plain(entry[2])}" for name in entry[1].split(", ")]
        elif not begins and (kind == "error" or (kind == "entry" and line[0].islower())):
            done.append("    " + plain(line))
        else:
            if not begins and kind in ("entry", "error"):
                done.append("")
            kind = "text"
            done.append(plain(line))
    return done


def setup(app) -> None:
    """The blocks of protocol.md are bytes for a test; docstrings are plain text; a link shows the
    title of its page."""
    for name in ("frame", "wire"):
        app.add_lexer(name, TextLexer)

    def text(app, what, name, obj, options, lines: list[str]) -> None:
        lines[:] = restructured(lines, "ivar" if what == "class" else "param")

    def skip(app, what, name, obj, skip, options) -> bool | None:
        # Python's own words about the field of a tuple; the class describes its fields.
        return True if str(obj.__doc__).startswith("Alias for field") else None

    def titles(app, docname: str, source: list[str]) -> None:
        source[0] = PAGE.sub("[](", source[0])

    app.connect("source-read", titles)
    app.connect("autodoc-process-docstring", text)
    app.connect("autodoc-skip-member", skip)
