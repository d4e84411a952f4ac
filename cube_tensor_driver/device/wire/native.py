"""Whether the wire was compiled (native/). Without it everything works in Python, and slower."""

from __future__ import annotations

try:
    from ... import _wire as wire
except ImportError:
    wire = None  # type: ignore[assignment]

SLOWER = (
    "the wire is decoded in Python, which is slower, because no C compiler was there at the "
    "installation: install one (sudo apt install gcc python3-dev) and install again"
)
