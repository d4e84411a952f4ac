"""A bag as what a reconstruction runs by: its skin, its rest frequencies and what was found bad,
each in its time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..config.skin import Skin, SkinCube, SkinLink
from ..core.errors import BagError
from ..core.health import Health
from ..core.pipeline import Pipeline
from ..core.tensor import rpy_from_quaternion
from .read import Bag
from .reprocess import Recording


class RecordedHealth(Health):
    """Health under which replayed frequencies give the recorded stress.

    Rest frequencies follow the recording's; pads that were left out are left out again. What the
    recording does not have is found anew.
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
        self.pipeline = Pipeline(first.calibrations, np.float32)
        self.pipeline.rest_frequency = first.rest_frequency
        self._number = 0
        super().__init__(self.pipeline)

    def close(self) -> None:
        """Close the bag."""
        self._bag.__exit__()

    def update(
        self,
        cube: np.ndarray,
        frequency: np.ndarray,
        pad_fault: np.ndarray,
        stamp_ns: np.ndarray,
        temperature: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """As `Health.update`."""
        newest_ns = int(stamp_ns.max(initial=0))
        number = self._recording.number(newest_ns)
        if number != self._number:
            self._number = number
            self.pipeline.rest_frequency = self._recording.pipelines[number].rest_frequency
            self.refresh()
        anew = super().update(cube, frequency, pad_fault, stamp_ns, temperature)
        # A message is stamped with its earliest row.
        found = self._recording.found.of(stamp_ns.min(initial=newest_ns)[None], cube[None])
        return (found.left_out[0], found.bits[0]) if found.known[0] else anew


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
