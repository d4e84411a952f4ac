# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Diagnostics of the reconstruction: rows, lost messages, tares, and the health of the cubes."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.impl.rcutils_logger import RcutilsLogger

from ...config.skin import Skin
from ...core.arrays import AnyArray, Mask
from ...core.reconstructor import Reconstructor
from ...core.rows import FrequencyRows, StressRows
from ...core.status import INVALID, LEFT_OUT, WORDS
from ..compat import SubscriptionEventCallbacks
from .updater import make_status

if TYPE_CHECKING:
    from ..nodes.taring import Taring

MAX_CUBE_STATUSES = 64
"""Maximum number of cubes that have a status in one message of /diagnostics.

If all hubs of a skin with 1000 cubes are disconnected, a status for each cube would be useless.
"""

MISSING = "missing: no row yet, see its link"
"""Status text of a cube that has not sent any row since the node was configured."""

STALE = "stale: no rows any more, see its link"
"""Status text of a cube that has sent rows before, but none since the previous status."""

MIN_UPDATES_TO_LOG = 5
"""Number of updates of the diagnostics (one per second) during which cubes without any row are not
logged, because hubs may start later than the node."""

MAX_KNOWN_PUBLISHERS = 8
"""Maximum number of publishers of one topic whose last message numbers are remembered, so that
messages of different publishers are not taken for gaps."""

LogChanges = list[tuple[str, bool]]
"""Lines for the log, each with whether it reports a problem (True) or the end of one (False)."""


class ReconstructionDiagnostics:
    """Makes the diagnostic statuses of the reconstruction. It is used once a second.

    Attributes:
        refused_messages: Number of messages of `frequencies` that were refused, because they were
            damaged or inconsistent.
        compensation_problem: Why a compensation does not work now; empty: there is no problem.
    """

    def __init__(
        self, skin: Skin, reconstructor: Reconstructor, tare: Taring, lost: LostMessages
    ) -> None:
        self.refused_messages = 0
        self.compensation_problem = ""
        self._skin, self._tare, self._lost = skin, tare, lost
        self._cubes = CubeHealth(skin, reconstructor)
        self._rows = self._invalid_rows = 0
        self._rows_before = self._lost_before = 0  # at the last update
        self._was_inactive = False

    def count(self, rows: StressRows) -> None:
        """Count the rows (one cube at one sampling time) of one published message of `stress`, and
        the invalid ones among them."""
        self._rows += len(rows)
        self._invalid_rows += int(np.count_nonzero(rows.status & INVALID))

    def statuses(self, is_active: bool) -> tuple[list[DiagnosticStatus], LogChanges]:
        """Return the statuses for /diagnostics, and lines for the log about changes.

        The first status is about all rows. The others are about cubes that have a fault now or had
        one at the previous call. While the node is inactive there are no statuses of cubes, because
        an inactive node processes no rows and all cubes would seem to be silent.

        Args:
            is_active: Whether the node is active now.
        """
        cubes: list[DiagnosticStatus] = []
        changes: LogChanges = []
        if is_active and not self._was_inactive:
            cubes, changes = self._cubes.statuses(self._tare.uids)
        else:  # The node was inactive for at least a part of the time since the previous call.
            self._cubes.discard()
        self._was_inactive = not is_active

        lost = self._lost.count - self._lost_before
        values = {
            "rows": self._rows,
            "rows per second": self._rows - self._rows_before,
            "invalid rows": self._invalid_rows,
            "messages lost on the way": self._lost.count,
            "messages that contradict themselves": self.refused_messages,
            **self._tare.age(),
            **self._cubes.summary(),
        }
        self._rows_before, self._lost_before = self._rows, self._lost.count

        texts = [] if is_active else ["inactive: the node processes no rows until it is activated"]
        if lost > 0:
            texts.append(
                f"{lost} messages lost on the way: by the network, or this node was too late for "
                "its queue"
            )
        if self.compensation_problem:
            texts.append(self.compensation_problem)
        has_problem = bool(self.refused_messages or self.compensation_problem) or lost > 0
        level = DiagnosticStatus.WARN if has_problem else DiagnosticStatus.OK
        rows = make_status(
            "rows",
            self._skin.name,
            level,
            "; ".join(texts),
            values,
        )
        return [rows, *cubes], changes


