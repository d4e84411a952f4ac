"""A bag as what a reconstruction goes by, so that replayed frequencies give the recorded stress."""

from __future__ import annotations

from pathlib import Path

from ...core.reconstructor import Reconstructor, RecordedHealth
from ...core.rows import FrequencyRows
from ..recording import Settings
from ..source import open_bag


class RecordedReconstruction:
    """The rest frequencies and verdicts of a recording, each at its time. skin: as recorded.

    What the recording does not say is decided when the rows come.
    """

    def __init__(self, path: Path) -> None:
        """BagError: no bag, or one of several skins or calibrations."""
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

    def verdicts(self, rows: FrequencyRows, reconstructor: Reconstructor) -> RecordedHealth:
        """The verdicts about the rows of one message. Sets the reconstructor's rest frequencies to
        those of their time."""
        settings = self._source.recording.settings_at(rows)
        if settings is not self._settings:
            self._settings = settings
            reconstructor.rest_frequency = settings.rest_frequency
        return self._source.recording.verdicts(rows)
