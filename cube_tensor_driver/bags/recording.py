# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The calibrations, rest frequencies and health of the pads that a bag states for its frequencies.

Calibrations and rest frequencies are in the SkinInfo messages, each of which applies from its stamp
on. The health (which pads were left out as faulty) is in the recorded stress.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..config.skin import Skin, SkinCube, SkinLink
from ..core.arrays import Array, Index, Times, stack_pad_table
from ..core.calibration import Calibration
from ..core.errors import BagError, CubeError, MessageError
from ..core.reconstructor import Reconstructor, RecordedHealth
from ..core.rows import FrequencyRows, StressRows
from ..core.tensor import rpy_from_quaternion
from ..messages.skin_info import read_cube_calibrations, read_cube_poses, read_skin_elastomer
from ..messages.types import INFO_TYPE
from .read import Bag, read_stamp_ns
from .recorded_compensation import CompensationReader
from .recorded_health import RecordedHealthReader

if TYPE_CHECKING:
    from ..msg import SkinInfo


@dataclass(frozen=True, eq=False)
class Settings:
    """Calibrations and rest frequencies with which stress is reconstructed.

    Attributes:
        calibrations: Calibration of each cube, by the cube's index.
        rest_frequency: (cubes, P) frequencies of the P pads without load, in Hz, as the last tare
            (measurement without load) found them; NaN where a cube has fewer than P pads.
    """

    calibrations: tuple[Calibration, ...]
    rest_frequency: Array


class Recording:
    """The settings and the health of the pads that a bag states for the frequencies on one topic.

    Attributes:
        infos: SkinInfo messages (cubes, calibrations and rest frequencies) in the order of their
            stamps; there is at least one.
        settings: Calibrations and rest frequencies in each of the SkinInfo messages.
        health: Reader of the health of the pads (which were left out as faulty, and why).
        compensation: Reader of the recorded compensation of weight, creep and temperature.
    """

    def __init__(self, bag: Bag, topic: str) -> None:
        """Read the SkinInfo messages of an open bag.

        Args:
            bag: Open bag.
            topic: Topic of the frequencies.

        Raises:
            BagError: The bag has no SkinInfo message for the topic, or one that is invalid.
        """
        self._bag = bag
        self.infos: list[SkinInfo] = []
        self.settings: list[Settings] = []
        for info in sorted(find_skin_infos(bag, topic), key=read_stamp_ns):
            try:
                settings = read_settings(info)
                read_cube_poses(info)
            except CubeError as error:
                reason = error
                bag.skip(
                    topic.replace("frequencies", "info"),
                    read_stamp_ns(info),
                    error,
                )
            else:
                self.infos.append(info)
                self.settings.append(settings)
        if not self.infos:
            raise BagError(f"{bag.path}: {reason}") from None
        since_ns = [read_stamp_ns(info) for info in self.infos]
        self._since_ns = np.array(since_ns)
        self.health = RecordedHealthReader(bag, topic)
        poses = read_cube_poses(self.infos[-1])
        self.compensation = CompensationReader(bag, topic, poses)

    def __repr__(self) -> str:
        name, count = self.infos[-1].name, len(self.infos)
        return f"Recording({name!r} of {self._bag.path}: {count} infos)"

    @property
    def skin(self) -> Skin:
        """The skin (cubes, their poses and calibrations) in the last SkinInfo message."""
        return make_recorded_skin(self.infos[-1], self.settings[-1].calibrations)

    def find_info_index(self, newest_ns: Times) -> Index:
        """Return the index in `infos` of the SkinInfo that applies to each message of frequencies.

        A SkinInfo message contains the cubes' poses, calibrations and rest frequencies. It applies
        to rows with its stamp or later stamps: the reconstruction node gives it a stamp just after
        the last row that was reconstructed with the previous SkinInfo.

        Args:
            newest_ns: Stamps (M,) of the newest row of each message, in ns since the Unix epoch.

        Returns:
            (M,) indices.
        """
        n_earlier = np.searchsorted(self._since_ns, newest_ns, side="right")
        # For messages of frequencies before the first SkinInfo, the first one is used, too.
        index: Index = np.maximum(n_earlier - 1, 0)
        return index

    def find_settings(self, rows: FrequencyRows) -> Settings:
        """Return the calibrations and rest frequencies that applied to the rows of one message.

        A rest frequency is the frequency of a pad without load; a row is one sample of one cube.
        """
        newest_ns = rows.stamp_ns.max(initial=0, keepdims=True)
        number = int(self.find_info_index(newest_ns)[0])
        return self.settings[number]

    def check_calibrations_stay(self) -> None:
        """Check that every cube has the same calibration throughout the recording.

        Raises:
            BagError: The calibration of a cube changes from one SkinInfo message to another.
        """
        ids = {
            tuple(calibration.id for calibration in settings.calibrations)
            for settings in self.settings
        }
        if len(ids) > 1:
            raise BagError(
                f"{self._bag.path}: the calibrations change within the recording: "
                "reprocess it instead"
            )