class CubeHealth:
    """Makes statuses of cubes for /diagnostics from what `Health` has found in the last second.

    `Health` finds faulty conditions of pads (such as open or noisy) and high residuals of cubes.
    """

    def __init__(self, skin: Skin, reconstructor: Reconstructor) -> None:
        self._skin, self._pipeline = skin, reconstructor.pipeline
        self._health = reconstructor.health
        self._has_come = np.zeros(len(skin.cubes), bool)
        # Index of a cube with a fault -> text of its status, in the previous statuses and in the
        # log. The log may lag behind, because cubes are not logged just after the start.
        self._reported: dict[int, str] = {}
        self._logged: dict[int, str] = {}
        self._updates = 0

    def statuses(self, uids: Mapping[int, int]) -> tuple[list[DiagnosticStatus], LogChanges]:
        """Return the statuses of cubes with a fault now or at the previous call, and log lines.

        Args:
            uids: Index of a cube in the skin -> its uid, for cubes whose uid the skin file lacks.
        """
        bits, strained, rows = self._health.collect()
        self._updates += 1
        self._has_come |= rows > 0

        levels = np.zeros(len(rows), int)
        levels[strained | (bits != 0).any(axis=1)] = 1  # DiagnosticStatus.WARN
        levels[(bits & LEFT_OUT != 0).any(axis=1)] = 2  # ERROR
        levels[rows == 0] = 3  # STALE
        not_fine = np.flatnonzero(levels)[:MAX_CUBE_STATUSES]
        words = self._describe_cubes(not_fine, bits, strained, rows)

        statuses: list[DiagnosticStatus] = []
        changes: LogChanges = []
        for number in sorted({*words, *self._reported}):
            cube = self._skin.cubes[number]
            text = words.get(number, "ok")
            level = int(levels[number]) if number in words else 0
            is_starting = self._updates <= MIN_UPDATES_TO_LOG and text == MISSING
            if text != self._logged.get(number, "ok") and not is_starting:
                self._logged[number] = text
                changes.append((f"cube {cube.name}: {text}", level > 0))
            uid = cube.uid or uids.get(number, 0)
            hardware_id = f"{uid:#x}" if uid else ""
            values = {"rows since the last": int(rows[number])}
            statuses.append(
                make_status(
                    f"cube {cube.name}",
                    hardware_id,
                    bytes([level]),
                    text,
                    values,
                )
            )
        self._reported = words
        return statuses, changes

    def discard(self) -> None:
        """Discard the conditions that `Health` has found since the previous call."""
        self._health.collect()

    def summary(self) -> dict[str, int]:
        """Return the number of pads in each faulty condition (open, short, noisy and so on) now.

        The number of cubes with a high residual is added. Numbers that are 0 are left out. The keys
        are those of the status on /diagnostics.
        """
        counts = {
            f"pads {word}": int(np.count_nonzero(self._health.state & bit))
            for bit, word in WORDS.items()
        }
        counts["cubes with a residual"] = int(np.count_nonzero(self._health.high_residual))
        return {name: count for name, count in counts.items() if count}

    def _describe_cubes(
        self, cubes: AnyArray, bits: AnyArray, strained: Mask, rows: AnyArray
    ) -> dict[int, str]:
        """Return the text of the status of each of these cubes.

        Args:
            cubes: Indices of the cubes.
            bits: Condition bits of each pad of all cubes, (all cubes, pads).
            strained: Whether the residual of a cube was high, (all cubes,).
            rows: Number of rows of each cube since the previous call, (all cubes,).
        """
        suspects = self._find_suspects(strained)
        words = {}
        for cube in cubes.tolist():
            if not rows[cube]:
                words[cube] = STALE if self._has_come[cube] else MISSING
                continue
            pads = self._skin.cubes[cube].calibration.layout.pads
            texts = [
                f"pad {pads[pad]} {_condition_words(int(bits[cube, pad]))}"
                for pad in np.flatnonzero(bits[cube]).tolist()
            ]
            if strained[cube]:
                texts.append(f"residual above its level: {_residual_cause(suspects.get(cube))}")
            words[cube] = "; ".join(texts)
        return words

    def _find_suspects(self, strained: Mask) -> dict[int, list[str]]:
        """Return the names of pads that may cause the high residuals of cubes.

        Args:
            strained: Whether the residual of a cube was high, (all cubes,).

        Returns:
            Index of a cube with a high residual -> its pads any one of which, if it alone were
            faulty, would explain the residual.
        """
        cubes = np.flatnonzero(strained)
        if not len(cubes):
            return {}
        health = self._health
        newest = FrequencyRows.of(
            cubes,
            health.last[cubes],
            temperature=health.temperature[cubes],
        )
        is_suspect = self._pipeline.suspects(newest, health.mask[cubes])
        names = {}
        for cube, suspects in zip(cubes.tolist(), is_suspect, strict=True):
            pads = self._skin.cubes[cube].calibration.layout.pads
            names[cube] = [pads[pad] for pad in np.flatnonzero(suspects)]
        return names


