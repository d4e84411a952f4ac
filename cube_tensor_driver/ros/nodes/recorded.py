"""A bag in place of a skin file: then replayed frequencies give the recorded stress."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from ...core.errors import BagError

if TYPE_CHECKING:
    from ...bags.reprocess.recorded_reconstruction import RecordedReconstruction

BAGS = (".mcap", ".db3")


def open_recording(path: Path, until: ExitStack) -> RecordedReconstruction | None:
    """What a bag says about its reconstruction; None for a skin file.

    until: closes the bag when it is closed. BagError: no bag, or the library that reads bags is
    missing.
    """
    if not path.is_dir() and path.suffix not in BAGS:
        return None
    # Imported here because no other node or parameter needs the library for bags, which has no
    # rosdep key.
    try:
        from ...bags.reprocess.recorded_reconstruction import RecordedReconstruction
    except ModuleNotFoundError as error:
        raise BagError(
            f"config: {path} is a bag, and reading it needs the Python package {error.name}: "
            "pip install 'rosbags>=0.11,<0.12' 'mcap>=1.6,<2' zstandard"
        ) from None

    recorded = RecordedReconstruction(path)
    until.callback(recorded.close)
    return recorded
