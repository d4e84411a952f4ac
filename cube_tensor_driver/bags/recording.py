"""What a bag says beside its frequencies: which settings were in force when, and the verdicts about
pads."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..config.skin import Skin, SkinCube, SkinLink
from ..core.calibration import Calibration
from ..core.errors import BagError, MessageError
from ..core.reconstructor import RecordedHealth
from ..core.rows import FrequencyRows
from ..core.tensor import rpy_from_quaternion
from ..messages.codec import SECOND
from ..messages.skin_info import cube_calibrations
from .read import Bag
from .recorded_verdicts import VerdictReader


@dataclass(frozen=True, eq=False)
class Settings:
    """What stress was made with.

    calibrations: of the cubes in order
    rest_frequency: (cubes, P) Hz as they were after tare; NaN where a cube has no such pad
    """

    calibrations: tuple[Calibration, ...]
    rest_frequency: NDArray[np.float64]


class Recording:
    """The infos and verdicts that belong to the frequencies on `topic` of an open bag.

    infos: SkinInfo messages in the order of their stamps
    settings: one for each info
    BagError: there is no info, or it cannot be used.
    """

    def __init__(self, bag: Bag, topic: str) -> None:
        self._bag = bag
        self.infos = sorted(skin_infos(bag, topic), key=stamp_ns)
        try:
            self.settings = [settings_of(info) for info in self.infos]
        except MessageError as error:
            raise BagError(f"{bag.path}: {error}") from None
        self._since_ns = np.array([stamp_ns(info) for info in self.infos])
        self._verdicts = VerdictReader(bag, topic)

    @property
    def skin(self) -> Skin:
        """The skin as the last info has it."""
        return recorded_skin(self.infos[-1], self.settings[-1].calibrations)

    def number_at(self, newest_ns: Any) -> Any:
        """Which info holds for a message whose newest row has this stamp; of an array (M,) too.

        An info holds for what was sampled from its stamp on: the node stamps it just behind the
        last row that was made without it.
        """
        return np.maximum(np.searchsorted(self._since_ns, newest_ns, side="right") - 1, 0)

    def settings_at(self, rows: FrequencyRows) -> Settings:
        """The settings under which the rows of one message were reconstructed."""
        return self.settings[int(self.number_at(rows.stamp_ns.max(initial=0)))]

    def verdicts(self, rows: FrequencyRows) -> RecordedHealth:
        """What was found bad of rows when they were recorded. Fastest in the order of recording."""
        return self._verdicts.of(rows)

    def check_calibrations_stay(self) -> None:
        """BagError: cubes change their calibration within the recording."""
        ids = [[one.id for one in settings.calibrations] for settings in self.settings]
        if any(other != ids[0] for other in ids):
            raise BagError(
                f"{self._bag.path}: the calibrations change within the recording: "
                "reprocess it instead"
            )


def skin_infos(bag: Bag, topic: str) -> list[Any]:
    """The infos of the skin whose frequencies are on `topic`. BagError: there is none.

    They are the reconstruction's. The driver knows of no tare: what it says counts only where no
    reconstruction ran. It says it on `driver/info`; bags of older versions have it on `info`, too.
    """
    skin = topic.removesuffix("frequencies")
    own, of_driver = f"{skin}info", f"{skin}driver/info"
    recorded = {connection.topic for connection in bag.connections if connection.msgcount}
    infos = bag.infos(of_driver if of_driver in recorded and own not in recorded else own)
    return [info for info in infos if info.sender == "reconstruction"] or infos


def stamp_ns(info: Any) -> int:
    """When an info became true."""
    return int(info.header.stamp.sec) * SECOND + int(info.header.stamp.nanosec)


def settings_of(info: Any) -> Settings:
    """The settings that a SkinInfo describes. MessageError: they contradict each other."""
    calibrations = cube_calibrations(info)
    if not calibrations:
        raise MessageError(f"info of the skin {info.name}: it has no cubes")
    widest = max(calibration.layout.n_pads for calibration in calibrations)
    rest = np.full((len(calibrations), widest), np.nan)
    for row, cube, calibration in zip(rest, info.cubes, calibrations, strict=True):
        layout = calibration.layout
        if len(cube.rest_frequency) != layout.n_pads:
            raise MessageError(
                f"info of the skin {info.name}: cube {cube.name} has {len(cube.rest_frequency)} "
                f"rest frequencies, its layout {layout.name} has {layout.n_pads} pads"
            )
        row[: layout.n_pads] = cube.rest_frequency
    return Settings(calibrations, rest)


def recorded_skin(info: Any, calibrations: tuple[Calibration, ...]) -> Skin:
    """The skin of a SkinInfo. A bag does not say where the ports of its links were."""
    names = dict.fromkeys(cube.link for cube in info.cubes if cube.link)
    links = tuple(SkinLink(name, "recorded", 0, None) for name in names)
    cubes = []
    for cube, calibration in zip(info.cubes, calibrations, strict=True):
        position, q = cube.pose.position, cube.pose.orientation
        roll, pitch, yaw = rpy_from_quaternion(np.array([q.x, q.y, q.z, q.w])).tolist()
        cubes.append(
            SkinCube(
                cube.name,
                cube.link or None,
                int(cube.index),
                int(cube.uid) or None,
                (float(position.x), float(position.y), float(position.z)),
                (roll, pitch, yaw),
                calibration,
            )
        )
    return Skin(info.name, info.header.frame_id, None, links, tuple(cubes))