class LostMessages:
    """Counts the messages of a topic that were published but have not arrived.

    DDS numbers the messages of each publisher consecutively, so that a gap in the numbers shows a
    lost message. Either the network has lost it, or it was dropped because this process did not
    read its queue in time; DDS does not report the latter. If rclpy does not provide the numbers,
    or several publishers send alternately, only the losses that DDS reports are counted. The count
    continues when the node makes a new subscription.
    """

    def __init__(self) -> None:
        # Number of lost messages: in earlier subscriptions; by gaps in this one; as DDS reports
        # for this one.
        self._earlier = self._left_out = self._reported = 0
        self._newest: int | None = None
        # Number of messages missing just before the newest one. It is counted only when the next
        # message continues the numbers, as otherwise the newest came from another publisher.
        self._gap = 0
        self._other_publishers: deque[int] = deque(maxlen=MAX_KNOWN_PUBLISHERS)
        self._has_several_publishers = False

    @property
    def count(self) -> int:
        """Number of messages lost so far, in all subscriptions since the node was made."""
        return self._earlier + max(self._left_out, self._reported)

    def new_subscription(self) -> SubscriptionEventCallbacks:
        """Begin to count for a new subscription.

        Returns:
            The argument `event_callbacks` of `create_subscription`.
        """
        self._earlier, self._left_out, self._reported = self.count, 0, 0
        self._newest, self._gap, self._has_several_publishers = None, 0, False
        self._other_publishers.clear()
        return SubscriptionEventCallbacks(message_lost=self._on_message_lost)

    def note_arrival(self, number: int | None) -> None:
        """Record the arrival of a message.

        Args:
            number: Number that DDS gave the message; None: rclpy does not provide it.
        """
        newest, self._newest = self._newest, number
        if number is None or newest is None:
            return
        is_next = number == newest + 1
        continues_other = not is_next and number - 1 in self._other_publishers
        if continues_other or number <= newest:
            # The message came from another publisher: one of several that send alternately, or a
            # new one, whose numbers begin at 1.
            self._has_several_publishers |= continues_other
            self._other_publishers.append(newest)
            self._gap = 0
        elif not self._has_several_publishers:
            self._left_out += self._gap
            self._gap = number - newest - 1

    def _on_message_lost(self, event: Any) -> None:
        self._reported = event.total_count


def log_changes(logger: RcutilsLogger, changes: LogChanges) -> None:
    """Write lines to the log: problems as warnings, and the end of problems as information."""
    for line, is_bad in changes:
        # rclpy requires that a line of code always logs with the same level, so there are two.
        if is_bad:
            logger.warning(line)
        else:
            logger.info(line)


def _condition_words(bits: int) -> str:
    """Return the faulty conditions of a pad as text, such as "open and noisy".

    Args:
        bits: Bits of the conditions, see `core/status.py`.
    """
    return " and ".join(word for bit, word in WORDS.items() if bits & bit)


def _residual_cause(suspects: list[str] | None) -> str:
    """Return a text with the possible cause of a high residual of a cube.

    Args:
        suspects: Names of the pads any one of which may be faulty; None or empty: none is known.
    """
    if suspects:
        return f"pad {' or '.join(suspects)} may be bad"
    return "a pad is bad, or the load is outside the modes of this layout"