def find_skin_infos(bag: Bag, topic: str) -> list[SkinInfo]:
    """Return the SkinInfo messages of the skin whose frequencies are on a topic.

    The messages of the reconstruction node are preferred, because they contain the rest frequencies
    that the last tare (measurement without load) found. The driver's messages on `driver/info`
    contain the rest frequencies of the calibrations, and are used only if the bag has no message of
    the reconstruction node.

    Args:
        bag: Open bag.
        topic: Topic of the frequencies, whose prefix all topics of the skin share.

    Raises:
        BagError: The bag has no SkinInfo message of this skin.
    """
    skin = topic.removesuffix("frequencies")
    driver_topic = f"{skin}driver/info"
    try:
        infos = bag.read_infos(f"{skin}info")
    except BagError:
        if driver_topic not in bag.list_topics(INFO_TYPE):
            raise
        infos = bag.read_infos(driver_topic)
    reconstructed = [info for info in infos if info.sender == "reconstruction"]
    return reconstructed or infos


def reconstruct_rows(
    reconstructor: Reconstructor,
    rows: FrequencyRows,
    health: RecordedHealth | None,
) -> StressRows:
    """Compute the stress of recorded rows (samples of cubes).

    Args:
        reconstructor: Reconstructor of the skin.
        rows: Rows of frequencies.
        health: Health of the pads as recorded; None: it is determined from the frequencies alone.
    """
    # If the health of every row is recorded, it is not determined again, which makes the
    # reconstruction two fifths faster.
    if health is not None and health.known.all():
        return reconstructor.process_known(rows, health)
    return reconstructor.process(rows, health)


def read_settings(info: SkinInfo) -> Settings:
    """Return the calibrations and rest frequencies in a SkinInfo message.

    Raises:
        MessageError: The message has no cubes, an invalid calibration, a number of rest frequencies
            that is not the number of the cube's pads, or a rest frequency that is not above 0.
    """
    calibrations = read_cube_calibrations(info)
    # A skin without cubes cannot be reconstructed, and the steps below require at least one cube.
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
        frequency = np.asarray(cube.rest_frequency, float)
        if not (np.isfinite(frequency) & (frequency > 0)).all():
            raise MessageError(
                f"info of the skin {info.name}: cube {cube.name} has the rest frequencies "
                f"{frequency.tolist()}; they must be finite and above 0"
            )
        rest.append(frequency)
    widest = max(map(len, rest))
    return Settings(calibrations, stack_pad_table(rest, widest, np.nan))


def make_recorded_skin(
    info: SkinInfo,
    calibrations: tuple[Calibration, ...],
) -> Skin:
    """Return the skin that a SkinInfo message describes.

    Args:
        info: SkinInfo message.
        calibrations: Calibration of each of its cubes.

    Returns:
        The skin. Its links (connections to the hubs) have "recorded" as their port, because a bag
        does not state the ports.
    """
    # `dict.fromkeys` removes repeated names and keeps the order of the cubes.
    names = dict.fromkeys(cube.link for cube in info.cubes if cube.link)
    links = tuple(SkinLink(name, "recorded", 0, None) for name in names)
    cubes = []
    for cube, calibration in zip(info.cubes, calibrations, strict=True):
        position = cube.pose.position
        q = cube.pose.orientation
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
    # A frame id consists of a prefix, which the launch file sets, and the names of skin and cube.
    unprefixed = f"{info.name}_{cubes[0].name}"
    frame_prefix = info.cubes[0].frame_id.removesuffix(unprefixed)
    return Skin(
        name=info.name,
        parent_frame=info.header.frame_id,
        rate=None,
        links=links,
        cubes=tuple(cubes),
        frame_prefix=frame_prefix,
        elastomer=read_skin_elastomer(info),
    )
