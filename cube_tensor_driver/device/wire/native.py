"""Import of the wire module in C (folder native/), which reads and decodes frames.

Where it was not compiled, `wire` is None, and the same functions run in Python, more slowly.
"""

from __future__ import annotations

try:
    from ... import _wire as wire
except ImportError:
    wire = None  # type: ignore[assignment]

__all__ = ["NOT_COMPILED", "wire"]

NOT_COMPILED = (
    "the wire is decoded in Python, which is slower, because no C compiler was there at the "
    "installation: install one (sudo apt install gcc python3-dev) and install again"
)
"""Warning that is logged where the wire module in C was not compiled (`wire` is None)."""
