# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Touches, contacts and surface traction, computed and written while a bag is reprocessed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from ...core.arrays import Times
from ...core.errors import BagError
from ...core.latest_stress import STALE_S, LatestStress
from ...core.rows import FrequencyRows, StressRows
from ...messages.codec import Decoded
from ...messages.contacts import make_contacts_message, make_traction_message
from ...messages.skin_info import (
    describe_geometry,
    read_cube_calibrations,
    read_cube_poses,
    read_skin_elastomer,
)
from ...messages.touch import make_touch_message
from ...messages.types import CONTACTS, TOUCH, TRACTION
from ...touch.contact_finder import ContactFinder, ContactSettings, make_contact_finder
from ...touch.touch_detection import NO_TOUCHES, Touch, Touches
from ..metadata import quality
from ..read import make_message, serialise
from ..recording import make_recorded_skin
from ..write import BagWriter

if TYPE_CHECKING:
    from ...msg import SkinInfo


@dataclass(frozen=True)
class ContactOptions:
    """Options with which contacts are computed from the stress of a bag.

    Attributes:
        settings: Method of contact estimation and its parameters.
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
    ) -> None:
        """Add the topics of touches, contacts and traction to a bag.

        Args:
            writer: The bag that is being written.
            topics: Common prefix of the names of the skin's topics, which ends in "/".
            options: Method of contact estimation, and rate of the messages.
        """
        self._writer = writer
        self._settings = options.settings
        self._period_ns = 1e9 / options.rate
        self._contacts = f"{topics}contacts"
        self._traction = f"{topics}traction"
        self._touches = f"{topics}touch"
        writer.add_topic(self._touches, TOUCH, [quality()])
        writer.add_topic(self._contacts, CONTACTS, [quality()])
        writer.add_topic(
            self._traction,
            TRACTION,
            [quality(depth=2)],
        )
        self._info: SkinInfo | None = None
        self._geometry: list[object] | None = None
        self._finder: ContactFinder | None = None
        self._frame_id = ""
        self._last_ns: int | None = None

    def set_up(self, info: SkinInfo) -> None:
        """Use a SkinInfo message (poses and calibrations of the cubes) for the stress that follows.

        If the frame, the elastomer, and the names, poses and sizes of the cubes are the same as in
        the previous SkinInfo, the tracked contacts continue. Otherwise contact estimation starts
        without contacts, as in the ROS node `contacts`.

        Raises:
            CubeError: Contacts cannot be computed on a skin with these cubes.
        """
        if self._geometry == describe_geometry(info):
            # The new message states other rest frequencies, found by a tare or by tracking of
            # drift. The stress changes with them, which must not count as a touch.
            if info is not self._info:
                self._touch.restart()
            self._info = info
            return
        calibrations = read_cube_calibrations(info)
        self._touch: Touch = Touch(make_recorded_skin(info, calibrations))
        self._info = info
        self._finder = make_contact_finder(
            self._settings,
            read_cube_poses(info),
            calibrations,
            read_skin_elastomer(info),
        )
        self._latest = LatestStress(len(info.cubes))
        self._geometry = describe_geometry(info)
        self._frame_id = info.header.frame_id

    def write(
        self,
        stress: StressRows,
        messages: Decoded[FrequencyRows],
        recorded_ns: Times,
    ) -> None:
        """Compute touches and contacts from the stress of M messages and write them into the bag.

        Touches and contacts get the recording time of the message of frequencies from which they
        were computed.

        Args:
            stress: Rows of stress of all M messages, message after message.
            messages: The M messages of frequencies, all with the same number of rows.
            recorded_ns: (M,) time at which each message was recorded, in ns since the Unix epoch.
        """
        rows_per_message = len(stress) // len(messages)
        for number, stamp_ns in enumerate(messages.stamp_ns.tolist()):
            begin = number * rows_per_message
            rows = stress.select(slice(begin, begin + rows_per_message))
            self._latest.update(rows, stamp_ns * 1e-9)
            time_ns = int(recorded_ns[number])
            touches = self._touch(rows)
            for found in touches:
                message = make_touch_message(
                    make_message,
                    self._frame_id,
                    found,
                )
                self._writer.write(
                    self._touches,
                    time_ns,
                    serialise(TOUCH, message),
                )
            newest = touches[-1] if touches else NO_TOUCHES
            self._write(stamp_ns, time_ns, newest)

    def _is_due(self, stamp_ns: int) -> bool:
        """Return whether contacts are due, one period after the last ones or after a jump back.

        Args:
            stamp_ns: Stamp of the message of frequencies, in ns since the Unix epoch. If the result
                is true, the next period starts at this stamp.
        """
        if self._last_ns is not None:
            elapsed_ns = stamp_ns - self._last_ns
            if 0 <= elapsed_ns < self._period_ns:
                return False
        self._last_ns = stamp_ns
        return True

    def _write(self, stamp_ns: int, recorded_ns: int, touches: Touches) -> None:
        """Write the contacts and traction of the newest stress of each cube, if they are due.

        Between two due times, only the contacts are written, and only when one begins to slip.

        Args:
            stamp_ns: Stamp of the messages that are written, in ns since the Unix epoch.
            recorded_ns: Time of recording of these messages, in ns since the Unix epoch.
            touches: Touches in the newest scan.
        """
        if self._finder is None:
            raise BagError(f"{self._contacts}: no info says where the cubes are; record info")
        finder = self._finder
        time_s = stamp_ns * 1e-9
        health = self._latest.health(time_s, STALE_S)
        values = self._latest.usable_values(health)
        is_due = self._is_due(stamp_ns)
        if is_due:
            finder.update(
                time_s,
                values,
                self._latest.left_out,
                self._latest.status,
                touches,
            )
        elif not finder.follow(time_s, values):
            return
        message = make_contacts_message(
            make_message,
            stamp_ns,
            self._frame_id,
            finder.contacts,
            finder.slip,
            finder.touch_id,
        )
        self._writer.write(
            self._contacts,
            recorded_ns,
            serialise(CONTACTS, message),
        )
        cloud = finder.make_cloud(values) if is_due else None
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
                serialise(TRACTION, message),
            )
