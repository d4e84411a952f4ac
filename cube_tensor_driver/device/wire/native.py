# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Import of the wire module in C (folder native/), which reads and decodes frames.

Where it was not compiled, `wire` is None, and the same functions run in Python, more slowly.
"""

from __future__ import annotations

import sysconfig
from ctypes import sizeof

from ..track import LinkTrack

try:
    from ... import _wire as wire
except ImportError:
    wire = None  # type: ignore[assignment]
else:
    # The module changes the fields of LinkTrack in memory, so it is not used if it was built for
    # another layout of them.
    if getattr(wire, "TRACK_SIZE", 0) != sizeof(LinkTrack):
        wire = None  # type: ignore[assignment]

__all__ = ["NOT_COMPILED", "wire"]

NOT_COMPILED = "the wire is decoded in Python, which is slower, because " + (
    "a free-threaded Python loads no module of the stable ABI: use a Python with its lock (GIL)"
    if sysconfig.get_config_var("Py_GIL_DISABLED")
    else "the module in C is missing or of another version: install a compiler "
    "(sudo apt install gcc python3-dev) and install again"
)
"""Warning that is logged where `wire`, the wire module in C, is None."""
