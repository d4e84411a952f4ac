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
from ..compat import SubscriptionEventCallbacks, has_message_numbers
from .updater import make_status

if TYPE_CHECKING:
    from ..nodes.taring import Taring

MAX_CUBE_STATUSES = 64
"""Maximum number of cubes that have a status in one message of /diagnostics.

If all hubs of a skin with 1000 cubes are disconnected, nobody would read 1000 equal statuses.
"""

MISSING = "missing: no row yet, see its link"
"""Status text of a cube of which no row (sample) has arrived since the node was configured."""

STALE = "stale: no rows any more, see its link"
"""Status text of a cube of which rows (samples) have arrived before, but none since the previous
status."""

MIN_UPDATES_TO_LOG = 5
"""Number of updates of the diagnostics (one per second) during which cubes without any row are not
logged, because hubs may start later than the node."""

MAX_KNOWN_PUBLISHERS = 8
"""Maximum number of publishers of one topic whose last sequence numbers are remembered. By these
numbers a message from another publisher is recognised, so that its number is not taken for a gap,
which would be counted as lost messages."""

LogChanges = list[tuple[str, bool]]
"""Lines for the log, each with a flag: True if it reports a problem, False if it reports the end of
a problem."""


class ReconstructionDiagnostics:
    """Makes the diagnostic statuses of the node `reconstruction`, once a second.

    Attributes:
        refused_messages: Number of messages of `frequencies` that were refused, because they were
            damaged or inconsistent.
        compensation_problem: Why the compensation of weight does not work now; empty: there is no
            problem.
    """

    def __init__(
        self,
        skin: Skin,
        reconstructor: Reconstructor,
        tare: Taring,
        lost: LostMessages,
    ) -> None:
        self.refused_messages = 0
        self.compensation_problem = ""
        self._skin = skin
        self._tare = tare
        self._lost = lost
        self._cubes = CubeHealth(skin, reconstructor)
        self._rows = self._invalid_rows = 0
        self._rows_before = self._lost_before = 0
        self._was_inactive = False

    def count(self, rows: StressRows) -> None:
        """Count the rows of one published message of `stress`, and the invalid ones among them.

        Args:
            rows: Rows of stress; a row is the stress of one cube at one sampling time.
        """
        self._rows += len(rows)
        self._invalid_rows += int(np.count_nonzero(rows.status & INVALID))

    def make_statuses(self, is_active: bool) -> tuple[list[DiagnosticStatus], LogChanges]:
        """Return the statuses for /diagnostics, and lines for the log about changes.

        The first status is about all rows (samples of cubes). The others are about cubes that have
        a fault now or had one at the previous call. While the node is inactive there are no
        statuses of cubes, because an inactive node processes no rows, so that all cubes would be
        reported as stale.

        Args:
            is_active: Whether the node is active now.
        """
        cubes: list[DiagnosticStatus] = []
        changes: LogChanges = []
        if is_active and not self._was_inactive:
            cubes, changes = self._cubes.make_statuses(self._tare.uids)
        else:
            # The node was inactive at times since the previous call. Rows that are missing in this
            # time are no fault of the cubes.
            self._cubes.discard()
        self._was_inactive = not is_active

        lost = self._lost.count - self._lost_before
        values = {
            "rows": self._rows,
            "rows per second": self._rows - self._rows_before,
            "invalid rows": self._invalid_rows,
            "messages lost on the way": self._lost.count,
            "messages that contradict themselves": self.refused_messages,
            **self._tare.describe_age(),
            **self._cubes.count_faults(),
        }
        self._rows_before = self._rows
        self._lost_before = self._lost.count

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
    """Makes the diagnostic statuses of cubes from the faults that `Health` has found.

    A fault is a faulty condition of a pad (such as open or noisy), or a high residual of a cube: a
    disagreement between the measurements of its pads.
    """

    def __init__(self, skin: Skin, reconstructor: Reconstructor) -> None:
        self._skin = skin
        self._pipeline = reconstructor.pipeline
        self._health = reconstructor.health
        self._has_come = np.zeros(len(skin.cubes), bool)
        # Index of a cube with a fault -> text of its previous diagnostic status.
        self._reported: dict[int, str] = {}
        # Index of a cube -> text about it that was logged last.
        self._logged: dict[int, str] = {}
        self._updates = 0

    def make_statuses(self, uids: Mapping[int, int]) -> tuple[list[DiagnosticStatus], LogChanges]:
        """Return the statuses of cubes with a fault now or at the previous call, and log lines.

        Args:
            uids: Index of a cube in the skin -> the uid that its hub reports. It is used for cubes
                whose uid is not in the skin file.
        """
        bits, has_residual, rows = self._health.collect()
        self._updates += 1
        self._has_come |= rows > 0

        has_condition = (bits != 0).any(axis=1)
        has_left_out_pad = (bits & LEFT_OUT != 0).any(axis=1)
        levels = np.full(len(rows), DiagnosticStatus.OK, object)
        levels[has_residual | has_condition] = DiagnosticStatus.WARN
        levels[has_left_out_pad] = DiagnosticStatus.ERROR
        levels[rows == 0] = DiagnosticStatus.STALE
        is_faulty = levels != DiagnosticStatus.OK
        faulty = np.flatnonzero(is_faulty)[:MAX_CUBE_STATUSES]
        words = self._describe_cubes(faulty, bits, has_residual, rows)

        statuses: list[DiagnosticStatus] = []
        changes: LogChanges = []
        for number in sorted({*words, *self._reported}):
            cube = self._skin.cubes[number]
            text = words.get(number, "ok")
            level = levels[number] if number in words else DiagnosticStatus.OK
            is_starting = self._updates <= MIN_UPDATES_TO_LOG and text == MISSING
            if text != self._logged.get(number, "ok") and not is_starting:
                self._logged[number] = text
                changes.append((f"cube {cube.name}: {text}", number in words))
            uid = cube.uid or uids.get(number, 0)
            hardware_id = f"{uid:#x}" if uid else ""
            values = {"rows since the last": int(rows[number])}
            statuses.append(
                make_status(
                    f"cube {cube.name}",
                    hardware_id,
                    level,
                    text,
                    values,
                )
            )
        self._reported = words
        return statuses, changes

    def discard(self) -> None:
        """Discard the faults that `Health` has found since the previous call of `make_statuses`."""
        self._health.collect()

    def count_faults(self) -> dict[str, int]:
        """Return the numbers of pads in each faulty condition, and of cubes with a high residual.

        Conditions are open, short, noisy and so on. The keys of the dict are the keys of the
        diagnostic status, such as "pads open". Numbers that are 0 are left out.
        """
        counts = {
            f"pads {word}": int(np.count_nonzero(self._health.state & bit))
            for bit, word in WORDS.items()
        }
        counts["cubes with a residual"] = int(np.count_nonzero(self._health.high_residual))
        return {name: count for name, count in counts.items() if count}

    def _describe_cubes(
        self,
        cubes: AnyArray,
        bits: AnyArray,
        has_residual: Mask,
        rows: AnyArray,
    ) -> dict[int, str]:
        """Return the index of each of these cubes -> the text of its diagnostic status.

        Args:
            cubes: Indices of the cubes.
            bits: Condition bits of each pad of all cubes, (all cubes, pads).
            has_residual: Whether the residual of a cube was high, (all cubes,).
            rows: Number of rows (samples) of each cube since the previous call, (all cubes,).
        """
        suspects = self._find_suspects(has_residual)
        words = {}
        for cube in cubes.tolist():
            if not rows[cube]:
                words[cube] = STALE if self._has_come[cube] else MISSING
                continue
            pads = self._skin.cubes[cube].calibration.layout.pads
            texts = [
                f"pad {pads[pad]} {_describe_conditions(int(bits[cube, pad]))}"
                for pad in np.flatnonzero(bits[cube]).tolist()
            ]
            if has_residual[cube]:
                texts.append(
                    f"residual above its level: {_find_residual_cause(suspects.get(cube))}"
                )
            words[cube] = "; ".join(texts)
        return words

    def _find_suspects(self, has_residual: Mask) -> dict[int, list[str]]:
        """Return the names of pads that may cause the high residuals of cubes.

        Args:
            has_residual: Whether the residual of a cube was high, (all cubes,).

        Returns:
            Index of a cube with a high residual -> names of its suspected pads. A fault of a single
            one of them would explain the residual.
        """
        cubes = np.flatnonzero(has_residual)
        if not len(cubes):
            return {}
        health = self._health
        newest = FrequencyRows.from_values(
            cubes,
            health.sums.view_pads("last")[cubes],
            temperature=health.temperature[cubes],
        )
        left_out = health.sums.cubes["mask"][cubes]
        is_suspect = self._pipeline.find_suspects(newest, left_out)
        names = {}
        for cube, suspects in zip(cubes.tolist(), is_suspect, strict=True):
            pads = self._skin.cubes[cube].calibration.layout.pads
            names[cube] = [pads[pad] for pad in np.flatnonzero(suspects)]
        return names


