"""A bag as what a reconstruction runs by: its skin, its rest frequencies and what was found bad,
each in its time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..config.skin import Skin, SkinCube, SkinLink
from ..core.errors import BagError
from ..core.pipeline import Pipeline
from ..core.reconstructor import Reconstructor, Verdicts
from ..core.rows import FrequencyRows
from ..core.tensor import rpy_from_quaternion
from .read import Bag
from .reprocess import Recording


class RecordedReconstruction:
    """What a recording says about its own reconstruction, so that replayed frequencies give the
    recorded stress.

    Rest frequencies follow the recording's; pads that were left out are left out again. What the
    recording does not have is decided when the rows come.
    """

    def __init__(self, path: Path) -> None:
        """BagError: no bag, or one of several skins or calibrations."""
        self._bag = Bag(path)
        self._bag.__enter__()
        self._recording = Recording(self._bag, f"{self._bag.skin()}frequencies")
        first, *others = self._recording.pipelines
        ids = [calibration.id for calibration in first.calibrations]
        if any([calibration.id for calibration in other.calibrations] != ids for other in others):
            raise BagError(
                f"{path}: the calibrations change within the recording: reprocess it instead"
            )
        self.skin = recorded_skin(self._recording.infos[-1], first)
        self._number: int | None = None

    def close(self) -> None:
        """Close the bag."""
        self._bag.__exit__()

    def verdicts(self, rows: FrequencyRows, reconstructor: Reconstructor) -> Verdicts:
        """What was decided about the rows of one message; sets the rest frequencies of their time."""
        newest_ns = int(rows.stamp_ns.max(initial=0))
        number = self._recording.number(newest_ns)
        if number != self._number:
            self._number = number
            reconstructor.rest_frequency = self._recording.pipelines[number].rest_frequency
        # A message is stamped with its earliest row.
        stamp_ns = rows.stamp_ns.min(initial=newest_ns)[None]
        found = self._recording.found.of(stamp_ns, rows.cube[None])
        known = np.repeat(found.known, len(rows))
        return Verdicts(known, found.left_out[0], found.bits[0])


def recorded_skin(info: Any, pipeline: Pipeline) -> Skin:
    """The skin of a SkinInfo; where its ports were no bag says."""
    names = dict.fromkeys(cube.link for cube in info.cubes if cube.link)
    links = tuple(SkinLink(name, "recorded", 0, None) for name in names)
    cubes = []
    for cube, calibration in zip(info.cubes, pipeline.calibrations, strict=True):
        at, turn = cube.pose.position, cube.pose.orientation
        roll, pitch, yaw = rpy_from_quaternion(np.array([turn.x, turn.y, turn.z, turn.w])).tolist()
        cubes.append(
            SkinCube(
                cube.name,
                cube.link or None,
                int(cube.index),
                int(cube.uid) or None,
                (float(at.x), float(at.y), float(at.z)),
                (roll, pitch, yaw),
                calibration,
            )
        )
    return Skin(info.name, info.header.frame_id, None, links, tuple(cubes))
