"""The command line: one module per command, with its arguments, its work and what it prints.

`table.py` lists the commands; `main.py` parses the words and turns errors into exit codes. At the
top of these modules only the standard library is imported, so that every --help works before the
environment is set up; all other imports are inside functions. Work of more than a page belongs
into another folder.
"""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
"""The folder of the checkout. The commands for developers work on it."""
