"""The command line: one module per command, with its arguments and its run.

`table.py` lists the commands, `main.py` reads the words and turns errors into exit codes. Only the
standard library is imported at the top of these modules: every --help works before the environment
is set up. Work of more than a page is a function of another room.
"""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
"""The checkout, which the commands for developers work on."""
