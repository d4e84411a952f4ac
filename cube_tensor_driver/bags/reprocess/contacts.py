# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Touches, contacts and surface traction, computed and written while a bag is reprocessed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from ...config.skin import Elastomer
from ...core.arrays import Array
from ...core.latest_stress import STALE_S, LatestStress
from ...core.rate_limit import find_next_due_ns
from ...core.reconstructor import Reconstructor
from ...core.rows import StressRows
from ...core.stress_errors import StressErrors
from ...messages.contacts import encode_contacts, make_traction_message
from ...messages.skin_info import (
    describe_geometry,
    read_cube_poses,
    read_skin_elastomer,
)
from ...messages.touch import encode_touch
from ...messages.types import CONTACTS_TYPE, TOUCH_TYPE, TRACTION_TYPE
from ...touch.contact_finder import ContactSettings, make_contact_finder
from ...touch.touch_detection import NO_TOUCHES, Touch, Touches
from ..metadata import describe_quality
from ..read import make_message, serialise
from ..recording import make_recorded_skin
from ..write import BagWriter

if TYPE_CHECKING:
    from ...msg import SkinInfo


@dataclass(frozen=True)
class ContactOptions:
    """Options with which contacts are computed from the stress of a bag.

    Attributes:
        settings: Method of contact estimation, its smallest pressure and influence functions.
        rate: Maximum rate of the computed messages of contacts, in Hz.
    """

    settings: ContactSettings
    rate: float


class ContactWriter:
    """Computes touches and contacts of one skin from its stress and writes them into a bag.

    The topics `touch`, `contacts` and `traction` (force per area on the surface) have the same
    messages as those that the ROS nodes publish.
    """

    def __init__(
        self,
        writer: BagWriter,
        topics: str,
        options: ContactOptions,
        elastomer: Elastomer | None,
    ) -> None:
        """Add the topics of touches, contacts and traction to a bag.

        Args:
            writer: The bag that is being written.
            topics: Common prefix of the names of the skin's topics, which ends in "/".
            options: Method of contact estimation, and rate of the messages.
            elastomer: Elastomer of the skin; None: as recorded.
        """
        self._writer = writer
        self._settings = options.settings
        self._elastomer = elastomer
        self._period_ns = round(1e9 / options.rate)
        self._contacts = f"{topics}contacts"
        self._traction = f"{topics}traction"
        self._touches = f"{topics}touch"
        writer.add_topic(self._touches, TOUCH_TYPE, [describe_quality()])
        writer.add_topic(self._contacts, CONTACTS_TYPE, [describe_quality()])
        writer.add_topic(
            self._traction,
            TRACTION_TYPE,
            [describe_quality(depth=2)],
        )
        self._info: SkinInfo | None = None
        self._geometry: list[object] | None = None
        self._frame_id = ""
        self._due_ns = 0
        self._reconstructor: Reconstructor | None = None
        self._errors: Array | None = None

    def set_up(self, info: SkinInfo, reconstructor: Reconstructor) -> None:
        """Use a SkinInfo message (poses and calibrations of the cubes) for the stress that follows.

        If the frame, the elastomer, and the names, poses and sizes of the cubes are the same as in
        the previous SkinInfo, the tracked contacts continue. Otherwise contact estimation starts
        without contacts, as in the ROS node `contacts`.

        Args:
            info: The message.
            reconstructor: Computes this stress, and states its errors.

        Raises:
            CubeError: Contacts cannot be computed on a skin with these cubes.
        """
        geometry = describe_geometry(info)
        has_other_geometry = geometry != self._geometry
        if reconstructor is not self._reconstructor or has_other_geometry:
            self._reconstructor = reconstructor
            self._stress_errors = StressErrors(reconstructor)
            self._errors = None
            skin = make_recorded_skin(info, reconstructor.calibrations)
            self._touch = Touch(skin, find_errors=reconstructor.errors)
        elif info is not self._info:
            # The new message states other rest frequencies, found by a tare or by tracking of
            # drift. The stress changes with them, which must not count as a touch.
            self._touch.restart()
        self._info = info
        if has_other_geometry:
            self._geometry = geometry
            self._frame_id = info.header.frame_id
            self._latest = LatestStress(len(info.cubes))
            self._finder = make_contact_finder(
                self._settings,
                read_cube_poses(info),
                reconstructor.calibrations,
                self._elastomer or read_skin_elastomer(info),
            )

    def write(
        self,
        stress: StressRows,
        stamps_ns: list[int],
        recorded_ns: list[int],
    ) -> None:
        """Compute touches and contacts from the stress of M messages and write them into the bag.

        If the stress has errors other than noise (`Reconstructor.has_errors`), it must be that of
        one message, because the errors are those of its newest rows.

        Args:
            stress: Rows of stress of all M messages, which have the same number of rows.
            stamps_ns: (M,) stamps of the messages, in ns since the Unix epoch.
            recorded_ns: (M,) time at which each message of frequencies was recorded, in ns since
                the Unix epoch. Touches and contacts get the same time.
        """
        rows_per_message = len(stress) // len(stamps_ns)
        for number, stamp_ns in enumerate(stamps_ns):
            begin = number * rows_per_message
            rows = stress.select(slice(begin, begin + rows_per_message))
            self._latest.update(rows, stamp_ns * 1e-9)
            errors = self._stress_errors.update(rows, stamp_ns)
            if errors is not None:
                self._errors = errors.astype(float)
            touches = self._touch(rows)
            for found in touches:
                data = encode_touch(self._frame_id, found)
                self._writer.write(self._touches, recorded_ns[number], data)
            newest = touches[-1] if touches else NO_TOUCHES
            self._write_contacts(stamp_ns, recorded_ns[number], newest)

    def _write_contacts(
        self,
        stamp_ns: int,
        recorded_ns: int,
        touches: Touches,
    ) -> None:
        """Write contacts and traction, computed from each cube's newest stress, if they are due.

        Between two due times, only the contacts are written, and only when one begins to slip.

        Args:
            stamp_ns: Stamp of the messages that are written, in ns since the Unix epoch.
            recorded_ns: Time of recording of these messages, in ns since the Unix epoch.
            touches: Touches in the newest scan.
        """
        finder = self._finder
        time_s = stamp_ns * 1e-9
        health = self._latest.compute_health(time_s, STALE_S)
        values = self._latest.select_usable_values(health)
        next_ns = find_next_due_ns(stamp_ns, self._due_ns, self._period_ns)
        if next_ns is not None:
            self._due_ns = next_ns
            finder.update(
                time_s,
                values,
                self._latest.left_out,
                self._latest.status,
                touches,
                self._errors,
            )
        elif not finder.follow(time_s, values):
            return
        data = encode_contacts(
            stamp_ns,
            self._frame_id,
            finder.contacts,
            finder.slip,
            finder.touch_id,
        )
        self._writer.write(self._contacts, recorded_ns, data)
        cloud = None if next_ns is None else finder.make_cloud(values)
        if cloud is not None:
            message = make_traction_message(
                make_message,
                stamp_ns,
                self._frame_id,
                cloud,
            )
            self._writer.write(
                self._traction,
                recorded_ns,
                serialise(TRACTION_TYPE, message),
            )