class LostMessages:
    """Counts the messages of a topic that were published but have not arrived.

    DDS numbers the messages of each publisher consecutively, so that a gap in the numbers shows a
    lost message. Either the network has lost it, or it was dropped because this process did not
    read its queue in time; DDS does not report messages that were dropped in this way. If rclpy
    does not provide the numbers, only the losses that DDS reports are counted, and if several
    publishers send alternately, none. The count continues when the node makes a new subscription.
    """

    def __init__(self) -> None:
        # Number of messages that earlier subscriptions of the node have lost.
        self._lost_earlier = 0
        # Number of messages that are missing in the sequence numbers of the present subscription.
        self._lost_by_number = 0
        # Number of messages that the present subscription has lost according to DDS.
        self._lost_by_dds = 0
        self._newest: int | None = None
        # Number of messages that are missing just before the newest one. They are counted as lost
        # only when the next message has a higher number. Otherwise the newest message may come from
        # another publisher, whose numbers differ.
        self._gap = 0
        self._other_publishers: deque[int] = deque(maxlen=MAX_KNOWN_PUBLISHERS)
        self._has_several_publishers = False

    @property
    def count(self) -> int:
        """Number of messages lost so far, in all subscriptions since the node was made."""
        return self._lost_earlier + max(self._lost_by_number, self._lost_by_dds)

    def begin_subscription(self) -> SubscriptionEventCallbacks:
        """Begin to count the lost messages of a new subscription, in addition to those so far.

        Returns:
            The argument `event_callbacks` of `create_subscription`.
        """
        self._lost_earlier = self.count
        self._lost_by_number = self._lost_by_dds = self._gap = 0
        self._newest = None
        self._has_several_publishers = False
        self._other_publishers.clear()
        # The event can block a node for ever: https://github.com/ros2/rmw_fastrtps/pull/890.
        on_message_lost = None if has_message_numbers() else self._on_message_lost
        return SubscriptionEventCallbacks(message_lost=on_message_lost)

    def note_arrival(self, number: int | None) -> None:
        """Record the arrival of a message.

        Args:
            number: Sequence number that DDS gave the message; None: rclpy does not provide it.
        """
        newest = self._newest
        self._newest = number
        if number is None or newest is None:
            return
        is_next = number == newest + 1
        continues_other = not is_next and number - 1 in self._other_publishers
        if continues_other or number <= newest:
            # The message came from another publisher. Either several publishers send alternately,
            # or a publisher was restarted, so that its numbers begin at 1 again.
            self._has_several_publishers |= continues_other
            self._other_publishers.append(newest)
            self._gap = 0
        elif not self._has_several_publishers:
            self._lost_by_number += self._gap
            self._gap = number - newest - 1

    def _on_message_lost(self, event: Any) -> None:
        self._lost_by_dds = event.total_count


def log_changes(logger: RcutilsLogger, changes: LogChanges) -> None:
    """Write lines to the log: problems as warnings, and the end of problems as information."""
    for line, is_bad in changes:
        # There are two calls, because rclpy requires that one line of code always logs with the
        # same severity.
        if is_bad:
            logger.warning(line)
        else:
            logger.info(line)


def _describe_conditions(bits: int) -> str:
    """Return the faulty conditions of a pad as text, such as "open and noisy".

    Args:
        bits: Bits of the conditions, see `core/status.py`.
    """
    words = [word for bit, word in WORDS.items() if bits & bit]
    return " and ".join(words)


def _find_residual_cause(suspects: list[str] | None) -> str:
    """Return a text with the possible cause of a high residual of a cube.

    Args:
        suspects: Names of the pads any one of which may be faulty; None or empty: none is known.
    """
    if suspects:
        return f"pad {' or '.join(suspects)} may be bad"
    return "a pad is bad, or the load is outside the modes of this layout"
