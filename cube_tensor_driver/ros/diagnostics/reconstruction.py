"""What the reconstruction reports: rows, lost messages, tare, and the health of cubes in words."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus

from ...config.skin import Skin
from ...core.arrays import AnyArray, Mask
from ...core.reconstructor import Reconstructor
from ...core.rows import FrequencyRows, StressRows
from ...core.status import INVALID, LEFT_OUT, WORDS
from ..compat import SubscriptionEventCallbacks
from .updater import make_status

MAX_CUBE_STATUSES = 64
"""Maximum number of statuses of cubes in one message.

On a skin whose hubs are all gone, a status for each of 1000 cubes helps nobody.
"""

MISSING = "missing: no row yet, see its link"

STALE = "stale: no rows any more, see its link"

MIN_UPDATES_TO_LOG = 5
"""Number of updates, one a second, before the log names a cube that has sent nothing yet.

Hubs may start after the node.
"""

MAX_KNOWN_PUBLISHERS = 8
"""Maximum number of publishers of a topic that are told apart by their message numbers."""

LogChanges = list[tuple[str, bool]]
"""Lines for the log, and whether each is bad news."""


class TareState(Protocol):
    """What diagnostics need of tare: uids by cube, and its age in words."""

    uids: dict[int, int]

    def age(self) -> dict[str, str]: ...


class ReconstructionDiagnostics:
    """Makes the statuses of the reconstruction, once a second.

    Attributes:
        refused_messages: Number of messages that were damaged or contradicted themselves.
    """

    def __init__(
        self, skin: Skin, reconstructor: Reconstructor, tare: TareState, lost: LostMessages
    ) -> None:
        self.refused_messages = 0
        self._skin, self._tare, self._lost = skin, tare, lost
        self._cubes = CubeHealth(skin, reconstructor)
        self._rows = self._invalid_rows = 0
        self._rows_before = self._lost_before = 0  # at the last update
        self._was_inactive = False

    def count(self, rows: StressRows) -> None:
        """Count rows that were published."""
        self._rows += len(rows)
        self._invalid_rows += int(np.count_nonzero(rows.status & INVALID))

    def statuses(self, is_active: bool) -> tuple[list[DiagnosticStatus], LogChanges]:
        """Return the statuses, and what changed for the log.

        The first status is about all rows. The others are about cubes that are not fine, or were
        not at the last update. An inactive node processes no rows, which is no fault of the cubes,
        so that it reports none.
        """
        cubes: list[DiagnosticStatus] = []
        changes: LogChanges = []
        if is_active and not self._was_inactive:
            cubes, changes = self._cubes.statuses(self._tare.uids)
        else:  # The node was not active for all of the time since the last update.
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
        has_problem = bool(self.refused_messages) or lost > 0
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
    """Turns what `Health` has found since the last update into words."""

    def __init__(self, skin: Skin, reconstructor: Reconstructor) -> None:
        self._skin, self._pipeline = skin, reconstructor.pipeline
        self._health = reconstructor.health
        self._has_come = np.zeros(len(skin.cubes), bool)
        # Cube -> its words, of those that were not fine: at the last update, and in the log.
        self._reported: dict[int, str] = {}
        self._logged: dict[int, str] = {}
        self._updates = 0

    def statuses(self, uids: Mapping[int, int]) -> tuple[list[DiagnosticStatus], LogChanges]:
        """Return statuses of cubes that are not fine or were not at the last update, and changes.

        Args:
            uids: Index of a cube in the skin -> its uid, where the skin file does not give it.
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
            text = words.get(number, "fine")
            level = int(levels[number]) if number in words else 0
            is_starting = self._updates <= MIN_UPDATES_TO_LOG and text == MISSING
            if text != self._logged.get(number, "fine") and not is_starting:
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
        """Forget what `Health` has found since the last update."""
        self._health.collect()

    def summary(self) -> dict[str, int]:
        """Return how many pads and cubes are in each condition now, without conditions of none."""
        counts = {
            f"pads {word}": int(np.count_nonzero(self._health.state & bit))
            for bit, word in WORDS.items()
        }
        counts["cubes with a residual"] = int(np.count_nonzero(self._health.high_residual))
        return {name: count for name, count in counts.items() if count}

    def _describe_cubes(
        self, cubes: AnyArray, bits: AnyArray, strained: Mask, rows: AnyArray
    ) -> dict[int, str]:
        """Return the words of these cubes, from conditions and numbers of rows of all cubes."""
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
        """Return, for each strained cube, the pads that alone would explain the residual."""
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
    """Counts the messages of a topic that were sent and did not come.

    It counts over one subscription after the other. DDS numbers the messages of each publisher. A
    number that is left out is a message that is gone for good: the network lost it, or it was
    dropped because this process was away longer than its queue holds, which DDS itself tells
    nobody. Where rclpy does not give the numbers, and where several publishers send in turn, only
    what DDS reports as lost is counted.
    """

    def __init__(self) -> None:
        # Lost in earlier subscriptions, by gaps of this one, and as DDS reports for this one.
        self._earlier = self._left_out = self._reported = 0
        self._newest: int | None = None
        # The gap just before the newest number; it counts when its publisher goes on.
        self._gap = 0
        self._other_publishers: deque[int] = deque(maxlen=MAX_KNOWN_PUBLISHERS)
        self._has_several_publishers = False

    @property
    def count(self) -> int:
        """Number of lost messages so far."""
        return self._earlier + max(self._left_out, self._reported)

    def new_subscription(self) -> SubscriptionEventCallbacks:
        """Begin to count for a new subscription, and return the events to make it with."""
        self._earlier, self._left_out, self._reported = self.count, 0, 0
        self._newest, self._gap, self._has_several_publishers = None, 0, False
        self._other_publishers.clear()
        return SubscriptionEventCallbacks(message_lost=self._on_message_lost)

    def note_arrival(self, number: int | None) -> None:
        """Take note of a message that came, and of its number; None: it is not known."""
        newest, self._newest = self._newest, number
        if number is None or newest is None:
            return
        is_next = number == newest + 1
        continues_other = not is_next and number - 1 in self._other_publishers
        if continues_other or number <= newest:
            # From another publisher: one of several, or a new one, which begins at 1.
            self._has_several_publishers |= continues_other
            self._other_publishers.append(newest)
            self._gap = 0
        elif not self._has_several_publishers:
            self._left_out += self._gap
            self._gap = number - newest - 1

    def _on_message_lost(self, event: Any) -> None:
        self._reported = event.total_count


def log_changes(logger: Any, changes: LogChanges) -> None:
    """Log each line; bad news are warnings."""
    for line, is_bad in changes:
        # Two calls, because rclpy ties the level to the line of code that logs.
        if is_bad:
            logger.warning(line)
        else:
            logger.info(line)


def _condition_words(bits: int) -> str:
    """Return the conditions of a pad in words."""
    return " and ".join(word for bit, word in WORDS.items() if bits & bit)


def _residual_cause(suspects: list[str] | None) -> str:
    """Return what may be the cause of a residual, in words."""
    if suspects:
        return f"pad {' or '.join(suspects)} may be bad"
    return "a pad is bad, or the load is outside the modes of this layout"
