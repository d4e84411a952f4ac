"""Sphinx settings: ./cube docs builds the pages, every warning an error."""

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
autodoc_default_options = {"members": True, "undoc-members": False}
exclude_patterns = ["_build"]


def setup(app) -> None:
    """Docstrings are plain text with equations drawn in characters: shown as they stand."""

    def literal(app, what, name, obj, options, lines: list[str]) -> None:
        if lines:
            lines[:] = ["::", "", *("   " + line for line in lines)]

    # The blocks of protocol.md: a test reads them as bytes.
    for name in ("frame", "wire"):
        app.add_lexer(name, TextLexer)
    app.connect("autodoc-process-docstring", literal)
