# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The command line: one module per command, with its arguments, its work and what it prints.

`table.py` lists the commands; `main.py` parses the command line and turns errors into exit codes.
At their top, these modules import only the standard library and modules that need nothing else, so
that every --help works before the environment is set up. All other imports are inside functions.
Work that takes more than a page of code belongs into another folder.
"""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
"""Path of the checkout of this repository, in which the commands for developers work."""
