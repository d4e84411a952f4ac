"""What a bag states beside its frequencies: the settings, each from its time on, and the health of
the pads."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..config.skin import Skin, SkinCube, SkinLink
from ..core.arrays import Array, pad_table
from ..core.calibration import Calibration
from ..core.errors import BagError, MessageError
from ..core.reconstructor import RecordedHealth
from ..core.rows import FrequencyRows
from ..core.tensor import rpy_from_quaternion
from ..messages.codec import SECOND
from ..messages.skin_info import cube_calibrations
from .read import Bag
from .recorded_health import RecordedHealthReader


@dataclass(frozen=True, eq=False)
class Settings:
    """What stress was reconstructed with.

    Attributes:
        calibrations: Calibration of each cube, in order.
        rest_frequency: (cubes, P) frequencies without load after the last tare, in Hz; NaN where a
            cube has no such pad.
    """

    calibrations: tuple[Calibration, ...]
    rest_frequency: Array


class Recording:
    """The settings and the recorded health that belong to the frequencies on one topic.

    Attributes:
        infos: SkinInfo messages in the order of their stamps.
        settings: Settings of each info.
    """

    def __init__(self, bag: Bag, topic: str) -> None:
        """Read the infos of an open bag.

        Args:
            bag: Open bag.
            topic: Topic of the frequencies.

        Raises:
            BagError: There is no info, or it cannot be used.
        """
        self._bag = bag
        self.infos = sorted(skin_infos(bag, topic), key=stamp_ns)
        try:
            self.settings = [settings_of(info) for info in self.infos]
        except MessageError as error:
            raise BagError(f"{bag.path}: {error}") from None
        stamps = [stamp_ns(info) for info in self.infos]
        self._since_ns = np.array(stamps)
        # It reads the bag only when it is asked.
        self._health = RecordedHealthReader(bag, topic)

    def __repr__(self) -> str:
        return f"Recording({self.infos[-1].name!r} of {self._bag.path}: {len(self.infos)} infos)"

    @property
    def skin(self) -> Skin:
        """The skin as the last info describes it."""
        return recorded_skin(self.infos[-1], self.settings[-1].calibrations)

    def number_at(self, newest_ns: Any) -> Any:
        """Return which info holds for a message, by its place in `infos`.

        An info holds for what was sampled from its stamp on: the node stamps it just behind the
        last row that was reconstructed without it.

        Args:
            newest_ns: Stamp of the newest row of the message, in ns; or an array (M,) of stamps.
        """
        number = np.searchsorted(self._since_ns, newest_ns, side="right") - 1
        # Nothing earlier is known about messages that were recorded before the first info.
        return np.maximum(number, 0)

    def settings_at(self, rows: FrequencyRows) -> Settings:
        """Return the settings under which the rows of one message were reconstructed."""
        newest_ns = rows.stamp_ns.max(initial=0)
        number = int(self.number_at(newest_ns))
        return self.settings[number]

    def health_at(self, rows: FrequencyRows) -> RecordedHealth:
        """Return the health of the pads that was found when rows were recorded.

        It is fastest when rows are asked for in the order of recording.
        """
        return self._health.health_at(rows)

    def check_calibrations_stay(self) -> None:
        """Check that no cube changes its calibration.

        Raises:
            BagError: One does.
        """
        first = self.settings[0].calibrations
        expected = [one.id for one in first]
        if any([one.id for one in other.calibrations] != expected for other in self.settings):
            raise BagError(
                f"{self._bag.path}: the calibrations change within the recording: "
                "reprocess it instead"
            )


def skin_infos(bag: Bag, topic: str) -> list[Any]:
    """Return the infos of the skin whose frequencies are on a topic.

    They are the reconstruction's. The driver does not know of a tare: its info on `driver/info`
    counts only where no reconstruction ran.

    Raises:
        BagError: There is none.
    """
    skin = topic.removesuffix("frequencies")
    own, of_driver = f"{skin}info", f"{skin}driver/info"
    recorded = {one.topic for one in bag.connections if one.msgcount}
    is_only_driver = of_driver in recorded and own not in recorded
    infos = bag.infos(of_driver if is_only_driver else own)
    reconstructed = [info for info in infos if info.sender == "reconstruction"]
    return reconstructed or infos


def stamp_ns(message: Any) -> int:
    """Return the stamp of a message's header, in ns since the epoch."""
    stamp = message.header.stamp
    return int(stamp.sec) * SECOND + int(stamp.nanosec)


def settings_of(info: Any) -> Settings:
    """Return the settings that a SkinInfo describes.

    Raises:
        MessageError: They contradict each other.
    """
    calibrations = cube_calibrations(info)
    # Without cubes nothing can be reconstructed, and the table below would have no columns.
    if not calibrations:
        raise MessageError(f"info of the skin {info.name}: it has no cubes")
    rest = []
    for cube, calibration in zip(info.cubes, calibrations, strict=True):
        layout = calibration.layout
        if len(cube.rest_frequency) != layout.n_pads:
            raise MessageError(
                f"info of the skin {info.name}: cube {cube.name} has {len(cube.rest_frequency)} "
                f"rest frequencies, its layout {layout.name} has {layout.n_pads} pads"
            )
        rest.append(np.asarray(cube.rest_frequency, float))
    widest = max(map(len, rest))
    return Settings(calibrations, pad_table(rest, widest, np.nan))


def recorded_skin(info: Any, calibrations: tuple[Calibration, ...]) -> Skin:
    """Return the skin of a SkinInfo; a bag does not state where the ports of its links were."""
    # A dict keeps each name once, in the order of the cubes.
    names = dict.fromkeys(cube.link for cube in info.cubes if cube.link)
    links = tuple(SkinLink(name, "recorded", 0, None) for name in names)
    cubes = []
    for cube, calibration in zip(info.cubes, calibrations, strict=True):
        position, q = cube.pose.position, cube.pose.orientation
        quaternion = np.array([q.x, q.y, q.z, q.w])
        roll, pitch, yaw = rpy_from_quaternion(quaternion).tolist()
        cubes.append(
            SkinCube(
                name=cube.name,
                link=cube.link or None,
                index=int(cube.index),
                uid=int(cube.uid) or None,
                xyz=(float(position.x), float(position.y), float(position.z)),
                rpy=(roll, pitch, yaw),
                calibration=calibration,
            )
        )
    return Skin(info.name, info.header.frame_id, None, links, tuple(cubes))
