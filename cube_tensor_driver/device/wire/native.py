"""The wire module in C (native/), if it was compiled.

Without it everything works in Python, more slowly.
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
"""Warning that is logged where `wire` is None."""
