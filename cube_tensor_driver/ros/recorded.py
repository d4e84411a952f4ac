"""A bag in place of a skin file: then replayed frequencies give the recorded stress."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..bags.recorded_reconstruction import RecordedReconstruction

BAGS = (".mcap", ".db3")


def open_recording(path: Path, until: ExitStack) -> RecordedReconstruction | None:
    """What a bag says about its reconstruction; None for a skin file.

    until: closes the bag when it is closed. BagError: no bag.
    """
    if not path.is_dir() and path.suffix not in BAGS:
        return None
    # Imported here because it loads much that a node does not need otherwise.
    from ..bags.recorded_reconstruction import RecordedReconstruction

    recorded = RecordedReconstruction(path)
    until.callback(recorded.close)
    return recorded
