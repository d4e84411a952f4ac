# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Settings and health from a bag for a reconstruction, so that replayed frequencies give exactly
the recorded stress."""

from __future__ import annotations

from pathlib import Path

from ...core.compensation.motion import Motion
from ...core.reconstructor import Reconstructor, RecordedHealth
from ...core.rows import FrequencyRows
from ..recording import Settings
from ..source import open_bag


class RecordedReconstruction:
    """The rest frequencies and the health of the pads that applied at each time of a recording.

    A rest frequency is the frequency of a pad without load. The health states which pads were left
    out as faulty.

    Attributes:
        skin: The skin (cubes, their poses and calibrations) as the bag describes it.
    """

    def __init__(self, path: Path) -> None:
        """Open a bag.

        Raises:
            BagError: There is no bag, it has several skins, or the calibration of a cube changes
                within the recording.
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

    def find_health(
        self,
        rows: FrequencyRows,
        reconstructor: Reconstructor,
    ) -> RecordedHealth:
        """Return the recorded health (which pads were left out, and why) for rows of one message.

        The rest frequencies (without load) that applied when these rows were recorded are set in
        the reconstructor.

        Args:
            rows: Rows (samples of cubes) of one message of frequencies.
            reconstructor: The reconstructor that will process these rows.

        Returns:
            The health. Where its `known` is false, no stress was recorded for the row, and the
            reconstructor determines the health itself.
        """
        settings = self._source.recording.find_settings(rows)
        if settings is not self._settings:
            self._settings = settings
            reconstructor.rest_frequency = settings.rest_frequency
        return self._source.recording.health.find(rows)

    def find_compensation(
        self,
        stamp_ns: int,
        reconstructor: Reconstructor,
    ) -> Motion | None:
        """Return the recorded motion of the skin, which the compensation of its weight requires.

        The recorded states of creep and temperature are set in the reconstructor.

        Args:
            stamp_ns: Stamp of the message of frequencies, in ns since the Unix epoch.
            reconstructor: The reconstructor that will process the rows of this message.

        Returns:
            The motion; None: weight was not compensated.
        """
        recorded = self._source.recording.compensation.find(stamp_ns)
        reconstructor.compensation.restore(recorded.states)
        return recorded.motion
