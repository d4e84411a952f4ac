"""A bag that determines a reconstruction, so that replayed frequencies give the recorded stress."""

from __future__ import annotations

from pathlib import Path

from ...core.reconstructor import Reconstructor, RecordedHealth
from ...core.rows import FrequencyRows
from ..recording import Settings
from ..source import open_bag


class RecordedReconstruction:
    """The rest frequencies and the health of a recording, each at its time.

    Attributes:
        skin: The skin as it was recorded.
    """

    def __init__(self, path: Path) -> None:
        """Open a bag.

        Raises:
            BagError: There is no bag, or it has several skins or changes its calibrations.
        """
        self._source = open_bag(path)
        try:
            self._source.recording.check_calibrations_stay()
        except BaseException:
            self.close()
            raise
        self.skin = self._source.skin
        self._settings: Settings | None = None

    def close(self) -> None:
        """Close the bag."""
        self._source.bag.close()

    def health_at(self, rows: FrequencyRows, reconstructor: Reconstructor) -> RecordedHealth:
        """Return the recorded health for the rows of one message.

        It also sets the rest frequencies of the reconstructor to those of the rows' time. What the
        recording does not state is decided when the rows come.
        """
        settings = self._source.recording.settings_at(rows)
        if settings is not self._settings:
            self._settings = settings
            reconstructor.rest_frequency = settings.rest_frequency
        return self._source.recording.health_at(rows)
